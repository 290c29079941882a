"""Inputs from the corners and the middle of very wide ranges, out of numbers from 0 to 1.

Places u (n, k) are what a random generator or a property-based test draws; every function here
turns them into physical inputs, one row each, logarithmically where a range spans decades.
"""

from typing import NamedTuple

import numpy as np

EDGE = 1e-6  # how near D comes to 2 and 3


class Range(NamedTuple):
    """From `low` to `high` in logarithms, and 0 at the lowest twentieth of the places if `zero`."""

    low: float
    high: float
    zero: bool = False

    def at(self, u: np.ndarray) -> np.ndarray:
        """The values at places u from 0 to 1, any shape."""
        if self.zero:
            inside = np.maximum(u - 0.05, 0) / 0.95
            return np.where(u < 0.05, 0.0, Range(self.low, self.high).at(inside))
        # Bounded, for the last digit.
        return np.clip(self.low * (self.high / self.low) ** u, self.low, self.high)

    def __str__(self) -> str:
        return f"{'0, ' if self.zero else ''}{self.low:g} to {self.high:g}"


JOINT = {
    "G": Range(1e-18, 1e-4),
    "gamma - 1": Range(1e-3, 10),
    "E": Range(1e6, 1e13),
    "sigma_y/E": Range(1e-6, 1),
    "H/sigma_y": Range(1, 10),
    "P": Range(1e-6, 1e12),
    "mu_m": Range(1e-6, 0.9, zero=True),
    "mu_s/mu_m": Range(1, 1e3),
}
MECHANISM = {
    "m": Range(0.1, 10),
    "omega_1": Range(10, 1e5),
    "omega_2": Range(10, 1e5),
    "xi_1": Range(1e-8, 1e3, zero=True),
    "xi_2": Range(1e-8, 1e3, zero=True),
    "F": Range(1e-3, 1e3, zero=True),
    "V": Range(1e-3, 10),
    "K_n": Range(1e3, 1e15),
    "K_t/K_n": Range(1e-6, 1, zero=True),
    "mu_m": Range(1e-4, 0.9, zero=True),
    "mu_s/mu_m": Range(1, 100),
    "v_m/V": Range(0.5, 1e4),
}
AREA = {"L": Range(1e-8, 10), "L/L_s": Range(1, 1e8)}
JOINT_COLUMNS, MECHANISM_COLUMNS, ROUGHNESS_COLUMNS = 10, 12, 5


def dimension(u: np.ndarray) -> np.ndarray:
    """D: a third of the places each near 2, near 3 (to 1e-6, in logarithms) and in between."""
    edge = Range(EDGE, 0.1)
    low, high = 2 + edge.at(3 * np.minimum(u, 1 / 3)), 3 - edge.at(3 * (1 - np.maximum(u, 2 / 3)))
    middle = np.where(u == 0.5, 2.5, 2.1 + 0.8 * (3 * u - 1))
    return np.where(u < 1 / 3, low, np.where(u > 2 / 3, high, middle))


def joints(u: np.ndarray) -> np.ndarray:
    """Columns D, G, gamma, E, nu, sigma_y, H, P, mu_s, mu_m (n, 10) from places (n, 10)."""
    r, u = JOINT, u.T
    E = r["E"].at(u[3])
    sigma_y = E * r["sigma_y/E"].at(u[5])
    H = sigma_y * r["H/sigma_y"].at(u[6])
    mu_m = r["mu_m"].at(u[8])
    mu_s = np.maximum(mu_m, 1e-6) * r["mu_s/mu_m"].at(u[9])
    D, G, gamma = dimension(u[0]), r["G"].at(u[1]), 1 + r["gamma - 1"].at(u[2])
    return np.stack([D, G, gamma, E, u[4] / 2, sigma_y, H, r["P"].at(u[7]), mu_s, mu_m], 1)


def mechanisms(u: np.ndarray) -> np.ndarray:
    """Columns m, omega_1, omega_2, xi_1, xi_2, F, V, K_n, K_t, mu_s, mu_m, v_m from (n, 12)."""
    r, u = MECHANISM, u.T
    plain = [r[name].at(u[i]) for i, name in enumerate(("m", "omega_1", "omega_2", "xi_1", "xi_2"))]
    F = np.where(u[5] < 0.5, -1, 1) * r["F"].at(np.abs(2 * u[5] - 1))
    V, K_n, mu_m = r["V"].at(u[6]), r["K_n"].at(u[7]), r["mu_m"].at(u[9])
    mu_s = np.maximum(np.minimum(np.maximum(mu_m, 1e-4) * r["mu_s/mu_m"].at(u[10]), 2), mu_m)
    K_t, v_m = K_n * r["K_t/K_n"].at(u[8]), V * r["v_m/V"].at(u[11])
    return np.stack([*plain, F, V, K_n, K_t, mu_s, mu_m, v_m], 1)


def areas(u: np.ndarray) -> np.ndarray:
    """Columns D, G, gamma, L, L_s (n, 5) from places (n, 5)."""
    L = AREA["L"].at(u[:, 3])
    L_s = np.minimum(L / AREA["L/L_s"].at(u[:, 4]), L)
    gamma = 1 + JOINT["gamma - 1"].at(u[:, 2])
    return np.stack([dimension(u[:, 0]), JOINT["G"].at(u[:, 1]), gamma, L, L_s], 1)


def places(rng: np.random.Generator, n: int, k: int) -> np.ndarray:
    """Places (n, k): even ones, and rows with few or most of them at 0, 1/2 or 1."""
    u = rng.uniform(size=(n, k))
    at_corner = rng.uniform(size=(n, k)) < rng.choice([0.0, 0.2, 0.6], size=(n, 1))
    return np.where(at_corner, rng.choice([0.0, 0.5, 1.0], size=(n, k)), u)


def single(columns: np.ndarray) -> np.ndarray:
    """Joints, mechanisms or areas rounded to float32, kept inside their domain."""
    x, one = columns.astype(np.float32), np.float32(1)
    if x.shape[1] == MECHANISM_COLUMNS:
        x[:, 9] = np.maximum(x[:, 9], x[:, 10])
        return x
    x[:, 0] = np.clip(x[:, 0], np.nextafter(2 * one, 3 * one), np.nextafter(3 * one, 2 * one))
    if x.shape[1] == JOINT_COLUMNS:
        x[:, 6] = np.maximum(x[:, 5], x[:, 6])
        x[:, 9] = np.minimum(x[:, 9], np.float32(0.9))
        x[:, 8] = np.maximum(x[:, 8], x[:, 9])
    else:
        x[:, 4] = np.minimum(x[:, 3], x[:, 4])
    return x
