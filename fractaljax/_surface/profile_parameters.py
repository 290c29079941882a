"""Roughness parameters of a measured profile, as drawings hold them: ISO 21920-2."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import Record, scalar
from .evaluation import section_bounds
from .gaussian_filter import band_pass, check_nesting_indices
from .heights import check_heights, extremes, height_statistics, remove_mean, slope
from .material_ratio import material_ratio
from .profile_elements import mean_element_width


class ProfileParameters(Record):
    """Roughness parameters of a profile by ISO 21920-2 (before, ISO 4287 and ISO 13565-2)."""

    Ra: Float[Array, "..."]  # arithmetic mean height [m]
    Rq: Float[Array, "..."]  # root mean square height [m]
    Rz: Float[Array, "..."]  # maximum height, mean over the sections [m]
    Rp: Float[Array, "..."]  # peak height, mean over the sections [m]
    Rv: Float[Array, "..."]  # pit depth, mean over the sections [m]
    Rt: Float[Array, "..."]  # total height, over the whole evaluation length [m]
    Rsk: Float[Array, "..."]  # skewness [-]
    Rku: Float[Array, "..."]  # kurtosis [-]
    Rdq: Float[Array, "..."]  # root mean square gradient, rise over run [-]
    RSm: Float[Array, "..."]  # mean width of the profile elements [m]
    Rk: Float[Array, "..."]  # core height [m]
    Rpk: Float[Array, "..."]  # reduced peak height [m]
    Rvk: Float[Array, "..."]  # reduced pit depth [m]
    Mr1: Float[Array, "..."]  # material ratio of the peaks [%]
    Mr2: Float[Array, "..."]  # material ratio above the pits [%]


def profile_parameters(
    z: Float[ArrayLike, " n"],
    dx: ScalarLike,
    *,
    cutoff: ScalarLike | None = None,
    shortest: ScalarLike | None = None,
    sections: int | None = None,
) -> ProfileParameters:
    """Roughness parameters of a profile, as ISO 21920-2 defines them.

    The Gaussian filters of ISO 16610-21 take out waves shorter than `shortest` and longer than
    `cutoff`, and half a cutoff is dropped at both ends, as run-up and overrun. The evaluation
    length, in the middle, is made of sections (sampling lengths) as long as the cutoff.

    **Arguments:**

    - `z`: (n,), heights [m].
    - `dx`: distance of the points [m].
    - `cutoff`: lambda_c [m]. By default none: z is roughness already, only its mean is subtracted,
      no tilt, and all of it (less half of `shortest` at both ends) is one section.
    - `shortest`: lambda_s [m]. By default no short waves are taken out.
    - `sections`: how many sections, by default five, or as many as z holds, with a warning; without
      `cutoff` the profile is divided into so many.

    Hills and valleys below a tenth of Rz, or narrower than a hundredth of a section, are no profile
    elements. RSm is NaN where no element is complete. Rk, Rpk and Rvk are those of the same
    roughness: the second step of ISO 13565-1 is left out.

    Differentiable in z and, without filters, in dx; works under `jit` and `vmap`, with filters and
    then dx known at trace time. Extremes, RSm and what is sorted have derivatives piecewise. Flat
    heights have no Rsk and Rku (NaN).

    **Returns:** `ProfileParameters`.

    **Raises:** `ValueError` unless z is (n,), n >= 8, finite, dx > 0,
    2 dx <= shortest <= cutoff, and z holds the sections.
    """
    z, dx = check_heights(z, "n"), scalar("dx", dx, above=0)
    cutoff, shortest = check_nesting_indices(cutoff, shortest, (dx,))
    bounds = section_bounds(z.size, dx, cutoff, shortest, sections)
    z = z.astype(jnp.result_type(z, dx))
    return _profile_parameters(z, dx, cutoff, shortest, bounds)


@functools.partial(jax.jit, static_argnames="bounds")
def _profile_parameters(z, dx, cutoff, shortest, bounds):
    filtered = band_pass(z, cutoff, shortest, (dx,))
    first, end = bounds[0], bounds[-1]
    inside = filtered[first:end]
    if cutoff is None:
        inside = remove_mean(inside)
    heights = height_statistics(inside)
    peaks, pits = extremes(inside[_section_points(bounds)])
    Rp, Rv = jnp.mean(peaks), -jnp.mean(pits)
    curve = material_ratio(inside)
    section = dx * (end - first) / peaks.size
    return ProfileParameters(
        Ra=heights.mean_absolute,
        Rq=heights.root_mean_square,
        Rz=Rp + Rv,
        Rp=Rp,
        Rv=Rv,
        Rt=peaks[jnp.argmax(peaks)] - pits[jnp.argmin(pits)],
        Rsk=heights.skewness,
        Rku=heights.kurtosis,
        Rdq=jnp.sqrt(jnp.mean(slope(filtered, dx)[first:end] ** 2)),
        RSm=mean_element_width(inside, dx, (Rp + Rv) / 10, section / 100),
        Rk=curve.core,
        Rpk=curve.peaks,
        Rvk=curve.valleys,
        Mr1=curve.first,
        Mr2=curve.second,
    )


def _section_points(bounds) -> np.ndarray:
    """Indices (sections, points) from the first bound on; a shorter section repeats its last."""
    starts, ends = np.array(bounds[:-1])[:, None], np.array(bounds[1:])[:, None]
    points = starts + np.arange(np.max(ends - starts))[None]
    return np.minimum(points, ends - 1) - bounds[0]
