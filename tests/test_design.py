"""Designs against a fine grid, on every kind of request, and the refusals."""

import math
import random

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.design import DEFAULT_BOUNDS, _pose

SIDE = 700


@pytest.fixture(scope="module")
def scene():
    return fj.brake_scene()


@jax.jit
def grid(scene, Ds, Gs):
    """Growth rate, K_n, a_l/a_e and Q_e/(mu_s P) on the grid, by the public functions."""

    def one(D, G):
        moved = scene.replace(D=D, G=G)
        contact, friction = moved.contact, moved.friction
        state = fj.contact_state(
            contact.surface, contact.material, contact.P, mu_s=friction.mu_s, mu_m=friction.mu_m
        )
        return fj.growth_rate(moved), state.K_n, state.log_area_ratio, state.slip_ratio

    return jax.lax.map(lambda D: jax.vmap(lambda G: one(D, G))(Gs), Ds)


def nearest_on_grid(scene, bounds=DEFAULT_BOUNDS, target=-math.pi, K_n_min=None):
    """The least scaled distance of a grid point that meets every requirement."""
    (D_low, D_high), (G_low, G_high) = bounds["D"], bounds["G"]
    Ds, Gs = jnp.linspace(D_low, D_high, SIDE), jnp.geomspace(G_low, G_high, SIDE)
    growth, K_n, log_area_ratio, slip = (np.asarray(x) for x in grid(scene, Ds, Gs))
    K_n_min = float(fj.stiffness(scene)[0]) if K_n_min is None else K_n_min
    meets = (growth <= target) & (K_n >= K_n_min)
    meets &= (log_area_ratio >= math.log(2)) & (slip <= 0.9)
    surface = scene.contact.surface
    dD = (np.asarray(Ds) - float(surface.D)) / (bounds["D"][1] - bounds["D"][0])
    dG = np.log(np.asarray(Gs) / float(surface.G)) / math.log(bounds["G"][1] / bounds["G"][0])
    return np.sqrt(np.where(meets, dD[:, None] ** 2 + dG[None, :] ** 2, np.inf).min())


def assert_meets_requirements(best, target=-math.pi, K_n_min=None):
    """The final scene, evaluated afresh, keeps to everything that was asked."""
    scene = best.scene
    contact, friction = scene.contact, scene.friction
    state = fj.contact_state(
        contact.surface, contact.material, contact.P, mu_s=friction.mu_s, mu_m=friction.mu_m
    )
    start = fj.stiffness(best.initial)[0]
    assert best.result == fj.DesignResult.found and best.violated == ()
    assert fj.growth_rate(scene) <= target
    assert state.K_n >= (start if K_n_min is None else K_n_min)
    assert state.slip_ratio is not None
    assert state.a_l >= 2 * state.a_e and state.slip_ratio <= 0.9
    assert state.regime == fj.Regime.elastic_plastic
    for name, (low, high) in best.bounds.items():
        assert low <= getattr(contact.surface, name) <= high
    assert best.growth_rate == float(fj.growth_rate(scene))


def squealing_scenes(count, seed=2026):
    """Random scenes of the ranges that a brake has, all of them squealing."""
    rng, base = random.Random(seed), fj.brake_scene()
    while count:
        scene = base.replace(
            D=rng.uniform(2.35, 2.6),
            G=math.exp(rng.uniform(math.log(3e-11), math.log(3e-9))),
            P=math.exp(rng.uniform(math.log(300), math.log(30000))),
            mu_s=rng.uniform(0.35, 0.5),
        )
        if fj.growth_rate(scene) > 0:
            count -= 1
            yield scene


def test_fifty_random_scenes_reach_the_grid_optimum():
    """Within 1 percent of the least distance on a 700 x 700 grid, whichever basin it is in."""
    for scene in squealing_scenes(50):
        best = fj.design(scene, progress=False)
        assert_meets_requirements(best)
        assert math.sqrt(best.value) <= 1.01 * nearest_on_grid(scene)


@pytest.mark.slow
def test_other_requests_reach_the_grid_optimum():
    """The same where K_n, the slip limit, corners and other bounds decide."""
    rng = random.Random(7)
    for scene in squealing_scenes(30, seed=11):
        K_n_min = float(fj.stiffness(scene)[0]) * math.exp(rng.uniform(0, 6))
        target = -rng.uniform(0.0, 6.0)
        expected = nearest_on_grid(scene, target=target, K_n_min=K_n_min)
        best = fj.design(scene, target=target, K_n_min=K_n_min, progress=False)
        if math.isinf(expected):
            assert best.result == fj.DesignResult.infeasible
            continue
        assert_meets_requirements(best, target, K_n_min)
        assert math.sqrt(best.value) <= 1.01 * expected


def test_reference_design(scene):
    """The main job: the reference brake becomes stable with a margin, and no softer."""
    best = fj.design(scene, progress=False)
    assert_meets_requirements(best)
    assert best.active == ("growth_rate <= target",)
    assert best.growth_rate == pytest.approx(-math.pi, rel=1e-5)
    assert best.scene.replace(D=2.4, G=1.342e-10).to_toml() == scene.to_toml()
    first, last = ({name: c[i] for name, c in best.history.items()} for i in (0, -1))
    assert last["growth_rate"] == pytest.approx(best.growth_rate, rel=1e-9)
    assert last["D"] == pytest.approx(float(best.scene.contact.surface.D), rel=1e-14)
    assert set(first) >= {"D", "G", "objective", "growth_rate", "K_n", "K_t", "slip_ratio"}
    assert np.isfinite(np.stack(list(best.history.values()))).all()


def test_nearest_is_projection_where_one_requirement_binds(scene):
    """At the optimum the step from the start is parallel to the gradient of the binding one."""
    best = fj.design(scene, progress=False)
    surface, (D_low, D_high), (G_low, G_high) = (
        best.scene.contact.surface,
        *DEFAULT_BOUNDS.values(),
    )
    scale = jnp.array([D_high - D_low, math.log(G_high / G_low)])

    def growth(x):
        return fj.growth_rate(scene.replace(D=x[0] * scale[0], G=jnp.exp(x[1] * scale[1])))

    end = jnp.array([surface.D, jnp.log(surface.G)]) / scale
    start = jnp.array([2.4, math.log(1.342e-10)]) / scale
    normal, step = jax.grad(growth)(end), end - start
    cosine = normal @ step / (jnp.linalg.norm(normal) * jnp.linalg.norm(step))
    assert cosine == pytest.approx(-1, abs=1e-6)


@pytest.mark.parametrize("surface", [{"D": 2.2, "G": 1e-9}, {"D": 2.7, "G": 1e-11}])
def test_starts_outside_the_elastic_regime(scene, surface):
    """A fully plastic or slipping start looks stable and has no gradient; it is led out."""
    start = scene.replace(**surface)
    assert fj.growth_rate(start) < -math.pi
    best = fj.design(start, progress=False)
    assert_meets_requirements(best)
    assert math.sqrt(best.value) <= 1.01 * nearest_on_grid(start)


def test_requirements_inform_on_both_sides_of_regime_boundaries(scene):
    """Where growth and stiffness are flat, the area and slip requirements still have a slope."""
    plastic = scene.replace(D=2.2, G=1e-9)
    request, problem, _ = _pose(plastic, DEFAULT_BOUNDS, None, None, None, (), 2.0, 0.9, True)
    slopes = jax.jacfwd(lambda u: problem.requirements(request, u))(request.start)
    assert jnp.all(slopes["growth_rate <= target"] == 0)
    assert jnp.all(jnp.abs(slopes["a_l >= area_ratio_min a_e"]) > 1)
    slipping = eqx.tree_at(lambda r: r.start, request, jnp.array([0.75, 0.25]))
    slopes = jax.jacrev(lambda u: problem.requirements(slipping, u))(slipping.start)
    assert jnp.all(jnp.abs(slopes["Q_e <= slip_ratio_max mu_s P"]) > 1)


@pytest.mark.parametrize(
    ("request_", "violated"),
    [
        ({"target": -100.0}, ("growth_rate <= target",)),
        ({"K_n_min": 1e14}, ("K_n >= K_n_min",)),
        ({"bounds": {"D": (2.39, 2.41), "G": (1.3e-10, 1.4e-10)}}, ("growth_rate <= target",)),
    ],
)
def test_infeasible_requests_say_what_cannot_be_met(scene, request_, violated):
    """A result, not a success: the best point inside the model, and the requirement it misses."""
    best = fj.design(scene, progress=False, **request_)
    assert best.result == fj.DesignResult.infeasible
    assert best.violated == violated
    assert "infeasible" in best.outcome and f"not met: {violated[0]}" in repr(best)
    state = best.scene.contact.state(0.4, 0.25)
    assert state.regime == fj.Regime.elastic_plastic and state.slip_ratio <= 0.9


def test_infeasible_stiffness_gets_the_stiffest_surface(scene):
    """The best point found for an unreachable K_n is the one with the largest K_n allowed."""
    stiffest = fj.design(scene, objective=lambda s: -fj.stiffness(s)[0], progress=False)
    best = fj.design(scene, K_n_min=1e14, progress=False)
    ratio = fj.stiffness(best.scene)[0] / fj.stiffness(stiffest.scene)[0]
    assert ratio == pytest.approx(1, rel=1e-3)
    assert set(best.active) == {"Q_e <= slip_ratio_max mu_s P", "D <= upper bound"}


def test_all_plastic_bounds_are_infeasible(scene):
    """Bounds that hold no elastic surface: named, though the bare oscillator is stable."""
    bounds = {"D": (2.1, 2.3), "G": (1e-10, 1e-8)}
    best = fj.design(scene.replace(D=2.2, G=1e-9), bounds, progress=False)
    assert best.violated == ("a_l >= area_ratio_min a_e",)
    assert fj.growth_rate(best.scene) < -math.pi


def test_objective_replaces_distance(scene):
    """With the growth rate as objective no grid point that meets the rest does better."""
    best = fj.design(scene, objective=fj.growth_rate, progress=False)
    assert_meets_requirements(best)
    Ds = jnp.linspace(*DEFAULT_BOUNDS["D"], SIDE)
    Gs = jnp.geomspace(*DEFAULT_BOUNDS["G"], SIDE)
    growth, K_n, log_area_ratio, slip = (np.asarray(x) for x in grid(scene, Ds, Gs))
    meets = (K_n >= float(fj.stiffness(scene)[0])) & (slip <= 0.9)
    meets &= log_area_ratio >= math.log(2)
    assert best.value == pytest.approx(best.growth_rate, rel=1e-12)
    assert best.growth_rate <= growth[meets].min() + 1e-3


def test_one_variable_alone(scene):
    """Bounds on D alone leave G as it is, and the other way round."""
    best = fj.design(scene, {"D": (2.1, 2.9)}, progress=False)
    assert_meets_requirements(best)
    assert best.scene.contact.surface.G == scene.contact.surface.G
    best = fj.design(scene, {"G": (1e-12, 1e-8)}, progress=False)
    assert_meets_requirements(best)
    assert best.scene.contact.surface.D == scene.contact.surface.D


def test_own_constraint_and_two_active(scene):
    """A function of the scene as a requirement; two of them meet in a corner."""

    def coarse(scene):
        return scene.contact.surface.D - 2.42

    best = fj.design(scene, constraints=(coarse,), progress=False)
    assert_meets_requirements(best)
    assert best.active == ("growth_rate <= target", "coarse")
    assert pytest.approx(2.42, abs=1e-5) == best.scene.contact.surface.D


def test_given_stiffness_ratio_asks_nothing_of_slip(scene):
    """With K_t/K_n given, no tangential law is evaluated and none is required."""
    best = fj.design(scene.replace(stiffness_ratio=0.2), progress=False)
    assert best.result == fj.DesignResult.found
    assert fj.growth_rate(best.scene) <= -math.pi
    assert "slip_ratio" not in best.history and "not evaluated" in repr(best)


def test_stable_scene_stays(scene):
    """A surface that meets every requirement is its own design."""
    stable = fj.design(scene, progress=False).scene
    again = fj.design(stable, K_n_min=0.0, progress=False)
    assert again.result == fj.DesignResult.unchanged and again.value == 0
    assert again.scene.to_toml() == stable.to_toml()


def test_single_precision(scene):
    """float32 designs the same surface, a little further inside what is required."""
    single = jax.tree.map(lambda x: x.astype(jnp.float32), scene)
    best = fj.design(single, progress=False)
    assert best.result == fj.DesignResult.found and best.violated == ()
    assert best.active == ("growth_rate <= target",)
    exact = fj.design(scene, progress=False)
    assert best.value == pytest.approx(exact.value, rel=1e-2)
    assert fj.growth_rate(best.scene).dtype == jnp.float32


def test_same_request_same_design(scene):
    """The search has no chance in it."""
    first, second = (fj.design(scene, progress=False) for _ in range(2))
    assert first.scene.to_toml() == second.scene.to_toml()


def test_progress_bar(scene, capsys):
    """The search shows where it is, on standard error, unless told not to."""
    fj.design(scene)
    assert "120/120" in capsys.readouterr().err
    fj.design(scene, progress=False)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bounds": {"D": (2.5, 2.3)}}, "bounds on D must be (lower, upper), got (2.5, 2.3)"),
        ({"bounds": {"D": (2.4, 2.4)}}, "bounds on D must be (lower, upper)"),
        ({"bounds": {"D": (2.0, 2.9)}}, "D must be above 2 and below 3, got 2.0"),
        ({"bounds": {"G": (0.0, 1e-9)}}, "G must be above 0, got 0.0"),
        ({"bounds": {"D": (2.5, 2.9)}}, "D must lie inside its bounds [2.5, 2.9], got 2.4"),
        ({"bounds": {"D": (2.1, math.nan)}}, "D bound must be finite, got nan"),
        ({"bounds": {"D": (2.1, 2.5, 2.9)}}, "bounds on D must be (lower, upper)"),
        ({"bounds": {"P": (1.0, 2.0)}}, "bounds must be on D, G or both, got P"),
        ({"bounds": {}}, "bounds must be on D, G or both, got none"),
        ({"target": math.nan}, "target must be finite, got nan"),
        ({"K_n_min": -1.0}, "K_n_min must be at least 0, got -1.0"),
        ({"area_ratio_min": 0.5}, "area_ratio_min must be at least 1, got 0.5"),
        ({"slip_ratio_max": 1.5}, "slip_ratio_max must be above 0 and at most 1, got 1.5"),
        ({"starts": 0}, "starts must be a whole number of at least 1, got 0"),
    ],
)
def test_refusals(scene, arguments, message):
    """One clear line: the argument, the bound, the value."""
    with pytest.raises(ValueError) as caught:
        fj.design(scene, progress=False, **arguments)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_fixed_contact_has_no_surface(scene):
    """A joint of given stiffness cannot be designed."""
    with pytest.raises(ValueError, match="a FixedContact has no surface to change"):
        fj.design(scene.replace(contact=fj.FixedContact(4e8, 2e8)))
