"""Materials: Eq. 2, the domain, refusals."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import fractaljax as fj
from tools import refusals

GOOD: dict[str, Any] = {"E": 1.154e11, "nu": 0.3, "sigma_y": 3.55e8, "H": 9.94e8}
BODIES = {"E1": 2.1e11, "nu1": 0.27, "E2": 9e10, "nu2": 0.35}
PAIR = BODIES | {"sigma_y": 3.55e8, "H": 9.94e8}


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_equation_2(mode):
    """E in 40 digits, dE/dE1 = (1 - nu1^2)(E/E1)^2 and dE/dnu1 = 2 nu1 E^2/E1; nu is the mean."""
    E1, nu1, E2, nu2 = BODIES.values()
    with mp.workdps(40):
        truth = 1 / ((1 - mpf(nu1) ** 2) / mpf(E1) + (1 - mpf(nu2) ** 2) / mpf(E2))
    material = fj.Material.pair(**PAIR)
    E = float(material.E)
    assert float(abs(mpf(E) / truth - 1)) < 4e-16
    assert (material.nu, material.sigma_y, material.H) == ((nu1 + nu2) / 2, 3.55e8, 9.94e8)
    slopes = mode(lambda x: fj.Material.pair(x[0], x[1], x[2], x[3], 3.55e8, 9.94e8).E)(
        jnp.array([E1, nu1, E2, nu2])
    )
    by_1 = [(1 - nu1**2) * (E / E1) ** 2, 2 * nu1 * E**2 / E1]
    by_2 = [(1 - nu2**2) * (E / E2) ** 2, 2 * nu2 * E**2 / E2]
    np.testing.assert_allclose(slopes, by_1 + by_2, rtol=2e-15)


def test_the_domain_and_beyond_it_under_jit():
    """nu = 0, nu = 0.5 and H = sigma_y belong to the domain."""
    for nu in (0.0, 0.5):
        material = fj.Material(**GOOD | {"nu": nu, "H": GOOD["sigma_y"]})
        assert (material.nu, material.H) == (nu, material.sigma_y)
    material = jax.jit(fj.Material)(**GOOD | {"H": 1.0})
    assert np.isnan(material.H) and GOOD["E"] == material.E


def hardness(H):
    return fj.Material(**GOOD | {"H": H}).H


ARRAYS = {"sigma_y": np.array([1.0, 3.0]), "H": np.array([2.5, 2.5])}


test_refusals = refusals(
    [
        (lambda: fj.Material(**GOOD | {"E": 0}), r"^E must be above 0, got 0\.0$"),
        (lambda: fj.Material(**GOOD | {"nu": np.nextafter(0.5, 1)}), "^nu .* at most 0.5, got"),
        (lambda: fj.Material(**GOOD | {"H": 1}), r"^H .* sigma_y = 355000000\.0, got 1\.0$"),
        (lambda: fj.Material(**GOOD | ARRAYS), r"^H must be at least sigma_y = 3\.0, got 2\.5$"),
        (lambda: fj.Material.pair(**PAIR | {"E2": -1}), r"^E2 must be above 0, got -1\.0$"),
        (lambda: fj.Material.pair(**PAIR | {"nu1": 0.6}), "^nu1 must be"),
        (lambda: jax.grad(hardness)(1.0), r"^H must be at least sigma_y = 355000000\.0, got 1\.0"),
    ],
    kind=(ValueError, TypeError),
)
