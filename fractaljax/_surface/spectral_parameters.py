"""Roughness parameters of a profile with Gaussian heights, from its spectrum behind the filters.

The filtered moments are m_2k, the integral of C(q) q^2k T(q)^2 dq, with the one-dimensional
spectrum C of the profile and the transmission T of both filters.
"""

import math
from statistics import NormalDist

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from .._base.parts import Numbers
from .gaussian_filter import low_pass_transmission
from .profile_parameters import ProfileParameters


def roughness_transmission(
    q: ArrayLike, cutoff: ArrayLike | None = None, shortest: ArrayLike | None = None
) -> Numbers:
    """Share of the amplitude of a wave of wavenumber q [rad/m] that the Gaussian filters leave.

    [1 - 2^-(lambda_c f)^2] 2^-(lambda_s f)^2 with f = q/(2 pi), of the shape of q; a filter that is
    None passes all.
    """
    frequency = jnp.asarray(q, float) / (2 * jnp.pi)
    share = jnp.ones_like(frequency)
    if shortest is not None:
        share = low_pass_transmission(frequency, shortest)
    if cutoff is not None:
        # 1 - 2^-x, exact for long waves too.
        share = -jnp.expm1(-math.log(2) * (jnp.asarray(cutoff) * frequency) ** 2) * share
    return share


def gaussian_profile_parameters(
    m0: ArrayLike, m2: ArrayLike, cutoff: ArrayLike, sections: int = 5
) -> ProfileParameters:
    """Expected roughness parameters of a profile with Gaussian heights; any shape.

    m0 [m^2] and m2 are the filtered mean squares of heights and slopes, and `cutoff` [m] is the
    length of a section. Extremes are those of independent maxima, as many as upward crossings of
    the mean line, N = cutoff (m2/m0)^(1/2)/(2 pi) in a section: Rz = 2 Rq (c + 0.5772/c) with
    c = (2 ln N)^(1/2). Simulated profiles have an Rz lower by 4 to 12 %. RSm is the mean distance
    of the upward crossings, with no hill or valley left out. N must be above 1.
    """
    m0, m2, cutoff = jnp.asarray(m0, float), jnp.asarray(m2, float), jnp.asarray(cutoff, float)
    Rq = jnp.sqrt(m0)
    RSm = 2 * jnp.pi * jnp.sqrt(m0 / m2)

    def expected_range(length):
        c = jnp.sqrt(2 * jnp.log(length / RSm))
        return 2 * Rq * (c + np.euler_gamma / c)

    Rz = expected_range(cutoff)
    core, peaks, first = _gaussian_material_ratio()
    same = jnp.ones_like(Rz)
    return ProfileParameters(
        Ra=math.sqrt(2 / math.pi) * Rq,
        Rq=Rq,
        Rz=Rz,
        Rp=Rz / 2,
        Rv=Rz / 2,
        Rt=expected_range(sections * cutoff),
        Rsk=0 * same,
        Rku=3 * same,
        Rdq=jnp.sqrt(m2),
        RSm=RSm,
        Rk=core * Rq,
        Rpk=peaks * Rq,
        Rvk=peaks * Rq,
        Mr1=100 * first * same,
        Mr2=100 * (1 - first) * same,
    )


def _gaussian_material_ratio() -> tuple[float, float, float]:
    """(Rk/Rq, Rpk/Rq, Mr1) of Gaussian heights.

    The steepness of the least-squares line over the middle 40 %, 12/0.4^3 times the integral of
    (Phi(u) - 1/2) u phi(u) du, by parts.
    """
    normal = NormalDist()
    end = normal.inv_cdf(0.7)
    integral = math.erf(end) / (2 * math.sqrt(math.pi)) - 0.4 * normal.pdf(end)
    core = 12 / 0.4**3 * integral
    upper = core / 2
    first = normal.cdf(-upper)
    return core, 2 * (normal.pdf(upper) / first - upper), first
