"""What a problem traces, its names, and residuals that inform on both sides of a boundary."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.constraints import NormalStiffness
from fractaljax._design.rows import describe, linearised
from fractaljax._design.statement import DEFAULT_BOUNDS
from fractaljax._design.tolerance import Tolerance
from structures import fractal_joints
from tools import primitives

STATED: dict[str, Any] = dict(
    objective=None,
    target=None,
    K_n_min=1e8,
    constraints=(),
    envelope=None,
    tolerance=None,
    quantile=0.95,
    area_ratio_min=2.0,
    slip_ratio_max=0.9,
    friction_slope=True,
)


def stated(x=None, bounds=DEFAULT_BOUNDS, **changes):
    return fj.DesignProblem(fj.brake_scene() if x is None else x, bounds, **STATED | changes)


def traced(problem, conditions=0):
    """The program of a search as text, and how many operations it has."""
    jaxpr = jax.make_jaxpr(linearised)(problem, jnp.full((4, 2), 0.5), jnp.ones((4, conditions)))
    return str(jaxpr), sum(primitives(jaxpr.jaxpr).values())


def test_only_what_is_asked_is_traced_and_once():
    """No scatter and no tangential law without them."""
    plain, size = traced(stated())
    assert not any(word in plain for word in ("sort", "cumsum", "log_sum_exp", "f64[55"))
    scattered, _ = traced(stated(tolerance=Tolerance.of({"D": 0.005})))
    assert "cumsum" in scattered and "f64[55" in scattered
    enveloped, _ = traced(stated(envelope=fj.Envelope({"P": (1500.0, 2500.0)})), 1)
    assert "cumsum" not in enveloped
    assert traced(stated(fj.brake_scene().replace(stiffness_ratio=0.2)))[1] < size
    # Two designs of one kind differ in leaves alone.
    first, second = (
        stated(
            envelope=fj.Envelope({"P": (1500.0, high)}),
            tolerance=Tolerance.of({"D": sigma}),
            constraints=(NormalStiffness(limit),),
        )
        for high, sigma, limit in [(2500.0, 0.005, 1e8), (2600.0, 0.004, 2e8)]
    )
    assert jax.tree.structure(first) == jax.tree.structure(second)


def test_names_are_in_the_order_of_the_residuals():
    """Plain functions and constraints keep their places."""

    def coarse(scene):
        return scene.contact.surface.D - 2.42

    problem = stated(constraints=(NormalStiffness(4e8), coarse, NormalStiffness(5e8)))
    assert problem.residual_names == [
        "a_l >= area_ratio_min a_e",
        "Q_e <= slip_ratio_max mu_s P",
        "growth_rate <= target",
        "K_n >= K_n_min",
        "K_n >= 4e+08 N/m",
        "coarse",
        "K_n >= 5e+08 N/m",
    ]
    row = problem.at(problem.start, problem.nominal_condition)[0][problem.named_columns]
    assert row[0] == 0 and row[-2] == pytest.approx(2.4 - 2.42) and row.shape == (8,)


@pytest.mark.slow
def test_requirements_are_those_of_the_contacts_that_a_design_moves():
    """Of a structure every fractal joint by name; nothing of a joint that stays as it is."""
    structure = fractal_joints()
    names = stated(structure, {"left.D": (2.3, 2.8)}).residual_names
    assert names[:2] == ["left: a_l >= area_ratio_min a_e", "left: Q_e <= slip_ratio_max mu_s P"]
    assert not any("right" in name for name in names)
    both = stated(structure, {"D": (2.3, 2.8)})
    assert both.contacts == ("left", "right")
    assert len(both.residual_names) == 6 + both.modes
    only = ["growth_rate <= target"]
    assert stated(bounds={"omega_1": (5e3, 7e3)}).residual_names == only
    fixed = fj.brake_scene().replace(contact=fj.FixedContact(4e8, 2e8))
    assert stated(fixed, {"K_t/K_n": (0.1, 0.6), "mu": (0.1, 0.5)}).residual_names == only


@pytest.mark.slow
def test_scaled_variables_and_the_default_target():
    bounds = {"D": (2.3, 2.8), "P": (500.0, 8000.0), "mu_s": (0.3, 0.5)}
    problem = stated(bounds=bounds)
    assert problem.logarithmic == (False, True, False)
    np.testing.assert_allclose(
        list(problem.quantities(jnp.full(3, 0.5)).values()), [2.55, 2000, 0.4]
    )
    np.testing.assert_allclose(problem.scaled(fj.brake_scene()), problem.start, rtol=1e-12)
    moved = problem.mechanism_at(jnp.array([0.2, 0.5, 1.0]), problem.nominal_condition)
    assert pytest.approx(2000) == moved.contact.P and moved.friction.mu_s == pytest.approx(0.5)
    # Of a scene in closed form; of the same as a structure by its eigenvalues without friction.
    scene = fj.brake_scene()
    for x, bounds in (
        (scene, {"D": (2.3, 2.8)}),
        (fj.Structure.from_scene(scene), {"D": (2.3, 2.8)}),
    ):
        assert stated(x, bounds).target == pytest.approx(-np.pi, rel=1e-9)


@pytest.mark.slow
def test_residuals_inform_on_both_sides_of_regime_boundaries():
    """Where growth and stiffness are flat, the area and slip residuals still have a slope."""
    problem = stated()
    area, slip, growth = 1, 2, 3
    plastic = problem.scaled(fj.brake_scene().replace(D=2.2, G=1e-9))
    us = np.array([plastic, [0.75, 0.25]])
    _, jacobians, _ = linearised(problem, us, np.zeros((2, 0)))
    assert jnp.all(jacobians[0, growth] == 0) and jnp.all(jnp.abs(jacobians[0, area]) > 1)
    assert jnp.all(jnp.abs(jacobians[1, slip]) > 1)
    for u, jacobian in zip(us, jacobians, strict=True):
        reverse = jax.jacrev(lambda u: problem.at(u, problem.nominal_condition)[0])(jnp.asarray(u))
        np.testing.assert_allclose(jacobian, reverse, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("form", [True, "linear"])
def test_load_curves_are_kept(form):
    """A design of a joint that follows its load curve asks for the growth rate on that curve."""
    brake = fj.brake_scene()
    law = fj.PerssonContact(
        brake.contact.surface, brake.contact.material, P=1907.3, area=1e-3, L=1e-2, L_s=1e-6
    )
    scene = fj.Scene(law, brake.friction, brake.oscillator, form).replace(F=800.0)
    problem = stated(scene, {"D": (2.3, 2.6)}, K_n_min=None)
    found = describe(problem, problem.scaled(scene)[None])
    assert found["growth_rate"][0] == pytest.approx(float(fj.growth_rate(scene)), rel=1e-9)


@pytest.mark.slow
def test_limits_of_a_search_are_all_but_what_is_minimised():
    """The growth rates of a structure by another law are limited, those that are minimised not."""
    structure = fractal_joints()
    law = fj.AsperityContact(
        structure.joints[0].contact.surface, structure.joints[0].contact.material, 1500.0, L_s=1e-6
    )
    least = fj.DesignProblem(
        structure, {"left.D": (2.3, 2.8)}, fj.growth_rate, laws=[law], K_n_min=0.0, modes=2
    )
    names = ["objective", *least.residual_names]
    limited = [names[i] for i in np.flatnonzero(least.limited)]
    assert [name for name in limited if "growth" in name] == [
        "growth_rate <= target by AsperityContact",
        "growth_rate of mode 2 <= target by AsperityContact",
    ]
    nearest = least.with_fields(objective=None)
    assert not nearest.limited[nearest.growth_columns].any() and nearest.limited[-1]
