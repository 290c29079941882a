"""Designs of structures whose growth rate is now that of one mode, now that of another."""

from typing import Any

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


@pytest.mark.slow
@pytest.mark.parametrize("target", [None, 1e6])
def test_the_least_growth_rate_is_where_four_modes_meet(target):
    """However far away the target is."""
    x = one_damper(p=0.1, q=0.2, r=0.6)
    best = fj.design(x, BOUNDS, fj.growth_rate, target, starts=2, lattice=4, progress=False)
    assert best.growth_rate == pytest.approx(-0.75 / 2, abs=1e-7)
    for name in SHARES:
        assert float(best.scene.parameters[name]) == pytest.approx(0.75, abs=1e-6)


@pytest.mark.slow
def test_the_nearest_design_and_one_that_cannot_be_met():
    """p, q, r >= 0.6 and p + q + r <= 2.4, from (0.1, 0.2, 0.3): p = q = r = 0.6."""
    x = one_damper(p=0.1, q=0.2, r=0.3)
    best = fj.design(x, BOUNDS, target=-0.3, starts=2, lattice=4, progress=False)
    np.testing.assert_allclose([best.scene.parameters[name] for name in SHARES], 0.6, rtol=1e-6)
    assert "growth_rate of mode 2 <= target" in best.active
    x = one_damper(p=0.1, q=0.2, r=0.3)
    best = fj.design(x, BOUNDS, target=-0.5, starts=2, lattice=4, progress=False)
    assert best.result == DesignResult.infeasible
    assert best.violated and best.growth_rate == pytest.approx(-0.75 / 2, abs=1e-5)


@pytest.mark.slow
def test_leading_eigenvalues_and_their_derivatives():
    structure = two_joints(4)

    @jax.jit
    def few(K_n):
        x = structure.replace(**{"left.K_n": K_n})
        return leading(*assembled(x, True).matrices, 3).s.real

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


def test_what_holds_the_least_growth_rate():
    """At p = q = r = 0.75 all four modes, each with a weight of 1/4 as none leads; by hand."""
    x = one_damper(p=0.1, q=0.2, r=0.3)
    best = fj.design(x, BOUNDS, target=-0.5, starts=2, lattice=4, progress=False)
    found = best.least_growth
    assert found is not None and found.met and found.stationary
    assert found.growth_rate == pytest.approx(-0.375, abs=1e-7) and found.margin > 0
    assert found.values == pytest.approx({name: 0.75 for name in SHARES}, abs=1e-6)
    assert list(found.held_by.values()) == pytest.approx([0.25] * 4, abs=1e-6)
    assert found.steepest == pytest.approx(0.5 * 1.99 * 3**0.5, rel=1e-3)  # of the last damper
    assert found.agreed == found.starts == 3
    words = str(best)
    assert "least growth rate found, with every other requirement met: -0.375 1/s" in words
    assert "no small change lowers it" in words and "3 of 3 starts end within 1 %" in words


@pytest.mark.slow
def test_bounds_and_requirements_hold_it_as_well():
    """Only r may move, up to 0.5: the rate of its mode is held by the bound, 1/2 a unit of r."""
    x = one_damper(p=0.7, q=0.7, r=0.3)
    limits: Any = {"r": (0.1, 0.5)}
    found = fj.design(x, limits, target=-0.4, starts=1, lattice=2, progress=False).least_growth
    assert found is not None and found.growth_rate == pytest.approx(-0.25, abs=1e-7)
    assert found.held_by == pytest.approx(
        {"growth_rate <= target": 1.0, "r <= upper bound": 0.4 / 2}, abs=1e-6
    )

    def most(x):
        return 10 * (x.parameters["r"] - 0.4)

    asked: Any = dict(constraints=[most], starts=1, lattice=2, progress=False)
    found = fj.design(x, limits, None, -0.4, **asked).least_growth
    assert found is not None and found.growth_rate == pytest.approx(-0.2, abs=1e-6)
    assert found.held_by == pytest.approx({"growth_rate <= target": 1.0, "most": 0.05}, abs=1e-6)


@pytest.mark.slow
def test_requirements_that_contradict_one_another_are_named():
    """p <= 0.2 and p >= 0.6: both lack 0.2 at p = 0.4, where half the weight is on each."""
    x = one_damper(p=0.1, q=0.2, r=0.3)

    def small(x):
        return x.parameters["p"] - 0.2

    def large(x):
        return 0.6 - x.parameters["p"]

    asked: Any = dict(constraints=[small, large], starts=2, lattice=4, progress=False)
    best = fj.design(x, BOUNDS, None, -0.1, **asked)
    found = best.least_growth
    assert best.result == DesignResult.infeasible and found is not None and not found.met
    assert found.values["p"] == pytest.approx(0.4, abs=1e-6)
    assert found.unmet == pytest.approx({"small": 0.2, "large": 0.2}, abs=1e-6)
    assert found.held_by == pytest.approx({"small": 0.5, "large": 0.5}, abs=1e-6)
    assert found.stationary and found.steepest == pytest.approx(1.99)
    assert found.agreed == found.starts == 3
    words = str(best)
    assert "no design was found to meet, whatever grows: " in words
    assert "small (0.5), large (0.5)" in words and "0 is asked" in words


@pytest.mark.slow
def test_every_law_has_its_modes():
    """A structure of two joints under its own law and another: rates as of each by itself."""
    from fractaljax._design.joints import with_contact_law
    from fractaljax._design.rows import evaluate

    x: Any = fractal_joints()
    contact = x.joints[0].contact
    law = fj.AsperityContact(fj.Surface(2.2, 1e-9), contact.material, 1.0, 1e-5)
    none: Any = dict.fromkeys(("objective", "target", "envelope", "tolerance"))
    rest: Any = dict(K_n_min=0.0, constraints=(), quantile=0.95, friction_slope=True)
    limits: Any = dict(area_ratio_min=2.0, slip_ratio_max=0.9, laws=[law])
    problem = fj.DesignProblem(x, {"left.D": (2.3, 2.5)}, **none, **rest, **limits)
    k = problem.modes
    row = evaluate(problem, np.asarray(problem.start)[None], np.zeros((1, 0)))[0]
    growing = np.sinh(row[problem.growth_columns]) * float(problem.growth_scale)
    assert len(growing) == 2 * k and len(problem.named_columns) == len(row)
    names = problem.residual_names[problem.model_residuals :]
    assert names[k] == "growth_rate <= target by AsperityContact"
    for mechanism, rates in ((x, growing[:k]), (with_contact_law(x, law), growing[k:])):
        s: Any = np.asarray(fj.stability(mechanism).eigenvalues)
        wanted = np.sort(s[s.imag >= 0].real)[::-1][:k]
        np.testing.assert_allclose(rates + float(problem.target), wanted, rtol=1e-8)
    for joint, own in zip(with_contact_law(x, law).joints, x.joints, strict=True):
        assert repr(joint.contact.surface) == repr(own.contact.surface)
        assert joint.contact.P == own.contact.P
        assert joint.contact.L_s == law.L_s


@pytest.mark.slow
@pytest.mark.optimised
def test_a_structure_is_designed_under_two_laws():
    x: Any = fractal_joints()
    law = fj.AsperityContact(fj.Surface(2.2, 1e-9), x.joints[0].contact.material, 1.0, 1e-5)
    from fractaljax._design.joints import with_contact_law

    bounds: dict[str, tuple[float, float]] = {"D": (2.15, 2.85), "G": (1e-12, 1e-8)}
    bounds = {
        f"{joint}.{name}": ends for joint in ("left", "right") for name, ends in bounds.items()
    }
    own, other = (float(fj.growth_rate(y)) for y in (x, with_contact_law(x, law)))
    target = min(own, other) - 0.1 * abs(min(own, other))
    best: Any = fj.design(
        x, bounds, None, target, 0.0, laws=[law], starts=4, lattice=6, progress=False
    )
    rates = [float(fj.growth_rate(y)) for y in (best.scene, with_contact_law(best.scene, law))]
    assert (best.violated == ()) == (max(rates) <= target + 1e-6)
    assert best.violated == () or best.least_growth.growth_rate > target
