"""`DesignProblem` as users call it: plain functions, all transformations, an optimiser's loop."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import fractaljax as fj
from fractaljax import constraints
from structures import fractal_joints

SCENE = fj.brake_scene()
BOUNDS = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}
US = np.array([[0.2, 0.56], [0.27, 0.54], [0.6, 0.8], [0.05, 0.95]])


def moved(u):
    """The scene of a design, by hand."""
    return SCENE.replace(D=2.3 + 0.5 * u[0], G=1e-11 * 100 ** u[1])


def test_functions_are_those_of_the_mechanism():
    """Loss, residuals, quantities and mechanism beside growth rate, stiffness and contact state."""
    limit = constraints.Roughness(at_most=1e-6, L=1e-3, L_s=1e-6)
    problem = fj.DesignProblem(SCENE, BOUNDS, fj.growth_rate, [limit], target=5.0, K_n_min=5e8)
    assert problem.names == ("D", "G")
    assert problem.residual_names == [
        "a_l >= area_ratio_min a_e",
        "Q_e <= slip_ratio_max mu_s P",
        "growth_rate <= target",
        "K_n >= K_n_min",
        "Sq <= 1e-06 m",
    ]
    assert problem.start == pytest.approx([0.2, np.log(13.42) / np.log(100)])
    residuals = jax.jit(jax.vmap(problem.residuals))(US)
    for u, row in zip(US, residuals, strict=True):
        x = moved(u)
        assert problem.loss(u) == pytest.approx(float(fj.growth_rate(x)), rel=1e-9)
        quantities = problem.quantities(u)
        assert quantities["D"] == pytest.approx(float(x.contact.surface.D), rel=1e-13)
        assert quantities["G"] == pytest.approx(float(x.contact.surface.G), rel=1e-13)
        assert fj.growth_rate(problem.mechanism(u)) == pytest.approx(float(fj.growth_rate(x)))
        state = x.contact.state(x.friction.mu_s, x.friction.mu_m)
        scale = 2 * np.pi  # the least damping rate
        expected = [
            2 * (np.log(2) - state.log_area_ratio),
            10 * (state.slip_ratio - 0.9),
            np.arcsinh((float(fj.growth_rate(x)) - 5) / scale),
            1 - fj.stiffness(x)[0] / 5e8,
            limit(x),
        ]
        np.testing.assert_allclose(row, expected, rtol=1e-9, atol=1e-11)


def test_defaults_are_those_of_design():
    problem = fj.DesignProblem(SCENE, BOUNDS)
    best = fj.design(SCENE, BOUNDS, progress=False)
    assert problem.target == best.target and problem.K_n_min[0] == best.K_n_min
    u = problem.scaled(best.scene)
    assert problem.loss(u) == pytest.approx(best.value, rel=1e-9)
    assert problem.residuals(u).max() <= 1e-9
    assert problem.loss(problem.start) == 0
    assert problem.residuals(problem.start).max() > 1  # it squeals


@pytest.mark.slow
@pytest.mark.parametrize("name", ["loss", "residuals"])
def test_both_modes_agree_with_differences(name):
    """Under jit and vmap, on both sides of coalescence and at bounds of the regimes."""
    problem = fj.DesignProblem(SCENE, BOUNDS, lambda x: fj.stiffness(x)[1] / 1e9)
    function = getattr(problem, name)
    forward = jax.jit(jax.vmap(jax.jacfwd(function)))(US)
    reverse = jax.jit(jax.vmap(jax.jacrev(function)))(US)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
    values, h = jax.jit(jax.vmap(function)), 1e-4
    for i, direction in enumerate(np.eye(2)):
        ends = [np.asarray(values(US + k * h * direction)) for k in (-2, -1, 1, 2)]
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        np.testing.assert_allclose(forward[..., i], slope, rtol=1e-6, atol=1e-6)


def test_a_problem_may_be_made_of_traced_mechanisms():
    """Mapped over mechanisms, and differentiated by what they hold."""

    def residuals(P, mu_s, u):
        return fj.DesignProblem(SCENE.replace(P=P, mu_s=mu_s), BOUNDS).residuals(u)

    P, mu_s = np.array([1500.0, 1907.3, 2600.0]), np.array([0.4, 0.41, 0.45])
    rows = jax.jit(jax.vmap(residuals))(P, mu_s, US[:3])
    slopes = jax.jit(jax.vmap(jax.jacrev(residuals)))(P, mu_s, US[:3])
    for i in range(3):
        problem = fj.DesignProblem(SCENE.replace(P=P[i], mu_s=mu_s[i]), BOUNDS)
        np.testing.assert_allclose(rows[i], problem.residuals(US[i]), rtol=1e-9, atol=1e-12)
        h = 1e-4 * P[i]
        ends = [residuals(P[i] + k * h, mu_s[i], US[i]) for k in (-1, 1)]
        np.testing.assert_allclose(slopes[i], (ends[1] - ends[0]) / (2 * h), rtol=1e-5, atol=1e-9)
    # A start outside the bounds is no number, where nothing can be raised.
    inside = jax.jit(lambda D: fj.DesignProblem(SCENE.replace(D=D), BOUNDS).loss(US[0]))
    assert np.isnan(inside(2.9)) and np.isfinite(inside(2.5))


@pytest.mark.slow
def test_an_envelope_counts_by_its_worst():
    envelope = {"P": (1700.0, 2100.0)}
    problem = fj.DesignProblem(SCENE, BOUNDS, fj.growth_rate, envelope=envelope, K_n_min=4e8)
    rows = []
    for P in np.linspace(1700, 2100, 33):
        single = fj.DesignProblem(SCENE.replace(P=P), BOUNDS, fj.growth_rate, K_n_min=4e8)
        rows.append([single.loss(US[1]), *single.residuals(US[1])])
    worst = np.max(rows, axis=0)
    np.testing.assert_allclose(problem.loss(US[1]), worst[0], rtol=1e-9)
    np.testing.assert_allclose(problem.residuals(US[1]), worst[1:], rtol=1e-9, atol=1e-12)


def test_an_optax_loop_of_ones_own_ends_at_the_same_design():
    """Adam with a decaying rate, projected into the box, on an exact penalty."""
    problem = fj.DesignProblem(SCENE, BOUNDS)

    def merit(u):
        return problem.loss(u) + 0.1 * jnp.sum(jnp.maximum(problem.residuals(u), 0))

    optimiser = optax.adam(optax.cosine_decay_schedule(0.02, 400))

    @jax.jit
    def run(u):
        def step(carry, _):
            u, state = carry
            changes, state = optimiser.update(jax.grad(merit)(u), state)
            return (jnp.clip(u + changes, 0, 1), state), None

        return jax.lax.scan(step, (u, optimiser.init(u)), None, 400)[0][0]

    traced, u = jax.make_jaxpr(run)(problem.start), run(problem.start)
    best = fj.design(SCENE, BOUNDS, progress=False)
    np.testing.assert_allclose(u, problem.scaled(best.scene), atol=5e-4)
    assert problem.residuals(u).max() < 1e-4
    # Neither the start nor what comes of it has a weak type, which would be traced again.
    ends: list[Any] = [*traced.jaxpr.invars, *traced.jaxpr.outvars]
    assert not any(x.aval.weak_type for x in ends)


@pytest.mark.slow
def test_limits_of_cycles_are_those_of_the_cycle():
    """Loss and residual are measures of the cycle that `limit_cycle` finds."""
    amplitude = constraints.CycleAmplitude()
    limit = constraints.CycleAmplitude(at_most=1e-5)
    problem = fj.DesignProblem(SCENE, {"D": (2.35, 2.45)}, amplitude, [limit], target=1e4)
    u = problem.start
    cycle = fj.limit_cycle(SCENE)
    assert problem.loss(u) == pytest.approx(float(cycle.amplitude[0]), rel=1e-9)
    residual = problem.residuals(u)[problem.residual_names.index(limit.name)]
    assert residual == pytest.approx(float(cycle.amplitude[0] / 1e-5 - 1), rel=1e-9)


@pytest.mark.slow
def test_of_a_structure_traced_or_not():
    """The default target and stiffness of a traced structure are those of one that is there."""
    structure = fractal_joints()
    bounds = {"left.D": (2.3, 2.8)}
    problem = fj.DesignProblem(structure, bounds, modes=2)
    u = np.array([0.4])

    def residuals(P):
        return fj.DesignProblem(structure.replace(**{"left.P": P}), bounds, modes=2).residuals(u)

    P = structure.joints[0].contact.P
    np.testing.assert_allclose(jax.jit(residuals)(P), problem.residuals(u), rtol=1e-8, atol=1e-10)
    assert fj.growth_rate(problem.mechanism(u)) == pytest.approx(
        float(fj.growth_rate(structure.replace(**{"left.D": 2.5}))), rel=1e-9
    )


def test_what_is_wrong_is_said():
    with pytest.raises(ValueError, match=r"u must have the shape \(2,\), got \(3,\)"):
        fj.DesignProblem(SCENE, BOUNDS).loss(np.ones(3))
    with pytest.raises(ValueError, match="D must lie inside its bounds"):
        fj.DesignProblem(SCENE, {"D": (2.5, 2.8)})
    with pytest.raises(ValueError, match="modes must be a whole number"):
        fj.DesignProblem(fractal_joints(), {"left.D": (2.3, 2.8)}, modes=0)
