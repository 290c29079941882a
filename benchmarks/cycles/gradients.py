"""Gradients of period and amplitude by K_n, mu_s and V: of the package, and by differences."""

import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj

from ..page import cell, table, versions
from ..timing import compiled, taking_turns
from .events import heyoka_events
from .reference import PLACE, SLOPES, reference
from .transients import last_turn, law

REPEATS = 11
STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # relative, of the central differences
PERIODS, TIGHT = 120, 2.3e-16  # of the peer: what is left of the transient is rounding
AT = np.array([PLACE[name] for name in SLOPES])


def measures(place: jax.Array) -> jax.Array:
    """Period [s] and amplitude [m] (2,) at K_n, mu_s and V (3,)."""
    K_n, mu_s, V = place
    cycle = fj.limit_cycle(reference(K_n, mu_s, V), throw=False)
    return jnp.stack([cycle.period, cycle.amplitude[0]])


def differences(value: Callable, step: float) -> Callable[[], np.ndarray]:
    """Central differences of a function of a place (3,): derivatives (2, 3)."""

    def run() -> np.ndarray:
        columns = []
        for k, x in enumerate(AT):
            h = step * x * np.eye(len(AT))[k]
            columns.append((np.asarray(value(AT + h)) - np.asarray(value(AT - h))) / (2 * step * x))
        return np.stack(columns, axis=1)

    return run


def errors(found: Any) -> np.ndarray:
    """Relative errors (2, 3) of derivatives."""
    return np.abs(np.asarray(found) / np.array(list(SLOPES.values())).T - 1)


def best_step(value: Callable) -> float:
    """The step at which differences are off by least, at worst."""
    return min(STEPS, key=lambda step: float(np.max(errors(differences(value, step)()))))


def peer(place: np.ndarray) -> tuple[float, float]:
    """heyoka's period and amplitude at a place (3,)."""
    numbers = law(*(float(x) for x in place))
    return last_turn(numbers, heyoka_events(numbers, TIGHT, PERIODS)())


def measure() -> list[dict[str, Any]]:
    """One row a method: time, compile time, time to that of the value, errors."""
    at = jnp.array(AT)
    value, compile_s = compiled(measures, at)
    methods: dict[str, tuple[float | None, Callable]] = {
        "value alone": (compile_s, lambda: value(at))
    }
    for name, mode in (("forward mode", jax.jacfwd), ("reverse mode", jax.jacrev)):
        program, compile_s = compiled(mode(measures), at)
        methods[name] = compile_s, lambda program=program: program(at)
    step = best_step(lambda place: value(jnp.array(place)))
    own = differences(lambda place: value(jnp.array(place)), step)
    methods[f"differences of the value, 6 calls, step {step:g}"] = None, own
    if "heyoka" in versions("heyoka"):
        step = best_step(peer)
        name = f"differences of heyoka by events, 6 runs of {PERIODS} periods, step {step:g}"
        methods[name] = None, differences(peer, step)
    found = {name: np.asarray(call()) for name, (_, call) in methods.items()}
    times = taking_turns({name: call for name, (_, call) in methods.items()}, REPEATS)
    plain = times["value alone"]
    return [
        {
            "name": name,
            "compile_s": compile_s,
            "seconds": statistics.median(times[name]),
            "ratio_to_value": statistics.median(
                a / b for a, b in zip(times[name], plain, strict=True)
            ),
            "errors": None if found[name].ndim == 1 else errors(found[name]).tolist(),
        }
        for name, (compile_s, _) in methods.items()
    ]


def choice(rows: list[dict[str, Any]]) -> str:
    """Which way to a gradient, in one sentence."""
    own = min(rows[1:3], key=lambda r: r["ratio_to_value"])
    last = rows[-1]
    return (
        f"Take {own['name']} for the gradients by three quantities of one cycle:"
        f" {own['ratio_to_value']:.2g} times the value's time, errors up to"
        f" {np.max(own['errors']):.0e}; {last['name']}, takes"
        f" {last['seconds'] / own['seconds']:.1f} times as long for up to"
        f" {np.max(last['errors']):.0e}."
    )


def section(rows: list[dict[str, Any]]) -> list[str]:
    """The lines of a page: one sentence, the table, how it was measured."""
    headings = ["method", "compile [s]", "time [ms]", "to the value's"]
    headings += [f"error by {name}: period, amplitude" for name in SLOPES]
    lines = []
    for found in rows:
        compile_s = found["compile_s"]
        wrong = found["errors"] and zip(*found["errors"], strict=True)
        lines.append(
            [
                found["name"],
                cell(compile_s, ".1f"),
                f"{found['seconds'] * 1e3:.3g}",
                f"{found['ratio_to_value']:.2f}",
                *([f"{T:.1e}, {A:.1e}" for T, A in wrong] if wrong else ["-"] * len(SLOPES)),
            ]
        )
    return [
        "## Gradients",
        "",
        choice(rows),
        "",
        *table(headings, lines),
        "",
        "All derivatives by K_n (K_t/K_n fixed), mu_s and V at once; the truth has 19 digits by K_n"
        " and nine to ten by mu_s and V, where smaller errors cannot be told apart. Differences"
        f" are central, at that relative step of {', '.join(f'{step:g}' for step in STEPS)} which"
        " is best at worst: a user would not know it.",
        "",
    ]
