"""Draw margin.png: three measures of stability, `python docs/make_margin.py`."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from fractaljax._mechanism.oscillator import Linearised
from fractaljax._stability.margin import margin_of
from fractaljax._stability.quartic import roots

PICTURE = Path(__file__).with_name("margin.png")
POINTS = 401
SMOOTHING = 2e-4  # of the spectral abscissa


def state_matrix(a, b, c_1, c_2, g):
    """A matrix with the characteristic polynomial (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g."""
    h = np.sqrt(g)
    return np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-a, h, -c_1, 0], [-h, -b, 0, -c_2]])


def smoothed_abscissa(matrix, eps):
    """The s at which trace P = 1/eps, (A - s)' P + P (A - s) = -1 (Vanbiervliet et al. 2009).

    doi 10.1137/070704034. By bisection: the trace falls to 0 above the spectral abscissa.
    """
    one = np.eye(len(matrix))
    low = np.linalg.eigvals(matrix).real.max()
    high = low + eps * len(matrix) + np.linalg.norm(matrix, 2)
    for _ in range(60):
        s = (low + high) / 2
        shifted = (matrix - s * one).T
        operator = np.kron(shifted, one) + np.kron(one, shifted)
        P = np.linalg.solve(operator, -one.ravel()).reshape(one.shape)
        low, high = (s, high) if np.trace(P) > 1 / eps else (low, s)
    return (low + high) / 2


@jax.jit
@jax.vmap
def measures(lin: Linearised):
    """Growth rate, least damping ratio and margin."""
    s = roots(lin)
    return s[0].real, (-s.real / jnp.abs(s)).min(), margin_of(lin)


def draw(path=PICTURE) -> None:
    """Measures along mu through an exact exceptional point, and along a damping ratio."""
    from matplotlib.figure import Figure

    # In units of the rms frequency: a + b = 2. Modes coalesce at mu = 0.5, equally damped.
    mu = np.linspace(0.49, 0.51, POINTS)
    xi_1 = np.linspace(0.0, 0.02, POINTS)
    columns = [
        (mu, "friction coefficient µ [-]", (1.1, 0.9, 0.01, 0.01, (0.2 * mu) ** 2), 0.5),
        (
            xi_1,
            "damping ratio ξ₁ [-]",
            (1.2, 0.8, 2 * xi_1 * np.sqrt(1.2), 0.02 * np.sqrt(0.8), 0),
            None,
        ),
    ]
    titles = [
        "growth rate [ω]\n(dashed: smoothed abscissa)",
        "least damping ratio [-]",
        "margin [-]",
    ]
    figure = Figure(figsize=(9.6, 7.2), layout="constrained")
    axes = figure.subplots(3, 2, sharex="col")
    for column, (x, label, numbers, coalescence) in zip(axes.T, columns, strict=True):
        lin = [np.broadcast_to(np.asarray(value, float), x.shape) for value in numbers]
        values = measures(Linearised(*map(jnp.asarray, lin)))
        smoothed = [
            smoothed_abscissa(state_matrix(*one), SMOOTHING) for one in zip(*lin, strict=True)
        ]
        column[0].plot(x, smoothed, color="tab:orange", ls="dashed", lw=1.4)
        for ax, value, title in zip(column, values, titles, strict=True):
            ax.plot(x, np.asarray(value), color="tab:blue", lw=1.6)
            ax.axhline(0, color="0.35", lw=0.8)
            ax.set_ylabel(title)
            if coalescence is not None:
                ax.axvline(coalescence, color="0.35", ls="dotted", lw=1.1)
        column[-1].set_xlabel(label)
        column[-1].locator_params(axis="x", nbins=5)
    axes[0, 0].set_title("through flutter; dotted: the modes coalesce exactly", fontsize="medium")
    axes[0, 1].set_title("two modes, one of which decays faster and faster", fontsize="medium")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    draw()
