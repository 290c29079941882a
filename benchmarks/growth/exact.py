"""The growth rate and its derivatives with 40 digits: the truth that errors are taken to."""

import dataclasses
from typing import Any

import mpmath
import numpy as np
from mpmath import mpf
from tqdm import tqdm

from ..exact_joint import exact_joint
from ..page import spread
from ..truths import mechanism
from .loops import tuned_loop

mp: Any = mpmath.mp  # it makes its functions at run time


JOINT = ("gamma", "E", "nu", "sigma_y", "H", "P", "mu_s", "mu_m")  # after D and G
MASS = ("m", "omega_1", "omega_2", "xi_1", "xi_2", "F", "V")  # before K_n and K_t
FRICTION = ("mu_s", "mu_m", "v_m")


def exact_growth(b: dict[str, float], D, log_G):
    """Growth rate [1/s] of the brake's numbers with another surface, to 60 digits."""
    joint = exact_joint(D, mp.exp(log_G), *(b[name] for name in JOINT))
    mass, friction = ([b[name] for name in names] for names in (MASS, FRICTION))
    return mechanism(*mass, joint["K_n"], joint["K_t"], *friction)["growth_rate"]


def exact_rows(b: dict[str, float], D: list[float], G: list[float]) -> np.ndarray:
    """Value and derivatives to D and ln G (n, 3) with 40 digits, rounded to doubles."""
    rows = []
    with mp.workdps(40):
        h = mpf(10) ** -12
        for d, g in zip(tqdm(D, desc="40 digits"), G, strict=True):
            x, y = mpf(d), mp.log(mpf(g))
            by_D = (exact_growth(b, x + h, y) - exact_growth(b, x - h, y)) / (2 * h)
            by_log_G = (exact_growth(b, x, y + h) - exact_growth(b, x, y - h)) / (2 * h)
            rows.append([float(v) for v in (exact_growth(b, x, y), by_D, by_log_G)])
    return np.array(rows)


@dataclasses.dataclass(frozen=True)
class Truth:
    """Some points of the loops, as many of each regime, with 40 digits."""

    places: list[int]
    rows: np.ndarray  # (n, 3): value, by D, by ln G
    omega: np.ndarray  # (n,) modulus of the critical eigenvalue [1/s]
    regimes: dict[str, float]  # their shares of the loops' points


def truth_of(numbers: dict[str, float], D: np.ndarray, G: np.ndarray, count: int) -> Truth:
    """The first points of each of the three regimes, by mpmath."""
    growth = tuned_loop(numbers)
    states = [growth(d, g) for d, g in zip(D.tolist(), G.tolist(), strict=True)]
    regimes = [state[2] for state in states]
    kinds = sorted(set(regimes))
    places = {kind: [i for i, r in enumerate(regimes) if r == kind] for kind in kinds}
    first = [i for kind in kinds for i in places[kind][: count // len(kinds)]]
    return Truth(
        places=first,
        rows=exact_rows(numbers, D[first].tolist(), G[first].tolist()),
        omega=np.array([states[i][1] for i in first]),
        regimes={kind: len(places[kind]) / len(D) for kind in kinds},
    )


def errors_of(rows: np.ndarray, truth: Truth) -> dict[str, Any]:
    """Errors of the growth rate in omega; of the gradient in its length, where it has one."""
    found = {"growth_rate": spread(np.abs(rows[:, 0] - truth.rows[:, 0]) / truth.omega)}
    if rows.shape[1] == 3:
        length = np.linalg.norm(truth.rows[:, 1:], axis=1)
        off = np.linalg.norm(rows[:, 1:] - truth.rows[:, 1:], axis=1)
        found["gradient"] = spread(off[length > 0] / length[length > 0])
    return found
