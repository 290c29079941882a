"""Quantities that come one at a time: structures, damping, boundaries, topographies, cycles."""

import dataclasses
import statistics
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from tqdm import tqdm

import fractaljax as fj
from fractaljax.surface.topography import random_turns

from ..cycles.reference import reference
from ..timing import seconds
from . import cycles as cycle_extremes

mp: Any = mpmath.mp  # it makes its functions at run time
WAVES = 3  # of each length in a topography
CASES = Iterator[tuple[str, Callable[[], Any], Callable[[Any], float]]]


@dataclasses.dataclass(frozen=True)
class Other:
    """A quantity with its ranges, and its cases: a name, the call, the error of what it gave."""

    quantity: str
    ranges: str
    cases: Callable[[bool], CASES]


def chain(rng, n: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Mass and stiffness (n, n) of a chain, both over `spread` decades."""
    M = np.diag(10 ** rng.uniform(-spread / 2, spread / 2, n))
    k = 1e6 * 10 ** rng.uniform(-spread / 2, spread / 2, n + 1)
    return M, np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)


def damping_cases(quick: bool) -> CASES:
    """The damping ratios that come back from the matrix, by mpmath."""
    rng = np.random.default_rng(5)
    for spread in (1.0, 3.0) if quick else (0.0, 1.0, 3.0, 6.0):
        for ratio in (1e-8, 0.01, 1e3):
            M, K = chain(rng, 4, spread)

            def call(M=M, K=K, ratio=ratio):
                return fj.modal_damping(M, K, ratio)

            def error(C, M=M, K=K, ratio=ratio):
                with mp.workdps(40):
                    root = mp.diag([mp.sqrt(mp.mpf(m)) for m in np.diag(M)]) ** -1
                    w, X = mp.eigsy(root * mp.matrix(K.tolist()) * root)
                    own = X.T * root * mp.matrix(np.asarray(C).tolist()) * root * X
                    top = mp.sqrt(max(w))
                    return max(
                        float(
                            abs(own[i, i] / (2 * mp.sqrt(w[i])) / ratio - 1) * mp.sqrt(w[i]) / top
                        )
                        for i in range(4)
                    )

            yield f"masses and springs over {spread:g} decades, ratio {ratio:g}", call, error


def structure_cases(quick: bool) -> CASES:
    """Largest real part of a chain with one joint, by mpmath; beside the largest modulus."""
    rng = np.random.default_rng(6)
    for spread in (1.0,) if quick else (0.0, 1.0, 3.0, 6.0):
        for K_n in (1e3, 1e15) if quick else (1e3, 1e6, 1e9, 1e12, 1e15):
            M, K = chain(rng, 6, spread)
            C = 1e-6 * K
            joint = fj.Joint(fj.FixedContact(K_n, K_n / 2), fj.Coulomb(0.4), 2, 3)
            structure = fj.Structure(M, C, K, joint)

            def call(structure=structure):
                return fj.growth_rate(structure)

            def error(found, structure=structure):
                M, C, K = (np.asarray(x) for x in fj.assemble(structure))
                with mp.workdps(60):
                    inverse = mp.matrix(M.tolist()) ** -1
                    A, n = mp.zeros(12), 6
                    for i in range(n):
                        A[i, n + i] = 1
                    A[n:, :n] = -inverse * mp.matrix(K.tolist())
                    A[n:, n:] = -inverse * mp.matrix(C.tolist())
                    s = mp.eig(A, left=False, right=False)
                    exact, size = max(mp.re(z) for z in s), max(abs(z) for z in s)
                    return float(abs(mp.mpf(float(found)) - exact) / size)

            yield f"K_n = {K_n:g} N/m, {spread:g} decades", call, error


def boundary_cases(quick: bool) -> CASES:
    """Growth rate on the boundary, beside the frequency of the imaginary pair."""
    scene = fj.brake_scene()
    stiff = scene.replace(contact=fj.FixedContact(4e8, 2e8))
    windows = [(scene, ("D", 2.05, 2.95), ("G", 1e-14, 1e-6))]
    windows += (
        []
        if quick
        else [
            (scene, ("P", 1e-2, 1e8), ("D", 2.05, 2.95)),
            (stiff, ("K_n", 1e3, 1e15), ("mu_s", 0.26, 2.0)),
            (stiff, ("xi_1", 1e-6, 1e3), ("xi_2", 1e-6, 1e3)),
        ]
    )
    for own, x, y in windows:

        def call(own=own, x=x, y=y):
            return fj.hopf_boundary(own, x, y)

        def error(found):
            rates = [np.abs(b.growth_rate) / (2 * np.pi * b.frequency) for b in found.branches]
            return float(max((rate.max() for rate in rates), default=0.0))

        yield f"{x[0]} and {y[0]}", call, error


def topography_cases(quick: bool) -> CASES:
    """The double sum of Eq. 13 on a grid of 16 x 16, wave by wave; beside the largest height."""
    key, n, L = jax.random.key(1), 16, 1e-3
    for D in (2 + 1e-6, 2.5, 3 - 1e-6):
        for G in (1e-18,) if quick else (1e-18, 1e-10, 1e-4):
            for gamma in (1.5,) if quick else (1.05, 1.5, 10.0):
                surface = fj.Surface(D, G, gamma)

                def call(surface=surface):
                    return fj.topography(surface, L, n, key=key, M=WAVES)

                def error(z, surface=surface):
                    exact = double_sum(surface, L, n, key)
                    return float(np.abs(np.asarray(z) - exact).max() / np.abs(exact).max())

                yield f"D = {D:.7g}, G = {G:g} m, gamma = {gamma:g}", call, error


def double_sum(surface: fj.Surface, length: float, n: int, key) -> np.ndarray:
    """Eq. 13 by extended doubles, its phases being those that the package draws."""
    D, G, gamma = (np.longdouble(float(x)) for x in (surface.D, surface.G, surface.gamma))
    L = np.longdouble(length)
    count = 1 + int(np.floor(np.log(n / 2) / np.log(float(gamma)) + 1e-9))
    turns = np.asarray(random_turns(key, count, WAVES)).astype(np.longdouble)
    x = (np.arange(n) * L / n)[:, None]
    y, pi = x.T, np.longdouble("3.14159265358979323846264338327950288")
    z = np.zeros((n, n), np.longdouble)
    for i in range(count):
        for m in range(WAVES):
            angle, phase = pi * (m + 1) / WAVES, 2 * pi * turns[i, m]
            wave = 2 * pi * gamma**i / L * (x * np.cos(angle) + y * np.sin(angle))
            z += gamma ** (i * (D - 3)) * (np.cos(phase) - np.cos(wave + phase))
    return L * (G / L) ** (D - 2) * np.sqrt(np.log(gamma) / WAVES) * z


def identify_cases(quick: bool) -> CASES:
    """One profile in other units: D must stay, and G go with the unit of length."""
    surface, n, L = fj.Surface(2.4, 1e-10), 1024, 1e-3
    z = np.asarray(fj.topography(surface, L, n, key=jax.random.key(2))[:, 0])
    given = fj.identify(z, L / n)
    for unit in (1e-9, 1e6) if quick else (1e-9, 1e-3, 1e3, 1e6):

        def call(unit=unit):
            return fj.identify(z * unit, L / n * unit)

        def error(found, unit=unit):
            return max(abs(found.D - given.D), abs(np.log(found.G / given.G / unit)))

        yield f"lengths times {unit:g}", call, error


OTHERS = [
    Other("modal_damping", "ratio 1e-8 to 1e3, chains over 0 to 6 decades", damping_cases),
    Other(
        "growth_rate of a Structure",
        "K_n 1e3 to 1e15 N/m on chains over 0 to 6 decades, dampers 1e-6 s times the springs",
        structure_cases,
    ),
    Other(
        "hopf_boundary",
        "D 2.05 to 2.95, G 1e-14 to 1e-6 m, P 1e-2 to 1e8 N, K_n 1e3 to 1e15 N/m, xi 1e-6 to 1e3",
        boundary_cases,
    ),
    Other(
        "topography", "D to 2 + 1e-6 and 3 - 1e-6, G 1e-18 to 1e-4 m, gamma to 10", topography_cases
    ),
    Other("identify", "lengths 1e-9 to 1e6 times those of a profile", identify_cases),
]


def other_row(other: Other, quick: bool) -> dict[str, Any]:
    """The row of a quantity: its worst error and its slowest case, in float64."""
    off, taken, bad = [], {}, 0
    for name, call, error in tqdm(list(other.cases(quick)), desc=other.quantity):
        call()
        taken[name], found = seconds(call)
        lost = error(found)
        bad += not np.isfinite(lost)
        off.append(lost)
    slowest = max(taken, key=lambda name: taken[name])
    middle = statistics.median(taken.values())
    return {
        "quantity": other.quantity,
        "ranges": other.ranges,
        "points": len(off),
        "worst": max(off),
        "not_finite": bad,
        "seconds": middle,
        "slowest": slowest,
        "slowest_ratio": taken[slowest] / middle,
    }


def grazing(quick: bool) -> list[dict[str, Any]]:
    """Cycles on both sides of the K_n at which direction 1 just touches the belt's velocity."""
    if quick:
        return []

    @jax.jit
    def stuck(K_n):
        cycle = fj.limit_cycle(reference(K_n), throw=False)
        return cycle.stick_fraction[0], cycle.period, cycle.error

    K = np.geomspace(1e8, 1e9, 31)
    sticks = np.array([float(stuck(jnp.asarray(k))[0]) > 0 for k in K])
    turns = np.flatnonzero(sticks[1:] != sticks[:-1])
    if not turns.size:
        return []
    a, b = K[turns[0]], K[turns[0] + 1]
    while b / a - 1 > 1e-9:
        middle = np.sqrt(a * b)
        inside = (float(stuck(jnp.asarray(middle))[0]) > 0) == sticks[turns[0]]
        a, b = (middle, b) if inside else (a, middle)
    rows = []
    for k in (a, b):
        fraction, period, error = (float(value) for value in stuck(jnp.asarray(k)))
        rows.append({"K_n": float(k), "stick": fraction, "period": period, "error": error})
    return rows


def motion(quick: bool) -> dict[str, Any]:
    """Limit cycles and tanh laws at their extremes, as the page of the limit cycle has them."""
    return {
        "cycles": cycle_extremes.extremes(quick),
        "layers": cycle_extremes.stiff_rows(quick),
        "grazing": grazing(quick),
    }
