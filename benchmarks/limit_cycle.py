"""Error against run time of the stick-slip limit cycle: this package against transients.

Every peer runs the transient from the package's default start and reads the last period: by events
on the exact law, or through tanh(v/eps) in place of sgn v. The truth has more digits than a double.
"""

import functools
import statistics
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import fractaljax as fj

from .page import cell, draw, png, subplots, table, verdict
from .timing import compiled, ratio, seconds, taking_turns, versions
from .transients import (
    AMPLITUDE,
    CAP,
    K_N,
    MU_S,
    PERIOD,
    PERIODS,
    RUNS,
    V,
    heyoka_events,
    last_period,
    law,
    outcomes,
    reference,
)

TITLE = "The stick-slip limit cycle: error against run time"
OPTIONAL = ("heyoka", "numbalsoda")
PACKAGES = ("numpy", "scipy", "diffrax", "numba", *OPTIONAL)
LONG = 3.0  # s: a call that takes longer is timed once, and no tighter tolerance is tried
OFTEN = 0.03  # s: what takes longer is repeated three times only
EQUAL, WANTED = 1e-9, 10  # the error at which the package meets its best peer; the ratio wanted
OWN, OWN_TANH, EVENTS = "fractaljax, exact", "fractaljax, tanh", "heyoka, exact, by events"
EXPLICIT, IMPLICIT = (1e-4, 1e-6, 1e-8, 1e-10), (1e-4, 1e-6, 1e-8)
# Families of peers on the tanh law, and their tolerances.
PEERS = {
    "SciPy RK45": EXPLICIT,
    "SciPy DOP853": EXPLICIT,
    "SciPy LSODA": EXPLICIT,
    "SciPy Radau": IMPLICIT,
    "diffrax Tsit5": EXPLICIT,
    "diffrax Dopri5": EXPLICIT,
    "diffrax Dopri8": EXPLICIT,
    "diffrax Kvaerno5": IMPLICIT,
    "diffrax KenCarp4": IMPLICIT,
    "numbalsoda LSODA": EXPLICIT,
    "numbalsoda DOP853": EXPLICIT,
    "heyoka, step capped": EXPLICIT,
}

Row = dict[str, Any]
Method = tuple[Row, Callable[[], tuple[float, float]]]  # the call gives period and amplitude


class Size(NamedTuple):
    """How much is measured."""

    segments: tuple[int, ...]
    eps: tuple[float, ...]  # of the peers, in V
    own_eps: tuple[float, ...]
    peers: tuple[str, ...]
    periods: tuple[int, ...]  # of the transients by events
    repeats: int
    gradients: bool


EPS = (1e-1, 1e-2, 1e-3, 1e-4)
FULL = Size((20, 24, 32, 40, 64), EPS, EPS, tuple(PEERS), (30, 45, 60, 76, 90, 120), 21, True)
FEW = ("SciPy LSODA", "diffrax Tsit5", "numbalsoda LSODA")
QUICK = Size((24,), (1e-2,), (), FEW, (76,), 3, False)


# Methods ------------------------------------------------------------------------------------------


def row(group: str, setting: str, compile_s: float | None = None, **more: Any) -> Row:
    """What is known of a method before it is run."""
    name = f"{group}, {setting}"
    return {"name": name, "group": group, "setting": setting, "compile_s": compile_s, **more}


def own(**options: Any) -> tuple[Callable, float]:
    """Period, amplitude and result of the package's cycle by K_n, compiled; and the seconds."""

    def cycle(K):
        found = fj.limit_cycle(reference(K), throw=False, **options)
        return found.period, found.amplitude[0], found.result

    return compiled(cycle, K_N)


def own_exact(n: int) -> Method:
    """The package with n segments."""
    program, compile_s = own(segments=n)
    return row(OWN, f"{n} segments", compile_s), lambda: program(K_N)[:2]


def own_tanh(eps: float) -> Method:
    """The package's cycle of the tanh law; with an implicit solver where it is stiff."""
    solver, steps = (None, 16384) if eps > 5e-4 else (diffrax.Kvaerno5(), 8192)
    program, compile_s = own(regularisation=eps * V, solver=solver, max_steps=steps)
    (outcome,) = outcomes(program(K_N)[2])
    setting = f"eps {eps:g} V, {type(solver).__name__ if solver else 'Tsit5'}"
    return row(OWN_TANH, setting, compile_s, eps=eps, result=outcome), lambda: program(K_N)[:2]


def by_events(periods: int) -> Method:
    """heyoka on the exact law."""
    run = heyoka_events(law(), periods)
    found = row(EVENTS, f"{periods} periods", periods=periods)
    return found, lambda: last_period(law(), run())


def on_tanh(family: str, eps: float, rtol: float) -> Method:
    """One peer on the tanh law."""
    library, _, solver = family.replace(",", "").partition(" ")
    run, compile_s = RUNS[library](solver, law(), eps, rtol, PERIODS[eps]), None
    if library == "diffrax":
        from .transients import diffrax_program

        compile_s = diffrax_program(solver)[1]
    setting, more = f"eps {eps:g} V, rtol {rtol:g}", {"rtol": rtol, "periods": PERIODS[eps]}
    return row(family, setting, compile_s, eps=eps, **more), lambda: last_period(law(), run())


# Measuring ----------------------------------------------------------------------------------------


def relative(period: Any, amplitude: Any) -> tuple[float, float]:
    """Relative errors."""
    return abs(float(period) / PERIOD - 1), abs(float(amplitude) / AMPLITUDE - 1)


def first_call(method: Method) -> Method:
    """With its errors and the time of one warm call; or with the reason that it has none."""
    found, call = method
    try:
        first, values = seconds(call)
        once = first if first > LONG else seconds(call)[0]
    except RuntimeError as failed:
        return found | {"failed": str(failed).splitlines()[0]}, call
    errors = relative(*values)
    if not np.isfinite(errors).all():
        return found | {"failed": found.get("result", "not finite")}, call
    return found | {"seconds": once, "period": errors[0], "amplitude": errors[1]}, call


def every_method(size: Size) -> tuple[list[Method], list[str]]:
    """All methods, and what was left out."""
    missing = [name for name in OPTIONAL if name not in versions(*OPTIONAL)]
    methods = [own_exact(n) for n in tqdm(size.segments, desc="compile")]
    methods += [own_tanh(eps) for eps in tqdm(size.own_eps, desc="compile, tanh")]
    if "heyoka" not in missing:
        methods += [by_events(periods) for periods in size.periods]
    methods, left_out = [first_call(method) for method in methods], []
    peers = [name for name in size.peers if name.replace(",", " ").split()[0] not in missing]
    for eps in size.eps:
        for family in tqdm(peers, desc=f"eps {eps:g} V"):
            rtols = list(PEERS[family])
            while rtols:
                methods.append(first_call(on_tanh(family, eps, rtols.pop(0))))
                if methods[-1][0].get("seconds", np.inf) > LONG:
                    break
            left_out += [f"{family} at eps {eps:g} V, rtol {rtol:g}" for rtol in rtols]
    return methods, left_out


def in_turns(methods: list[Method], repeats: int) -> dict[str, list[float]]:
    """Times of repeated calls, the methods taking turns; of slow ones the one call stays."""
    times = {}
    for shortest, longest, count in ((0, OFTEN, repeats), (OFTEN, LONG, 3)):
        calls = {
            found["name"]: call
            for found, call in methods
            if shortest <= found.get("seconds", LONG) < longest
        }
        times |= taking_turns(calls, count)
    for found, _ in methods:
        if found["name"] in times:
            found["seconds"] = statistics.median(times[found["name"]])
    return times


def worst(found: Row) -> float:
    """The larger error of period and amplitude."""
    return max(found["period"], found["amplitude"])


def quickest(rows: list[Row], groups: tuple[str, ...], error: float) -> Row | None:
    """The quickest method of some groups with a smaller error."""
    able = [r for r in rows if r["group"] in groups and "failed" not in r and worst(r) < error]
    return min(able, key=lambda r: r["seconds"], default=None)


def headline(rows: list[Row], times: dict[str, list[float]]) -> list[Row]:
    """The ratio to the best peer at equal error."""
    own, peer = quickest(rows, (OWN,), EQUAL), quickest(rows, (EVENTS, *PEERS), EQUAL)
    if own is None or peer is None:
        return []
    both = [times[found["name"]] for found in (peer, own)]
    shorter = min(map(len, both))
    what = f"one cycle to {EQUAL:g}: {own['name']}, against {peer['name']}"
    return [{"what": what, "ratio": ratio(*(t[:shorter] for t in both)), "wanted": WANTED}]


def measure(quick: bool) -> Row:
    """Errors and times of every method, and of the gradients."""
    size = QUICK if quick else FULL
    methods, left_out = every_method(size)
    times = in_turns(methods, size.repeats)
    rows = [found for found, _ in methods]
    return {
        "truth": {"period": PERIOD, "amplitude": AMPLITUDE},
        "repeats": size.repeats,
        "not_installed": [name for name in OPTIONAL if name not in versions(*OPTIONAL)],
        "headline": headline(rows, times),
        "methods": rows,
        "left_out": left_out,
        "gradients": gradients() if size.gradients else [],
    }


# Gradients of period and amplitude by K_n, mu_s and V ---------------------------------------------

# By K_n at fixed K_t/K_n with 19 digits, by mu_s at fixed mu_m and by V with the nine to ten digits
# of tests/reference/cycle.json.
SLOPES = {
    "K_n": (-3.778482645969588942e-13, -2.137527543171888603e-14),
    "mu_s": (2.9293397590337195e-05, 1.571030430586891e-05),
    "V": (-2.295324305437884e-05, 1.0063974100762737e-4),
}
AT = np.array([K_N, MU_S, V])
STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # relative, of the central differences
SETTLED, TIGHT = 120, 2.3e-16  # periods and tolerance of the peer: only rounding is left


def measures(place: jax.Array) -> jax.Array:
    """Period [s] and amplitude [m] (2,) at K_n, mu_s and V (3,)."""
    cycle = fj.limit_cycle(reference(*place), throw=False)
    return jnp.stack([cycle.period, cycle.amplitude[0]])


def peer(place: np.ndarray) -> tuple[float, float]:
    """heyoka's period and amplitude at a place (3,)."""
    numbers = law(*(float(x) for x in place))
    return last_period(numbers, heyoka_events(numbers, SETTLED, tolerance=TIGHT)())


def differences(value: Callable, step: float) -> np.ndarray:
    """Central differences of a function of a place (3,): derivatives (2, 3)."""
    pairs = [(value(AT + h), value(AT - h)) for h in np.diag(step * AT)]
    slopes = [np.subtract(*map(np.asarray, pair)) for pair in pairs]
    return np.stack(slopes, axis=1) / (2 * step * AT)


def slope_errors(found: Any) -> np.ndarray:
    """Relative errors (2, 3) of derivatives."""
    return np.abs(np.asarray(found) / np.array(list(SLOPES.values())).T - 1)


def best_differences(value: Callable) -> tuple[float, Callable]:
    """The step with the smallest worst error, and a call of the differences with it."""
    step = min(STEPS, key=lambda step: float(np.max(slope_errors(differences(value, step)))))
    return step, functools.partial(differences, value, step)


def gradients() -> list[Row]:
    """One row a method: time, compile time, time to that of the value, errors."""
    at, methods = jnp.array(AT), {}
    for name, function in (
        ("value alone", measures),
        ("forward mode", jax.jacfwd(measures)),
        ("reverse mode", jax.jacrev(measures)),
    ):
        program, compile_s = compiled(function, at)
        methods[name] = functools.partial(program, at), compile_s
    value = methods["value alone"][0].func
    step, call = best_differences(lambda place: value(jnp.array(place)))
    methods[f"differences of the value, 6 calls, step {step:g}"] = call, None
    if versions("heyoka").get("heyoka"):
        step, call = best_differences(peer)
        name = f"differences of heyoka by events, 6 runs of {SETTLED} periods, step {step:g}"
        methods[name] = call, None
    times = taking_turns({name: call for name, (call, _) in methods.items()}, 11)
    return [
        {
            "name": name,
            "compile_s": compile_s,
            "seconds": statistics.median(times[name]),
            "ratio_to_value": ratio(times[name], times["value alone"]),
            "errors": None if name == "value alone" else slope_errors(call()).tolist(),
        }
        for name, (call, compile_s) in methods.items()
    ]


def gradient_blocks(rows: list[Row]) -> list[str]:
    """One sentence, the table, how it was measured."""
    own, last = min(rows[1:3], key=lambda r: r["ratio_to_value"]), rows[-1]

    def errors(found):
        pairs = zip(*found["errors"], strict=True) if found["errors"] else ()
        return " | ".join(f"{T:.1e}, {A:.1e}" for T, A in pairs) or " | ".join("-" * len(SLOPES))

    return [
        "## Gradients",
        f"""Use {own["name"]} for the gradients by three quantities of one cycle:
        {own["ratio_to_value"]:.2g} times the value's time, errors up to
        {np.max(own["errors"]):.0e}. The last row, {last["name"]}, takes
        {last["seconds"] / own["seconds"]:.1f} times as long for errors up to
        {np.max(last["errors"]):.0e}.""",
        table(
            "method | compile [s] | time [ms] | to the value's | "
            + " | ".join(f"error by {name}: period, amplitude" for name in SLOPES),
            (
                f"{r['name']} | {cell(r['compile_s'], '.1f')} | {r['seconds'] * 1e3:.3g}"
                f" | {r['ratio_to_value']:.2f} | {errors(r)}"
                for r in rows
            ),
        ),
        f"""All derivatives by K_n (K_t/K_n fixed), mu_s and V at once; the truth has 19 digits by
        K_n and nine to ten by mu_s and V, so that smaller errors are not resolved. Differences are
        central, at whichever relative step of {", ".join(f"{step:g}" for step in STEPS)} has the
        smallest worst error: a user would not know it.""",
    ]


# The page -----------------------------------------------------------------------------------------


def choice(result: Row) -> str:
    """Which method to use for one cycle."""
    rows = result["methods"]
    own, peer = quickest(rows, (OWN,), EQUAL), quickest(rows, (EVENTS, *PEERS), 1e-2)
    assert own and peer
    ratios = "".join(
        f", {head['ratio']:.1f} times as fast as the best peer at equal error"
        f" ({head['what'].split('against ')[1]}; wanted >= {head['wanted']}: {verdict(head)})"
        for head in result["headline"]
    )
    return f"""Use `fj.limit_cycle` by the exact law: {own["seconds"] * 1e3:.2g} ms for an error of
        {worst(own):.0e} ({own["setting"]}){ratios}. The quickest transient with an error below
        0.01, {peer["name"]}, takes {peer["seconds"] * 1e3:.2g} ms for {worst(peer):.0e}."""


def cells(found: Row) -> str:
    """One row of the table."""
    outcome = found.get("result", "converged")
    errors = f"- | {found.get('failed')} | -"
    if "failed" not in found:
        errors = f"{found['seconds'] * 1e3:.3g} | {found['period']:.1e} | {found['amplitude']:.1e}"
    return (
        f"{found['group']} | {found['setting']}{'' if outcome == 'converged' else f' ({outcome})'}"
        f" | {cell(found['compile_s'], '.1f')} | {found.get('periods', '-')} | {errors}"
    )


def page(result: Row) -> list[str]:
    """One sentence, the tables, how they were measured."""
    groups = list(dict.fromkeys(found["group"] for found in result["methods"]))
    rows = sorted(result["methods"], key=lambda r: (groups.index(r["group"]), -r.get("eps", 0)))
    left_out, missing = "; ".join(result["left_out"]), ", ".join(result["not_installed"])
    return [
        choice(result),
        table(
            "method | setting | compile [s] | periods run | time [ms] | error of the period"
            " | of the amplitude",
            map(cells, rows),
        ),
        f"""Times are those of one warm call from the default start, medians of up to
        {result["repeats"]} of them, the methods taking turns (what takes more than {LONG:g} s is
        run once). Compile time is apart, and diffrax compiles once for all settings of a solver.
        Errors are relative, of the period and of the peak to peak of x1, against a solution of the
        exact law with 20 digits. A transient ends when it has settled: the slowest Floquet
        multiplier is 0.797, so that 1e-9 takes 76 periods. The tanh law needs fewer, as its error
        stops at a floor that only a smaller eps lowers. At eps = 0.1 V the layer is so wide that
        the motion does not repeat after one return of the Poincare map; its last return is shown
        all the same. Between eps = 0.003 and 0.001 V the amplitude's error changes its sign, so
        that 0.001 V looks better than it is. The peers' steps are set by their error control;
        heyoka's steps on the tanh law are at most {CAP} eps/V (in 1/omega): without a cap its
        series jump over the layer, and at eps = 0.001 V the amplitude grows to four times what it
        is.""",
        f"Left out, as a looser tolerance takes more than {LONG:g} s: {left_out}."
        if left_out
        else "",
        f"Not installed: {missing}." if missing else "",
        *(gradient_blocks(result["gradients"]) if result["gradients"] else []),
    ]


# Of a family; every eps is a line of its own.
STYLES = {
    OWN: "k*-",
    OWN_TANH: "C7*-",
    EVENTS: "C2s-",
    "heyoka, step capped": "C8D-",
    "numbalsoda LSODA": "C0o-",
    "diffrax Tsit5": "C3^-",
    "diffrax Dopri8": "C6v-",
    "diffrax Kvaerno5": "C4X-",
    "SciPy LSODA": "C9P-",
    "SciPy RK45": "C1d-",
}


def picture(result: Row) -> bytes:
    """The larger error against time: a line over the tolerances of a method, by eps."""
    figure, ax = subplots(figsize=(10.5, 6))
    found, lines = [r for r in result["methods"] if "failed" not in r], []
    for group, style in STYLES.items():
        rows = [r for r in found if r["group"] == group]
        for i, eps in enumerate(dict.fromkeys(r.get("eps") for r in rows)):
            line = [r for r in rows if r.get("eps") == eps]
            x, y = [r["seconds"] for r in line], [max(worst(r), 1e-16) for r in line]
            lines.append((x, y, style, None if i else group))
    draw(ax, lines, "time [s]", "relative error: period or amplitude [-]")
    for i, eps in enumerate(dict.fromkeys(r["eps"] for r in found if "rtol" in r)):
        floor = worst(
            min((r for r in found if r.get("eps") == eps), key=lambda r: r.get("rtol", 1))
        )
        place: dict[str, Any] = {
            "xycoords": ("axes fraction", "data"),
            "va": ("bottom", "top")[i % 2],
        }
        ax.axhline(floor, color="0.6", lw=0.8, ls=":", zorder=0)
        ax.annotate(f"eps = {eps:g} V", (1.01, floor), fontsize=8, **place)
    return png(figure)
