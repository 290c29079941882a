"""Roughness parameters of a measured profile, as drawings hold them: ISO 21920-2."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, ScalarLike

from .._base.parts import scalar
from .drawing_parameters import ProfileParameters
from .evaluation import section_bounds
from .gaussian_filter import band_pass, check_nesting_indices
from .heights import check_heights, extremes, height_statistics, remove_mean, slope
from .material_ratio import material_ratio
from .profile_elements import mean_element_width
from .spectral_parameters import (
    refuse_grid,
    require_step,
    spectral_profile_parameters,
)
from .spectrum import Spectrum


def profile_parameters(
    z: Float[ArrayLike, " n"] | Spectrum,
    dx: ScalarLike | None = None,
    *,
    cutoff: ScalarLike | None = None,
    shortest: ScalarLike | None = None,
    sections: int | None = None,
    L: ScalarLike | None = None,
    L_s: ScalarLike | None = None,
) -> ProfileParameters:
    """Roughness parameters of a profile, as ISO 21920-2 defines them, or expected of a spectrum.

    The Gaussian filters of ISO 16610-21 take out waves shorter than `shortest` and longer than
    `cutoff`, and half a cutoff is dropped at both ends, as run-up and overrun. The evaluation
    length, in the middle, is made of sections (sampling lengths) as long as the cutoff.

    **Arguments:**

    - `z`: (n,), heights [m]; or a `Spectrum`, for the parameters to expect of it.
    - `dx`: distance of the points [m]; None (default) for a spectrum.
    - `cutoff`: lambda_c [m]. By default none: z is roughness already, only its mean is subtracted,
      no tilt, and all of it (less half of `shortest` at both ends) is one section.
    - `shortest`: lambda_s [m]. By default no short waves are taken out.
    - `sections`: how many sections, by default five, or as many as z holds, with a warning; without
      `cutoff` the profile is divided into so many.
    - `L`, `L_s`: longest and shortest wavelength [m] of a `Surface`; None (default) for all else.

    Hills and valleys below a tenth of Rz, or narrower than a hundredth of a section, are no profile
    elements. RSm is NaN where no element is complete. Rk, Rpk and Rvk are those of the same
    roughness: the second step of ISO 13565-1 is left out.

    Differentiable in z and, without filters, in dx; works under `jit` and `vmap`, with filters and
    then dx known at trace time. Extremes, RSm and what is sorted have derivatives piecewise. Flat
    heights have no Rsk and Rku (NaN).

    For a spectrum they are those of a profile with Gaussian heights in a random direction, smooth
    functions of all its numbers and of the filters, which may be traced. Rz and its kin are up to
    12 % above the mean of measured ones; they need a cutoff longer than RSm (else NaN). RSm counts
    every crossing of the mean line, with no hill left out, and is less than a measured one. A sum
    of few waves per ln q, as `topography` makes of a `Surface`, is not quite its spectrum.

    **Returns:** `ProfileParameters`.

    **Raises:** `ValueError` unless z is (n,), n >= 8, finite, dx > 0,
    2 dx <= shortest <= cutoff, and z holds the sections; for a spectrum with `dx`, for heights with
    `L` or `L_s`, and as `roughness`.
    """
    if isinstance(z, Spectrum):
        refuse_grid(dx)
        return spectral_profile_parameters(z, cutoff, shortest, L, L_s, sections)
    dx = require_step(dx, L, L_s)
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
