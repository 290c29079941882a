"""The mass on the belt: two directions coupled by friction (Eq. 39)."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Numbers, Part, concrete, flag, number, quantity, require_kind
from .._friction import Friction


def belt_velocity(V: Any) -> Numbers:
    """A sliding velocity V of at least 0 as an array; one that is traced must be above 0."""
    return number("V", V, above=0) if concrete(V) is None else number("V", V, at_least=0)


class Oscillator(Part):
    """A mass on springs and dampers in two directions, pressed on a belt by F at 45 degrees.

    Without the contact, K_i = m omega_i^2 and C_i = 2 xi_i omega_i m.

    With V = 0 nothing slides by itself: there is no steady sliding, and motions need an excitation.

    **Raises:** `ValueError` unless m, omega_1, omega_2 > 0, xi_1, xi_2, V >= 0 and F is finite. A V
    that is traced becomes NaN unless it is above 0.
    """

    m: Numbers = quantity("kg", "mass", log=True)
    omega_1: Numbers = quantity(
        "rad/s", "natural frequency along the belt, without contact", log=True
    )
    omega_2: Numbers = quantity(
        "rad/s", "natural frequency normal to it, without contact", log=True
    )
    xi_1: Numbers = quantity("-", "damping ratio along the belt")
    xi_2: Numbers = quantity("-", "damping ratio normal to it")
    F: Numbers = quantity("N", "external force")
    V: Numbers = quantity("m/s", "belt velocity", log=True)

    def __init__(
        self,
        m: ArrayLike,
        omega_1: ArrayLike,
        omega_2: ArrayLike,
        xi_1: ArrayLike,
        xi_2: ArrayLike,
        F: ArrayLike,
        V: ArrayLike,
    ):
        self.m = number("m", m, above=0)
        self.omega_1 = number("omega_1", omega_1, above=0)
        self.omega_2 = number("omega_2", omega_2, above=0)
        self.xi_1 = number("xi_1", xi_1, at_least=0)
        self.xi_2 = number("xi_2", xi_2, at_least=0)
        self.F = number("F", F)
        self.V = belt_velocity(V)


class Linearised(eqx.Module):
    """(s^2 + c_1 s + a)(s^2 + c_2 s + b) + g: the characteristic polynomial of two directions."""

    a: Float[Array, ""]  # omega_1^2 + K_t/m [1/s^2]
    b: Float[Array, ""]  # omega_2^2 + K_n/m [1/s^2]
    c_1: Float[Array, ""]  # damping of direction 1 [1/s]
    c_2: Float[Array, ""]  # damping of direction 2 [1/s]
    g: Float[Array, ""]  # product of the two couplings, mu^2 K_n K_t/m^2 [1/s^4]


def equilibrium(
    oscillator: Oscillator,
    K_n: ArrayLike,
    K_t: ArrayLike,
    mu: ArrayLike,
    P: ArrayLike | None = None,
) -> tuple[Numbers, Numbers]:
    """The static displacements (x_01, x_02) [m] of Eq. 40, from its linear system.

    [[K_1 + K_t, -mu K_n], [mu K_t, K_2 + K_n]] x_0 = [F, -F]/sqrt(2); its determinant is positive.

    **Arguments**, of any shapes that broadcast:

    - `oscillator`: the mass on the belt.
    - `K_n`, `K_t`: normal and tangential contact stiffness [N/m].
    - `mu`: friction coefficient [-].
    - `P`: load of a preloaded joint [N], whose friction mu P is added to the first component; by
      default there is none.

    **Raises:** `TypeError` unless given an `Oscillator`; `ValueError` unless K_n >= 0, K_t >= 0, P
    > 0 and mu is finite.
    """
    require_kind("oscillator", oscillator, Oscillator)
    K_n, K_t = number("K_n", K_n, at_least=0), number("K_t", K_t, at_least=0)
    P = None if P is None else number("P", P, above=0)
    return static_displacements(oscillator, K_n, K_t, number("mu", mu), P)


def static_displacements(
    oscillator: Oscillator,
    K_n: ArrayLike,
    K_t: ArrayLike,
    mu: ArrayLike,
    P: ArrayLike | None = None,
) -> tuple[Numbers, Numbers]:
    """As `equilibrium`, without checks."""
    # In flexibilities, because the determinant and its square leave the range of a float32.
    r_1 = 1 / (oscillator.m * oscillator.omega_1**2 + K_t)
    r_2 = 1 / (oscillator.m * oscillator.omega_2**2 + K_n)
    n, t = mu * K_n * r_2, mu * K_t * r_1
    f = oscillator.F / jnp.sqrt(2.0) / (1 + n * t)
    x_1, x_2 = f * (1 - n) * r_1, -f * (1 + t) * r_2
    if P is None:
        return x_1, x_2
    along = mu * P * r_1 / (1 + n * t)
    return x_1 + along, x_2 - mu * K_t * r_2 * along


def static_normal_force(
    oscillator: Oscillator, K_n: ArrayLike, K_t: ArrayLike, mu: ArrayLike, P: ArrayLike
) -> Array:
    """P + K_n x_02 [N] of a preloaded joint at its equilibrium, at most 0 if it is open.

    With r_i the flexibilities 1/(K_1 + K_t) and 1/(K_2 + K_n) it is
    [P - K_n r_2 (1 + mu K_t r_1) F/sqrt(2)]/(1 + mu^2 K_n K_t r_1 r_2), without loss of digits.
    """
    r_1 = 1 / (oscillator.m * oscillator.omega_1**2 + K_t)
    r_2 = 1 / (oscillator.m * oscillator.omega_2**2 + K_n)
    n, t = mu * K_n * r_2, mu * K_t * r_1
    lifting = K_n * r_2 * (1 + t) * oscillator.F / jnp.sqrt(2.0)
    return (jnp.asarray(P) - lifting) / (1 + n * t)


def linearise(
    oscillator: Oscillator,
    friction: Friction,
    K_n: ArrayLike,
    K_t: ArrayLike,
    friction_slope: bool = True,
    P: ArrayLike | None = None,
    static: tuple[Array, Array] | None = None,
) -> Linearised:
    """Eq. 43 about the equilibrium at sliding velocity V, optionally with the friction slope.

    The slope adds mu'(V) N_0/m to the damping of direction 1 and -mu'(V) K_t x_01/m to that of
    direction 2, where N_0 is K_n x_02, or P + K_n x_02 for a joint with the preload P. Instead,
    `static` may hold (x_01, N_0), with K_n the slope of the load curve there. A law without slope
    traces neither these terms nor the equilibrium, except with a preload: where N_0 <= 0 the joint
    is open, and c_1 is NaN.
    """
    m, V = oscillator.m, oscillator.V
    mu = friction.mu(V) if friction.velocity_dependent else friction.kinetic_limit()
    c_1 = 2 * oscillator.xi_1 * oscillator.omega_1
    c_2 = 2 * oscillator.xi_2 * oscillator.omega_2
    N = None if static is None else static[1]
    if static is None and P is not None:
        N = static_normal_force(oscillator, K_n, K_t, mu, P)
    if flag("friction_slope", friction_slope) and friction.velocity_dependent:
        slope = friction.slope(V)
        if static is None:
            x_01, x_02 = static_displacements(oscillator, K_n, K_t, mu, P)
            pull = K_n * x_02 if N is None else N
        else:
            x_01, pull = static
        c_1 = c_1 + slope * pull / m
        c_2 = c_2 - slope * K_t * x_01 / m
    if N is not None:
        c_1 = jnp.where(N > 0, c_1, jnp.nan)
    return Linearised(
        a=oscillator.omega_1**2 + K_t / m,
        b=oscillator.omega_2**2 + K_n / m,
        c_1=c_1,
        c_2=c_2,
        g=mu**2 * (K_n / m) * (K_t / m),
    )


def dimensionless(lin: Linearised) -> tuple[Float[Array, ""], Linearised]:
    """omega = sqrt(a + b), and the system in its units: no power leaves the range of a float32.

    omega and all results from it are NaN where rounding hides the sign of the growth rate: damping
    above 1/sqrt(eps) omega (6.7e7 omega; 2.9e3 omega in float32), coupling above omega^4/eps, and
    numbers that overflowed.
    """
    omega = jnp.sqrt(lin.a + lin.b)
    square = 1 / omega**2  # omega^4 is in range, but its square in a derivative is not
    damping = jnp.maximum(jnp.abs(lin.c_1), jnp.abs(lin.c_2)) / omega
    coupling = lin.g * square * square
    most = float(jnp.finfo(omega.dtype).eps) ** -0.5
    omega = jnp.where((damping < most) & (coupling < most**2), omega, jnp.nan)
    return omega, Linearised(
        a=lin.a / omega**2,
        b=lin.b / omega**2,
        c_1=lin.c_1 / omega,
        c_2=lin.c_2 / omega,
        g=coupling,
    )
