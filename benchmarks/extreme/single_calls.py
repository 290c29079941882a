"""Quantities that come one call at a time: structures, damping, boundaries, heights, motion."""

import itertools
import math
import statistics
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from scipy.optimize import brentq
from tqdm import tqdm

import fractaljax as fj
from fractaljax._surface.topography import random_phases

from ..timing import seconds
from ..transients import SCALE, V, outcomes, reference

mp: Any = mpmath.mp  # it makes its functions at run time
WAVES = 3  # of each length in a topography
Row = dict[str, Any]
Cases = Iterator[tuple[str, tuple]]  # a name, and what the quantity is computed from


def chain(rng, n: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Mass and stiffness (n, n) of a chain, both over `spread` decades."""
    M = np.diag(10 ** rng.uniform(-spread / 2, spread / 2, n))
    k = 1e6 * 10 ** rng.uniform(-spread / 2, spread / 2, n + 1)
    return M, np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)


def damping_cases() -> Cases:
    rng = np.random.default_rng(5)
    for spread, ratio in itertools.product((0.0, 1.0, 3.0, 6.0), (1e-8, 0.01, 1e3)):
        name = f"masses and springs over {spread:g} decades, ratio {ratio:g}"
        yield name, (*chain(rng, 4, spread), ratio)


def damping_error(C, M, K, ratio) -> float:
    """Of the damping ratios that come back from the matrix, by mpmath."""
    with mp.workdps(40):
        root = mp.diag([mp.sqrt(mp.mpf(m)) for m in np.diag(M)]) ** -1
        squares, X = mp.eigsy(root * mp.matrix(K.tolist()) * root)
        own = X.T * root * mp.matrix(np.asarray(C).tolist()) * root * X
        w = [mp.sqrt(square) for square in squares]
        return float(max(abs(own[i, i] / (2 * w[i]) / ratio - 1) * w[i] for i in range(4)) / max(w))


def structure_cases() -> Cases:
    rng = np.random.default_rng(6)
    for spread, K_n in itertools.product((0.0, 1.0, 3.0, 6.0), (1e3, 1e6, 1e9, 1e12, 1e15)):
        M, K = chain(rng, 6, spread)
        joint = fj.Joint(fj.FixedContact(K_n, K_n / 2), fj.Coulomb(0.4), 2, 3)
        yield f"K_n = {K_n:g} N/m, {spread:g} decades", (fj.Structure(M, 1e-6 * K, K, joint),)


def structure_error(found, structure: fj.Structure) -> float:
    """Of the largest real part, by mpmath; beside the largest modulus."""
    M, C, K = (mp.matrix(np.asarray(x).tolist()) for x in fj.assemble(structure))
    with mp.workdps(60):
        A, n = mp.zeros(12), 6
        for i in range(n):
            A[i, n + i] = 1
        A[n:, :n], A[n:, n:] = -(M**-1) * K, -(M**-1) * C
        s = mp.eig(A, left=False, right=False)
        exact, size = max(mp.re(z) for z in s), max(abs(z) for z in s)
        return float(abs(mp.mpf(float(found)) - exact) / size)


def boundary_cases() -> Cases:
    scene = fj.brake_scene()
    stiff = scene.replace(contact=fj.FixedContact(4e8, 2e8))
    for own, x, y in (
        (scene, ("D", 2.05, 2.95), ("G", 1e-14, 1e-6)),
        (scene, ("P", 1e-2, 1e8), ("D", 2.05, 2.95)),
        (stiff, ("K_n", 1e3, 1e15), ("mu_s", 0.26, 2.0)),
        (stiff, ("xi_1", 1e-6, 1e3), ("xi_2", 1e-6, 1e3)),
    ):
        yield f"{x[0]} and {y[0]}", (own, x, y)


def boundary_error(found, *_) -> float:
    """Growth rate on the boundary, beside the frequency of the imaginary pair."""
    rates = [np.abs(b.growth_rate) / (2 * np.pi * b.frequency) for b in found.branches]
    return float(max((rate.max() for rate in rates), default=0.0))


def topography_cases() -> Cases:
    ends = (2 + 1e-6, 2.5, 3 - 1e-6), (1e-18, 1e-10, 1e-4), (1.05, 1.5, 10.0)
    for D, G, gamma in itertools.product(*ends):
        given = fj.Surface(D, G, gamma), 1e-3, 16, jax.random.key(1)
        yield f"D = {D:.7g}, G = {G:g} m, gamma = {gamma:g}", given


def heights(surface: fj.Surface, length: float, n: int, key) -> jax.Array:
    return fj.topography(surface, length, n, key=key, M=WAVES)


def topography_error(z, surface: fj.Surface, length: float, n: int, key) -> float:
    """Beside the largest height of Eq. 13 wave by wave, its phases being the package's."""
    D, G, gamma = (np.longdouble(float(x)) for x in (surface.D, surface.G, surface.gamma))
    L = np.longdouble(length)
    count = 1 + int(np.floor(np.log(n / 2) / np.log(float(gamma)) + 1e-9))
    phases = np.asarray(random_phases(key, count, WAVES)).astype(np.longdouble)
    x = (np.arange(n) * L / n)[:, None]
    y, pi = x.T, np.longdouble("3.14159265358979323846264338327950288")
    exact = np.zeros((n, n), np.longdouble)
    for i, m in itertools.product(range(count), range(WAVES)):
        angle, phase = pi * (m + 1) / WAVES, 2 * pi * phases[i, m]
        wave = 2 * pi * gamma**i / L * (x * np.cos(angle) + y * np.sin(angle))
        exact += gamma ** (i * (D - 3)) * (np.cos(phase) - np.cos(wave + phase))
    exact *= L * (G / L) ** (D - 2) * np.sqrt(np.log(gamma) / WAVES)
    return float(np.abs(np.asarray(z) - exact).max() / np.abs(exact).max())


def identify_cases() -> Cases:
    n, L = 1024, 1e-3
    z = fj.topography(fj.Surface(2.4, 1e-10), L, n, key=jax.random.key(2))[:, 0]
    for unit in (1e-9, 1e-3, 1e3, 1e6):
        yield f"lengths times {unit:g}", (np.asarray(z), L / n, unit)


def identified(z: np.ndarray, step: float, unit: float = 1.0) -> Any:
    return fj.identify(z * unit, step * unit)


def identify_error(found, z: np.ndarray, step: float, unit: float) -> float:
    """One profile in other units: D must stay, and G go with the unit of length."""
    given = identified(z, step)
    return max(abs(found.D - given.D), abs(np.log(found.G / given.G / unit)))


STRUCTURES = "K_n 1e3 to 1e15 N/m on chains over 0 to 6 decades, dampers 1e-6 s times the springs"
BOUNDARIES = "D 2.05 to 2.95, G 1e-14 to 1e-6 m, P 1e-2 to 1e8 N, K_n 1e3 to 1e15 N/m, xi 1e-6 to"
CHAINS = "ratio 1e-8 to 1e3, chains over 0 to 6 decades"
SURFACES = "D to 2 + 1e-6 and 3 - 1e-6, G 1e-18 to 1e-4 m, gamma to 10"
UNITS = "lengths 1e-9 to 1e6 times those of a profile"
QUANTITIES = {  # ranges, cases, the quantity, its error
    "modal_damping": (CHAINS, damping_cases, fj.modal_damping, damping_error),
    "growth_rate of a Structure": (STRUCTURES, structure_cases, fj.growth_rate, structure_error),
    "hopf_boundary": (BOUNDARIES + " 1e3", boundary_cases, fj.hopf_boundary, boundary_error),
    "topography": (SURFACES, topography_cases, heights, topography_error),
    "identify": (UNITS, identify_cases, identified, identify_error),
}


def quantity_row(name: str, ranges: str, cases: Callable, call: Callable, error: Callable) -> Row:
    """The worst error of a quantity and its slowest case, in float64."""
    off, taken = [], {}
    for case, given in tqdm(list(cases()), desc=name):
        call(*given)
        taken[case], found = seconds(call, *given)
        off.append(error(found, *given))
    slowest, middle = max(taken, key=lambda case: taken[case]), statistics.median(taken.values())
    return {
        "quantity": name,
        "ranges": ranges,
        "points": len(off),
        "worst": max(off),
        "not_finite": int((~np.isfinite(off)).sum()),
        "seconds": middle,
        "slowest": slowest,
        "slowest_ratio": taken[slowest] / middle,
    }


# Motion


def bisect(inside: Callable[[float], bool], low: float, high: float) -> tuple[float, float]:
    """The two ends, 1e-9 apart in the logarithm, between which a property changes."""
    first = inside(low)
    while math.log(high / low) > 1e-9:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if inside(middle) == first else (low, middle)
    return low, high


def barely(sign: int) -> fj.Scene:
    """The reference scene with so little friction that its growth rate is +-1e-6 omega."""

    def weaker(share):
        return reference().replace(friction=fj.Stribeck(0.4 * share, 0.25 * share, 0.5))

    def gap(share):
        return float(fj.growth_rate(weaker(share))) / SCALE - sign * 1e-6

    return weaker(brentq(gap, 0.01, 1.0, xtol=1e-15))


def scenes() -> dict[str, fj.Scene]:
    """Where the search for a cycle may fail."""
    base, brake = reference(), fj.brake_scene()

    def sticks(G):
        return float(fj.stiffness(brake.replace(G=G))[1]) > 0

    slip, plastic = bisect(sticks, 1e-11, 1e-10), bisect(sticks, 2e-10, 4e-10)
    undamped = base.replace(xi_1=0.0, xi_2=0.0)
    return (
        {f"K_n = {K:.0e} N/m": reference(K) for K in 10.0 ** np.arange(6, 14)}
        | {f"V = {v:g} m/s": base.replace(V=v) for v in (1e-4, 1e-3, 1e-2, 0.5, 1.0)}
        | {
            "xi_1 = xi_2 = 0": undamped,
            "F = 0": base.replace(F=0.0),
            "xi_1 = xi_2 = 0, F = 0": undamped.replace(F=0.0),
            "growth 1e-6 omega": barely(1),
            "growth -1e-6 omega": barely(-1),
            "brake": brake,
            "brake, G at gross slip, outside": brake.replace(G=slip[0]),
            "brake, G at gross slip, inside": brake.replace(G=slip[1]),
            "brake, G at fully plastic, inside": brake.replace(G=plastic[0]),
            "brake, G at fully plastic, outside": brake.replace(G=plastic[1]),
        }
        | {f"brake, D = {D:g}": brake.replace(D=D) for D in (2.45, 2.9)}
    )


def cycles() -> list[Row]:
    """One row a scene, by the exact law."""

    @eqx.filter_jit
    def describe(scene):
        cycle = fj.limit_cycle(scene, throw=False)
        omega = jnp.sqrt(fj.stiffness(scene)[0] / scene.oscillator.m)
        off = jnp.abs(cycle.multipliers - 1).min()
        numbers = {"period": cycle.period, "error": cycle.error, "trivial_multiplier_off": off}
        return cycle.result, cycle.returns, fj.growth_rate(scene) / omega, numbers

    rows = []
    for name, scene in tqdm(scenes().items(), desc="extreme"):
        describe(scene)
        elapsed, (result, returns, growth, numbers) = seconds(describe, scene)
        numbers = {key: float(value) for key, value in numbers.items()}
        why, (outcome,) = None, outcomes(result)
        if not all(map(math.isfinite, numbers.values())):
            why, numbers = str(fj.CycleResult[result]), dict.fromkeys(numbers)
        row = {"name": name, "result": outcome, "turns": int(returns), "seconds": elapsed}
        growth = float(growth) if math.isfinite(growth) else None
        rows.append(row | {"growth_by_omega": growth, "non_finite": why} | numbers)
    return rows


def layers() -> list[Row]:
    """Three periods of the tanh law from a point of the exact cycle: how far it comes back."""
    cycle = fj.limit_cycle(reference(), segments=64)
    units = np.array([V / SCALE, V / SCALE, V, V])
    rows = []
    for eps in 10.0 ** np.arange(-3, -9, -1):

        def run(eps=eps):
            options = {"solver": diffrax.Kvaerno5(), "max_steps": 200_000, "throw": False}
            t1 = 3 * cycle.period
            return fj.simulate(reference(), cycle.state, t1, regularisation=eps, **options)

        run()
        elapsed, found = seconds(run)
        off = float(np.max(np.abs(np.asarray(found.end - cycle.state)) / units))
        rows.append(
            {
                "eps": float(eps),
                "result": str(fj.SimulationResult[found.result]),
                "steps": int(np.sum(np.diff(found.times) > 0)),
                "seconds": elapsed,
                "off_the_exact_cycle": off if math.isfinite(off) else None,
            }
        )
    return rows


def grazing() -> list[Row]:
    """Cycles on both sides of the K_n at which direction 1 just touches the belt's velocity."""

    @jax.jit
    def cycle(K_n):
        found = fj.limit_cycle(reference(K_n), throw=False)
        return {"stick": found.stick_fraction[0], "period": found.period, "error": found.error}

    def sticks(K_n):
        return float(cycle(K_n)["stick"]) > 0

    K = np.geomspace(1e8, 1e9, 31).tolist()
    for low, high in itertools.pairwise(K):
        if sticks(low) != sticks(high):
            found = {k: cycle(k) for k in bisect(sticks, low, high)}
            return [{"K_n": k} | {n: float(x) for n, x in r.items()} for k, r in found.items()]
    return []
