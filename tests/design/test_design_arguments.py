"""`design` refuses what it cannot mean, by name and in one line, before it searches."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import fractaljax as fj

SCENE = fj.brake_scene()
SURFACE = SCENE.contact.surface
DESIGN = {
    "x": [None, 1, SURFACE, SCENE.replace(contact=fj.FixedContact(1e8, 1e8))],
    "bounds": [1, [], {}, {"P": (1, 2)}, {1: 2}, {"D": 2.4}, {"D": (2.3,)}, {"D": (2.5, 2.3)}],
    "objective": [1, "growth_rate"],
    "target": [np.nan, "0", True, [1.0], np.array([1.0])],
    "K_n_min": [-1.0, np.inf, np.array([1.0, 2.0])],
    "constraints": [1, fj.growth_rate, [1], {"a": 1}],
    "envelope": [1, {}, {"P": 1.0}, {"P": (2.0, 1.0)}, {"P": (1.0, np.inf)}, {"Q": (1, 2)}],
    "risk": [1, "best", ("cvar",), ("cvar", 1.0), ("worst", 1), (1, 2, 3)],
    "tolerance": [1, 0, False, [], {}, {"D": -1}, {"D": "1"}, {"D": np.nan}, {"Q": 1.0}],
    "quantile": [0.4, 1.0, np.nan, True, np.array([0.9])],
    "area_ratio_min": [0.5, np.nan],
    "slip_ratio_max": [0.0, 1.1],
    "friction_slope": ["no", 1, None, 0.0],
    "solver": [1, "SLSQP"],
    "starts": [0, -1, 1.5, True, "4", np.nan, np.inf, [4], 10**30, 65],
    "lattice": [0, 200_000, 10**30, np.nan],
    "seed": [-1, 0.5, 10**20, 2**63, True, None],
    "quiet_within": [0, -1.0, np.nan, "2", True, {}, [], [1.0], [1, 1, 1, 0], [[1.0] * 4] * 2],
    "search": [None, 1, "thorough", {}, {"renewals": 2}],
    "progress": ["no", None],
}


@pytest.mark.parametrize("argument", DESIGN)
def test_a_design_is_refused_before_its_search(argument, monkeypatch):
    """The message has the argument's name, and comes before anything is searched for."""
    monkeypatch.setattr("fractaljax._design.design.choose_starts", None)
    small: dict[str, Any] = dict(x=SCENE, lattice=8, starts=4, progress=False)
    for bad in DESIGN[argument]:
        with pytest.raises((TypeError, ValueError)) as refused:
            fj.design(**small | {argument: bad})
        message = str(refused.value)
        words = (argument, "scene", "FractalContact", "D bound", "bound", "envelope", "tolerance")
        assert any(word in message for word in words), (bad, message)
        assert len(message) < 250 and "\n" not in message, message


@pytest.mark.parametrize("bad", [0, -1, 1.5, True, None, "2", np.nan, [1], (0,), ()])
def test_a_search_is_refused_where_it_is_made(bad):
    """Every field of a search by its name."""
    for field in dataclasses.fields(fj.DesignSearch):
        if bad == [1] and field.name == "kick_starts":
            continue
        with pytest.raises((TypeError, ValueError), match=f"^{field.name} must be "):
            fj.DesignSearch(**{field.name: bad})
    assert fj.DesignSearch(kick_starts=[8, 16]) == fj.DesignSearch(kick_starts=(8, 16))
