"""Mode coupling: the minimal models of Hoffmann et al. and of Sinou and Jezequel."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj
from fractaljax._validate.cases import mode_coupling

from .case import Case, CaseResult, Curve, Panel, closed, self_checked


def _published(mu):
    """The eigenvalues (..., 2) of Hoffmann's model in the upper half plane: s^2 = -2 +- root."""
    root = np.sqrt(np.asarray(1 - 4 * np.asarray(mu) / 3, complex))[..., None]
    s: Any = np.sqrt(-2 + root * np.array([1, -1]))
    return np.where(s.imag < 0, -s, s)


def _hoffmann() -> CaseResult:
    model = mode_coupling()
    mu = np.linspace(0.0125, 1.5, 120)
    eigenvalues = jax.jit(jax.vmap(lambda mu: fj.stability(model.replace(mu=mu)).eigenvalues))
    s: Any = np.asarray(eigenvalues(jnp.asarray(mu)))
    published: Any = _published(mu)
    upper: Any = np.sort_complex(np.where(s.imag > 0, s, np.nan))[:, :2]
    panels = []
    for name, computed, exact in (
        ("frequency [rad/s]", np.sort(upper.imag), np.sort(published.imag)),
        ("growth rate [1/s]", np.sort(upper.real), np.sort(published.real)),
    ):
        curves = []
        for k, labels in enumerate((("Hoffmann et al., in closed form", "fractaljax"), ("", ""))):
            curves += [
                Curve(mu[3::4], exact[3::4, k], labels[0], False),
                Curve(mu, computed[:, k], labels[1], True),
            ]
        panels.append(Panel("friction coefficient mu [-]", name, curves))
    return CaseResult(self_checked("hoffmann"), panels)


# --- with damping -------------------------------------------------------------------------

_W_1, _W_2 = 200 * np.pi, 150 * np.pi  # rad/s


def _damped(eta_1, eta_2) -> fj.ParametricStructure:
    """Springs and dampers press the mass on the belt: both of their forces bring friction."""
    c_1, c_2 = eta_1 * _W_1, eta_2 * _W_2
    damping = [(None, np.diag([c_1, c_2])), ("mu", [[0.0, -c_2], [c_1, 0.0]])]
    stiffness = [(None, np.diag([_W_1**2, _W_2**2])), ("mu", [[0.0, -(_W_2**2)], [_W_1**2, 0.0]])]
    return fj.ParametricStructure(np.eye(2), damping, stiffness, parameters={"mu": 0.2})


def _polynomial(eta_1, eta_2, mu):
    """The coefficients of s^4 to s^0: (s^2 + p_1)(s^2 + p_2) + mu^2 p_1 p_2, p = c s + w^2."""
    p_1, p_2 = [0, eta_1 * _W_1, _W_1**2], [0, eta_2 * _W_2, _W_2**2]
    free = np.polymul(np.add([1, 0, 0], p_1), np.add([1, 0, 0], p_2))
    return np.polyadd(free, mu**2 * np.polymul(p_1, p_2))


def _critical(eta_1, eta_2):
    """The friction where Hurwitz' determinant vanishes; a_2, a_1, a_0 are linear in mu^2."""
    c_1, c_2 = eta_1 * _W_1, eta_2 * _W_2
    a_3, part, a_1 = c_1 + c_2, _W_1**2 + _W_2**2, c_1 * _W_2**2 + c_2 * _W_1**2
    above = a_3 * part * a_1 - (a_3 * _W_1 * _W_2) ** 2
    return np.sqrt(above / (a_1**2 - a_3 * c_1 * c_2 * a_1) - 1)


def _sinou() -> CaseResult:
    growth = jax.jit(jax.vmap(lambda model, mu: fj.growth_rate(model.replace(mu=mu)), (None, 0)))
    mu, checks, curves = np.linspace(0.1, 0.4, 61), [], []
    for eta in ((0.02, 0.02), (0.02, 0.1), (0.1, 0.02), (0.0, 0.0)):
        model, label = _damped(*eta), f"eta = {eta[0]:g}, {eta[1]:g}"
        # Without damping growth leaves rounding as the root of what mu exceeds its critical value.
        least = 0.0 if any(eta) else 1e-6 * _W_1
        low, high = np.array([0.1]), np.array([0.4])
        for _ in range(45):
            middle = (low + high) / 2
            grows = np.asarray(growth(model, jnp.asarray(middle))) > least
            low, high = np.where(grows, low, middle), np.where(grows, middle, high)
        exact = _critical(*eta) if any(eta) else (_W_1**2 - _W_2**2) / (2 * _W_1 * _W_2)
        checks.append(closed(f"critical friction, {label} [-]", exact, high[0], 1e-9))
        roots = [np.roots(_polynomial(*eta, x)).real.max() for x in mu[::4]]
        curves.append(Curve(mu[::4], roots, f"quartic, {label}", False))
        curves.append(Curve(mu, growth(model, jnp.asarray(mu)), f"fractaljax, {label}", True))
    panel = Panel("friction coefficient mu [-]", "growth rate [1/s]", curves)
    return CaseResult(checks, [panel])


CASES = (
    Case(
        "hoffmann",
        "Minimal model of mode coupling",
        "N. Hoffmann, M. Fischer, R. Allgaier, L. Gaul, Mech. Res. Commun. 29, 197 (2002)",
        "10.1016/S0093-6413(02)00254-9",
        _hoffmann,
    ),
    Case(
        "sinou",
        "Mode coupling with damping",
        "J.-J. Sinou, L. Jezequel, Eur. J. Mech. A/Solids 26, 106 (2007)",
        "10.1016/j.euromechsol.2006.03.002",
        _sinou,
    ),
)
