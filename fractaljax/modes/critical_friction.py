"""The friction at which a mechanism starts to squeal.

The polynomial (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g has a pair of imaginary roots where the
coupling g, proportional to mu^2, reaches g_c = c_1 c_2/(c_1 + c_2)^2 [(a - b)^2 + (c_1 + c_2)
(c_1 b + c_2 a)]: a Hopf bifurcation. Where only g depends on friction that is a closed form. The
slope of the friction law changes the damping as well and a fractal joint its stiffness: then the
first root along friction is bracketed and polished, with the implicit derivative.
"""

import functools

import jax
import jax.numpy as jnp

from ..base.parts import flag, require_scalar
from ..base.singular import positive_sqrt, safe_divide
from ..mechanism.contact import MU_M_MAX
from ..mechanism.oscillator import Linearised, dimensionless, linearise
from ..mechanism.quantities import sliding_friction, with_friction_times
from ..mechanism.scene import Scene, require_kind, stiffness

_FACTORS = 512  # of friction, looked at for the first root
_HALVINGS = 50


def critical_coupling(lin: Linearised) -> jax.Array:
    """g_c [1/s^4], the coupling at which a pair of eigenvalues is imaginary.

    Without damping, where it depends on how the damping vanishes, that of equal damping:
    (a - b)^2/4, where the modes coalesce.
    """
    a_3, a_1 = lin.c_1 + lin.c_2, lin.c_1 * lin.b + lin.c_2 * lin.a
    half = jnp.full_like(a_3, 0.5)
    # Not of products, whose powers in a derivative underflow in a float32.
    share = safe_divide(lin.c_1, a_3, half) * safe_divide(lin.c_2, a_3, half)
    return share * ((lin.a - lin.b) ** 2 + a_3 * a_1)


def coupling_reserve(lin: Linearised) -> jax.Array:
    """(g_c - g)/(a + b)^2 [-], below 0 exactly where an eigenvalue has a positive real part.

    Smooth on the scale of stiffness, not of damping, unlike the growth rate and the margin: what
    Newton's method wants. Where a direction is driven it is negative whatever g_c.
    """
    _, lin = dimensionless(lin)
    reserve = critical_coupling(lin) - lin.g
    return jnp.where((lin.c_1 < 0) | (lin.c_2 < 0), -jnp.abs(reserve), reserve)


def critical_frequency(lin: Linearised) -> jax.Array:
    """Frequency [Hz] of the imaginary pair where g = g_c: omega^2 = a_1/a_3."""
    a_3, a_1 = lin.c_1 + lin.c_2, lin.c_1 * lin.b + lin.c_2 * lin.a
    return positive_sqrt(safe_divide(a_1, a_3, (lin.a + lin.b) / 2)) / (2 * jnp.pi)


def linearised(scene: Scene, friction_slope: bool) -> Linearised:
    """The characteristic polynomial of a scene, its stiffness included."""
    K_n, K_t = stiffness(scene)
    return linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope)


@functools.partial(jax.jit, static_argnames="friction_slope")
def critical_friction(scene: Scene, friction_slope: bool = True) -> jax.Array:
    """Friction coefficient mu(V) at which the scene starts to squeal [-], a scalar.

    With a `FixedContact` and friction that has no slope, or `friction_slope=False`, the closed
    form mu_c = m sqrt(g_c/(K_n K_t)), infinite where K_n or K_t is 0. Otherwise the friction law
    as a whole is multiplied by a factor, so that mu_s, mu_m and its slope grow together, and the
    joint answers as it does in `stiffness`: K_t of a fractal joint depends on mu_s, its critical
    area on mu_m. The first friction that squeals is looked for from 1/500 to 500 times that of
    the scene, as far as Eq. 19 goes (mu_m <= 0.9): 0 if the least squeals already, infinite if
    none does, NaN where it is out of what can be computed. To hold the stiffness,
    `scene.replace(contact=FixedContact(*stiffness(scene)))`.

    The derivative is that of the root, and 0 where it is 0 or infinite.

    **Raises:** `ValueError` if the scene holds arrays: use `jax.vmap`.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    sloping = flag("friction_slope", friction_slope) and scene.friction.velocity_dependent
    if sloping or scene.contact.fractal:
        factor = _first_factor(scene, friction_slope)
        none = factor == jnp.inf
        return jnp.where(none, jnp.inf, sliding_friction(scene) * jnp.where(none, 1, factor))
    lin = linearised(scene, friction_slope=False)
    K_n, K_t = stiffness(scene)
    m = scene.oscillator.m
    omega, lin = dimensionless(lin)
    coupling = positive_sqrt(K_n / m / omega**2 * (K_t / m / omega**2))
    infinite = jnp.full_like(coupling, jnp.inf)
    return safe_divide(positive_sqrt(critical_coupling(lin)), coupling, infinite)


def _reserve(scene, factor, friction_slope):
    return coupling_reserve(linearised(with_friction_times(scene, factor), friction_slope))


def _along(scene, factor, friction_slope):
    """The reserve at a factor of the friction law, and its derivative by that."""
    return jax.jvp(
        lambda x: _reserve(scene, x, friction_slope), (factor,), (jnp.ones_like(factor),)
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _first_factor(scene, friction_slope):
    """The least factor of the friction law that squeals; 0 if any does, infinite if none."""
    x = (jnp.arange(_FACTORS, dtype=scene.oscillator.m.dtype) + 0.5) / _FACTORS
    factors = x / (1 - x)
    if scene.contact.fractal:
        lowest = scene.friction.mu_m
        factors = jnp.minimum(
            factors, safe_divide(MU_M_MAX, lowest, jnp.full_like(lowest, jnp.inf))
        )
    reserves = jax.vmap(lambda factor: _reserve(scene, factor, friction_slope))(factors)
    # What cannot be computed is not taken for stable: the first of those makes the root NaN.
    squeals = ~(reserves >= 0)
    first = jnp.argmax(squeals)

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        inside = ~(_reserve(scene, middle, friction_slope) >= 0)
        return jnp.where(inside, low, middle), jnp.where(inside, middle, high)

    ends = factors[jnp.maximum(first - 1, 0)], factors[first]
    _, factor = jax.lax.fori_loop(0, _HALVINGS, halve, ends)
    value, slope = _along(scene, factor, friction_slope)
    step = safe_divide(value, slope, jnp.zeros_like(value))
    # Eq. 19 has a step, where no root needs be.
    factor = factor - jnp.where(jnp.abs(step) < 1e-6 * factor, step, 0)
    root = jnp.where(squeals[0], 0, jnp.where(squeals[first], factor, jnp.inf))
    return jnp.where(jnp.isnan(reserves[first]), jnp.nan, root)


@_first_factor.defjvp
def _first_factor_jvp(friction_slope, primals, tangents):
    # Implicit differentiation; by pieces that can be differentiated again.
    (scene,), (dscene,) = primals, tangents
    factor = _first_factor(scene, friction_slope)
    inside = (factor > 0) & (factor < jnp.inf)
    at = jnp.where(inside, factor, 1)
    _, dreserve = jax.jvp(lambda s: _reserve(s, at, friction_slope), (scene,), (dscene,))
    _, slope = _along(scene, at, friction_slope)
    return factor, -jnp.where(inside, safe_divide(dreserve, slope, jnp.zeros_like(slope)), 0)
