"""`design_many`: every member as `design` finds it, derivatives as of designs solved again."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax import constraints
from structures import fractal_joints

SCENE = fj.brake_scene()
BOUNDS = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}
QUIET: dict[str, Any] = {"progress": False}


def drawn(count, seed=0):
    """Loads and static frictions of brakes that squeal."""
    rng = np.random.default_rng(seed)
    return rng.uniform(1300, 2600, count), rng.uniform(0.36, 0.55, count)


def single(P, mu_s, **asked):
    return fj.design(SCENE.replace(P=P, mu_s=mu_s), BOUNDS, **asked, **QUIET)


@pytest.mark.parametrize(
    ("count", "asked"),
    [
        (4, {}),
        pytest.param(24, {}, marks=pytest.mark.slow),
        pytest.param(4, {"objective": fj.growth_rate}, marks=pytest.mark.slow),
        pytest.param(4, {"K_n_min": 3e9}, marks=pytest.mark.slow),
        pytest.param(3, {"tolerance": {"D": 0.002}, "K_n_min": 1e9}, marks=pytest.mark.slow),
        pytest.param(
            4,
            {"constraints": [constraints.Roughness(at_most=5e-7, L=1e-3, L_s=1e-6)]},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_members_are_designs(count, asked):
    """Of random brakes, by other objectives and requirements, each meets what it must."""
    P, mu_s = drawn(count)
    found = fj.design_many(SCENE.replace(P=P, mu_s=mu_s), BOUNDS, **asked, **QUIET)
    assert found.value.shape == (count,) and np.all(found.met)
    assert np.all(found.residuals <= 0)
    for i in range(count):
        best = single(P[i], mu_s[i], **asked)
        surface = best.scene.contact.surface
        assert found.value[i] <= best.value + 1e-6 * max(1, abs(best.value))
        if found.value[i] > best.value - 1e-7 * max(1, abs(best.value)):
            assert found.D[i] == pytest.approx(float(surface.D), abs=2e-5)
            assert np.log(found["G"][i] / surface.G) == pytest.approx(0, abs=5e-4)
        x = SCENE.replace(P=P[i], mu_s=mu_s[i], D=found.D[i], G=found.G[i])
        assert found.growth_rate[i] == pytest.approx(float(fj.growth_rate(x)), rel=1e-8, abs=1e-8)
        assert found.target[i] == best.target


@pytest.mark.slow
def test_derivatives_are_those_of_designs_solved_again():
    """By what is held fixed, in both modes and mapped, where one requirement is active."""

    def designed(P, mu_s):
        found = fj.design_many(SCENE.replace(P=P, mu_s=mu_s), BOUNDS, **QUIET)
        return jnp.stack([found.D, jnp.log(found.G), found.value, found.growth_rate])

    both = {"forward": jax.jacfwd, "reverse": jax.jacrev}
    slopes = {k: jax.jit(f(designed, (0, 1)))(1907.3, 0.41) for k, f in both.items()}
    np.testing.assert_allclose(*slopes.values(), rtol=1e-9, atol=1e-12)
    solved = jax.jit(jax.vmap(designed))
    for i, (size, name) in enumerate([(1907.3, "P"), (0.41, "mu_s")]):
        h = 1e-3 * size
        at = np.full((4, 2), [1907.3, 0.41])
        at[:, i] += np.array([-2, -1, 1, 2]) * h
        ends = np.asarray(solved(*at.T))
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        found = slopes["forward"][i]
        np.testing.assert_allclose(found, slope, rtol=2e-6, atol=2e-7 / size, err_msg=name)
    assert abs(slopes["forward"][0][3]) < 1e-9  # the growth rate stays at its target


@pytest.mark.slow
def test_inside_of_all_limits_none_holds_the_design():
    """Where nothing is active the slope is that of a free minimum, here known."""

    def aim(x):
        D, ln_G = x.contact.surface.D, jnp.log(x.contact.surface.G)
        return 100 * (D - 2.45 - 1e-5 * (x.contact.P - 1900)) ** 2 + (ln_G + 22.6) ** 2

    def designed(P):
        asked: Any = {"target": 1e5, "K_n_min": 0.0, **QUIET}
        found = fj.design_many(SCENE.replace(P=P), BOUNDS, aim, **asked)
        return found.D, jnp.log(found.G), found.residuals

    assert np.max(designed(jnp.asarray(2000.0))[2]) < -1e-3
    slopes = jax.jacfwd(designed)(2000.0)
    assert slopes[0] == pytest.approx(1e-5, rel=1e-6)
    assert slopes[1] == pytest.approx(0, abs=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_batch_mark_members_that_fail():
    """Mapped, they are finite but where there is no design."""

    def designed(mu_s):
        return fj.design_many(SCENE.replace(mu_s=mu_s), BOUNDS, **QUIET).D

    slopes = jax.jit(jax.vmap(jax.grad(designed)))(np.array([0.41, 3.0, 0.45]))
    assert np.isfinite(slopes).tolist() == [True, False, True]


@pytest.mark.slow
def test_at_a_corner_two_requirements_decide():
    """As many are active as there are variables: no curvature, and slopes all the same."""

    def designed(P, least):
        found = fj.design_many(SCENE.replace(P=P), BOUNDS, K_n_min=least, **QUIET)
        return jnp.stack([found.D, jnp.log(found.G)]), found.residuals

    P, least = 1907.3, 4e9
    residuals = np.asarray(designed(jnp.asarray(P), least)[1])
    assert np.sum(residuals > -1e-6) == 2
    slope = jax.jacrev(lambda P: designed(P, least)[0])(P)
    ends = [np.asarray(designed(jnp.asarray(P + k), least)[0]) for k in (-1.0, 1.0)]
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2, rtol=1e-5)


def test_a_member_that_fails_marks_itself():
    """Out of reach, quiet already, or without any number; the others are as without them."""
    own = SCENE.friction.mu_m
    mu_m = np.array([own, own, 0.04, own])
    xs = SCENE.replace(mu_s=np.array([0.41, 3.0, 0.3, 0.41]), mu_m=mu_m)
    found = fj.design_many(xs, BOUNDS, K_n_min=4e8, target=-3.0, **QUIET)
    members = fj.DesignResult.found, fj.DesignResult.infeasible, fj.DesignResult.unchanged
    for i, member in enumerate(members):
        assert (found.result == member)[i]
    assert found.met.tolist() == [True, False, True, True]
    assert found.D[0] == found.D[3]
    np.testing.assert_array_equal(found.designed().contact.surface.D, found.D)
    np.testing.assert_array_equal(found.mechanism_quantity("mu_s"), [0.41, 3.0, 0.3, 0.41])
    assert "infeasible" in repr(found)


@pytest.mark.slow
def test_batches_stores_and_devices_change_nothing(tmp_path):
    P, mu_s = drawn(7)
    xs = SCENE.replace(P=P, mu_s=mu_s)
    whole = fj.design_many(xs, BOUNDS, **QUIET)
    kept = fj.design_many(xs, BOUNDS, batch_size=3, out=tmp_path / "designs", **QUIET)
    again = fj.design_many(xs, BOUNDS, batch_size=3, out=tmp_path / "designs", **QUIET)
    for other in (kept, again):
        np.testing.assert_allclose(other.D, whole.D, rtol=1e-9)
        np.testing.assert_allclose(other.G, whole.G, rtol=1e-8)
    np.testing.assert_array_equal(kept.D, again.D)
    with pytest.raises(ValueError, match="another sweep"):
        fj.design_many(
            SCENE.replace(P=P + 1, mu_s=mu_s),
            BOUNDS,
            batch_size=3,
            out=tmp_path / "designs",
            **QUIET,
        )
    grid = fj.design_many(SCENE.replace(P=P[:2, None], mu_s=mu_s[None, :3]), BOUNDS, **QUIET)
    assert grid.D.shape == (2, 3) and grid.residuals.shape[:2] == (2, 3)
    assert grid.D[0, 0] == pytest.approx(float(whole.D[0]), rel=1e-9)


@pytest.mark.slow
def test_families_of_structures():
    """A list of structures with other matrices; each end as `design` finds it."""
    base = fractal_joints()
    family = [base, base.replace(**{"left.P": 1.1 * base.joints[0].contact.P})]
    bounds = {"left.D": (2.3, 2.8)}
    asked = {"K_n_min": 0.0, "target": 0.0}
    found = fj.design_many(family, bounds, **asked, **QUIET)
    for i, x in enumerate(family):
        best = fj.design(x, bounds, **asked, **QUIET)
        assert bool(found.met[i]) == (not best.violated)
        if found.met[i]:
            assert found.value[i] == pytest.approx(best.value, rel=1e-6, abs=1e-9)


def test_what_is_wrong_is_said():
    with pytest.raises(ValueError, match=r"D must lie inside its bounds \[2.3, 2.8\] in every"):
        fj.design_many(SCENE.replace(D=np.array([2.4, 2.9])), BOUNDS, **QUIET)
    with pytest.raises(ValueError, match=r"xs\[1\] differs from xs\[0\]"):
        fj.design_many([SCENE, SCENE.replace(friction=fj.Coulomb(0.3))], BOUNDS, **QUIET)
    with pytest.raises(TypeError, match="xs must be a mechanism with arrays, or a list"):
        fj.design_many(cast(Any, "brake.toml"), BOUNDS, **QUIET)
    with pytest.raises(ValueError, match="takes no cycle amplitude: use design"):
        fj.design_many(SCENE, BOUNDS, constraints.CycleAmplitude(), **QUIET)
    with pytest.raises(ValueError, match="there are D, G"):
        fj.design_many(SCENE, {"Q": (1.0, 2.0)}, **QUIET)
