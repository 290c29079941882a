"""Test problems as plain numbers: mechanisms with joints, each with an attracting cycle.

They are in reference/mechanisms.json, beside the numbers of their cycles and with a note each. A
problem holds M, C, K, F and its joints: directions as vectors, V, the friction law with its
constants, and P, K_n, K_t where they are not zero. A joint without "normal" has the constant normal
force P; with "preload" false it is of the source's form. "start" is [x, x'], from which the cycle
is reached; "by" names quantities for derivatives.
"""

import copy
import json
from math import pi, sqrt
from pathlib import Path
from typing import Any

TABLE = Path(__file__).parent / "reference" / "mechanisms.json"


def read(problem) -> dict[str, Any]:
    """A problem of the table, its friction laws as (law, numbers)."""
    joints = [joint | {"friction": tuple(joint["friction"])} for joint in problem["joints"]]
    return problem | {"joints": joints}


PROBLEMS = {
    row["name"]: read(row["problem"]) for row in json.loads(TABLE.read_text("utf-8"))["rows"]
}

# The source's case of section 3.3, at K_n = 4e8 N/m.
PLAIN: dict[str, float] = {
    **{"m": 1.0, "omega_1": 2000 * pi, "omega_2": 1600 * pi, "xi_1": 0.001, "xi_2": 0.007},
    **{"F": 5.0, "V": 0.15, "K_n": 4e8, "K_t": 2e8, "mu_s": 0.4, "mu_m": 0.25, "v_m": 0.5},
}


def source_form(m, omega_1, omega_2, xi_1, xi_2, F, V, K_n, K_t, mu_s, mu_m, v_m) -> dict[str, Any]:
    """The source's two directions on a belt; constant friction where mu_m is mu_s."""
    law = ("stribeck", {"mu_s": mu_s, "mu_m": mu_m, "v_m": v_m})
    friction = ("coulomb", {"mu": mu_s}) if mu_m == mu_s else law
    joint = {"tangential": [1.0, 0.0], "normal": [0.0, 1.0], "preload": False}
    return {
        "M": [[m, 0.0], [0.0, m]],
        "C": [[2 * m * xi_1 * omega_1, 0.0], [0.0, 2 * m * xi_2 * omega_2]],
        "K": [[m * omega_1**2, 0.0], [0.0, m * omega_2**2]],
        "F": [F / sqrt(2), -F / sqrt(2)],
        "joints": [joint | {"V": V, "K_n": K_n, "K_t": K_t, "friction": friction}],
    }


def changed(problem, places, values):
    """The problem with numbers changed at dotted places, as `by` names them."""
    problem = copy.deepcopy(problem)
    for place, value in zip(places, values, strict=True):
        *path, last = (int(key) if key.isdigit() else key for key in place.split("."))
        table = problem
        for key in path:
            table = table[key]
            table = table[1] if isinstance(table, tuple) else table  # (law, numbers)
        table[last] = value
    return problem
