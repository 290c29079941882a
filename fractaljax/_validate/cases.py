"""The cases of the self-check: contact, stability, motion and gradients, each in closed form."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from .._contact.fixed import FixedContact
from .._dynamics.limit_cycle import limit_cycle
from .._friction import Coulomb, HyperbolicStribeck
from .._mechanism.scene import Scene, brake_scene
from .._mechanism.structure import Joint, Structure
from .._stability.critical_friction import critical_friction
from .._stability.stability import growth_rate, stability
from .check import QUADRATURE, STATED, Check, closed


def hurwitz_friction(K_n, kappa):
    """The friction at which Hurwitz' determinant of Eq. 43 vanishes, for the reference brake.

    K_n in N/m; kappa is K_t/K_n.
    """
    w_1, w_2, xi_1, xi_2 = 2000 * np.pi, 1600 * np.pi, 0.001, 0.007
    a, b, c_1, c_2 = w_1**2 + kappa * K_n, w_2**2 + K_n, 2 * xi_1 * w_1, 2 * xi_2 * w_2
    a_3, a_2, a_1 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a
    return np.sqrt(((a_3 * a_2 * a_1 - a_1**2) / a_3**2 - a * b) / (kappa * K_n**2))


def mode_coupling() -> Structure:
    """Hoffmann's minimal model, x'' + [[2, 1 - 4 mu/3], [1, 2]] x = 0."""
    joint = Joint(FixedContact(4 / 3, 0.0, 1.0), Coulomb(0.5), 0, 1, preload=True)
    return Structure(np.eye(2), None, [[2.0, 1.0], [1.0, 2.0 - 4 / 3]], joint)


def falling_friction() -> Structure:
    """Leine's block on a belt, whose friction falls with speed."""
    friction = HyperbolicStribeck(1.0, 3.0)
    joint = Joint(FixedContact(0.0, 0.0, 1.0), friction, tangential=[1.0], V=0.2)
    return Structure([[1.0]], [[0.0]], [[1.0]], joint)


def _reference() -> Sequence[Check]:
    scene = brake_scene()
    log_stiffness, slope = jax.value_and_grad(
        lambda D: jnp.log(scene.replace(D=D).contact.stiffness(0.4, 0.25)[0])
    )(2.4)
    fixed = Scene(FixedContact(4e8, 2e8), Coulomb(0.4), scene.oscillator)
    K_n, by_D = 402628934.2683103, 68.08648087676846
    critical = hurwitz_friction(4e8, 0.5)
    return (
        Check("K_n, Eq. 30 [N/m]", K_n, float(jnp.exp(log_stiffness)), 1e-10 * K_n, QUADRATURE),
        Check("d ln K_n/dD [-]", by_D, float(slope), 1e-10 * by_D, QUADRATURE),
        closed("critical mu, Eq. 43 [-]", critical, critical_friction(fixed), 1e-9),
    )


def _hoffmann() -> Sequence[Check]:
    model = mode_coupling()
    lower, higher = np.sqrt(2 + np.sqrt(1 / 3) * np.array([-1, 1]))  # at mu = 0.5
    frequencies = np.unique(np.round(np.abs(stability(model).eigenvalues.imag), 9))
    growth, slope = jax.value_and_grad(lambda mu: growth_rate(model.replace(mu=mu)))(1.5)
    s = np.sqrt(-2 + 1j)  # at mu = 1.5, where s^2 = -2 + (1 - 4 mu/3)^(1/2)
    return (
        closed("critical friction mu [-]", 3 / 4, critical_friction(model), 1e-9),
        closed("lower frequency at mu = 0.5 [rad/s]", lower, frequencies[0], 1e-8),
        closed("higher frequency at mu = 0.5 [rad/s]", higher, frequencies[-1], 1e-8),
        closed("growth rate at mu = 1.5 [1/s]", s.real, growth, 1e-9),
        closed("d(growth rate)/d(mu) at mu = 1.5 [1/s]", (1j / 3 / s).real, slope, 1e-9),
    )


def _leine() -> Sequence[Check]:
    cycle = limit_cycle(falling_friction(), [0.0, 0.0])
    note = (
        "the initial state 1.133944669704, of whose decimals eight count: SciPy has 1.133944676441"
    )
    quantity = "largest x, as printed [m]"
    return (Check(quantity, 1.133944669704, float(cycle.state[0]), 1e-8, STATED, note),)


CASES: Mapping[str, Callable[[], Sequence[Check]]] = {
    "reference": _reference,
    "hoffmann": _hoffmann,
    "leine": _leine,
}
