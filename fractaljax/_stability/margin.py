"""The margin of stability: smooth in a scene, where the growth rate is not.

Where modes coalesce the derivative of an eigenvalue is infinite, and where they cross the largest
real part has a kink. The third Hurwitz determinant of the characteristic polynomial is smooth at
both, being the product of -(lambda_i + lambda_j) over all pairs, but its size says little: for two
modes s^2 + u_i s + v_i it is u_1 u_2 Delta, where Delta, near (v_1 - v_2)^2, measures how far apart
the modes are. Smooth minima with the sign of the true one extract the product u_1 u_2 from that,
and the smaller of u_1 and u_2 from their product and their sum.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, ScalarLike

from .._base.singular import positive_sqrt
from .._mechanism.oscillator import Linearised, dimensionless


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
