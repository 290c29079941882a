"""Surfaces: the domain and refusals."""

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj
from tools import refusals


def test_the_whole_open_interval():
    """2 < D < 3 up to the doubles next to its ends; gamma is 1.5 unless given."""
    for D in (np.nextafter(2, 3), 2.5, np.nextafter(3, 2)):
        surface = fj.Surface(D, 1e-10)
        assert (surface.D, surface.G, surface.gamma) == (D, 1e-10, 1.5)
        assert surface.D.dtype == np.float64
    surface = jax.jit(fj.Surface)(2.4, -1.0)
    assert surface.D == 2.4 and np.isnan(surface.G)


test_refusals = refusals(
    [
        *((lambda D=D: fj.Surface(D, 1e-10), "^D must be above 2 and below 3") for D in (2, 3)),
        (lambda: fj.Surface(jnp.array([2.5, 3.5]), 1e-10), r"^D .* below 3, got 3\.5$"),
        (lambda: fj.Surface(2.4, 0.0), "^G must be above 0, got 0.0$"),
        (lambda: fj.Surface(2.4, 1e-10, 1), r"^gamma must be above 1, got 1\.0$"),
        (lambda: jax.grad(lambda D: fj.Surface(D, 1e-10).D)(3.25), r"^D .* below 3, got 3\.25"),
    ],
    kind=(ValueError, TypeError),
)
