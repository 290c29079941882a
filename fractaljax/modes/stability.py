"""Does it squeal: eigenvalues of the linearised oscillator in closed form.

The characteristic polynomial (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g, in units of sqrt(a + b), is
the product of two real quadratics. Shifted by the mean damping these are z^2 +- alpha z + beta,
with alpha^2 the largest root of Ferrari's resolvent cubic in closed form. That start loses what is
small beside alpha or the damping. Newton steps on the remainder of a division by one of the two
(Bairstow's method), which see the polynomial by its factors above and lose nothing, restore it:
two of them suffice. No LAPACK, no loop over eigenvalues, derivatives of every order.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.parts import Record
from ..base.singular import polynomial, positive_sqrt, safe_divide
from ..mechanism.oscillator import Linearised, dimensionless, linearise
from ..mechanism.quantities import sliding_friction
from ..mechanism.scene import Scene, stiffness
from ..mechanism.structure import Structure
from .complex_modes import ComplexModes, complex_modes, growth_rate_of_structure
from .margin import margin_of

_NEWTON_STEPS = 2
_SMALL = 1e-3
# cos(2/3 arccos x) on [0, 1], highest power first; 2e-7 off at most.
_COSINE_OF_THIRD = [
    -0.00214345,
    0.01062305,
    -0.02653822,
    0.05154791,
    -0.11082304,
    0.57733346,
    0.50000016,
]


class Stability(Record):
    """Linear stability of a scene about its sliding equilibrium, as `stability` returns it."""

    eigenvalues: jax.Array  # (4,) complex [1/s], largest real part first
    growth_rate: jax.Array  # largest real part [1/s]; > 0: it squeals
    frequency: jax.Array  # of the eigenvalue with the largest real part [Hz]
    damping_ratio: jax.Array  # of the same eigenvalue, -Re/|lambda|
    margin: jax.Array  # smooth in the scene; > 0 exactly where stable, see `margin`


class _Quadratic(eqx.Module):
    """s^2 + u s + v, in units of omega."""

    u: jax.Array
    v: jax.Array


def _cosine_of_third(x):
    """cos(arccos(x)/3) to 2e-7, for -1 <= x <= 1: a polynomial in cos(arccos(x)/2)."""
    return polynomial(_COSINE_OF_THIRD, jnp.sqrt((1 + x) / 2))


def _rough_cbrt(x):
    """Cube root of x >= 0 to 1e-5, by functions that compilers vectorise."""
    x = x.astype(jnp.float32)
    return jnp.where(x > 0, jnp.exp(jnp.log(jnp.where(x > 0, x, 1)) / 3), 0)


def _alpha(p, q, e):
    """The largest alpha >= 0 with alpha^6 + 2 p alpha^4 + e alpha^2 - q^2 = 0, roughly.

    Ferrari's resolvent of z^4 + p z^2 + q z + r, with e = p^2 - 4 r.
    """
    # Without its cubic term, when that is small: the usual, lightly damped case.
    root = positive_sqrt(e**2 + 8 * p * q**2)
    light = safe_divide(
        jnp.where(e > 0, 2 * q**2, root - e), jnp.where(e > 0, e + root, 4 * p), jnp.zeros_like(e)
    )
    # Else in closed form, trigonometric or Cardano's, to a third of the digits.
    P, Q = e - 4 * p**2 / 3, 16 * p**3 / 27 - 2 * p * e / 3 - q**2
    discriminant = Q**2 / 4 + (P / 3) ** 3
    radius = positive_sqrt(-P / 3)
    cosine = jnp.clip(safe_divide(-Q / 2, radius**3, jnp.ones_like(Q)), -1, 1)
    three = 2 * radius * _cosine_of_third(cosine)
    cube = jnp.abs(Q / 2) + positive_sqrt(discriminant)
    u = jnp.where(Q > 0, -1, 1) * _rough_cbrt(cube).astype(Q.dtype)
    one = u - safe_divide(P / 3, u, jnp.zeros_like(u))
    closed = jnp.where(discriminant > 0, one, three) - 2 * p / 3
    # Where alpha^2 is of this size, either of the two has three digits right at least.
    small = (p > 0) & (light <= _SMALL * p)
    # The same where it is the only root, whatever the sign of p.
    small |= (discriminant > 0) & (2 * root > e) & (light**2 <= _SMALL * e)
    square = jnp.maximum(jnp.where(small, light, closed), 0)
    # One of Newton's steps doubles them.
    value = ((square + 2 * p) * square + e) * square - q**2
    slope = (3 * square + 4 * p) * square + e
    return positive_sqrt(square - safe_divide(value, slope, jnp.zeros_like(value)))


class _Division(eqx.Module):
    """The characteristic polynomial divided by a quadratic, with remainder r_1 s + r_0."""

    r_1: jax.Array
    r_0: jax.Array
    apart_1: jax.Array  # the quotient minus the divisor, apart_1 s + apart_0
    apart_0: jax.Array

    def resultant(self, by: _Quadratic) -> jax.Array:
        """Of quotient and divisor: 0 where they share a root."""
        T, E = self.apart_1, self.apart_0
        return (E - by.u * T) * E + by.v * T**2


def _divide(lin: Linearised, by: _Quadratic) -> _Division:
    # Each factor is reduced first: (p_1 s + q_1)(p_2 s + q_2) + g, which cancels nothing.
    p_1, q_1, p_2, q_2 = lin.c_1 - by.u, lin.a - by.v, lin.c_2 - by.u, lin.b - by.v
    apart_1, apart_0 = p_1 + p_2, q_1 + q_2 + p_1 * p_2
    return _Division(
        r_1=p_1 * q_2 + p_2 * q_1 - by.u * (p_1 * p_2),
        r_0=q_1 * q_2 + lin.g - by.v * (p_1 * p_2),
        apart_1=apart_1,
        apart_0=apart_0,
    )


def _remainder(by: _Quadratic, division: _Division):
    return (by.u**2 + jnp.abs(by.v)) * division.r_1**2 + division.r_0**2


@jax.jit
def _newton_step(lin: Linearised, old: _Quadratic, division: _Division):
    """A step towards a divisor without remainder, kept if it makes the remainder smaller."""
    T, E = division.apart_1, division.apart_0
    scale = safe_divide(jnp.ones_like(T), division.resultant(old), jnp.zeros_like(T))
    new = _Quadratic(
        old.u + (E * division.r_1 - T * division.r_0) * scale,
        old.v + (old.v * T * division.r_1 + (E - old.u * T) * division.r_0) * scale,
    )
    new_division = _divide(lin, new)
    better = _remainder(old, new_division) < _remainder(old, division)
    return jax.tree.map(lambda x, y: jnp.where(better, x, y), (new, new_division), (old, division))


def _split(lin: Linearised) -> tuple[jax.Array, _Quadratic, _Quadratic]:
    """omega = sqrt(a + b) and two quadratics in its units; the second has the larger damping."""
    omega, lin = dimensionless(lin)
    sigma, d = (lin.c_1 + lin.c_2) / 4, (lin.c_1 - lin.c_2) / 2
    # Shifted by the mean damping: (z^2 + d z + A)(z^2 - d z + B) + g.
    A, B = lin.a - sigma**2 - d * sigma, lin.b - sigma**2 + d * sigma
    p, q = A + B - d**2, d * (B - A)
    e = (A - B) ** 2 - 2 * d**2 * (A + B) + d**4 - 4 * lin.g
    alpha = _alpha(p, q, e)
    # beta_2 - beta_1 = q/alpha; where alpha vanishes it is the square root of e.
    vanishing = alpha < jnp.finfo(alpha.dtype).eps ** 2
    gap = jnp.where(vanishing, positive_sqrt(e), q / jnp.where(vanishing, 1, alpha))
    divisor = _Quadratic(2 * sigma - alpha, (p + alpha**2 + gap) / 2 + sigma * (sigma - alpha))
    division = _divide(lin, divisor)
    # Damping can swamp alpha; then the factor with less of it, which leaves g, starts better.
    lighter = lin.c_1 < lin.c_2
    own = _Quadratic(jnp.where(lighter, lin.c_1, lin.c_2), jnp.where(lighter, lin.a, lin.b))
    own_division = _Division(
        jnp.zeros_like(lin.g),
        lin.g,
        jnp.abs(2 * d),
        jnp.where(lighter, lin.b - lin.a, lin.a - lin.b),
    )
    better = (lin.g * division.resultant(divisor)) ** 2 < _remainder(
        divisor, division
    ) * own_division.resultant(own) ** 2
    divisor, division = jax.tree.map(
        lambda x, y: jnp.where(better, x, y), (own, own_division), (divisor, division)
    )
    for _ in range(_NEWTON_STEPS):
        divisor, division = _newton_step(lin, divisor, division)
    quotient = _Quadratic(divisor.u + division.apart_1, divisor.v + division.apart_0)
    return omega, divisor, quotient


def _roots(quadratic: _Quadratic):
    """Larger and smaller real part of the two roots, and their imaginary part."""
    half, size = quadratic.u / 2, positive_sqrt(quadratic.v)
    # Where the roots are close, half^2 - v would be rounding, and another one in every kernel.
    discriminant = jnp.where(size > 0, (half - size) * (half + size), half**2 - quadratic.v)
    apart = positive_sqrt(discriminant)
    # The root of smaller modulus from the product of both: -half + apart would cancel.
    far = jnp.where(half < 0, apart - half, -half - apart)
    near = jnp.where(apart > 0, safe_divide(quadratic.v, far, jnp.zeros_like(far)), -half)
    return jnp.maximum(near, far), jnp.minimum(near, far), positive_sqrt(-discriminant)


def _eigenvalue_tangents(lin: Linearised, dlin: Linearised, s):
    """ds = -dchi/chi'(s) for the roots s of chi = (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g."""
    omega, lin = dimensionless(lin)
    z = s / omega
    first = z * (z + lin.c_1) + lin.a
    second = z * (z + lin.c_2) + lin.b
    slope = (2 * z + lin.c_1) * second + (2 * z + lin.c_2) * first
    change = (
        (dlin.a / omega + dlin.c_1 * z) * second
        + (dlin.b / omega + dlin.c_2 * z) * first
        + dlin.g / omega**3
    )
    # Where eigenvalues coalesce exactly the derivative is infinite: stay finite.
    size = slope.real**2 + slope.imag**2
    return -change * slope.conj() / jnp.maximum(size, jnp.finfo(size.dtype).eps ** 2)


@jax.custom_jvp
def _critical_eigenvalue(lin: Linearised):
    """The eigenvalue with the largest real part and no negative imaginary one, complex [1/s]."""
    omega, *quadratics = _split(lin)
    (high, _, imag), (other_high, _, other_imag) = map(_roots, quadratics)
    first = high >= other_high
    # Parts by themselves: where the real one alone is wanted, the other is not computed.
    return jax.lax.complex(
        omega * jnp.where(first, high, other_high), omega * jnp.where(first, imag, other_imag)
    )


@_critical_eigenvalue.defjvp
def _critical_eigenvalue_jvp(primals, tangents):
    (lin,), (dlin,) = primals, tangents
    s = _critical_eigenvalue(lin)
    return s, _eigenvalue_tangents(lin, dlin, s)


@jax.custom_jvp
def _eigenvalues(lin: Linearised):
    """All four eigenvalues [1/s], the largest real part first."""
    omega, *quadratics = _split(lin)
    s = []
    for high, low, imag in map(_roots, quadratics):
        s += [(high, imag), (low, -imag)]
    # Two sorted pairs are merged by three comparisons.
    for i, j in ((0, 2), (1, 3), (1, 2)):
        s[i], s[j] = _larger_first(s[i], s[j])
    # Not stacked: XLA then computes all of the above again for every element.
    place = jnp.arange(4)
    real, imag = (
        jnp.where(place == 0, a, jnp.where(place == 1, b, jnp.where(place == 2, c, d)))
        for a, b, c, d in zip(*s, strict=True)
    )
    return omega * jax.lax.complex(real, imag)


def _larger_first(s, other):
    """Two eigenvalues (real, imaginary), the larger real part first; of conjugates the upper."""
    conjugate = (s[0] == other[0]) & (s[1] == -other[1])
    swap = (other[0] > s[0]) | (conjugate & (other[1] > 0))
    first = tuple(jnp.where(swap, y, x) for x, y in zip(s, other, strict=True))
    second = tuple(jnp.where(swap, x, y) for x, y in zip(s, other, strict=True))
    return first, second


@_eigenvalues.defjvp
def _eigenvalues_jvp(primals, tangents):
    (lin,), (dlin,) = primals, tangents
    s = _eigenvalues(lin)
    return s, _eigenvalue_tangents(lin, dlin, s)


def require_computable(scene: Scene, friction_slope: bool = True) -> None:
    """Refuse a scene whose growth rate or margin is NaN, naming what left the range of numbers.

    **Raises:** `ValueError` as said.
    """
    K_n, K_t = stiffness(scene)
    lin = linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope)
    if jnp.isfinite(growth_rate_of_linearised(lin)) and jnp.isfinite(margin_of(lin)):
        return
    size = jnp.sqrt(lin.a + lin.b)
    found = {
        "K_n [N/m]": K_n,
        "K_t [N/m]": K_t,
        "the friction at V": sliding_friction(scene),
        "(K_t/m + omega_1^2) [1/s^2]": lin.a,
        "(K_n/m + omega_2^2) [1/s^2]": lin.b,
        "the damping of x1 [1/s]": lin.c_1,
        "the damping of x2 [1/s]": lin.c_2,
        "the coupling mu^2 K_n K_t/m^2 [1/s^4]": lin.g,
    }
    names = [name for name, value in found.items() if not jnp.isfinite(value)]
    if not names:
        ratios = {name: jnp.abs(found[name]) / size for name in list(found)[-3:-1]}
        ratios[list(found)[-1]] = lin.g**0.25 / size
        names = [max(ratios, key=lambda name: float(ratios[name]))]
    raise ValueError(
        f"stability cannot be computed in {size.dtype}: {names[0]} is {found[names[0]]:.6g}"
    )


def _damping_ratio(s):
    """-Re/|s|, and 0 where s is."""
    rest = s == 0
    return jnp.where(rest, 0, -s.real / jnp.abs(jnp.where(rest, 1, s)))


@functools.partial(jax.jit, static_argnames="friction_slope")
def growth_rate(scene: Scene | Structure, friction_slope: bool = True) -> jax.Array:
    """Largest real part of the eigenvalues [1/s], a scalar; above 0 the scene squeals.

    `friction_slope=False` leaves out the slope of the friction law, as the source's Eq. 43 does.
    Towards coalescing eigenvalues the derivative grows without bound, as it must; exactly there,
    where it is infinite, some finite number stands for it. Where numbers leave the range in which
    a sign can be told (`dimensionless`) it is NaN. A `Structure` takes LAPACK's route.

    **Raises:** `ValueError` if the scene holds arrays: use `jax.vmap`; or if a structure without F
    has friction with a slope.
    """
    if isinstance(scene, Structure):
        return growth_rate_of_structure(scene, friction_slope)
    K_n, K_t = stiffness(scene)
    return growth_rate_of(scene, K_n, K_t, friction_slope)


def growth_rate_of(scene: Scene, K_n, K_t, friction_slope: bool) -> jax.Array:
    """`growth_rate` where the stiffness of the contact is known already."""
    lin = linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope)
    return growth_rate_of_linearised(lin)


def growth_rate_of_linearised(lin: Linearised) -> jax.Array:
    """Largest real part of the roots of a characteristic polynomial [1/s], a scalar."""
    return _critical_eigenvalue(lin).real


@functools.partial(jax.jit, static_argnames="friction_slope")
def stability(scene: Scene | Structure, friction_slope: bool = True) -> Stability | ComplexModes:
    """Eigenvalues of Eq. 43 and what follows from them; arguments and errors as `growth_rate`."""
    if isinstance(scene, Structure):
        return complex_modes(scene, friction_slope)
    K_n, K_t = stiffness(scene)
    lin = linearise(scene.oscillator, scene.friction, K_n, K_t, friction_slope)
    eigenvalues = _eigenvalues(lin)
    return Stability(
        eigenvalues=eigenvalues,
        growth_rate=eigenvalues[0].real,
        frequency=jnp.abs(eigenvalues[0].imag) / (2 * jnp.pi),
        damping_ratio=_damping_ratio(eigenvalues[0]),
        margin=margin_of(lin),
    )
