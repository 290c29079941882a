"""The Hopf test function of n degrees of freedom, smooth where two modes coalesce.

Let sigma +- sqrt(delta) be the eigenvalues of two modes with decay rates u_1 and u_2, and
p = -Re sigma. Then

    T = p^2 - Re delta - (Im delta/(2 p))^2 = u_1 u_2 (p^2 + y^2)/p^2,   y = Im sqrt(delta),

is 0 exactly where one of them is imaginary. As (g_c - g) of two directions it varies on the scale
of the stiffness however light the damping, and is analytic through coalescence. Every mode has it
with its nearest neighbour; the least of them decides. Near coalescence sigma and delta are means
over a circle around both eigenvalues, which lose no digits there:

    sum_i f(s_i) = 1/(2 pi i) oint f(z) tr[Q^-1(z) Q'(z)] dz,   Q(z) = z^2 M + z C + K,

or Q(z) = z I - J of a field with the Jacobian J.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .band import in_band
from .quadratic import Modes, solve


class CriticalPair(NamedTuple):
    """The mode that decides, and what a boundary shows of it."""

    test: Float[Array, ""]  # T [1/s^2], below 0 exactly where a mode grows
    frequency: Float[Array, ""]  # [Hz], where T = 0
    growth_rate: Float[Array, ""]  # [1/s]
    damping: Float[Array, "2"]  # the two least damping ratios


class _Kind(NamedTuple):
    """What kind of problem has these eigenvalues."""

    conservative: jax.Array  # whether nothing damps
    hysteretic: bool  # whether damping is structural

    @classmethod
    def of(cls, C, K) -> "_Kind":
        """That of matrices."""
        conservative, hysteretic = ~(C != 0).any(), jnp.iscomplexobj(K)
        if hysteretic:
            conservative &= ~(K.imag != 0).any()
        return cls(conservative, hysteretic)

    @classmethod
    def of_field(cls) -> "_Kind":
        """That of a Jacobian."""
        return cls(jnp.zeros((), bool), False)


class _Choice(NamedTuple):
    """T of every mode with its nearest neighbour."""

    test: Float[Array, " k"]  # infinite for rigid-body modes and second ones of conjugate pairs
    counted: jax.Array  # (k,) all but rigid-body modes
    partner: Int[Array, " k"]
    alone: jax.Array  # (k,) whether the neighbour is the conjugate: T = u |s|
    undamped: jax.Array  # (k,) whether p is 0


def critical_pair(
    M: Float[Array, "n n"],
    C: Float[Array, "n n"],
    K: Float[Array, "n n"],
    C_error: Float[Array, "n n"] | None,
    rigid: Int[Array, ""],
    band: tuple[float, float] | None = None,
) -> CriticalPair:
    """T of the mode where it is least, the `rigid` eigenvalues of least modulus left out.

    Rigid-body eigenvalues are 0 at any friction; another one that is 0 means divergence. With a
    `band` only modes in it count.
    """
    unit = jax.lax.stop_gradient(1 / jnp.sqrt(jnp.diagonal(M)))
    scaled = [X * unit[:, None] * unit[None] for X in (M, C, K)]

    def trace(z):
        M, C, K = scaled
        return jnp.trace(jnp.linalg.solve(z**2 * M + z * C + K, 2 * z * M + C))

    s = solve(M, C, K, C_error).s
    return _critical_among(s, trace, rigid, _Kind.of(C, K), band)


def critical_pair_of_field(
    J: Float[Array, "k k"], s: Complex[Array, " k"], band: tuple[float, float] | None = None
) -> CriticalPair:
    """As `critical_pair`, for the eigenvalues s of the Jacobian J [1/s] of a field."""

    def trace(z):
        one = jnp.eye(len(J), dtype=z.dtype)
        return jnp.trace(jnp.linalg.solve(z * one - J, one))

    return _critical_among(s, trace, jnp.zeros((), int), _Kind.of_field(), band)


def _critical_among(
    s: Complex[Array, " k"],
    trace: Callable[[Any], Array],
    rigid: Int[Array, ""],
    kind: "_Kind",
    band: tuple[float, float] | None,
) -> CriticalPair:
    """T of the mode of least T, with tr[Q^-1(z) Q'(z)] as a function of z."""
    fixed = jax.lax.stop_gradient(s)
    chosen = _choice(fixed, rigid, kind, band)
    i = jnp.argmin(chosen.test)
    j, alone, undamped = (x[i] for x in (chosen.partner, chosen.alone, chosen.undamped))
    sigma, delta = _mean_and_spread(trace, s, i, j)
    test = jnp.where(alone, _alone(s[i].real, jnp.abs(fixed[i])), hopf_test(sigma, delta, undamped))
    splitting = _quotient(delta.imag, 2 * -sigma.real, undamped)
    imaginary = jnp.where(alone, fixed[i].imag, sigma.imag + splitting)
    real = (fixed[j] == fixed[i].conj()) | ((fixed[i].imag == 0) & (fixed[j].imag == 0))
    imaginary = jnp.where(real & ~alone, 0, imaginary)
    ratios = -fixed.real / jnp.where(fixed == 0, 1, jnp.abs(fixed))
    ratios = jnp.where(chosen.counted & (fixed.imag >= 0), ratios, jnp.inf)
    first = jnp.argmin(ratios)
    second = jnp.where(jnp.arange(len(s)) == first, jnp.inf, ratios).min()
    return CriticalPair(
        test=jnp.where(jnp.isnan(fixed).any(), jnp.nan, test),
        frequency=jnp.abs(imaginary) / (2 * jnp.pi),
        growth_rate=jnp.where(chosen.counted, fixed.real, -jnp.inf).max(),
        damping=jnp.stack([ratios[first], second]),
    )


def least_test(
    modes: Modes,
    C: Float[Array, "n n"],
    K: Float[Array, "n n"],
    rigid: Int[Array, ""],
    band: tuple[float, float] | None = None,
) -> Float[Array, ""]:
    """T [1/s^2] as in `critical_pair`, without derivatives; 0 if rounding may decide its sign."""
    return _least_test(modes.s, modes.error, rigid, _Kind.of(C, K), band)


def least_test_of_field(
    s: Complex[Array, " k"], error: Float[Array, " k"], band: tuple[float, float] | None = None
) -> Float[Array, ""]:
    """As `least_test`, for the eigenvalues of a Jacobian and their rounding errors."""
    return _least_test(s, error, jnp.zeros((), int), _Kind.of_field(), band)


def _least_test(s, error, rigid, kind, band):
    test = _choice(s, rigid, kind, band).test
    test = jnp.where(jnp.abs(s.real) <= error, jnp.maximum(test, 0), test).min()
    return jnp.where(jnp.isnan(s).any(), jnp.nan, test)


def _choice(s: Complex[Array, " k"], rigid, kind: _Kind, band) -> _Choice:
    conservative = kind.conservative
    place, size = jnp.arange(len(s)), jnp.abs(s)
    smaller = (size[None] < size[:, None]) | (
        (size[None] == size[:, None]) & (place[None] < place[:, None])
    )
    counted = smaller.sum(axis=1) >= rigid
    distance = jnp.abs(s[:, None] - s[None])
    distance = jnp.where(counted[None] & (place[None] != place[:, None]), distance, jnp.inf)
    partner = jnp.argmin(distance, axis=1)
    sigma, delta = (s + s[partner]) / 2, ((s - s[partner]) / 2) ** 2
    # Exactly 0 where C = 0, but for neighbours of which one grows alone.
    coalesced, single = jnp.finfo(size.dtype).eps ** 0.5, _resolution(size.dtype)
    undamped = jnp.abs(sigma.real) <= jnp.where(conservative, coalesced, single) * size
    alone = (s.imag > 0) & (s[partner] == s.conj()) & ~(undamped & conservative)
    if kind.hysteretic:  # static divergence, of the problem without K_loss
        alone |= (s.imag == 0) & (s.real > 0)
    test = jnp.where(alone, _alone(s.real, size), hopf_test(sigma, delta, undamped))
    counted &= in_band(s, band)
    test = jnp.where(counted & (s.imag >= 0), test, jnp.inf)
    return _Choice(test, counted, partner, alone, undamped)


def _resolution(dtype):
    """The damping ratio that may be rounding."""
    return 1e3 * jnp.finfo(dtype).eps


def _alone(growth, size):
    """T = u |s| of a mode whose neighbour is its conjugate, above 0 if it may be undamped."""
    return (_resolution(size.dtype) * size - growth) * size


def hopf_test(sigma, delta, undamped):
    """T of two modes with mean and spread sigma and delta, -|T| where p < 0: both modes grow.

    If they are `undamped`, T is the value at p = 0 with equal damping.
    """
    p = -sigma.real
    ratio = _quotient(delta.imag, 2 * p, undamped)
    # Without damping T is that of equal damping, which vanishes where the modes coalesce.
    test = jnp.where(undamped, 0, p**2) - delta.real - ratio**2
    return jnp.where((p < 0) & ~undamped, -jnp.abs(test), test)


def _quotient(x, y, none):
    return jnp.where(none, 0, x / jnp.where(none, 1, y))


def _mean_and_spread(trace, s, i, j):
    """sigma and delta of the modes i and j."""
    fixed = jax.lax.stop_gradient(s)
    place, middle = jnp.arange(len(s)), (fixed[i] + fixed[j]) / 2
    half = jnp.abs(fixed[i] - fixed[j]) / 2
    others = jnp.where((place == i) | (place == j), jnp.inf, jnp.abs(fixed - middle)).min()
    separated = 16.0  # times closer than any other mode: with 32 nodes the error is 4^-32
    others = jnp.minimum(others, separated * (jnp.abs(middle) + half))
    coalescing = separated * half <= others
    # Around the first alone where the second is as far as others; `solve` has s = 0 exactly.
    nearest = jnp.where(place == i, jnp.inf, jnp.abs(fixed - fixed[i])).min()
    least = jnp.sqrt(jnp.finfo(half.dtype).eps) * jnp.abs(fixed).max()
    radius = jnp.maximum(jnp.where(coalescing, others, nearest) / 4, least)
    first, second = _moments(trace, jnp.where(coalescing, middle, fixed[i]), radius)
    alone = fixed[i] + first
    sigma = jnp.where(coalescing, middle + first / 2, (alone + s[j]) / 2)
    spread = jnp.where(coalescing, second / 2 - first**2 / 4, ((alone - s[j]) / 2) ** 2)
    return sigma, spread


def _moments(trace, centre, radius):
    """Sums of z and of z^2 of the eigenvalues in a circle, z being relative to its centre."""
    nodes = 32
    step = radius * jnp.asarray(np.exp(2j * np.pi * (np.arange(nodes) + 0.5) / nodes), centre.dtype)
    traces = jax.vmap(trace)(centre + step)
    return tuple((traces * step**k).mean() for k in (2, 3))
