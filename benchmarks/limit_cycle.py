"""Error against run time of the stick-slip limit cycle: this package against transients.

Every peer runs the transient from the package's default start and reads the last period: by events
on the exact law, or through tanh(v/eps) in place of sgn v. The truth has more digits than a double.
"""

import functools
import os
import statistics
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import fractaljax as fj

from . import transients
from .page import draw, png, subplots, table, verdict
from .timing import compiled, ended, ratio, seconds, started, taking_turns, versions
from .transients import K_N, MU_S, V, heyoka_events, last_period, law, reference

TITLE = "The stick-slip limit cycle: error against run time"
OPTIONAL = ("heyoka", "numbalsoda")
PACKAGES = ("numpy", "scipy", "diffrax", "numba", *OPTIONAL)
LONG = 3.0  # s: a call that takes longer is timed once, and no tighter tolerance is tried
OFTEN = 0.03  # s: what takes longer is repeated three times only
EQUAL, WANTED = 1e-9, 4  # the error at which the package meets its best peer; the ratio wanted
OWN, OWN_TANH, EVENTS = "fractaljax, exact", "fractaljax, tanh", "heyoka, exact, by events"
# Peers on the tanh law; those by an implicit solver are not run at the last tolerance.
PEERS = (
    *("SciPy RK45", "SciPy DOP853", "SciPy LSODA", "SciPy Radau"),
    *("diffrax Tsit5", "diffrax Dopri5", "diffrax Dopri8", "diffrax Kvaerno5", "diffrax KenCarp4"),
    *("numbalsoda LSODA", "numbalsoda DOP853", "heyoka, step capped"),
)
IMPLICIT = ("SciPy Radau", "diffrax Kvaerno5", "diffrax KenCarp4")
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
EPS = (1e-1, 1e-2, 1e-3, 1e-4)  # in V
FULL = {"segments": (20, 24, 32, 40, 64), "own_eps": EPS, "periods": (30, 45, 60, 76, 90, 120)}
FULL |= {"eps": EPS, "peers": PEERS, "repeats": 21, "slopes": True}
QUICK = {"segments": (24,), "own_eps": (), "periods": (76,), "eps": (1e-2,), "repeats": 3}
QUICK |= {"peers": ("SciPy LSODA", "diffrax Tsit5", "numbalsoda LSODA"), "slopes": False}
Row = dict[str, Any]
Method = tuple[Row, Callable[[], tuple[float, float]]]  # the call gives period and amplitude


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
    program, compile_s = own(segments=n)
    return row(OWN, f"{n} segments", compile_s), lambda: program(K_N)[:2]


def own_tanh(eps: float) -> Method:
    """With an implicit solver where it is stiff."""
    solver, steps = (None, 16384) if eps > 5e-4 else (diffrax.Kvaerno5(), 8192)
    program, compile_s = own(regularisation=eps * V, solver=solver, max_steps=steps)
    (outcome,) = transients.outcomes(program(K_N)[2])
    setting = f"eps {eps:g} V, {type(solver).__name__ if solver else 'Tsit5'}"
    return row(OWN_TANH, setting, compile_s, eps=eps, result=outcome), lambda: program(K_N)[:2]


def by_events(periods: int) -> Method:
    run = heyoka_events(law(), periods)
    found = row(EVENTS, f"{periods} periods", periods=periods)
    return found, lambda: last_period(law(), run())


def on_tanh(family: str, eps: float, rtol: float) -> Method:
    periods, solver = transients.PERIODS[eps], family.removeprefix("diffrax ")
    run = transients.tanh_run(family, law(), eps, rtol, periods)
    compile_s = transients.diffrax_program(solver)[1] if solver != family else None
    more = {"eps": eps, "rtol": rtol, "periods": periods}
    found = row(family, f"eps {eps:g} V, rtol {rtol:g}", compile_s, **more)
    return found, lambda: last_period(law(), run())


def relative(period: Any, amplitude: Any) -> tuple[float, float]:
    """Relative errors."""
    exact = transients.PERIOD, transients.AMPLITUDE
    return abs(float(period) / exact[0] - 1), abs(float(amplitude) / exact[1] - 1)


def first_call(method: Method) -> Method:
    """With its errors and the time of one warm call; or with the reason that it has none."""
    found, call = method
    try:
        first, values = seconds(call)
        once = first if first > LONG else seconds(call)[0]
    except RuntimeError as failed:
        return found | {"failed": str(failed).splitlines()[0]}, call
    period, amplitude = relative(*values)
    if not np.isfinite([period, amplitude]).all():
        return found | {"failed": found.get("result", "not finite")}, call
    return found | {"seconds": once, "period": period, "amplitude": amplitude}, call


def until_long(family: str, eps: float) -> tuple[list[Method], list[str]]:
    """A peer with tighter and tighter tolerances until one takes long; what is left out."""
    found, rtols = [], list(TOLERANCES[: -1 if family in IMPLICIT else None])
    while rtols:
        found.append(first_call(on_tanh(family, eps, rtols.pop(0))))
        if found[-1][0].get("seconds", np.inf) > LONG:
            break
    return found, [f"{family} at eps {eps:g} V, rtol {rtol:g}" for rtol in rtols]


def in_turns(methods: list[Method], repeats: int) -> dict[str, list[float]]:
    """Times of repeated calls, the methods taking turns; of slow ones the one call stays."""
    times = {}
    for shortest, longest, count in ((0, OFTEN, repeats), (OFTEN, LONG, 3)):
        within = [m for m in methods if shortest <= m[0].get("seconds", LONG) < longest]
        times |= taking_turns({found["name"]: call for found, call in within}, count)
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


def in_this_process(segments, periods, repeats: int) -> list[Row]:
    """The headline, in a process that runs on one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    methods = [own_exact(n) for n in segments] + [by_events(count) for count in periods]
    methods = [first_call(method) for method in methods]
    times = in_turns(methods, repeats)
    return headline([found for found, _ in methods], times)


def headline(rows: list[Row], times: dict[str, list[float]]) -> list[Row]:
    """The ratio to the best peer at equal error."""
    own, peer = quickest(rows, (OWN,), EQUAL), quickest(rows, (EVENTS, *PEERS), EQUAL)
    if own is None or peer is None:
        return []
    pairs = list(zip(times[peer["name"]], times[own["name"]], strict=False))
    what = f"one cycle to {EQUAL:g}, a core each: {own['name']}, against {peer['name']}"
    return [{"what": what, "ratio": ratio(*map(list, zip(*pairs, strict=True))), "wanted": WANTED}]


def on_one_core(**given: Any) -> list[Row]:
    """The headline, in a process of its own.

    Peers use one core. Where XLA has more, passing parts of a short program between threads takes
    longer than it saves.
    """
    return ended(started(__name__, {"NPROC": "1"}, **given))


def measure(segments, own_eps, periods, eps, peers, repeats: int, slopes: bool) -> Row:
    """Errors and times of every method, and of the gradients; what is not installed is left out."""
    missing = [name for name in OPTIONAL if name not in versions(*OPTIONAL)]
    methods = [own_exact(n) for n in tqdm(segments, desc="compile")]
    methods += [own_tanh(width) for width in tqdm(own_eps, desc="compile, tanh")]
    if "heyoka" not in missing:
        methods += [by_events(count) for count in periods]
    methods, left_out = [first_call(method) for method in methods], []
    there = [name for name in peers if name.replace(",", " ").split()[0] not in missing]
    for width in eps:
        for family in tqdm(there, desc=f"eps {width:g} V"):
            found, left = until_long(family, width)
            methods, left_out = methods + found, left_out + left
    in_turns(methods, repeats)
    of_peer = {"segments": segments, "periods": periods, "repeats": repeats}
    return {
        "repeats": repeats,
        "not_installed": missing,
        "headline": [] if "heyoka" in missing else on_one_core(**of_peer),
        "methods": [found for found, _ in methods],
        "left_out": left_out,
        "gradients": gradients() if slopes else [],
    }


# Gradients of period and amplitude by K_n, mu_s and V

# By K_n at fixed K_t/K_n with 19 digits, by mu_s at fixed mu_m and by V with the nine to ten digits
# of tests/reference/cycle.json.
SLOPES = {
    "K_n": (-3.778482645969588942e-13, -2.137527543171888603e-14),
    "mu_s": (2.9293397590337195e-05, 1.571030430586891e-05),
    "V": (-2.295324305437884e-05, 1.0063974100762737e-4),
}
AT = np.array([K_N, MU_S, V])
STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # relative, of the central differences
VALUE = "value alone"
MODES = {VALUE: lambda f: f, "forward mode": jax.jacfwd, "reverse mode": jax.jacrev}
SETTLED, TIGHT = 120, 2.3e-16  # periods and tolerance of the peer: only rounding is left


def measures(place: jax.Array) -> jax.Array:
    """Period [s] and amplitude [m] (2,) at K_n, mu_s and V (3,)."""
    cycle = fj.limit_cycle(reference(*place), throw=False)
    return jnp.stack([cycle.period, cycle.amplitude[0]])


def peer(place: np.ndarray) -> tuple[float, float]:
    """The same by heyoka."""
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
    for name, mode in MODES.items():
        program, compile_s = compiled(mode(measures), at)
        methods[name] = functools.partial(program, at), compile_s
    value = methods[VALUE][0].func
    step, call = best_differences(lambda place: value(jnp.array(place)))
    methods[f"differences of the value, 6 calls, step {step:g}"] = call, None
    if "heyoka" in versions("heyoka"):
        step, call = best_differences(peer)
        name = f"differences of heyoka by events, 6 runs of {SETTLED} periods, step {step:g}"
        methods[name] = call, None
    times = taking_turns({name: call for name, (call, _) in methods.items()}, 11)
    return [
        {
            "name": name,
            "compile_s": compile_s,
            "seconds": statistics.median(times[name]),
            "ratio_to_value": ratio(times[name], times[VALUE]),
            "errors": None if name == VALUE else slope_errors(call()).tolist(),
        }
        for name, (call, compile_s) in methods.items()
    ]


def gradient_blocks(rows: list[Row]) -> list[str]:
    own, last = min(rows[1:3], key=lambda r: r["ratio_to_value"]), rows[-1]

    def shown(found):
        pairs = zip(*found["errors"], strict=True) if found["errors"] else ()
        cells = [f"{T:.1e}, {A:.1e}" for T, A in pairs] or ["-"] * len(SLOPES)
        return found | {"shown": " | ".join(cells)}

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
            map(shown, rows),
            "{name} | {compile_s:.1f} | {seconds!m:.3g} | {ratio_to_value:.2f} | {shown}",
        ),
        f"""All derivatives by K_n (K_t/K_n fixed), mu_s and V at once; the truth has 19 digits by
        K_n and nine to ten by mu_s and V, so that smaller errors are not resolved. Differences are
        central, at whichever relative step of {", ".join(f"{step:g}" for step in STEPS)} has the
        smallest worst error: a user would not know it.""",
    ]


def page(result: Row) -> list[str]:
    rows, groups = result["methods"], list(dict.fromkeys(r["group"] for r in result["methods"]))
    left_out, missing = "; ".join(result["left_out"]), ", ".join(result["not_installed"])
    own, peer = quickest(rows, (OWN,), EQUAL), quickest(rows, (EVENTS, *PEERS), 1e-2)
    assert own and peer
    ratios = ""
    for head in result["headline"]:
        equal = quickest(rows, (EVENTS, *PEERS), EQUAL) or peer
        ratios = f""" On a core each it is {head["ratio"]:.1f} times as fast as the best peer at
        equal error ({head["what"].split("against ")[1]}; wanted >= {head["wanted"]}:
        {verdict(head)}). Where it has more cores XLA passes parts of so short a program between
        threads, which takes longer: in the table {equal["seconds"] / own["seconds"]:.1f} times.
        (`NPROC=1` in the environment leaves it one.)"""

    def shown(found):
        outcome = found.get("result", "converged")
        setting = found["setting"] + ("" if outcome == "converged" else f" ({outcome})")
        off = found.get("failed") or format(found["period"], ".1e")
        return found | {"setting": setting, "off": off}

    return [
        f"""Use `fj.limit_cycle` by the exact law: {own["seconds"] * 1e3:.2g} ms for an error of
        {worst(own):.0e} ({own["setting"]}).{ratios} The quickest transient with an error below
        0.01, {peer["name"]}, takes {peer["seconds"] * 1e3:.2g} ms for {worst(peer):.0e}.""",
        table(
            "method | setting | compile [s] | periods run | time [ms] | error of the period"
            " | of the amplitude",
            map(shown, sorted(rows, key=lambda r: (groups.index(r["group"]), -r.get("eps", 0)))),
            "{group} | {setting} | {compile_s:.1f} | {periods} | {seconds!m:.3g} | {off}"
            " | {amplitude:.1e}",
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
        heyoka's steps on the tanh law are at most {transients.CAP} eps/V (in 1/omega): without a
        cap its series jump over the layer, and at eps = 0.001 V the amplitude grows to four times
        what it is.""",
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
        at_eps = [r for r in found if r.get("eps") == eps]
        floor = worst(min(at_eps, key=lambda r: r.get("rtol", 1)))
        place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "fontsize": 8}
        ax.axhline(floor, color="0.6", lw=0.8, ls=":", zorder=0)
        ax.annotate(f"eps = {eps:g} V", (1.01, floor), va=("bottom", "top")[i % 2], **place)
    return png(figure)
