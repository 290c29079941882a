"""The friction at which a mechanism starts to squeal.

(s^2 + c_1 s + a)(s^2 + c_2 s + b) + g has a pair of imaginary roots where the coupling g,
proportional to mu^2, reaches g_c = c_1 c_2/(c_1 + c_2)^2 [(a - b)^2 + (c_1 + c_2)(c_1 b + c_2 a)]:
a Hopf bifurcation. Where only g depends on friction that is a closed form. The slope of the
friction law changes the damping as well, and a fractal joint its stiffness. Then the first root
along friction is bracketed and polished, and differentiated implicitly.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._base.parts import flag, require_scalar
from .._base.singular import positive_sqrt, safe_divide
from .._contact.contact import MU_M_MAX
from .._mechanism.oscillator import (
    Linearised,
    dimensionless,
    linearise,
    static_normal_force,
)
from .._mechanism.quantities import sliding_friction, with_friction_times
from .._mechanism.scene import Scene, require_kind, stiffness
from .linearise import linearised

_FACTORS = 512  # of the friction law, among which the first root is bracketed
_BISECTIONS = 50


def critical_coupling(lin: Linearised) -> Float[Array, ""]:
    """g_c [1/s^4], the coupling at which a pair of eigenvalues is imaginary.

    Without damping it depends on how the damping vanishes: that of equal damping, (a - b)^2/4,
    where the modes coalesce.
    """
    a_3, a_1 = lin.c_1 + lin.c_2, lin.c_1 * lin.b + lin.c_2 * lin.a
    half = jnp.full_like(a_3, 0.5)
    # Two quotients: products of dampings would underflow in derivatives in float32.
    share = safe_divide(lin.c_1, a_3, half) * safe_divide(lin.c_2, a_3, half)
    return share * ((lin.a - lin.b) ** 2 + a_3 * a_1)


def hopf_test_function(lin: Linearised) -> Float[Array, ""]:
    """(g_c - g)/(a + b)^2 [-], below 0 exactly where an eigenvalue has a positive real part.

    It varies on the scale of the stiffness, unlike the growth rate and the margin, which vary on
    that of the damping. That suits Newton's method. Negative where a direction has negative
    damping, whatever g_c.
    """
    _, lin = dimensionless(lin)
    value = critical_coupling(lin) - lin.g
    return jnp.where((lin.c_1 < 0) | (lin.c_2 < 0), -jnp.abs(value), value)


def critical_frequency(lin: Linearised) -> Float[Array, ""]:
    """Frequency [Hz] of the imaginary pair where g = g_c: omega^2 = a_1/a_3."""
    a_3, a_1 = lin.c_1 + lin.c_2, lin.c_1 * lin.b + lin.c_2 * lin.a
    return positive_sqrt(safe_divide(a_1, a_3, (lin.a + lin.b) / 2)) / (2 * jnp.pi)


@functools.partial(jax.jit, static_argnames="friction_slope")
def critical_friction(scene: Scene, friction_slope: bool = True) -> Float[Array, ""]:
    """Friction coefficient mu(V) at which the scene starts to squeal [-], a scalar.

    With a `FixedContact` and friction that has no slope, or `friction_slope=False`, the closed
    form mu_c = m sqrt(g_c/(K_n K_t)), infinite where K_n or K_t is 0. Otherwise the friction law
    as a whole is multiplied by a factor, so that mu_s, mu_m and its slope grow together, and the
    contact follows as in `stiffness`: K_t of a fractal joint depends on mu_s, its critical area on
    mu_m. The first friction that squeals is searched from 1/500 to 500 times that of the scene, up
    to the limit of Eq. 19 (mu_m <= 0.9): 0 if the least squeals already, infinite if none does,
    NaN where it cannot be computed, and where a preloaded joint opens first. To hold the stiffness,
    `scene.replace(contact=FixedContact(*stiffness(scene)))`, with its P if it is preloaded.

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
    K_n, K_t = stiffness(scene)
    m = scene.oscillator.m
    lin = linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope=False)
    omega, lin = dimensionless(lin)
    coupling = positive_sqrt(K_n / m / omega**2 * (K_t / m / omega**2))
    infinite = jnp.full_like(coupling, jnp.inf)
    found = safe_divide(positive_sqrt(critical_coupling(lin)), coupling, infinite)
    if scene.normal_load is None:
        return found
    # Its sign changes at most once as friction grows: closed there, it is closed below.
    mu = jax.lax.stop_gradient(jnp.where(found == jnp.inf, 0, found))
    N = static_normal_force(scene.oscillator, K_n, K_t, mu, scene.normal_load)
    return jnp.where(N > 0, found, jnp.nan)


def _test(scene, factor, friction_slope):
    """The Hopf test function with the friction law times a factor."""
    return hopf_test_function(linearised(with_friction_times(scene, factor), friction_slope))


def _test_and_slope(scene, factor, friction_slope):
    """The test function, and its derivative by the factor."""
    return jax.jvp(lambda x: _test(scene, x, friction_slope), (factor,), (jnp.ones_like(factor),))


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
    values = jax.vmap(lambda factor: _test(scene, factor, friction_slope))(factors)
    # NaN does not count as stable: it makes the root NaN if it comes first.
    squeals = ~(values >= 0)
    first = jnp.argmax(squeals)

    def bisect(_, ends):
        low, high = ends
        middle = (low + high) / 2
        inside = ~(_test(scene, middle, friction_slope) >= 0)
        return jnp.where(inside, low, middle), jnp.where(inside, middle, high)

    ends = factors[jnp.maximum(first - 1, 0)], factors[first]
    _, factor = jax.lax.fori_loop(0, _BISECTIONS, bisect, ends)
    value, slope = _test_and_slope(scene, factor, friction_slope)
    step = safe_divide(value, slope, jnp.zeros_like(value))
    # At the step of Eq. 19 the sign can change without a root.
    factor = factor - jnp.where(jnp.abs(step) < 1e-6 * factor, step, 0)
    root = jnp.where(squeals[0], 0, jnp.where(squeals[first], factor, jnp.inf))
    return jnp.where(jnp.isnan(values[first]), jnp.nan, root)


@_first_factor.defjvp
def _first_factor_jvp(friction_slope, primals, tangents):
    # The implicit function, in operations that can be differentiated again.
    (scene,), (dscene,) = primals, tangents
    factor = _first_factor(scene, friction_slope)
    inside = (factor > 0) & (factor < jnp.inf)
    at = jnp.where(inside, factor, 1)
    _, change = jax.jvp(lambda s: _test(s, at, friction_slope), (scene,), (dscene,))
    _, slope = _test_and_slope(scene, at, friction_slope)
    return factor, -jnp.where(inside, safe_divide(change, slope, jnp.zeros_like(slope)), 0)
