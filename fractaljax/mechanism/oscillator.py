"""The mass on a belt: two directions coupled by friction (Eq. 39)."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.parts import Part, brief, flag, number, quantity
from .friction import Friction


class Oscillator(Part):
    """A mass on springs and dampers in two directions, pressed on a belt by F under 45 degrees.

    K_i = m omega_i^2 and C_i = 2 xi_i omega_i m, without the contact.

    **Raises:** `ValueError` unless m, omega_1, omega_2, V > 0, xi_1, xi_2 >= 0 and F is finite.
    """

    m: jax.Array = quantity("kg", "mass")
    omega_1: jax.Array = quantity("rad/s", "natural frequency along the belt, without contact")
    omega_2: jax.Array = quantity("rad/s", "natural frequency normal to it, without contact")
    xi_1: jax.Array = quantity("-", "damping ratio along the belt")
    xi_2: jax.Array = quantity("-", "damping ratio normal to it")
    F: jax.Array = quantity("N", "external force")
    V: jax.Array = quantity("m/s", "belt velocity")

    def __init__(self, m, omega_1, omega_2, xi_1, xi_2, F, V):
        self.m = number("m", m, above=0)
        self.omega_1 = number("omega_1", omega_1, above=0)
        self.omega_2 = number("omega_2", omega_2, above=0)
        self.xi_1 = number("xi_1", xi_1, at_least=0)
        self.xi_2 = number("xi_2", xi_2, at_least=0)
        self.F = number("F", F)
        self.V = number("V", V, above=0)


class Linearised(eqx.Module):
    """(s^2 + c_1 s + a)(s^2 + c_2 s + b) + g: the characteristic polynomial of two directions."""

    a: jax.Array  # omega_1^2 + K_t/m [1/s^2]
    b: jax.Array  # omega_2^2 + K_n/m [1/s^2]
    c_1: jax.Array  # damping of direction 1 [1/s]
    c_2: jax.Array  # damping of direction 2 [1/s]
    g: jax.Array  # product of the two couplings, mu^2 K_n K_t/m^2 [1/s^4]


def equilibrium(oscillator: Oscillator, K_n, K_t, mu) -> tuple[jax.Array, jax.Array]:
    """Eq. 40 as the linear system it comes from: the static displacements (x_01, x_02) [m].

    [[K_1 + K_t, -mu K_n], [mu K_t, K_2 + K_n]] x_0 = [F, -F]/sqrt(2); its determinant is positive.

    **Raises:** `TypeError` for what is no `Oscillator`; `ValueError` unless K_n >= 0, K_t >= 0 and
    mu is finite.
    """
    if not isinstance(oscillator, Oscillator):
        raise TypeError(f"oscillator must be an Oscillator, got {brief(oscillator)}")
    K_n, K_t = number("K_n", K_n, at_least=0), number("K_t", K_t, at_least=0)
    return static_displacements(oscillator, K_n, K_t, number("mu", mu))


def static_displacements(oscillator: Oscillator, K_n, K_t, mu) -> tuple[jax.Array, jax.Array]:
    """As `equilibrium`, without checks."""
    # In flexibilities: the determinant itself and its square leave the range of a float32.
    r_1 = 1 / (oscillator.m * oscillator.omega_1**2 + K_t)
    r_2 = 1 / (oscillator.m * oscillator.omega_2**2 + K_n)
    n, t = mu * K_n * r_2, mu * K_t * r_1
    f = oscillator.F / jnp.sqrt(2.0) / (1 + n * t)
    return f * (1 - n) * r_1, -f * (1 + t) * r_2


def linearise(
    oscillator: Oscillator, friction: Friction, K_n, K_t, friction_slope: bool = True
) -> Linearised:
    """Eq. 43 about the equilibrium, at sliding velocity V; with the friction law's slope if asked.

    The slope adds mu'(V) K_n x_02/m to the damping of direction 1 and -mu'(V) K_t x_01/m to that
    of direction 2. A law without slope traces neither of them, nor the equilibrium.
    """
    m = oscillator.m
    mu = friction.coefficient(oscillator.V) if friction.velocity_dependent else friction.mu_s
    c_1 = 2 * oscillator.xi_1 * oscillator.omega_1
    c_2 = 2 * oscillator.xi_2 * oscillator.omega_2
    if flag("friction_slope", friction_slope) and friction.velocity_dependent:
        x_01, x_02 = static_displacements(oscillator, K_n, K_t, mu)
        slope = friction.slope(oscillator.V)
        c_1 = c_1 + slope * K_n * x_02 / m
        c_2 = c_2 - slope * K_t * x_01 / m
    return Linearised(
        a=oscillator.omega_1**2 + K_t / m,
        b=oscillator.omega_2**2 + K_n / m,
        c_1=c_1,
        c_2=c_2,
        g=mu**2 * (K_n / m) * (K_t / m),
    )


def dimensionless(lin: Linearised) -> tuple[jax.Array, Linearised]:
    """omega = sqrt(a + b), and the system in its units: no power leaves the range of a float32.

    omega is NaN, and so is what follows from it, where rounding leaves no sign to be trusted:
    damping above 1/sqrt(eps) omega (6.7e7 omega; 2.9e3 omega in float32), coupling above
    omega^4/eps, and numbers that overflowed.
    """
    omega = jnp.sqrt(lin.a + lin.b)
    square = 1 / omega**2  # omega^4 stays in the range, but the square of it in a derivative not
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
