"""How designs move with what is held fixed: against designs solved again."""

from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from fractaljax._mechanism.quantities import value_of

SCENE = fj.brake_scene()
BOUNDS = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}


def designed(x=SCENE, **asked: Any) -> fj.Design:
    return fj.design(x, BOUNDS, progress=False, **asked)


def solved_again(name, h, **asked):
    """Differences of fourth order of D and G by a quantity, of the objective too."""
    ends = [
        designed(SCENE.replace(**{name: value}), **asked)
        for value in float(value_of(SCENE, name)) + h * np.array([-2, -1, 1, 2])
    ]
    rows = np.array(
        [[float(e.scene.contact.surface.D), float(e.scene.contact.surface.G)] for e in ends]
    )
    return (rows[0] - 8 * rows[1] + 8 * rows[2] - rows[3]) / (12 * h)


def told(best) -> fj.Sensitivity:
    assert best.sensitivity is not None
    return best.sensitivity


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        ("P", {}),
        pytest.param("mu_s", {}, marks=pytest.mark.slow),
        pytest.param("omega_2", {}, marks=pytest.mark.slow),
        pytest.param("xi_1", {}, marks=pytest.mark.slow),  # moves the target, too
        pytest.param("P", {"K_n_min": 4e9}, marks=pytest.mark.slow),
        pytest.param("P", {"objective": fj.growth_rate, "K_n_min": 3e9}, marks=pytest.mark.slow),
        pytest.param("mu_s", {"envelope": {"P": (1700, 2100)}}, marks=pytest.mark.slow),
    ],
)
def test_slopes_are_those_of_designs_solved_again(name, asked):
    best = designed(**asked)
    sensitivity = told(best)
    found = [sensitivity["D"][name], sensitivity["G"][name]]
    slope = solved_again(name, 1e-3 * float(value_of(SCENE, name)), **asked)
    np.testing.assert_allclose(found, slope, rtol=1e-4, atol=1e-12)


def test_multipliers_are_what_requirements_cost():
    """d(value)/d(target) by the multiplier of the growth rate, which is counted as arcsinh."""
    best = designed()
    assert list(told(best).multipliers) == ["growth_rate <= target"]
    cost = told(best).multipliers["growth_rate <= target"]
    h = 1e-3
    ends = [designed(target=best.target + k * h).value for k in (-1, 1)]
    # The slack of 1e-9 is that of the landing.
    assert -cost / (2 * np.pi) == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-5)


def test_ranges_end_where_another_requirement_becomes_active():
    """With K_n_min active beyond some load and not before, the foretold end is near."""
    best = designed()
    low, high = told(best).ranges["P"]
    assert low < 1907.3 < high
    assert "multipliers: growth_rate <= target: " in repr(told(best))


def test_what_cannot_be_told_is_none():
    """Infeasible, about cycles, or at its worst inside an envelope."""
    assert designed(SCENE.replace(mu_s=3.0)).sensitivity is None
    unchanged = fj.design(SCENE.replace(D=2.5), BOUNDS, progress=False)
    if unchanged.starts == 0:
        slopes = unchanged.sensitivity
        assert slopes is not None and set(slopes["D"].values()) == {0.0}
