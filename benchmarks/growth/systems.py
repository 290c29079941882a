"""Linearised systems (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g by family, and their growth rates.

Every family is hard in its own way; those near coalescence, where two eigenvalues meet and part
with infinite slope, come by their distance from it. The truth has 40 digits, by mpmath.
"""

from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
from mpmath import mpf

from ..truths import eigenvalues

mp: Any = mpmath.mp  # it makes its functions at run time

DISTANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
FLUTTER, STABLE = "flutter side", "stable side"
Columns = tuple[np.ndarray, ...]  # a, b, c_1, c_2, g


# ---------------------------------------------------------------------------------------------
# Families
# ---------------------------------------------------------------------------------------------


def stiffnesses(rng, n):
    """a and b [1/s^2] of a brake's size, and the coupling of mu from 0.05 to 0.8."""
    K_n, kappa, mu = 10 ** rng.uniform(7, 10, n), rng.uniform(0.1, 1, n), rng.uniform(0.05, 0.8, n)
    omega_1, omega_2 = 10 ** rng.uniform(3, 4.5, (2, n))
    return omega_1**2 + kappa * K_n, omega_2**2 + K_n, mu**2 * kappa * K_n**2


def damped(rng, n, low, high):
    """Both damping ratios even in the logarithm."""
    a, b, g = stiffnesses(rng, n)
    xi = 10 ** rng.uniform(low, high, (2, n))
    return a, b, 2 * xi[0] * np.sqrt(a), 2 * xi[1] * np.sqrt(b), g


def random(rng, n) -> Columns:
    """Lightly damped brakes, stable and unstable."""
    return damped(rng, n, -4, -1)


def strongly_damped(rng, n) -> Columns:
    """Damping ratios from 1 to 1000."""
    return damped(rng, n, 0, 3)


def real_roots(rng, n) -> Columns:
    """Both directions overdamped and weakly coupled: four real eigenvalues."""
    a, b, c_1, c_2, _ = damped(rng, n, 0.2, 1)
    return a, b, c_1, c_2, 1e-3 * rng.uniform(0, 1, n) * a * b


def no_leading_term(rng, n) -> Columns:
    """More mean damping than stiffness: p <= 0 in Ferrari's resolvent."""
    a, b = rng.uniform(0.1, 1, (2, n))
    c_1, c_2 = rng.uniform(2.2, 6, (2, n))
    return a, b, c_1, c_2, rng.uniform(0, 4, n)


def half_damped(a, b, g) -> Columns:
    """Every other system damped, the same in both directions, which leaves coalescence in place."""
    c = np.where(np.arange(len(a)) % 2, 2e-3 * np.sqrt(a), 0)
    return a, b, c, c, g


def near_coalescence(distance: float, side: str) -> Callable[..., Columns]:
    """The family with |a - b| = 2 sqrt(g) (1 -+ distance), on one side of coalescence."""

    def family(rng, n):
        a, _, g = stiffnesses(rng, n)
        away = -distance if side == FLUTTER else distance
        return half_damped(a, a + 2 * np.sqrt(g) * (1 + away), g)

    return family


def at_coalescence(rng, n) -> Columns:
    """|a - b| = 2 sqrt(g) in whole numbers, which float32 holds too: nothing parts the roots."""
    a, h = rng.integers(1, (2**20, 2**12), (n, 2)).T.astype(float)
    return half_damped(a, a + 2 * h, h**2)


FAMILIES: dict[str, Callable[..., Columns]] = {
    "random": random,
    "strongly damped": strongly_damped,
    "real roots": real_roots,
    "no positive leading term of the resolvent": no_leading_term,
}
# By distance and side; at 0 there are no sides.
COALESCING: dict[tuple[float, str], Callable[..., Columns]] = {
    (distance, side): near_coalescence(distance, side)
    for distance in DISTANCES
    for side in (FLUTTER, STABLE)
} | {(0.0, "both"): at_coalescence}


# ---------------------------------------------------------------------------------------------
# What LAPACK gets, and the truth
# ---------------------------------------------------------------------------------------------


def state_matrices(columns: Columns) -> tuple[np.ndarray, np.ndarray]:
    """[[0, I], [-K, -C]] (n, 4, 4) in units of a power of two near sqrt(a + b), and that (n,).

    Powers of two round nothing: LAPACK gets the very systems of the closed form.
    """
    a, b, c_1, c_2, g = columns
    omega = np.exp2(np.round(np.log2(a + b) / 2))
    p = np.exp2(np.round(np.log2(g) / 2))  # of the coupling p (g/p)
    A = np.zeros((len(a), 4, 4))
    A[:, 0, 2] = A[:, 1, 3] = 1
    A[:, 2, 0], A[:, 3, 1] = -a / omega**2, -b / omega**2
    A[:, 2, 1], A[:, 3, 0] = p / omega**2, -g / p / omega**2
    A[:, 2, 2], A[:, 3, 3] = -c_1 / omega, -c_2 / omega
    return A, omega


def exact_growth(a, b, c_1, c_2, g) -> tuple[Any, float]:
    """Largest real part with 40 digits, and the largest modulus."""
    # A coalescing eigenvalue has half the digits of the arithmetic.
    with mp.workdps(90):
        s = eigenvalues(*map(mpf, (a, b, c_1, c_2, g)))
        return mp.re(s[0]), float(max(map(abs, s)))
