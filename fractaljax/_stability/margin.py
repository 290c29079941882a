"""The margin of stability: smooth in a scene, where the growth rate is not.

Where modes coalesce the derivative of an eigenvalue is infinite, and where they cross the largest
real part has a kink. The third Hurwitz determinant of the characteristic polynomial is smooth at
both, being the product of -(lambda_i + lambda_j) over all pairs, but its size says little: for two
modes s^2 + u_i s + v_i it is u_1 u_2 Delta, where Delta, near (v_1 - v_2)^2, measures how far apart
the modes are. Smooth minima with the sign of the true one extract the product u_1 u_2 from that,
and the smaller of u_1 and u_2 from their product and their sum.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, ScalarLike

from .._base.singular import positive_sqrt
from .._mechanism.mechanism import Mechanism
from .._mechanism.oscillator import Linearised, dimensionless
from .._mechanism.quantities import has_memory
from .._mechanism.structure import Structure
from .band import among
from .field_modes import field_modes
from .linearise import assembled, linearised, require_equilibrium
from .quadratic import solve


def margin(
    scene: Mechanism, shift: ScalarLike = 0.0, friction_slope: bool = True
) -> Float[Array, ""]:
    """Margin of stability [-], a scalar: above 0 exactly where the growth rate is below `shift`.

    Its scale is that of a damping ratio. For a scene with lightly damped, well separated modes it
    is 0.5 to 1 times the least decay rate over the rms natural frequency sqrt((a + b)/2) in
    contact; for modes within their damping of each other, about 0.3 times. It is analytic in the
    scene where modes coalesce and where they cross. Only without any damping is it not: there it is
    0 where stable and negative in flutter.

    For a structure, and with friction that has memory, it is the least damping ratio, which has
    kinks where modes cross: a smooth measure of n degrees of freedom takes a Lyapunov equation of
    size 2n. With a shift the ratios are those of the eigenvalues minus the shift. Rigid-body modes
    do not count without a shift.

    **Arguments:**

    - `scene`: a scene or structure of scalars.
    - `shift`: growth rate [1/s] at which the margin is 0, a scalar, 0 by default.
    - `friction_slope`: as in `growth_rate`; the margin is NaN where the growth rate is.

    **Raises:** as `growth_rate`; `TypeError` for a `shift` that is no number.
    """
    kind = jnp.dtype(bool) if shift is None else jnp.result_type(shift)
    if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise TypeError(f"shift must be a real number, got {kind}; friction_slope comes third")
    value = _margin(scene, shift, friction_slope)
    require_equilibrium(scene, friction_slope, value)
    return value


@functools.partial(jax.jit, static_argnums=2)
def _margin(scene, shift, friction_slope):
    if has_memory(scene):
        s = field_modes(scene, friction_slope).s
        return least_damping_ratio(among(s - shift, getattr(scene, "band", None)))
    if isinstance(scene, Structure):
        s = solve(*assembled(scene, friction_slope).matrices).s
        return least_damping_ratio(among(s - shift, scene.band))
    return margin_of(linearised(scene, friction_slope), shift)


def damping_ratios(s: Complex[Array, " k"]) -> Float[Array, " k"]:
    """-Re/|s| of eigenvalues s of any shape, and 0 where s is 0."""
    zero = s == 0
    return jnp.where(zero, 0, -s.real / jnp.abs(jnp.where(zero, 1, s)))


def least_damping_ratio(s: Complex[Array, " k"]) -> Float[Array, ""]:
    """The least damping ratio of all nonzero eigenvalues; 1 if there are none."""
    return jnp.where(s == 0, 1, damping_ratios(s)).min()


@jax.jit
def least(total: jax.Array, product: jax.Array) -> jax.Array:
    """x + y - sqrt(x^2 + y^2) from x + y and x y; any shape. Above 0 exactly where both are.

    Fischer and Burmeister's function (Fischer 1992, doi 10.1080/02331939208843795): analytic except
    at x = y = 0, 0.59 times the smaller of two equal numbers, and the smaller one of two that are
    far apart. At x = y = 0 the derivative is that of x + y. Where no real x and y have this sum
    and product the root is taken as 0.
    """
    root = positive_sqrt(total**2 - 2 * product)
    positive = total > 0
    # total - root would cancel where the result is near 0.
    return jnp.where(positive, 2 * product / jnp.where(positive, total + root, 1), total - root)


@jax.jit
def margin_of(lin: Linearised, shift: ScalarLike = 0.0) -> Float[Array, ""]:
    """`margin` of a linearised scene; `shift` in 1/s.

    With s = shift + z the polynomial is again (z^2 + c_1 z + a)(z^2 + c_2 z + b) + g. With a_3,
    a_2, a_1, a_0 its coefficients, it is stable (Lienard and Chipart) if a_3, a_0, a_1 or a_2 and
    H_3 = a_1 (a_3 a_2 - a_1) - a_3^2 a_0 are positive. E = Delta + 2 (v_1 + v_2) u_1 u_2 +
    (u_1 u_2)^2 is a_2^2 - 4 a_0 + a_3 a_1, so u_1 u_2 is half the smooth minimum of two numbers
    with the sum E and the product 2 H_3. In every stable system E^2 > 4 H_3 as long as
    4 a_2 >= 3 (a + b) before the shift, that is except for shifts beyond critical damping.
    """
    omega, lin = dimensionless(lin)
    shift = shift / omega
    heavy = lin.c_1**2 + lin.c_2**2 + jnp.finfo(omega.dtype).eps ** 2
    a, b = lin.a + shift * (lin.c_1 + shift), lin.b + shift * (lin.c_2 + shift)
    c_1, c_2, g = lin.c_1 + 2 * shift, lin.c_2 + 2 * shift, lin.g
    a_3, a_2, a_1, a_0 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g
    # H_3 and E by their factors: as polynomials in the coefficients they would cancel.
    separation = (a - b) ** 2 + a_3 * a_1
    H_3 = c_1 * c_2 * separation - a_3**2 * g
    # With damping of both signs beyond critical, a_2 < 0, H_3 can be positive again: prevent that.
    H_3 = H_3 - a_3 * a_1 * jnp.minimum(a_2, 0)
    E = separation - 4 * g + 2 * c_1 * c_2 * (a + b) + (c_1 * c_2) ** 2
    u = least(a_3, least(E, 2 * H_3) / 2)
    # A single real eigenvalue passes the shift where a_0 = 0, which takes heavy damping.
    u = least(u * heavy + a_0, u * heavy * a_0) / heavy
    return u / jnp.sqrt(2.0)
