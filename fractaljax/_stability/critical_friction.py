"""The friction at which a mechanism starts to squeal.

(s^2 + c_1 s + a)(s^2 + c_2 s + b) + g has a pair of imaginary roots where the coupling g,
proportional to mu^2, reaches g_c = c_1 c_2/(c_1 + c_2)^2 [(a - b)^2 + (c_1 + c_2)(c_1 b + c_2 a)]:
a Hopf bifurcation. Where only g depends on friction that is a closed form. The slope of the
friction law changes the damping as well, and a fractal joint its stiffness. Then the first root
along friction is bracketed and polished, and differentiated implicitly. A structure takes that way
with the test function of `critical_pair.py`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.parts import brief, concrete, flag, nan_where
from .._base.programs import exported_jit
from .._base.singular import positive_sqrt, safe_divide
from .._contact.contact import MU_M_MAX
from .._mechanism.joint import Joint
from .._mechanism.mechanism import Mechanism
from .._mechanism.oscillator import dimensionless, linearise, static_normal_force
from .._mechanism.quantities import (
    has_memory,
    require_one,
    require_sliding,
    with_friction_times,
)
from .._mechanism.scene import Scene, stiffness
from .critical_pair import least_test
from .field_modes import linearised_with_memory
from .linearise import assembled, linearised
from .two_directions import critical_coupling


def critical_friction(
    scene: Mechanism, friction_slope: bool = True, joint: str | None = None
) -> Float[Array, ""]:
    """Friction coefficient mu(V) at which the scene or structure starts to squeal [-], a scalar.

    With a `FixedContact` and friction without a slope, the closed form mu_c = m sqrt(g_c/(K_n
    K_t)), infinite where K_n or K_t is 0. Otherwise the friction law as a whole is multiplied by a
    factor, so that mu_s, mu_m and its slope grow together, and the contact follows as in
    `stiffness`: K_t of a fractal joint depends on mu_s, its critical area on mu_m. The first
    friction that squeals is searched from 1/1000 to 1000 times that of the scene, up to the limit
    of Eq. 19 (mu_m <= 0.9): 0 if the least squeals already, infinite if none does, NaN where it
    cannot be computed, and where a preloaded joint opens first. To hold the stiffness,
    `scene.replace(contact=FixedContact(*stiffness(scene)))`, with its P if it is preloaded.

    For a structure, one factor scales the friction of all joints, and the equilibrium follows.
    Squeal begins by flutter or by static divergence (a real eigenvalue). The factor is the root of
    the Hopf test function of n degrees of freedom (`critical_pair.py`) between two of 512 factors
    f, evenly spaced in f/(1 + f): an interval of squeal narrower than that can be missed. Each
    takes a full eigenvalue solution. Friction with memory takes that way too, in a scene as well,
    with the eigenvalues of the Jacobian of its field.

    The derivative is that of the root, and 0 where it is 0 or infinite.

    **Arguments:**

    - `scene`: a scene or structure of scalars.
    - `friction_slope`: False leaves the slope of friction out of growth rates.
    - `joint`: name of the joint of a structure at whose sliding velocity mu is meant; by default
      all joints share that mu. The other coefficients keep their proportion to it.

    **Raises:** `ValueError` if the scene holds arrays: use `jax.vmap`; for a structure without
    joints, a `joint` that it does not have, or none where friction differs between them (NaN under
    a trace).
    """
    require_one("scene", scene)
    scene = require_sliding(scene, "for steady sliding")
    sloping = flag("friction_slope", friction_slope)
    if scene.uncoupled:
        if joint is not None:
            raise ValueError(f"joint names one of a structure, got {brief(joint)} for a scene")
        return _critical_friction_of_scene(scene, sloping)
    coefficient = _coefficient(scene, joint)
    factor = _factor_of_structure(scene, sloping)
    return jnp.where(factor == jnp.inf, jnp.inf, coefficient * _finite(factor))


def _finite(factor):
    return jnp.where(factor == jnp.inf, 1, factor)


def _coefficient(structure: Any, name: str | None) -> Array:
    """mu at the sliding velocity of the named joint, or the one that all joints share."""
    names = ", ".join(structure.joint_names)
    if not structure.joints:
        raise ValueError("critical_friction needs a joint, and the structure has none")
    if name is not None:
        if name not in structure.joint_names:
            raise ValueError(f"the structure has no joint {brief(name)}; it has {names}")
        return _sliding(structure.joints[structure.joint_names.index(name)])
    first, *others = map(_sliding, structure.joints)
    message = f"joint must be given, for friction differs between the joints: {names}"
    for other in others:
        values = concrete(first), concrete(other)
        if values[0] is None or values[1] is None:
            first = nan_where(first != other, first)
        elif values[0] != values[1]:
            raise ValueError(message)
    return first


_sliding = jax.jit(Joint.coefficient)


@functools.partial(exported_jit, static_argnames="friction_slope")
def _factor_of_structure(structure, friction_slope):
    factor, _ = _first_factor(structure, friction_slope)
    if has_memory(structure):
        return factor
    # Beyond a static divergence there is an equilibrium again: look for it before.
    least = assembled(with_friction_times(structure, 1e-3), friction_slope)
    return factor + 0 * least.C[0, 0]


@functools.partial(exported_jit, static_argnames="friction_slope")
def _critical_friction_of_scene(scene: Scene, friction_slope: bool) -> Float[Array, ""]:
    sloping = friction_slope and scene.friction.velocity_dependent
    closed = not (sloping or scene.follows_load_curve or has_memory(scene))
    if scene.contact.depends_on_friction or not closed:
        factor, _ = _first_factor(scene, friction_slope)
        return jnp.where(factor == jnp.inf, jnp.inf, scene.coefficient() * _finite(factor))
    K_n, K_t = stiffness(scene)
    m = scene.oscillator.m
    lin = linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope=False)
    omega, lin = dimensionless(lin)
    coupling = positive_sqrt(K_n / m / omega**2 * (K_t / m / omega**2))
    infinite = jnp.full_like(coupling, jnp.inf)
    critical_mu = safe_divide(positive_sqrt(critical_coupling(lin)), coupling, infinite)
    if scene.normal_load is None:
        return critical_mu
    # Its sign changes at most once as friction grows: closed there, it is closed below.
    mu = jax.lax.stop_gradient(jnp.where(critical_mu == jnp.inf, 0, critical_mu))
    N = static_normal_force(scene.oscillator, K_n, K_t, mu, scene.normal_load)
    return jnp.where(N > 0, critical_mu, jnp.nan)


class _FactorSearch(NamedTuple):
    """The search for the first factor of the friction that squeals: at `high`, not at `low`."""

    low: jax.Array
    high: jax.Array  # infinite before it is bracketed
    value: jax.Array  # at `high`: not below 0 if a joint opens first, perhaps NaN
    least: jax.Array  # whether the least factor squeals
    rounds: jax.Array
    refined: jax.Array  # rounds since it is bracketed
    rigid: jax.Array | None  # eigenvalues of rigid-body modes, of a structure


def _test(x, factor, friction_slope, rigid):
    """The Hopf test function with each friction law times a factor."""
    scaled = with_friction_times(x, factor)
    return linearised(scaled, friction_slope, refuse=False).hopf_test(rigid)


def _signs(x, factors, friction_slope, rigid):
    """Numbers (k,) with the sign of the test, True where a joint is open (k,), and `rigid`.

    One for each factor (k,). A number is 0 where rounding decides the sign. Rigid-body modes are
    those at the first factor, the least; later ones mean divergence.
    """
    if has_memory(x):

        def value_at(factor):
            scaled = with_friction_times(x, factor)
            return linearised_with_memory(scaled, friction_slope).least_test()

        values = jax.vmap(value_at)(factors)
        return values, jnp.isnan(values), rigid
    if x.uncoupled:
        values = jax.vmap(lambda f: _test(x, f, friction_slope, None))(factors)
        return values, jnp.isnan(values), None

    def modes_at(factor):
        attached = assembled(with_friction_times(x, factor), friction_slope, refuse=False)
        return attached.solve(), attached

    modes, attached = jax.vmap(modes_at)(factors)
    rigid = jnp.where(rigid < 0, (modes.s[0] == 0).sum(), rigid)
    over = jax.vmap(least_test, (0, 0, 0, None, None))
    values = over(modes, attached.C, attached.K, rigid, x.band)
    return values, jax.vmap(lambda system: system.open)(attached), rigid


def _lattice(x):
    """The factors (512,) among which the first root is bracketed."""
    dtype = jax.tree.leaves(x)[0].dtype
    share = (jnp.arange(512, dtype=dtype) + 0.5) / 512
    factors = share / (1 - share)
    for part in x.joints_by_name().values():
        if part.contact.yields:
            lowest = part.friction.mu_m
            most = safe_divide(MU_M_MAX, lowest, jnp.full_like(lowest, jnp.inf))
            factors = jnp.minimum(factors, most)
    return factors


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _first_factor(x: Any, friction_slope: bool):
    """The least factor of the friction that squeals; 0 if any does, infinite if none.

    Also the number of rigid-body eigenvalues of a structure.
    """
    # Eight factors are evaluated together; once there is a bracket, eight divide it into nine.
    groups = _lattice(x).reshape(-1, 8)
    inner = (jnp.arange(8, dtype=groups.dtype) + 1) / 9

    def onward(at):
        bracketed = at.high < jnp.inf
        # Twelve divisions leave 9^-12 of the bracket.
        return jnp.where(bracketed, at.refined < 12, at.rounds < len(groups))

    def search(at):
        bracketed = at.high < jnp.inf
        between = at.low + inner * (jnp.where(bracketed, at.high, at.low) - at.low)
        factors = jnp.where(bracketed, between, groups[jnp.minimum(at.rounds, len(groups) - 1)])
        values, lifted, rigid = _signs(x, factors, friction_slope, at.rigid)
        squeals = ~(values >= 0) | lifted  # NaN does not count as stable
        first, some = jnp.argmax(squeals), squeals.any()
        last = jnp.where(some, factors[first - 1], factors[-1])
        return _FactorSearch(
            low=jnp.where(some & (first == 0), at.low, last),
            high=jnp.where(some, factors[first], at.high),
            value=jnp.where(some, values[first], at.value),
            least=at.least | (some & (first == 0) & (at.rounds == 0)),
            rounds=at.rounds + 1,
            refined=at.refined + bracketed,
            rigid=rigid,
        )

    zero, number = jnp.zeros((), groups.dtype), jnp.zeros((), int)
    rigid = None if x.uncoupled else number - 1
    start = _FactorSearch(zero, zero + jnp.inf, zero - 1, zero > 0, number, number, rigid)
    final = jax.lax.while_loop(onward, search, start)
    bracketed = final.high < jnp.inf
    factor = jnp.where(bracketed, final.high, 1)
    value, slope = jax.jvp(
        lambda f: _test(x, f, friction_slope, final.rigid), (factor,), (jnp.ones_like(factor),)
    )
    step = safe_divide(value, slope, jnp.zeros_like(value))
    # At the step of Eq. 19 the sign can change without a root.
    factor = factor - jnp.where(jnp.abs(step) < 1e-6 * factor, step, 0)
    root = jnp.where(final.least, 0, jnp.where(bracketed, factor, jnp.inf))
    return jnp.where(final.value < 0, root, jnp.nan), final.rigid


@_first_factor.defjvp
def _first_factor_jvp(friction_slope, primals, tangents):
    # The implicit function, in operations that can be differentiated again.
    (x,), (dx,) = primals, tangents
    factor, rigid = _first_factor(x, friction_slope)
    inside = (factor > 0) & (factor < jnp.inf)
    at = jnp.where(inside, factor, 1)
    test = lambda x, f: _test(x, f, friction_slope, rigid)  # noqa: E731
    _, linear = jax.linearize(test, x, at)
    change = linear(dx, jnp.zeros_like(at))
    slope = linear(jax.tree.map(jnp.zeros_like, dx), jnp.ones_like(at))
    none = jnp.where(jnp.isnan(factor), jnp.nan, 0)
    tangent = -jnp.where(inside, safe_divide(change, slope, jnp.zeros_like(slope)), none)
    fixed = None if rigid is None else np.zeros(rigid.shape, jax.dtypes.float0)
    return (factor, rigid), (tangent, fixed)
