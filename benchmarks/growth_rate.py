"""Growth rate and its gradient to (D, G): this package against what SciPy and NumPy give.

The package, compiled and vmapped, beside the loops that a user would write with brentq and
numpy.linalg.eigvals, and beside the quickest peer, NumPy arrays throughout; their gradients are
differences. Errors are those of the timed calls, against 40 digits.
"""

import functools
import math
import statistics
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mpmath import mpf
from tqdm import tqdm

import fractaljax as fj

from .loops import STEP, arrays, brake, differences, plain_loop, tuned_loop
from .page import cell, draw, png, spread, subplots, table, verdict
from .timing import in_batches, in_parts, ratio, taking_turns
from .truths import growth_of_surface, mp

TITLE = "Growth rate with gradient over surfaces"
PACKAGES = ("numpy", "scipy", "mpmath")
WANTED = 1000  # ratio of the rates of value and gradient
LIMIT = 10.0  # s: a call that would take longer is left out
STEPS = tuple(float(step) for step in 10.0 ** -np.arange(2, 10.25, 0.5))  # in D and ln G
D_RANGE, G_RANGE = (2.35, 2.6), (3e-11, 3e-9)
VALUE, GRADIENT = "value", "value and gradient"
PLAIN, TUNED, ARRAYS = "loop", "tuned loop", "NumPy arrays"
FORWARD, REVERSE, FORWARD_32 = "forward mode", "reverse mode", "forward mode, float32"
FULL = {"points": 1_000_000, "at_once": 10_000, "arrays": 20_000, "loop": 2000, "exact": 48}
FULL |= {"repeats": 9, "batches": tuple(10**k for k in range(7))}
QUICK = {"points": 2000, "at_once": 1000, "arrays": 500, "loop": 50, "exact": 6}
QUICK |= {"repeats": 3, "batches": (1000,)}
Rows = list[dict[str, Any]]


def surfaces(count: int) -> tuple[np.ndarray, np.ndarray]:
    """D and G (n,) at random, G even in the logarithm; float32 holds them too."""
    rng = np.random.default_rng(0)
    D = rng.uniform(*D_RANGE, count)
    G = np.exp(rng.uniform(math.log(G_RANGE[0]), math.log(G_RANGE[1]), count))
    return D.astype(np.float32).astype(float), G.astype(np.float32).astype(float)


class Truth(NamedTuple):
    """Some points of the loops, as many of each regime, with 40 digits."""

    places: list[int]
    rows: np.ndarray  # (n, 3): value, by D, by ln G
    omega: np.ndarray  # (n,) modulus of the critical eigenvalue [1/s]
    regimes: dict[str, float]  # their shares of the loops' points


def exact_row(b: dict[str, float], D: float, G: float) -> list[float]:
    """Value and derivatives to D and ln G with 40 digits, rounded to doubles."""
    with mp.workdps(40):
        x, y, h = mpf(D), mp.log(mpf(G)), mpf(10) ** -12
        at = functools.partial(growth_of_surface, b)
        slopes = at(x + h, y) - at(x - h, y), at(x, y + h) - at(x, y - h)
        return [float(at(x, y)), *(float(slope / (2 * h)) for slope in slopes)]


def truth_of(b: dict[str, float], D: np.ndarray, G: np.ndarray, count: int) -> Truth:
    """The first points of each of the three regimes."""
    states = [tuned_loop(b)(d, g) for d, g in zip(D.tolist(), G.tolist(), strict=True)]
    places: dict[str, list[int]] = {}
    for i, (_, _, regime) in enumerate(states):
        places.setdefault(regime, []).append(i)
    places = dict(sorted(places.items()))
    first = [i for kind in places for i in places[kind][: count // len(places)]]
    return Truth(
        first,
        np.array([exact_row(b, float(D[i]), float(G[i])) for i in tqdm(first, desc="40 digits")]),
        np.array([states[i][1] for i in first]),
        {kind: len(found) / len(D) for kind, found in places.items()},
    )


def errors_of(rows: np.ndarray, truth: Truth) -> dict[str, Any]:
    """Errors of the growth rate in omega; of the gradient in its length, where it has one."""
    found = {"growth_rate": spread(np.abs(rows[:, 0] - truth.rows[:, 0]) / truth.omega)}
    if rows.shape[1] == 3:
        length = np.linalg.norm(truth.rows[:, 1:], axis=1)
        off = np.linalg.norm(rows[:, 1:] - truth.rows[:, 1:], axis=1)
        found["gradient"] = spread(off[length > 0] / length[length > 0])
    return found


class Method(NamedTuple):
    """A way to values or gradients at the first `points` surfaces."""

    name: str
    gradient: bool
    points: int
    run: Callable[[], Any]
    compile_s: float | None = None  # of the package; peers are not compiled

    def rows(self, G: np.ndarray) -> np.ndarray:
        """What it gives, as (n, 1) or (n, 3): value, by D, by ln G; n at least `at_once`."""
        found = self.run()
        if self.compile_s is None:
            return found.reshape(len(found), -1)
        value, *slopes = (np.asarray(x, float) for x in jax.tree.leaves(found[0]))
        if slopes:
            slopes[1] = slopes[1] * G[: len(value)]
        return np.stack([value, *slopes], axis=1)


def by_loop(body: Callable, gradient: bool, D: list[float], G: list[float]) -> Callable:
    """Growth rates (n,), or value and derivatives (n, 3), point by point."""

    def value(d, g):
        return body(d, g)[0]

    def one(d, g):
        return differences(value, d, g, STEP, 2) if gradient else value(d, g)

    return lambda: np.array([one(d, g) for d, g in zip(D, G, strict=True)])


def loops(b: dict[str, float], D: np.ndarray, G: np.ndarray) -> list[Method]:
    """Both loops, for values and for gradients."""
    return [
        Method(f"{name}, {what}", gradient, len(D), by_loop(body, gradient, D.tolist(), G.tolist()))
        for name, body in ((PLAIN, plain_loop(b)), (TUNED, tuned_loop(b)))
        for what, gradient in ((VALUE, False), (GRADIENT, True))
    ]


def with_arrays(b, D: np.ndarray, G: np.ndarray, steps: dict[int, float]) -> list[Method]:
    """NumPy arrays, for values and for gradients by the step of each order of difference."""
    growth = arrays(b)

    def gradient(order, step):
        return lambda: np.stack(differences(growth, D, G, step, order), axis=1)

    return [Method(f"{ARRAYS}, {VALUE}", False, len(D), lambda: growth(D, G))] + [
        Method(f"{ARRAYS}, {GRADIENT}, order {order}", True, len(D), gradient(order, step))
        for order, step in sorted(steps.items())
    ]


def package(name: str, D: np.ndarray, G: np.ndarray, at_once: int) -> Method:
    """One of the package's programs, called for `at_once` points until it has had all."""
    dtype = np.float32 if name == FORWARD_32 else np.float64
    scene = jax.tree.map(lambda x: jnp.asarray(x, dtype), fj.brake_scene())

    def value(D, G):
        return fj.growth_rate(scene.replace(D=D, G=G))

    def forward(D, G):
        rate, push = jax.linearize(value, D, G)
        one, zero = jnp.ones_like(D), jnp.zeros_like(D)
        return rate, (push(one, zero), push(zero, one))

    reverse = jax.value_and_grad(value, argnums=(0, 1))
    function = {VALUE: value, REVERSE: reverse}.get(name, forward)
    columns = [jnp.asarray(column, dtype) for column in (D, G)]
    run, compile_s = in_parts(jax.vmap(function), columns, at_once)
    return Method(name, name != VALUE, len(D), run, compile_s)


def by_step(D: np.ndarray, G: np.ndarray, truth: Truth) -> Rows:
    """Errors of the differences of NumPy arrays, by their order and step."""
    growth, at = arrays(brake()), (D[truth.places], G[truth.places])

    def errors(order, step):
        return errors_of(np.stack(differences(growth, *at, step, order), axis=1), truth)

    return [
        {"order": order, "step": step} | errors(order, step)["gradient"]
        for order in (2, 4)
        for step in STEPS
    ]


def by_batch(batches, repeats: int, D: np.ndarray, G: np.ndarray, steps) -> Rows:
    """Points a second in one call, by the number of points in it."""

    def calls(many, quick):
        first = D[:many], G[:many]
        methods = [peer for peer in with_arrays(brake(), *first, steps) if quick(peer.name)]
        methods += [package(name, *first, many) for name in (VALUE, FORWARD, REVERSE)]
        return {method.name: method.run for method in methods}

    return [
        {"points": n, "points_per_second": {m: n / statistics.median(t) for m, t in turns.items()}}
        for n, turns in in_batches(calls, batches, repeats, LIMIT)
    ]


def describe(method: Method, times: dict[str, list[float]], G, truth: Truth) -> dict[str, Any]:
    """A method's times a point, ratios to its peers, and errors."""
    kind, own, rows = GRADIENT if method.gradient else VALUE, times[method.name], method.rows(G)
    order = ", order 2" if method.gradient else ""
    return {
        "name": method.name,
        "gradient": method.gradient,
        "points": method.points,
        "compile_s": method.compile_s,
        "seconds_per_point": statistics.median(own),
        "points_per_second": 1 / statistics.median(own),
        "ratio_to_loop": ratio(times[f"{PLAIN}, {kind}"], own),
        "ratio_to_tuned_loop": ratio(times[f"{TUNED}, {kind}"], own),
        "ratio_to_arrays": ratio(times[f"{ARRAYS}, {kind}{order}"], own),
        "not_finite": int((~np.isfinite(rows)).any(axis=1).sum()),
        "error_to_40_digits": errors_of(rows[truth.places], truth),
    }


def measure(**size: Any) -> dict[str, Any]:
    """Times and errors of every method, by step and by batch."""
    b, (D, G), at_once = brake(), surfaces(size["points"]), size["at_once"]
    few, more = ((D[: size[name]], G[: size[name]]) for name in ("loop", "arrays"))
    truth = truth_of(b, *few, size["exact"])
    steps, best = by_step(D, G, truth), {}
    for row in sorted(steps, key=lambda row: row["worst"]):
        best.setdefault(row["order"], row["step"])  # only the truth shows which it is
    methods = [*loops(b, *few), *with_arrays(b, *more, best)]
    methods += [package(name, D, G, at_once) for name in (VALUE, FORWARD, REVERSE, FORWARD_32)]
    turns = taking_turns({method.name: method.run for method in methods}, size["repeats"])
    times = {m.name: [elapsed / m.points for elapsed in turns[m.name]] for m in methods}
    found = {method.name: describe(method, times, G, truth) for method in methods}
    # Forward mode: there are two inputs.
    ratios = {key: x for key, x in found[FORWARD].items() if key.startswith("ratio_to_")}
    what = f"{GRADIENT}, {FORWARD}, beside the loop as a user writes it"
    return {
        "headline": [{"what": what, "ratio": ratios["ratio_to_loop"], "wanted": WANTED} | ratios],
        "ranges": {"D": D_RANGE, "G": G_RANGE},
        "size": size,
        "exact_points": len(truth.places),
        "loop_step": STEP,
        "best_steps": best,
        "regimes": truth.regimes,
        "methods": list(found.values()),
        "steps": steps,
        "batches": by_batch(size["batches"], min(size["repeats"], 5), D, G, best),
    }


def worst(row: dict[str, Any], what: str = "gradient") -> float:
    """The worst error of a method."""
    return row["error_to_40_digits"][what]["worst"]


def page(result: dict[str, Any]) -> list[str]:
    size, ranges, head = result["size"], result["ranges"], result["headline"][0]
    regimes = ", ".join(f"{name} {share:.0%}" for name, share in result["regimes"].items())
    steps = [[r for r in result["steps"] if r["order"] == order] for order in (2, 4)]
    rows, batches = {row["name"]: row for row in result["methods"]}, result["batches"]
    by_arrays = (row for n, row in rows.items() if n.startswith(ARRAYS) and row["gradient"])
    peer = min(by_arrays, key=worst)
    time = {name: f"{row['seconds_per_point'] * 1e6:.2g} us" for name, row in rows.items()}
    return [
        f"""Use forward mode in float64 for the gradient to (D, G), and some {size["at_once"]:,}
        points in a call, as `fj.sweep` does: {time[FORWARD]} a point, good to
        {worst(rows[FORWARD]):.0e} of its length (reverse mode: {time[REVERSE]}), where the best
        differences of the quickest peer take {time[peer["name"]]} for {worst(peer):.0e}; float32
        takes {time[FORWARD_32]} and is good to {worst(rows[FORWARD_32]):.0e}.""",
        f"""Value and gradient come at {head["ratio"]:.0f} times the rate of the loop that a user
        writes with brentq, eigvals and central differences (wanted >= {head["wanted"]}:
        {verdict(head)}), {head["ratio_to_tuned_loop"]:.0f} times that of the same loop tuned by
        hand, and {head["ratio_to_arrays"]:.0f} times that of NumPy arrays without any loop.""",
        table(
            "method | compile [s] | time a point [us] | points a second | ratio to the loop"
            " | to the tuned loop | to NumPy arrays | growth rate error / omega: median, worst"
            " | gradient error, relative: median, worst | not finite",
            result["methods"],
            "{name} | {compile_s:.1f} | {seconds_per_point!u:.3g} | {points_per_second:.3g}"
            " | {ratio_to_loop:.3g} | {ratio_to_tuned_loop:.3g} | {ratio_to_arrays:.3g}"
            " | {error_to_40_digits.growth_rate:.1e} | {error_to_40_digits.gradient:.1e}"
            " | {not_finite}",
        ),
        "Gradient error of the differences of NumPy arrays by their step, relative:",
        table(
            "step | order 2: median, worst | order 4: median, worst",
            ({"step": x["step"], "two": x, "four": y} for x, y in zip(*steps, strict=True)),
            "{step:.1e} | {two:.1e} | {four:.1e}",
        ),
        "Points a second in one call, by the number of points in it:",
        table(
            "method | " + " | ".join(f"{row['points']:,}" for row in batches),
            (
                f"{name} | "
                + " | ".join(cell(row["points_per_second"].get(name), ".2g") for row in batches)
                for name in batches[0]["points_per_second"]
            ),
        ),
        f"""Surfaces of the reference brake at random, D {ranges["D"][0]} to {ranges["D"][1]}, G
        {ranges["G"][0]:g} to {ranges["G"][1]:g} m, even in ln G ({regimes}). The package gets
        {size["points"]:,}, {size["at_once"]:,} in a call, the NumPy arrays {size["arrays"]:,}, the
        loops {size["loop"]:,}. The loops call brentq for the load and numpy.linalg.eigvals for the
        state matrix, and for the gradient four more of each, at a step of {result["loop_step"]:g};
        the plain one equation by equation with NumPy, the tuned one with the math module, constants
        taken out and a reduced load balance. NumPy arrays have that balance too, with Newton steps
        in place of brentq, and LAPACK for all matrices in one call; their steps,
        {result["best_steps"]["2"]:.1e} for order 2 and {result["best_steps"]["4"]:.1e} for order 4,
        are those with the least worst error here, which a user without the truth cannot know.""",
        f"""Every time is the median of {size["repeats"]} turns (at most 5 by batch), the methods
        taking turns, and every ratio the median of the ratios within a turn. Compile time includes
        tracing and is in no other column. A call that would take above {LIMIT:.0f} s is left out.
        Errors are those of the same calls, against mpmath with 40 digits at
        {result["exact_points"]} of the points, as many of each regime; omega is the modulus of the
        critical eigenvalue. float32 holds these surfaces exactly; its row includes the rounding of
        the brake's other numbers.""",
    ]


def picture(result: dict[str, Any]) -> bytes:
    """Worst error over time a point; errors over the step; points a second over the batch."""
    figure, (top, middle, bottom) = subplots(3, 1, figsize=(8.3, 16))
    methods, batches = result["methods"], result["batches"]
    own = next(row for row in methods if row["name"] == FORWARD)["error_to_40_digits"]["gradient"]
    lines = []
    for row, marker in zip(methods, "osP*^vDX<>h", strict=False):
        error = worst(row, "gradient" if row["gradient"] else "growth_rate")
        style = ("C1" if row["compile_s"] is None else "C0") + marker
        lines.append((row["seconds_per_point"] * 1e6, error, style, row["name"]))
    title = "error of the gradient, of its length; of the value, of omega"
    draw(top, lines, "time a point [us]", "worst error [-]", title)
    lines = []
    for how, line in (("worst", "-"), ("median", "--")):
        for order, style in ((2, "C1s"), (4, "C3^")):
            rows = [row for row in result["steps"] if row["order"] == order]
            x, y = [row["step"] for row in rows], [row[how] for row in rows]
            lines.append((x, y, style + line, f"differences of order {order}, {how}"))
        lines.append((STEPS, [own[how]] * len(STEPS), f"C0{line}", f"{FORWARD}, {how}"))
    draw(middle, lines, "step in D and ln G [-]", "error of the gradient, of its length [-]")
    lines = []
    for name, marker in zip(batches[0]["points_per_second"], "sXPoD^", strict=False):
        rows = [row for row in batches if name in row["points_per_second"]]
        x, y = [row["points"] for row in rows], [row["points_per_second"][name] for row in rows]
        style = f"{'C1' if name.startswith(ARRAYS) else 'C0'}{marker}"
        lines.append((x, y, f"{style}{'--' if name.endswith(VALUE) else '-'}", name))
    draw(bottom, lines, "points in one call [-]", "points a second [1/s]")
    return png(figure, dpi=100)
