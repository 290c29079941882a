"""Designs and verdicts of mechanisms whose friction has memory: near those of dry friction."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj

BRAKE = fj.brake_scene()
DRY = BRAKE.replace(friction=fj.ExponentialStribeck(0.4, 0.25, 0.1))
SOFT = BRAKE.replace(friction=fj.LuGre(0.4, 0.25, 0.1, 1e5, 1.0))
STIFF = BRAKE.replace(friction=fj.LuGre(0.4, 0.25, 0.1, 1e8, 0.0))
BOUNDS = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}


def test_problem():
    """The growth rates are those of the two modes."""
    problem = fj.DesignProblem(SOFT, BOUNDS, K_n_min=1e7, modes=2)
    assert "growth_rate of mode 2 <= target" in problem.residual_names
    u = jnp.array([0.3, 0.4])
    first = problem.residual_names.index("growth_rate <= target")
    s: Any = np.asarray(fj.stability(problem.mechanism(u)).eigenvalues)
    rates = np.sinh(problem.residuals(u)[first : first + 2]) * problem.growth_scale + problem.target
    np.testing.assert_allclose(rates, np.sort(s[s.imag > 0].real)[::-1], rtol=1e-9)


@pytest.mark.slow
def test_slopes():
    """Those of the residuals in both modes, and those of all that a search limits."""
    problem = fj.DesignProblem(SOFT, BOUNDS)
    u, h = jnp.array([0.3, 0.4]), 1e-5
    row = jax.jit(lambda u: problem.at(u, problem.nominal_condition)[0])
    for function in (problem.residuals, row):
        forward = jax.jit(jax.jacfwd(function))(u)
        reverse = jax.jit(jax.jacrev(function))(u)
        np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
        for i, step in enumerate(h * np.eye(2)):
            ends = [function(u + k * step) for k in (-2, -1, 1, 2)]
            differences = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * h)
            np.testing.assert_allclose(forward[:, i], differences, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_designs():
    """With stiff bristles that of dry friction; with soft ones it is another, on the target."""
    best, dry = (fj.design(x, BOUNDS, progress=False) for x in (STIFF, DRY))
    for name in BOUNDS:
        np.testing.assert_allclose(best.scene[name], dry.scene[name], rtol=1e-5)
    soft = fj.design(SOFT, BOUNDS, progress=False)
    np.testing.assert_allclose(soft.growth_rate, -np.pi, rtol=1e-6)
    np.testing.assert_allclose(fj.growth_rate(soft.scene), soft.growth_rate, rtol=1e-9)
    assert abs(float(soft.scene.D - dry.scene.D)) > 1e-4
    many = fj.design_many([SOFT, STIFF], BOUNDS, progress=False)
    for i, one in enumerate((soft, best)):
        for name in BOUNDS:
            np.testing.assert_allclose(many.quantities[name][i], one.scene[name], rtol=1e-6)
    assert "mode" not in str(soft.active)


@pytest.mark.slow
def test_verdict():
    """Each answer is near that of dry friction; `Jenkins` is in series already."""
    stiff, dry = (fj.verdict(x, area=1e-4, progress=False) for x in (STIFF, DRY))
    names = [question.name for question in dry.questions]
    assert [question.name for question in stiff.questions] == names
    for one, other in zip(stiff.questions, dry.questions, strict=True):
        rates = [float(question.answer.split()[0]) for question in (one, other)]
        np.testing.assert_allclose(*rates, rtol=1e-3)
        assert one.quiet == other.quiet
    jenkins = fj.verdict(BRAKE.replace(friction=fj.Jenkins(0.4)), progress=False)
    assert "tangential spring in series" not in [question.name for question in jenkins.questions]
    assert jenkins.quiet
