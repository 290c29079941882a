"""Error against run time of the stick-slip limit cycle: this package against transients.

Every peer runs the transient from the package's default start and reads the last turn: by events
on the exact law, or through tanh(v/eps) in place of sgn v. The truth has more digits than a double.
"""

import dataclasses
import statistics
from typing import Any

from tqdm import tqdm

from ..page import cell, png, subplots, table, verdict, versions
from ..timing import others_running, ran_on, seconds, taking_turns, this_machine
from . import gradients as cycle_gradients, transients
from .methods import (
    EVENTS,
    OWN,
    OWN_TANH,
    PEERS,
    SHARES,
    Method,
    by_events,
    on_tanh,
    own_exact,
    own_tanh,
)
from .reference import AMPLITUDE, PERIOD, relative

LONG = 3.0  # s: a call that takes longer is timed once, and no tighter tolerance is tried
OFTEN = 0.03  # s: what takes longer is repeated three times only
EQUAL = 1e-9  # error at which the package is compared with its best peer
WANTED = 10  # the ratio wanted
OPTIONAL = ("heyoka", "numbalsoda")


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    segments: tuple[int, ...]
    shares: tuple[float, ...]  # eps/V
    own_shares: tuple[float, ...]
    peers: tuple[str, ...]
    periods: tuple[int, ...]  # of the transients by events
    repeats: int
    gradients: bool


FULL = Size((20, 24, 32, 40, 64), SHARES, SHARES, tuple(PEERS), (30, 45, 60, 76, 90, 120), 21, True)
QUICK = Size(
    (24,), (1e-2,), (), ("SciPy LSODA", "diffrax Tsit5", "numbalsoda LSODA"), (76,), 3, False
)


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def first_call(method: Method) -> dict[str, Any]:
    """A row with its errors and the time of one warm call; or with the reason that it has none."""
    found, call = method
    try:
        first, (period, amplitude) = seconds(call)
        once = first if first > LONG else seconds(call)[0]
    except RuntimeError as failed:
        return found | {"failed": str(failed).splitlines()[0]}
    errors = relative(period, PERIOD), relative(amplitude, AMPLITUDE)
    if not all(error < float("inf") for error in errors):
        return found | {"failed": found.get("result", "not finite")}
    return found | {"seconds": once} | dict(zip(("period", "amplitude"), errors, strict=True))


def one_by_one(family: str, share: float) -> tuple[list[Method], list[dict[str, Any]]]:
    """The tolerances of a peer that end in reasonable time: methods, and rows of one call each."""
    kept, rows = [], []
    for method in on_tanh(family, share):
        kept.append(method)
        rows.append(first_call(method))
        if "failed" in rows[-1] or rows[-1]["seconds"] > LONG:
            break
    return kept, rows


def every_method(size: Size) -> tuple[list[Method], list[dict[str, Any]], list[str]]:
    """All methods, their rows, and what was left out."""
    missing = [name for name in OPTIONAL if name not in versions(*OPTIONAL)]
    methods = own_exact(size.segments) + own_tanh(size.own_shares)
    if "heyoka" not in missing:
        methods += by_events(size.periods)
    rows, left_out = [first_call(method) for method in methods], []
    for share in size.shares:
        for family in tqdm(size.peers, desc=f"eps {share:g} V"):
            if family.replace(",", " ").split()[0] in missing:
                continue
            more_methods, more_rows = one_by_one(family, share)
            untried = PEERS[family][len(more_rows) :]
            left_out += [f"{family} at eps {share:g} V, rtol {rtol:g}" for rtol in untried]
            methods, rows = methods + more_methods, rows + more_rows
    return methods, rows, left_out


def in_turns(methods: list[Method], rows: list[dict[str, Any]], repeats: int) -> None:
    """Medians of repeated calls, the methods taking turns; of slow ones the one call stays."""
    for shortest, longest, count in ((0, OFTEN, repeats), (OFTEN, LONG, 3)):
        calls = {
            found["name"]: call
            for found, (_, call) in zip(rows, methods, strict=True)
            if shortest <= found.get("seconds", LONG) < longest
        }
        times = taking_turns(calls, count)
        for found in rows:
            if found["name"] in times:
                found["times"] = times[found["name"]]
                found["seconds"] = statistics.median(found["times"])


def worst(found: dict[str, Any]) -> float:
    """The larger error of period and amplitude."""
    return max(found["period"], found["amplitude"])


def accurate(rows: list[dict[str, Any]], groups: tuple[str, ...]) -> list[dict[str, Any]]:
    """Those of some groups whose errors of period and amplitude are small enough to compare."""
    return [
        found
        for found in rows
        if found["group"] in groups and "failed" not in found and worst(found) < EQUAL
    ]


def headline(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The ratio to the best peer at equal error: the median of the ratios within a turn."""
    own = min(accurate(rows, (OWN,)), key=lambda r: r["seconds"], default=None)
    peers = accurate(rows, (EVENTS, *PEERS))
    peer = min(peers, key=lambda r: r["seconds"], default=None)
    if own is None or peer is None:
        return []
    pairs = zip(peer["times"], own["times"], strict=False)
    return [
        {
            "what": f"one cycle to {EQUAL:g}: {own['name']}, against {peer['name']}",
            "ratio": statistics.median(a / b for a, b in pairs),
            "wanted": WANTED,
        }
    ]


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size, busy = (QUICK if quick else FULL), others_running()
    methods, rows, left_out = every_method(size)
    in_turns(methods, rows, size.repeats)
    head = headline(rows)
    for found in rows:
        found.pop("times", None)
    installed = versions("jax", "numpy", "scipy", "diffrax", "numba", *OPTIONAL)
    return {
        "quick": quick,
        "truth": {"period": PERIOD, "amplitude": AMPLITUDE},
        "repeats": size.repeats,
        "machine": this_machine(busy),
        "versions": installed,
        "not_installed": [name for name in OPTIONAL if name not in installed],
        "headline": head,
        "methods": rows,
        "left_out": left_out,
        "gradients": cycle_gradients.measure() if size.gradients else [],
    }


# ---------------------------------------------------------------------------------------------
# Showing
# ---------------------------------------------------------------------------------------------


def choice(result: dict[str, Any]) -> str:
    """Which method to take for one cycle, in one sentence."""
    rows = [found for found in result["methods"] if "failed" not in found]
    own = min(accurate(rows, (OWN,)), key=lambda r: r["seconds"])
    text = (
        f"Take `fj.limit_cycle` by the exact law:"
        f" {own['seconds'] * 1e3:.2g} ms for an error of {worst(own):.0e} ({own['setting']})"
    )
    for head in result["headline"]:
        text += (
            f", {head['ratio']:.1f} times as fast as the best peer at equal error"
            f" ({head['what'].split('against ')[1]}; wanted >= {head['wanted']}:"
            f" {verdict(head)})"
        )
    coarse = [r for r in rows if r["group"] in (EVENTS, *PEERS) and worst(r) < 1e-2]
    fastest = min(coarse, key=lambda r: r["seconds"])
    return text + (
        f"; the quickest transient with an error below 0.01, {fastest['name']}, takes"
        f" {fastest['seconds'] * 1e3:.2g} ms for {worst(fastest):.0e}."
    )


HEADINGS = [
    "method",
    "setting",
    "compile [s]",
    "periods run",
    "time [ms]",
    "error of the period",
    "of the amplitude",
]


def cells(found: dict[str, Any]) -> list[str]:
    """One row of the table."""
    outcome = found.get("result", "converged")
    start = [
        found["group"],
        found["setting"] + ("" if outcome == "converged" else f" ({outcome})"),
        cell(found["compile_s"], ".1f"),
        str(found.get("periods", "-")),
    ]
    if "failed" in found:
        return [*start, "-", found["failed"], "-"]
    return [
        *start,
        f"{found['seconds'] * 1e3:.3g}",
        f"{found['period']:.1e}",
        f"{found['amplitude']:.1e}",
    ]


def text(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, the tables, how they were measured."""
    groups = list(dict.fromkeys(found["group"] for found in result["methods"]))
    rows = sorted(result["methods"], key=lambda r: (groups.index(r["group"]), -r.get("eps", 0)))
    lines = [
        "# The stick-slip limit cycle: error against run time",
        "",
        choice(result),
        "",
        *table(HEADINGS, [cells(found) for found in rows]),
        "",
        "Times are those of one warm call from the plain start, medians of up to"
        f" {result['repeats']} of them, the methods taking turns (what takes more than {LONG:g} s"
        " is run once); compile time is apart, and diffrax compiles once for all settings of a"
        " solver. Errors are relative, of the period and of the peak to peak of x1, against a"
        " solution of the exact law with 20 digits. A transient ends when it has settled: the"
        " slowest Floquet multiplier is 0.797, so that 1e-9 takes 76 periods; the tanh law needs"
        " fewer, as its error stops at a floor that only a smaller eps lowers. At eps = 0.1 V the"
        " layer is so wide that the motion does not repeat after one turn: its last turn is shown"
        " all the same. Between eps = 0.003 and 0.001 V the amplitude's error changes its sign, so"
        " that 0.001 V looks better than it is. The others' steps are what their error control"
        f" makes them; heyoka's steps on the tanh law are at most {transients.CAP} eps/V (in"
        " 1/omega): without a cap its series jump over the layer, and at eps = 0.001 V the"
        " amplitude grows to four times what it is.",
        "",
    ]
    if result["left_out"]:
        names = "; ".join(result["left_out"])
        lines += [f"Left out, as a looser tolerance takes more than {LONG:g} s: {names}.", ""]
    if result["not_installed"]:
        lines += [f"Not installed: {', '.join(result['not_installed'])}.", ""]
    if result["gradients"]:
        lines += cycle_gradients.section(result["gradients"])
    return "\n".join([*lines, ran_on(result), ""])


# Colour and marker of a family in the picture; the layer's width is in the fill of the marker.
STYLES = {
    OWN: ("k", "*"),
    OWN_TANH: ("0.5", "*"),
    EVENTS: ("tab:green", "s"),
    "heyoka, step capped": ("tab:olive", "D"),
    "numbalsoda LSODA": ("tab:blue", "o"),
    "diffrax Tsit5": ("tab:red", "^"),
    "diffrax Dopri8": ("tab:pink", "v"),
    "diffrax Kvaerno5": ("tab:purple", "X"),
    "SciPy LSODA": ("tab:cyan", "P"),
    "SciPy RK45": ("tab:orange", "d"),
}


def picture(result: dict[str, Any]) -> bytes:
    """The larger error against time: a line over the tolerances of a method, by eps."""
    figure, ax = subplots(figsize=(10.5, 6))
    for group, (colour, marker) in STYLES.items():
        rows = [r for r in result["methods"] if r["group"] == group and "failed" not in r]
        label: str | None = group
        for share in dict.fromkeys(r.get("eps") for r in rows):
            line = [r for r in rows if r.get("eps") == share]
            x = [r["seconds"] for r in line]
            y = [max(worst(r), 1e-16) for r in line]
            size = 11 if marker == "*" else 7
            ax.plot(x, y, color=colour, marker=marker, ms=size, mec="k", mew=0.5, label=label)
            label = None
    ax.set(xscale="log", yscale="log")
    ax.margins(0.06)
    left, right = ax.get_xlim()
    ax.set_xlim(left / 3, right)
    above = 1.0
    for share in dict.fromkeys(r["eps"] for r in result["methods"] if "rtol" in r):
        finest = [r for r in result["methods"] if r.get("eps") == share and "failed" not in r]
        floor = worst(min(finest, key=lambda r: r.get("rtol", 1.0)))
        ax.axhline(floor, color="0.6", lw=0.8, ls=":", zorder=0)
        # Below its line where the one before is close above it.
        offset, above = -11 if above < 4 * floor else 3, floor
        ax.annotate(
            f"eps = {share:g} V",
            (0.005, floor),
            xycoords=("axes fraction", "data"),
            xytext=(0, offset),
            textcoords="offset points",
            fontsize=8,
        )
    ax.set(xlabel="time [s]", ylabel="relative error: period or amplitude [-]")
    ax.grid(True, which="major", alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    return png(figure, dpi=110)
