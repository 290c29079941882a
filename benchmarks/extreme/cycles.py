"""Limit cycles where the search for one may fail, and the tanh law where its layer is thin."""

import math
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq
from tqdm import tqdm

import fractaljax as fj

from ..cycles.reference import MEMBERS, SCALE, V, member, reference
from ..page import cell, table
from ..timing import seconds


def barely(sign: int) -> fj.Scene:
    """The reference scene with so little friction that its growth rate is +-1e-6 omega."""

    def weaker(share):
        return reference().replace(friction=fj.Stribeck(0.4 * share, 0.25 * share, 0.5))

    def gap(share):
        return float(fj.growth_rate(weaker(share))) / SCALE - sign * 1e-6

    return weaker(brentq(gap, 0.01, 1.0, xtol=1e-15))


def edge(low: float, high: float) -> tuple[float, float]:
    """The two neighbouring G between which K_t becomes zero or ceases to be."""
    brake = fj.brake_scene()

    def stiff(log_G):
        return float(fj.stiffness(brake.replace(G=math.exp(log_G)))[1]) > 0

    a, b = math.log(low), math.log(high)
    first = stiff(a)
    while b - a > 1e-9:
        middle = (a + b) / 2
        a, b = (middle, b) if stiff(middle) == first else (a, middle)
    return math.exp(a), math.exp(b)


def extreme_scenes(quick: bool) -> dict[str, fj.Scene]:
    """Where the search for a cycle may fail."""
    base = reference()
    scenes = {f"K_n = {K:.0e} N/m": reference(K) for K in 10.0 ** np.arange(6, 14)}
    scenes |= {f"V = {v:g} m/s": base.replace(V=v) for v in (1e-4, 1e-3, 1e-2, 0.5, 1.0)}
    scenes |= {
        "xi_1 = xi_2 = 0": base.replace(xi_1=0.0, xi_2=0.0),
        "F = 0": base.replace(F=0.0),
        "xi_1 = xi_2 = 0, F = 0": base.replace(xi_1=0.0, xi_2=0.0, F=0.0),
        "growth 1e-6 omega": barely(1),
        "growth -1e-6 omega": barely(-1),
    }
    if quick:
        return {name: scenes[name] for name in ("K_n = 1e+06 N/m", "V = 1 m/s", "F = 0")}
    brake = fj.brake_scene()
    slip, stiff = edge(1e-11, 1e-10)
    last, soft = edge(2e-10, 4e-10)
    scenes |= {
        "brake": brake,
        "brake, G at gross slip, outside": brake.replace(G=slip),
        "brake, G at gross slip, inside": brake.replace(G=stiff),
        "brake, G at fully plastic, inside": brake.replace(G=last),
        "brake, G at fully plastic, outside": brake.replace(G=soft),
        "brake, D = 2.45": brake.replace(D=2.45),
        "brake, D = 2.9": brake.replace(D=2.9),
    }
    return scenes


def extremes(quick: bool) -> list[dict[str, Any]]:
    """One row a scene, by the exact law."""

    @eqx.filter_jit
    def describe(scene):
        cycle = fj.limit_cycle(scene, throw=False)
        one = cycle.multipliers[jnp.argmin(jnp.abs(cycle.multipliers - 1))]
        K_n, _ = fj.stiffness(scene)
        omega = jnp.sqrt(K_n / scene.oscillator.m)
        numbers = (
            fj.growth_rate(scene) / omega,
            cycle.period,
            cycle.error,
            jnp.abs(one - 1),
            cycle.amplitude[0],
            jnp.max(cycle.stick_fraction),
        )
        return member(cycle), cycle.turns, numbers

    rows = []
    for name, scene in tqdm(extreme_scenes(quick).items(), desc="extreme"):
        describe(scene)
        elapsed, (result, turns, numbers) = seconds(describe, scene)
        growth, period, error, trivial, size, stuck = (float(x) for x in numbers)
        result = MEMBERS[int(result)]
        why = None
        if not all(math.isfinite(x) for x in (period, error, trivial, size)):
            why = str(fj.CycleResult[getattr(fj.CycleResult, result)])
        rows.append(
            {
                "name": name,
                "result": result,
                "growth_by_omega": growth if math.isfinite(growth) else None,
                "turns": int(turns),
                "seconds": elapsed,
                "non_finite": why,
            }
            | dict(
                zip(
                    ("period", "error", "trivial_multiplier_off", "amplitude", "stick_fraction"),
                    (None,) * 5 if why else (period, error, trivial, size, stuck),
                    strict=True,
                )
            )
        )
    return rows


def stiff_rows(quick: bool) -> list[dict[str, Any]]:
    """Three periods of the tanh law from a point of the exact cycle: how far it comes back."""
    cycle = fj.limit_cycle(reference(), segments=64)
    units = np.array([V / SCALE, V / SCALE, V, V])
    rows = []
    for eps in () if quick else 10.0 ** np.arange(-3, -9, -1):
        periods = 3

        def run(eps=eps, periods=periods):
            return fj.simulate(
                reference(),
                cycle.state,
                periods * cycle.period,
                regularisation=eps,
                solver=diffrax.Kvaerno5(),
                max_steps=200000,
                throw=False,
            )

        run()
        elapsed, found = seconds(run)
        off = np.max(np.abs(np.asarray(found.end - cycle.state)) / units)
        moved = np.asarray(jnp.diff(found.times) > 0)
        rows.append(
            {
                "eps": float(eps),
                "result": str(fj.SimulationResult[found.result]),
                "steps": int(np.sum(moved)),
                "seconds": elapsed,
                "finite": bool(np.isfinite(off)),
                "off_the_exact_cycle": float(off) if np.isfinite(off) else None,
            }
        )
    return rows


def extreme_table(rows: list[dict[str, Any]]) -> list[str]:
    """The lines of `extremes`' table."""
    headings = [
        "scene",
        "result",
        "growth / omega",
        "turns",
        "period [s]",
        "estimated error",
        "trivial multiplier - 1",
        "time [ms]",
        "non-finite",
    ]
    return table(
        headings,
        [
            [
                r["name"],
                r["result"],
                cell(r["growth_by_omega"], ".1e"),
                str(r["turns"]),
                cell(r["period"], ".6g"),
                cell(r["error"], ".1e"),
                cell(r["trivial_multiplier_off"], ".1e"),
                f"{r['seconds'] * 1e3:.3g}",
                r["non_finite"] or "no",
            ]
            for r in rows
        ],
    )


def stiff_table(rows: list[dict[str, Any]]) -> list[str]:
    """The lines of `stiff_rows`' table."""
    return table(
        ["eps [m/s]", "result", "steps", "time [s]", "off the exact cycle, scaled"],
        [
            [
                f"{r['eps']:.0e}",
                r["result"],
                str(r["steps"]),
                f"{r['seconds']:.3g}",
                cell(r["off_the_exact_cycle"], ".1e"),
            ]
            for r in rows
        ],
    )
