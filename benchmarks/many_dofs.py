"""One limit cycle of 40 degrees of freedom and three joints, against a compiled event loop.

Two elastic rods, one along the joints' tangents, one along their normals, under friction that falls
with speed. The peer is event_loop.py, from the same start until its returns repeat; the truth is
the same loop with the tightest of its tolerances.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import fractaljax as fj
from fractaljax._dynamics.scaled import hybrid_system, scaled_start

from . import event_loop
from .page import columns, draw, png, subplots, table, verdict
from .timing import compiled, ratio, taking_turns

TITLE = "A limit cycle of many degrees of freedom"
PACKAGES = ("numpy", "numba")
FULL = {"n": (12, 24, 40), "repeats": 7}
QUICK = {"n": (12,), "repeats": 1}
RTOL = 1e-8
TRUTH = 1e-12  # tolerance of the loop; its returns then repeat to ten times that
RETURNS = 1000  # of the loop, at most
WANTED = (0.0, 3.0)  # times as long as the loop, and the gradient as the value
OWN, SLOPE, PEER = "fractaljax", "fractaljax, with gradient", "event loop"
Row = dict[str, Any]


def rods(n: int) -> fj.Structure:
    """Two rods of n/2 masses each, with joints at the tip, the middle and half way between."""
    N = n // 2
    chain = np.diag([2.0] * (N - 1) + [1.0]) - np.eye(N, k=1) - np.eye(N, k=-1)
    M, K = np.eye(n) / N, np.kron(np.eye(2), N * chain)
    law = fj.ExponentialStribeck(0.6, 0.45, 0.5)
    joints = {}
    for name, place, P in (("tip", N, 1.0), ("middle", N // 2, 0.5), ("between", 3 * N // 4, 0.5)):
        contact = fj.FixedContact(1.0, 0.0, P=P)
        joints[name] = fj.Joint(contact, law, place - 1, N + place - 1, V=0.5, preload=True)
    return fj.Structure(M, 0.02 * M + 0.1 * K, K, joints)


def by_loop(structure: fj.Structure, rtol: float) -> Callable[[], tuple[float, int, int]]:
    """A call of the loop: the period [s], its steps and its returns."""
    system, omega, _ = event_loop.arguments(structure)
    start = np.asarray(scaled_start(hybrid_system(structure), None))
    run, slips = event_loop.loop(), np.ones(len(structure.joints), dtype=np.int64)

    def call():
        period, *_, steps, returns = run(
            start.copy(), slips.copy(), system, rtol, 10 * rtol, RETURNS
        )
        return period / omega, steps, returns

    return call


def own(structure: fj.Structure) -> dict[str, tuple[Callable, float]]:
    """The period alone, and with its derivative by P of the tip, compiled; and the seconds."""

    def period(P):
        return fj.limit_cycle(structure.replace(**{"tip.P": P}), rtol=RTOL, throw=False).period

    calls = {}
    for name, function in {OWN: period, SLOPE: jax.value_and_grad(period)}.items():
        program, compile_s = compiled(function, 1.0)
        calls[name] = functools.partial(program, 1.0), compile_s
    return calls


def measure(n: tuple[int, ...], repeats: int) -> Row:
    """All numbers of the page."""
    try:
        event_loop.loop()
        installed = True
    except ImportError:
        installed = False
    rows, headline = [], []
    for count in n:
        structure = rods(count)
        made = own(structure)
        calls = {name: call for name, (call, _) in made.items()}
        truth = None
        if installed:
            truth, calls[PEER] = by_loop(structure, TRUTH)()[0], by_loop(structure, RTOL)
        found = {name: call() for name, call in calls.items()}
        times = taking_turns(calls, repeats)
        for name, taken in times.items():
            period = float(found[name] if name == OWN else found[name][0])
            row: Row = {"name": name, "n": count, "period": period}
            row |= {"compile_s": made[name][1] if name in made else None}
            row |= {"time_s": float(np.median(taken))}
            row |= {"error": abs(period / truth - 1) if truth else None}
            row |= {"returns": found[name][2] if name == PEER else None}
            row |= {"ratio": ratio(taken, times[PEER]) if installed else None}
            rows.append(row)
        headline = [
            {"what": "its gradient over its value", "value": ratio(times[SLOPE], times[OWN])}
        ]
        if installed:
            one = {"what": "its time over the loop's", "value": ratio(times[OWN], times[PEER])}
            headline.insert(0, one)
    headline = [head | {"wanted": WANTED} for head in headline]
    return {"rows": rows, "headline": headline, "not_installed": [] if installed else ["numba"]}


def page(result: Row) -> list[str]:
    """Its blocks of Markdown."""
    said = [
        f"{head['what']} {head['value']:.2g} ({head['wanted'][1]:g} wanted: {verdict(head)})"
        for head in result["headline"]
    ]
    most = max(row["n"] for row in result["rows"])
    words = (
        f"A cycle of {most} degrees of freedom with three joints by `fj.limit_cycle`, compiled, "
    )
    words += f"at rtol {RTOL:g}: " + "; ".join(said) + "."
    if result["not_installed"]:
        words += " The event loop was not run: numba is not installed."
    head = "method | n | compile [s] | time [ms] | over the loop's | error of the period | returns"
    template = "{name} | {n} | {compile_s:.1f} | {time_s!m:.3g} | {ratio:.2g} | {error:.1e}"
    about = (
        "The loop steps with Dormand and Prince's 5(4) pair from event to event until three "
        "returns agree to ten times its tolerance; errors are relative, to the loop at "
        f"{TRUTH:g}. Its own compilation, some 15 s, is not in its time."
    )
    return [words, table(head, result["rows"], template + " | {returns}"), about]


def picture(result: Row) -> bytes:
    """Time by the number of degrees of freedom."""
    figure, ax = subplots(figsize=(6, 4))
    lines = []
    for name, style in ((OWN, "o-"), (SLOPE, "s-"), (PEER, "^-")):
        rows = [row for row in result["rows"] if row["name"] == name]
        if rows:
            lines.append((*columns(rows, "n", "time_s"), style, name))
    draw(ax, lines, "degrees of freedom", "time [s]", f"a limit cycle at rtol {RTOL:g}")
    counts = sorted({row["n"] for row in result["rows"]})
    ax.set_xticks(counts, [str(n) for n in counts])
    ax.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    return png(figure)
