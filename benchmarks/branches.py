"""A branch of limit cycles and a basin of attraction: error against run time, beside peers.

The branch is that of the reference scene over mu_s, with unstable cycles between three folds.
People without a continuation code for dry friction search for the cycle at one value after the
other, up and down, each from the last state; or they smooth the law, and follow the smooth cycle
with JaxCont's collocation. A basin is beside a search from every single start.
"""

import time
from typing import Any

import jax.numpy as jnp
import numpy as np

import fractaljax as fj

from .page import in_words, png, spread, subplots, table
from .timing import seconds, versions
from .transients import (
    MU_S,
    accelerations,
    cubic,
    extremes_of,
    last_period,
    law,
    reading,
    reference,
    scipy_states,
)

TITLE = "Branches and basins: error against run time"
PACKAGES = ("numpy", "scipy", "diffrax", "jaxcont")
WINDOW = (0.26, 0.8)  # of mu_s
FULL = {"values": 200, "checked": 12, "smooth": ((0.1, 20), (0.03, 40), (0.01, 80))}
FULL |= {"starts": 4000, "sample": 64, "repeats": 3}
QUICK = {"values": 6, "checked": 2, "smooth": ((0.1, 20),), "starts": 64, "sample": 4, "repeats": 1}
OWN, SWEEPS, JAXCONT = "fj.continue_cycle", "searches up and down", "JaxCont, tanh law"
COLLOCATION = 4  # points in an interval of JaxCont's mesh
SETTLING = 60  # periods of the smooth motion before JaxCont takes over
RADIUS = 2.0  # of the ball of starts, in V/omega and V
Row = dict[str, Any]


def searched(mu_s: float, state: Any) -> Any:
    return fj.limit_cycle(reference(mu_s=mu_s), state, throw=False)


def off(mu_s: float, period: float, amplitude: float, state: Any) -> float | None:
    """The relative error of a stable cycle beside the search from its own state."""
    truth = searched(mu_s, state)
    if not bool(truth.result == fj.CycleResult.converged):
        return None
    found = abs(period / truth.period - 1), abs(amplitude / truth.amplitude[0] - 1)
    return float(max(found))


def errors(chosen, mu_s, period, amplitude, state) -> Row:
    """Median and worst at the chosen points."""
    each = [off(mu_s[i], period[i], amplitude[i], state[i]) for i in chosen]
    known = [error for error in each if error is not None]
    return {"error": spread(known) if known else None, "compared": len(known)}


def spaced(places: np.ndarray, count: int) -> np.ndarray:
    """So many of the places, or all."""
    return places[np.unique(np.linspace(0, len(places) - 1, count).astype(int))]


def own_branch(checked: int, repeats: int) -> tuple[Row, Row]:
    """The package's branch."""

    def follow():
        return fj.continue_cycle(reference(), "mu_s", WINDOW, start)

    start = fj.limit_cycle(reference())
    first, _ = seconds(follow)
    warm = min(seconds(follow)[0] for _ in range(repeats))
    branch = follow()
    at = branch.parameter, branch.period, branch.amplitude[:, 0], branch.state
    row = {"name": OWN, "points": len(at[0]), "unstable": int(np.sum(~branch.stable))}
    row |= {"first_s": first, "seconds": warm, "folds": len(branch.folds), "result": "complete"}
    row |= errors(spaced(np.flatnonzero(branch.stable), checked), *at)
    events = [(event.kind, float(event.value)) for event in branch.events]
    curve = {"mu_s": at[0].tolist(), "amplitude": (at[2] * 1e6).tolist()}
    return row | {"events": events}, curve | {"stable": branch.stable.tolist()}


def sweeps(values: int) -> tuple[Row, Row]:
    """A search at each value, upwards and then downwards, each from the last state."""
    up = np.linspace(*WINDOW, values)
    state = fj.limit_cycle(reference()).state
    found, start = [], time.perf_counter()
    for mu_s in (*up, *up[::-1]):
        cycle = searched(float(mu_s), state)
        if bool(cycle.result == fj.CycleResult.converged):
            state = cycle.state
            found.append((float(mu_s), float(cycle.amplitude[0]) * 1e6))
    row = {"name": SWEEPS, "points": len(found), "unstable": 0, "first_s": None, "folds": 0}
    row |= {"seconds": time.perf_counter() - start, "result": f"{values} values, twice"}
    values_found, amplitudes = zip(*found, strict=True)
    curve: Row = {"mu_s": list(values_found), "amplitude": list(amplitudes)}
    return row, curve


def smooth_field(eps: float):
    """du/dt of the tanh law for u (4,) and mu_s."""

    def field(u, mu_s, args):
        numbers = *law().numbers[:-3], *cubic(mu_s)
        return jnp.stack([u[2], u[3], *accelerations(jnp.tanh, numbers, eps)(*u)])

    return field


def smooth_orbit(eps: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Times (k,) and states (k, 4) of one period after the transient, and that period; scaled."""
    times, units = reading(SETTLING), law()
    y = scipy_states("LSODA", units, eps, 1e-9, times)()
    rate = accelerations(np.tanh, units.numbers, eps)(*y.T)[0]
    period = last_period(units, extremes_of(times, y[:, 0], y[:, 2], rate))[0] / units.time
    last = times >= times[-1] - period
    return times[last] - times[last][0], y[last], period


def jaxcont_branch(eps: float, intervals: int, checked: int) -> tuple[Row, Row]:
    """JaxCont from the reference both ways, on a mesh of so many intervals."""
    import jaxcont as jc  # pyright: ignore[reportMissingImports]
    from jaxcont.core.collocation import Collocation  # pyright: ignore[reportMissingImports]
    from jaxcont.problems.periodic import (  # pyright: ignore[reportMissingImports]
        periodic_orbit_problem,
    )

    times, states, period = smooth_orbit(eps)
    mesh = Collocation(ntst=intervals, ncol=COLLOCATION)
    setting = f"eps {eps:g} V, {intervals} intervals"
    row = {"name": f"{JAXCONT}, {setting}", "unstable": None, "error": None, "compared": 0}
    start = time.perf_counter()
    problem = periodic_orbit_problem(
        smooth_field(eps), jnp.array(states), jnp.array(times), period, MU_S, mesh
    )
    # Steps in mu_s as fine as the package's, in the norm of all unknowns.
    options = {"ds": 0.1, "ds_min": 1e-4, "ds_max": 1.0, "max_steps": 120}
    settings = jc.ContinuationPar(newton_tol=1e-9, compute_stability=False, **options)

    def follow():
        # Without its events, which hold the Jacobians of all points at once: 20 GB.
        both = [jc.continuation(problem, p_span=(MU_S, end), settings=settings) for end in WINDOW]
        return [(np.asarray(one.branch.params), np.asarray(one.branch.states)) for one in both]

    found = follow()
    first = time.perf_counter() - start
    warm, _ = seconds(follow)
    row["folds"] = sum(int(np.sum(np.diff(np.sign(np.diff(one[0]))) != 0)) for one in found)
    mu_s, u = (np.concatenate(x) for x in zip(*found, strict=True))
    order = np.argsort(mu_s)
    mu_s, u = mu_s[order], u[order]
    nodes, units = u[:, : 4 * intervals].reshape(len(u), intervals, 4), law()
    x = np.concatenate([u[:, : 4 * intervals], u[:, 4 * intervals : -1]], axis=1)[:, ::4]
    amplitude, period = np.ptp(x, axis=1) * units.length, u[:, -1] * units.time
    speed = units.length / units.time
    state = nodes[:, 0] * np.repeat([units.length, speed], 2)
    row |= {"points": len(mu_s), "first_s": first, "seconds": warm}
    row |= {"result": f"mu_s {mu_s.min():.3g} to {mu_s.max():.3g}"}
    inside = np.flatnonzero((mu_s > WINDOW[0]) & (mu_s < WINDOW[1]))
    row |= errors(spaced(inside, checked), mu_s, period, amplitude, state)
    return row, {"mu_s": mu_s.tolist(), "amplitude": (amplitude * 1e6).tolist()}


def basins(starts: int, sample: int, repeats: int) -> Row:
    """The basin of the reference scene, and a search from each of some of its starts."""

    def labels():
        return fj.basin(reference(), radius=RADIUS, starts=starts, progress=False)

    def from_each(states):
        return np.array([searched(MU_S, state).period for state in states])

    first, _ = seconds(lambda: labels().labels)
    turns = [seconds(lambda: labels().labels)[0] for _ in range(repeats)]
    found = labels()
    chosen = spaced(np.arange(starts), sample)
    first_each, _ = seconds(from_each, found.starts[chosen])
    each_s, period = seconds(from_each, found.starts[chosen])
    known = np.array([np.nan, *(float(c.period) for c in found.cycles), np.nan, np.nan])
    # Where there is no cycle both are NaN.
    same = np.isclose(known[found.labels[chosen]], period, rtol=1e-6, atol=0, equal_nan=True)
    return {
        "starts": starts,
        "first_s": first,
        "seconds": min(turns),
        "shares": {k: v for k, v in found.shares.items() if v},
        "sample": sample,
        "sample_first_s": first_each,
        "sample_s": each_s,
        "alike": int(np.sum(same)),
    }


def measure(values, checked, smooth, starts, sample, repeats) -> Row:
    """The branch by each method, and the basin."""
    own, curve = own_branch(checked, repeats)
    row, swept = sweeps(values)
    rows, curves = [own, row], {OWN: curve, SWEEPS: swept}
    if "jaxcont" in versions("jaxcont"):
        for eps, intervals in smooth:
            row, found = jaxcont_branch(eps, intervals, checked)
            rows, curves = [*rows, row], curves | {row["name"]: found}
    for row in rows:
        row["per_point"] = row["seconds"] / max(row["points"], 1)
    ball = basins(starts, sample, repeats)
    ball["ratio"] = ball["sample_s"] / sample / (ball["seconds"] / starts)
    return {
        "headline": [
            {
                "what": "200 points of a branch [s]",
                "value": 200 * own["per_point"],
                "wanted": [0, 2],
            },
            {"what": f"basin of {starts} starts [s]", "value": ball["seconds"], "wanted": [0, 20]},
        ],
        "window": WINDOW,
        "rows": rows,
        "curves": curves,
        "basin": ball,
    }


# The page


def page(result: Row) -> list[str]:
    (own, swept, *peers), ball = result["rows"], result["basin"]
    shares = ", ".join(f"{name} {share:.1%}" for name, share in ball["shares"].items())
    events = ", ".join(f"{kind} {value:.6f}" for kind, value in own["events"])
    beside, than_peer = "JaxCont is not installed here.", ""
    if peers:
        best = min((row for row in peers if row["error"]), key=lambda row: row["error"]["worst"])
        times = best["per_point"] / own["per_point"]
        than_peer = f""", and JaxCont on the smoothed law {times:.0f} times as long for an error of
        {best["error"]["worst"]:.0e} beside {own["error"]["worst"]:.0e}"""
        beside = """JaxCont solves the smoothed law, with the whole Jacobian of its collocation, on
        a mesh that is even in time and does not move into the layer |v| < eps; its events, which
        need the Jacobians of all points at once, are left out, and folds are counted where mu_s
        turns back."""
    return [
        f"""Use `fj.continue_cycle` for cycles, stable and unstable, and where they change:
        {own["per_point"] * 1e3:.3g} ms a point, where a search at each value, which sees neither
        unstable cycles nor events, takes {swept["per_point"] * 1e3:.3g} ms{than_peer}. Use
        `fj.basin` for where starts end: {ball["seconds"] / ball["starts"] * 1e3:.2g} ms a start,
        {ball["ratio"]:.0f} times as fast as a search from each.""",
        table(
            "method | points | of them unstable | folds | reached | first call [s] | again [s]"
            " | a point [ms] | error: median, worst | compared",
            ({"compared": None, **row} for row in result["rows"]),
            "{name} | {points} | {unstable} | {folds} | {result} | {first_s:.1f} | {seconds:.2f}"
            " | {per_point!m:.3g} | {error:.0e} | {compared}",
        ),
        f"""Cycles of the reference scene over mu_s from {result["window"][0]:g} to
        {result["window"][1]:g}. Errors are relative, of period and amplitude, beside a search with
        the exact law from the point's own state, at stable points spread over the branch (of
        JaxCont at all, where the search may end in another cycle). Events of the branch:
        {events}. Searches up and down take each last state as the next start, so that they show
        where the motion jumps, but no unstable cycle. {beside}""",
        "## Basin",
        f"""{ball["starts"]} starts in a ball of {RADIUS:g} V/omega and V about the equilibrium:
        {ball["seconds"]:.3g} s ({ball["first_s"]:.3g} s the first time); {shares}. A search from
        each of {ball["sample"]} of them takes {ball["sample_s"]:.3g} s
        ({ball["sample_first_s"]:.3g} s the first time) and gives the label of
        {ball["alike"]}.""",
        table("what | found | wanted | ", map(in_words, result["headline"])),
    ]


def picture(result: Row) -> bytes:
    """Amplitudes over mu_s by each method; time a point beside the error."""
    figure, (left, right) = subplots(1, 2, figsize=(11, 4.8), width_ratios=(2, 1))
    curves = dict(result["curves"])
    own, swept = curves.pop(OWN), curves.pop(SWEEPS)
    for name, style in zip(curves, ("C2", "C1", "C4"), strict=False):
        left.plot(curves[name]["mu_s"], curves[name]["amplitude"], f"{style}.", ms=4, label=name)
    left.plot(swept["mu_s"], swept["amplitude"], "C3x", ms=4, label=SWEEPS)
    mu_s, amplitude, stable = (np.array(own[key]) for key in ("mu_s", "amplitude", "stable"))
    for where, style, label in ((stable, "C0-", ", stable"), (~stable, "C0--", ", unstable")):
        left.plot(mu_s, np.where(where, amplitude, np.nan), style, label=f"{OWN}{label}")
    left.set(xlabel="mu_s [-]", ylabel="peak to peak of x1 [um]")
    left.grid(True, alpha=0.4)
    left.legend(fontsize="small")
    for row, style in zip(result["rows"], ("C0o", "C3x", "C2s", "C1s", "C4s"), strict=False):
        if row.get("error"):
            right.plot(
                row["error"]["worst"], row["per_point"] * 1e3, style, ms=8, label=row["name"]
            )
    right.set(xscale="log", yscale="log")
    right.set(xlabel="worst relative error [-]", ylabel="time of a point [ms]")
    right.grid(True, alpha=0.4)
    right.legend(fontsize="small")
    return png(figure)
