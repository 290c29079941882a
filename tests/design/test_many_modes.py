"""Designs of structures whose growth rate is now that of one mode, now that of another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.design import DesignResult
from fractaljax._stability.linearise import assembled
from fractaljax._stability.quadratic import leading
from structures import fractal_joints, two_joints

SHARES = ("p", "q", "r")
BOUNDS: dict[str, tuple[float, float]] = {name: (0.01, 2.0) for name in SHARES}


def one_damper(**start):
    """Four oscillators that share one damper of 3 N s/m: best where each has a quarter of it."""
    places = [np.diag(np.eye(4)[i]) for i in range(4)]
    coefficients = [*SHARES, "3 - p - q - r"]
    return fj.ParametricStructure(
        np.eye(4),
        list(zip(coefficients, places, strict=True)),
        np.diag([100.0, 400.0, 900.0, 1600.0]),
        parameters=start,
    )


@pytest.mark.parametrize("target", [None, 1e6])
def test_the_least_growth_rate_is_where_four_modes_meet(target):
    """However far away the target is."""
    x = one_damper(p=0.1, q=0.2, r=0.6)
    best = fj.design(x, BOUNDS, fj.growth_rate, target, starts=2, lattice=4, progress=False)
    assert best.growth_rate == pytest.approx(-0.75 / 2, abs=1e-7)
    for name in SHARES:
        assert float(best.scene.parameters[name]) == pytest.approx(0.75, abs=1e-6)


def test_the_nearest_design_keeps_all_modes_from_growing():
    """p, q, r >= 0.6 and p + q + r <= 2.4, from (0.1, 0.2, 0.3): p = q = r = 0.6."""
    x = one_damper(p=0.1, q=0.2, r=0.3)
    best = fj.design(x, BOUNDS, target=-0.3, starts=2, lattice=4, progress=False)
    np.testing.assert_allclose([best.scene.parameters[name] for name in SHARES], 0.6, rtol=1e-6)
    assert "growth_rate of mode 2 <= target" in best.active


def test_a_request_that_cannot_be_met_ends_as_close_as_can_be():
    x = one_damper(p=0.1, q=0.2, r=0.3)
    best = fj.design(x, BOUNDS, target=-0.5, starts=2, lattice=4, progress=False)
    assert best.result == DesignResult.infeasible
    assert best.violated and best.growth_rate == pytest.approx(-0.75 / 2, abs=1e-5)


def test_leading_eigenvalues_and_their_derivatives():
    structure = two_joints(4)

    @jax.jit
    def few(K_n):
        x = structure.replace(**{"left.K_n": K_n})
        return leading(*assembled(x, True)[:3], 3).s.real

    @jax.jit
    def all_of_them(K_n):
        s = fj.stability(structure.replace(**{"left.K_n": K_n})).eigenvalues
        rank = jnp.argsort(jnp.where(s.imag >= 0, -s.real, jnp.inf))
        return s[rank[:3]].real

    K_n = 3e6
    np.testing.assert_allclose(few(K_n), all_of_them(K_n), rtol=1e-9)
    wanted = jax.jacfwd(all_of_them)(K_n)
    for d in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(d(few)(K_n), wanted, rtol=1e-8)


@pytest.mark.slow
def test_starts_far_from_the_requirements_are_led_to_them():
    """From most of the lattice both joints are plastic or slip; a solver alone loses a start."""
    x = fractal_joints()
    joints, ranges = ("left", "right"), {"D": (2.15, 2.85), "G": (1e-12, 1e-8)}
    bounds = {f"{joint}.{name}": ends for joint in joints for name, ends in ranges.items()}
    target = 0.5 * float(fj.growth_rate(x))
    best = fj.design(x, bounds, None, target, 0.0, starts=6, lattice=6, progress=False)
    assert best.failed_starts == 0 and best.violated == ()
