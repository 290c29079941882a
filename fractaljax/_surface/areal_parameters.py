"""Roughness parameters of a measured map, as drawings hold them: ISO 25178-2."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike, Float, ScalarLike

from .._base.parts import scalar
from .autocorrelation import autocorrelation_lengths
from .drawing_parameters import ArealParameters
from .evaluation import evaluation_area
from .gaussian_filter import band_pass, check_nesting_indices
from .heights import check_heights, extremes, height_statistics, remove_mean, slope
from .material_ratio import material_ratio
from .spectral_parameters import (
    refuse_grid,
    require_step,
    spectral_areal_parameters,
)
from .spectrum import Spectrum


def areal_parameters(
    z: Float[ArrayLike, "n m"] | Spectrum,
    dx: ScalarLike | None = None,
    *,
    dy: ScalarLike | None = None,
    cutoff: ScalarLike | None = None,
    shortest: ScalarLike | None = None,
    L: ScalarLike | None = None,
    L_s: ScalarLike | None = None,
) -> ArealParameters:
    """Roughness parameters of a map, as ISO 25178-2 defines them, or expected of a spectrum.

    x is along the first axis of the map.

    The Gaussian filters of ISO 16610-61 take out waves shorter than `shortest` and longer than
    `cutoff`, and half a cutoff is dropped at all edges. A warning says if what is left is smaller
    than a square with the cutoff as its side (ISO 25178-3).

    **Arguments:**

    - `z`: (n, m), heights [m]; or a `Spectrum`, for the parameters to expect of it.
    - `dx`: distance of the points along the first axis [m]; None (default) for a spectrum.
    - `dy`: distance of the points along the second axis [m], by default dx.
    - `cutoff`: nesting index of the L-filter [m]. By default none: z is roughness already, only its
      mean is subtracted, no tilt, and half of `shortest` is dropped at all edges.
    - `shortest`: nesting index of the S-filter [m]. By default no short waves are taken out.
    - `L`, `L_s`: longest and shortest wavelength [m] of a `Surface`; None (default) for all else.

    Sdr is the mean of (1 + (dz/dx)^2 + (dz/dy)^2)^(1/2) - 1. Sal and Str take the map as one period
    of the surface, with s = 0.2; a lag ends at half the map, and so does Str of a surface with a
    lay. Sk, Spk and Svk are those of the same roughness.

    Differentiable in z and, without filters, in dx and dy; works under `jit` and `vmap` with grid
    and filters known at trace time. Sal and Str have first derivatives; extremes and what is sorted
    have derivatives piecewise. Flat heights have no Ssk, Sku, Sal and Str (NaN).

    For a spectrum they are those of Gaussian heights on a large area, smooth functions of all its
    numbers and of the filters, which may be traced. Sdr is that of small slopes, Sdq^2/2. Sz, Sp,
    Sv, Sal and Str are NaN: the extremes depend on the area, and the lengths on the lay.

    **Returns:** `ArealParameters`.

    **Raises:** `ValueError` unless z is (n, m), both >= 8, finite, dx > 0, dy > 0,
    2 max(dx, dy) <= shortest <= cutoff, and z is longer than the cutoff; for a spectrum with `dx`
    or `dy`, for heights with `L` or `L_s`, and as `roughness`.
    """
    if isinstance(z, Spectrum):
        refuse_grid(dx, dy)
        return spectral_areal_parameters(z, cutoff, shortest, L, L_s)
    dx = require_step(dx, L, L_s)
    z, dx = check_heights(z, "n m"), scalar("dx", dx, above=0)
    steps = dx, dx if dy is None else scalar("dy", dy, above=0)
    cutoff, shortest = check_nesting_indices(cutoff, shortest, steps)
    area = evaluation_area(z.shape, steps, cutoff, shortest)
    z = z.astype(jnp.result_type(z, *steps))
    return _areal_parameters(z, jnp.stack(steps), cutoff, shortest, area)


@functools.partial(jax.jit, static_argnames="area")
def _areal_parameters(z, steps, cutoff, shortest, area):
    dx, dy = steps
    filtered = band_pass(z, cutoff, shortest, (dx, dy))
    inner = tuple(slice(*bounds) for bounds in area)
    inside = filtered[inner]
    if cutoff is None:
        inside = remove_mean(inside)
    heights = height_statistics(inside)
    square = slope(filtered.T, dx).T[inner] ** 2 + slope(filtered, dy)[inner] ** 2
    (peak,), (pit,) = extremes(inside.reshape(1, -1))
    Sal, Str = autocorrelation_lengths(inside, steps)
    curve = material_ratio(inside)
    return ArealParameters(
        Sa=heights.mean_absolute,
        Sq=heights.root_mean_square,
        Sz=peak - pit,
        Sp=peak,
        Sv=-pit,
        Ssk=heights.skewness,
        Sku=heights.kurtosis,
        Sdq=jnp.sqrt(jnp.mean(square)),
        # The same as sqrt(1 + square) - 1, without cancellation.
        Sdr=100 * jnp.mean(square / (1 + jnp.sqrt(1 + square))),
        Sal=Sal,
        Str=Str,
        Sk=curve.core,
        Spk=curve.peaks,
        Svk=curve.valleys,
        Smr1=curve.first,
        Smr2=curve.second,
    )
