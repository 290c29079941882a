"""Eqs. 31 and 37: the stiffness of a fractal joint over E sqrt(A_a), A_a being its nominal area.

Areas are relative to A_a: A_r* = A_r/A_a, a_e* = a_e/A_a; any shape.
"""

import jax.numpy as jnp
from jaxtyping import ArrayLike

from .._base.parts import Numbers, number
from .fractal import area_moment, normal_stiffness, tangential_stiffness


def dimensionless_normal_stiffness(D: ArrayLike, A_r: ArrayLike, a_e: ArrayLike) -> Numbers:
    """Eq. 31: K_n* = K_n/(E sqrt(A_a)) from A_r* and a_e*.

    **Arguments**, of any shapes that broadcast:

    - `D`: fractal dimension [-].
    - `A_r`: real contact area over the nominal one, A_r* [-].
    - `a_e`: critical area over the nominal one, a_e* [-]; it may be infinite.

    **Raises:** `ValueError` unless 2 < D < 3, A_r > 0 and a_e > 0.
    """
    D, J_half = _root_area_moment(D, A_r, a_e)
    return normal_stiffness(D, 1.0, J_half)


def dimensionless_tangential_stiffness(
    D: ArrayLike, nu: ArrayLike, A_r: ArrayLike, a_e: ArrayLike, slip_ratio: ArrayLike
) -> Numbers:
    """Eq. 37: K_t* = K_t/(E sqrt(A_a)) from A_r*, a_e* and the slip ratio.

    The source's text normalises by the shear modulus; its equation, followed here, by E.

    **Arguments**, of any shapes that broadcast:

    - `D`: fractal dimension [-].
    - `nu`: Poisson's ratio [-].
    - `A_r`: real contact area over the nominal one, A_r* [-].
    - `a_e`: critical area over the nominal one, a_e* [-]; it may be infinite.
    - `slip_ratio`: Q_e*/(mu P*) [-], at least 1 in gross slip, where K_t* is 0.

    **Raises:** `ValueError` unless 2 < D < 3, 0 <= nu <= 0.5, A_r > 0, a_e > 0 and `slip_ratio` is
    finite.
    """
    nu = number("nu", nu, at_least=0, at_most=0.5)
    slip_ratio = number("slip_ratio", slip_ratio)
    _, J_half = _root_area_moment(D, A_r, a_e)
    return tangential_stiffness(1.0, nu, slip_ratio, J_half)


def _root_area_moment(D, A_r, a_e) -> tuple[Numbers, Numbers]:
    """D and J(1/2)/sqrt(A_a)."""
    D, A_r = number("D", D, above=2, below=3), number("A_r", A_r, above=0)
    dtype = getattr(a_e, "dtype", type(a_e))
    if jnp.issubdtype(dtype, jnp.floating):
        # As D -> 2 a_e overflows to infinity in `contact_state`: nothing is elastic.
        a_e = jnp.minimum(a_e, jnp.finfo(dtype).max)
    log_a_e = jnp.log(number("a_e", a_e, above=0))
    t = jnp.log((3 - D) / (D - 1) * A_r) - log_a_e  # a_l by Eq. 28
    return D, area_moment(0.5, D, log_a_e, t)
