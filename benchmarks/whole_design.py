"""A whole design: by gradients, by Nelder and Mead's simplex, by grids; how near by when.

Each method solves the same task from the same starts, on the package and on the plain NumPy loop.
The designs that it tried are evaluated afterwards by one program, off the clock; the best of them
so far that meets every requirement is what a user could have stopped with. The optimum itself
comes from a dense grid, polished on the loop, which shares no line with the package.

A design is scaled variables u in [0, 1]^v. It is evaluated to one row: the objective, then the
requirements of `fj.design`, each at most 0 where it is met.
"""

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from mpmath import mpf
from tqdm import tqdm

import fractaljax as fj

from .loops import brake, plain_loop
from .page import Result, draw, png, subplots, table
from .timing import compiled, seconds
from .truths import growth_of_surface, mp

TITLE = "A whole design: gradients, Nelder-Mead and grids"
PACKAGES = ("numpy", "scipy", "mpmath")
TARGET = -math.pi  # largest growth rate allowed [1/s], the default of `fj.design` for this brake
GROWTH_SCALE = 2 * math.pi  # xi_1 omega_1 of this brake [1/s]
AREA_RATIO_MIN, SLIP_RATIO_MAX = 2.0, 0.9
LOGARITHMIC = ("G", "P", "omega_1", "omega_2")
NEAR, EXACT = 1e-2, 1e-6  # relative gaps to the optimum that are timed
FLOOR = 1e-9  # least gap that is shown
SHOWN = 1.05  # a curve keeps a point where the gap falls by this factor
MEETS = 1e-9  # largest requirement that counts as met
PENALTY = 100.0  # of the exact penalty
CHUNK = 4096  # designs of a grid evaluated in one call
ZOOM, LEVELS = 4.0, 12  # a zoomed grid shrinks by this factor, so many times
PLACES = 16  # that a scattered method starts from
STRIDES = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0]) % 1  # between them: they fill the bounds evenly
RESTARTS = 4  # of Nelder-Mead, from where it ended
FULL: dict[str, Any] = {"starts": 8, "loop_runs": 4, "dense": 90_000, "polished": 4}
FULL["sides"] = {  # of the grids by task: on the package, zoomed, on the loop
    "one condition": ((64, 256, 1024), (32,), (16, 48)),
    "envelope": ((64, 256), (32,), (8, 20)),
    "five variables": ((6, 12), (6,), (3, 5)),
}
QUICK: dict[str, Any] = {"starts": 2, "loop_runs": 1, "dense": 10_000, "polished": 2}
QUICK["sides"] = {"one condition": ((32,), (16,), (8,)), "five variables": ((5,), (5,), (3,))}
Rows = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class DesignTask:
    """Bounds of the variables, conditions of the envelope and the objective."""

    name: str
    title: str
    bounds: Mapping[str, tuple[float, float]]
    conditions: Mapping[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    nearest: bool = False  # the smallest change is best, not the smallest growth rate

    @property
    def every_condition(self) -> list[dict[str, float]]:
        """The quantities at each condition that a design is evaluated at."""
        rows = zip(*self.conditions.values(), strict=True) if self.conditions else [()]
        return [dict(zip(self.conditions, row, strict=True)) for row in rows]

    def quantities(self, u, exp: Callable = math.exp) -> dict[str, Any]:
        """The quantities of the scene at scaled variables u (v,)."""

        def between(name, low, high, x):
            if name in LOGARITHMIC:
                return exp(math.log(low) + x * math.log(high / low))
            return low + x * (high - low)

        return {name: between(name, *b, u[i]) for i, (name, b) in enumerate(self.bounds.items())}

    def scaled(self, quantities: Mapping[str, float]) -> np.ndarray:
        """Scaled variables (v,) of quantities; those beyond a bound by a rounding are on it."""
        u = []
        for name, (low, high) in self.bounds.items():
            scale = math.log if name in LOGARITHMIC else float
            u.append((scale(quantities[name]) - scale(low)) / (scale(high) - scale(low)))
        return np.clip(u, 0, 1)

    def starts(self, count: int) -> np.ndarray:
        """The brake's own design and designs spread at random (count, v)."""
        others = np.random.default_rng(0).uniform(size=(count - 1, len(self.bounds)))
        return np.vstack([self.scaled(brake())[None], others])

    def scale(self, best: float) -> float:
        """What gaps are relative to: the distance itself, or the decay rate xi_1 omega_1."""
        return best if self.nearest else GROWTH_SCALE


SURFACE: dict[str, tuple[float, float]] = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}
_P, _MU_S = np.meshgrid(np.linspace(1700, 2100, 5), np.linspace(0.35, 0.45, 5))
ENVELOPE = {"P": tuple(_P.ravel().tolist()), "mu_s": tuple(_MU_S.ravel().tolist())}
MORE = {"P": (1000.0, 4000.0), "omega_1": (5000.0, 8000.0), "omega_2": (4000.0, 6500.0)}
FIVE = "Nearest in D, G, P, omega_1, omega_2"
TASKS = (
    DesignTask("one condition", "D and G, one condition", SURFACE),
    DesignTask("envelope", "D and G, worst of 25 conditions", SURFACE, ENVELOPE),
    DesignTask("five variables", FIVE, SURFACE | MORE, nearest=True),
)


@functools.cache
def least_stiffness() -> float:
    """K_n of the reference brake [N/m]: no design may be softer."""
    return float(fj.stiffness(fj.brake_scene())[0])


def requirements(np, growth, K_n, log_area_ratio, slip_ratio) -> list[Any]:
    """Each at most 0 where it is met, as `fj.design` scales them; `np` is NumPy or JAX's."""
    return [
        2 * (math.log(AREA_RATIO_MIN) - log_area_ratio),
        10 * (slip_ratio - SLIP_RATIO_MAX),
        np.arcsinh((growth - TARGET) / GROWTH_SCALE),
        1 - K_n / least_stiffness(),
    ]


def by_package(task: DesignTask) -> Callable[[jax.Array], jax.Array]:
    """Evaluates a design (v,) by the package: a traceable function to a row (1 + k,)."""
    scene, own = fj.brake_scene(), jnp.asarray(task.scaled(brake()))
    least_stiffness()  # computed now, not while tracing
    conditions = {name: jnp.asarray(values) for name, values in task.conditions.items()}

    def at(quantities):
        moved = scene.replace(**quantities)
        state = moved.contact.state(moved.friction.mu_s, moved.friction.mu_m)
        ratios, growth = (state.log_area_ratio, state.slip_ratio), fj.growth_rate(moved)
        return jnp.stack([growth, *requirements(jnp, growth, state.K_n, *ratios)])

    def evaluate(u):
        quantities = task.quantities(u, jnp.exp)
        if conditions:
            row = jax.vmap(lambda condition: at(quantities | condition))(conditions).max(axis=0)
        else:
            row = at(quantities)
        return row.at[0].set(jnp.sum((u - own) ** 2)) if task.nearest else row

    return evaluate


def by_loop(task: DesignTask) -> Rows:
    """The same by the loop of a user without the package."""
    b, own = brake(), task.scaled(brake())

    def at(quantities):
        growth, _, _, *state = plain_loop(b | quantities)(quantities["D"], quantities["G"])
        return [growth, *requirements(np, growth, *state)]

    def evaluate(u):
        quantities = task.quantities(u)
        row = np.max([at(quantities | condition) for condition in task.every_condition], axis=0)
        if task.nearest:
            row[0] = np.sum((np.asarray(u) - own) ** 2)
        return row

    return evaluate


# Methods


class Trace:
    """Designs (n, v) that a method tried, the seconds when it had, and its answer."""

    def __init__(self, task: DesignTask):
        self.seen: list[tuple[float, np.ndarray]] = []
        self.evaluations: int | None = 0  # of one design at one condition; None if not counted
        self.answer: np.ndarray | None = None
        self._each = len(task.every_condition)
        self._start = time.perf_counter()

    def count(self, evaluations: int) -> None:
        """Evaluations of designs, at all conditions each."""
        self.evaluations = (self.evaluations or 0) + evaluations * self._each

    def add(self, us: np.ndarray, evaluations: int = 0) -> None:
        """Designs tried by now, and how many have been evaluated."""
        self.seen.append((time.perf_counter() - self._start, np.array(us)))
        self.count(evaluations)

    def end(self, answer: np.ndarray) -> "Trace":
        """The method's answer (v,), now."""
        self.add(answer[None])
        self.answer = answer
        return self


def by_design(task: DesignTask, start: np.ndarray) -> Trace:
    """`fj.design` as its users call it, from the surface at `start`; only its answer is seen."""
    scene, trace = fj.brake_scene().replace(**task.quantities(start)), Trace(task)
    floors = {"area_ratio_min": AREA_RATIO_MIN, "slip_ratio_max": SLIP_RATIO_MAX}
    required: Any = {"envelope": dict(task.conditions) or None, "progress": False} | floors
    what = dict(task.bounds), fj.growth_rate, TARGET, least_stiffness()
    surface = fj.design(scene, *what, **required).scene.contact.surface
    trace.end(task.scaled({"D": float(surface.D), "G": float(surface.G)}))
    trace.evaluations = None
    return trace


def scaled_row(task: DesignTask, row: np.ndarray) -> np.ndarray:
    """A row, or its derivatives, with the objective of order one."""
    row = np.array(row)
    row[..., 0] *= 1 if task.nearest else 1 / GROWTH_SCALE
    return row


def nelder_mead(
    task: DesignTask, evaluate: Rows, start: np.ndarray, trace: Trace | None = None
) -> Trace:
    """Nelder and Mead's simplex on an exact penalty, started again from its own answers."""
    trace = trace or Trace(task)

    def merit(u):
        row = scaled_row(task, evaluate(u))
        trace.add(u[None], 1)
        return row[0] + PENALTY * np.maximum(row[1:], 0).sum()

    u, best, bounds = start, np.inf, [(0, 1)] * len(start)
    options = {"xatol": 1e-9, "fatol": 1e-9, "maxfev": 1000, "adaptive": len(u) > 2}
    minimize = functools.partial(scipy.optimize.minimize, merit, bounds=bounds, options=options)
    for _ in range(RESTARTS):
        found = minimize(u, method="Nelder-Mead")
        u, gained, best = found.x, best - found.fun, found.fun
        if gained < 1e-9:
            break
    return trace.end(u)


def slsqp(
    task: DesignTask,
    evaluate: Rows,
    jacobian: Rows | None,
    start: np.ndarray,
    trace: Trace | None = None,
) -> Trace:
    """Sequential quadratic programming; without a Jacobian by SciPy's differences."""
    trace = trace or Trace(task)

    @functools.lru_cache(1)  # objective and constraints ask for the same design
    def row_at(place: bytes) -> np.ndarray:
        u = np.frombuffer(place)
        trace.add(u[None], 1)
        return scaled_row(task, evaluate(u))

    @functools.lru_cache(1)
    def slopes_at(place: bytes) -> np.ndarray:
        assert jacobian is not None
        trace.count(1)
        return scaled_row(task, jacobian(np.frombuffer(place)).T).T

    constraint: dict[str, Any] = {"type": "ineq", "fun": lambda u: -row_at(u.tobytes())[1:]}
    if jacobian is not None:
        constraint["jac"] = lambda u: -slopes_at(u.tobytes())[1:]
    found = scipy.optimize.minimize(
        lambda u: row_at(u.tobytes())[0],
        start,
        method="SLSQP",
        jac=None if jacobian is None else lambda u: slopes_at(u.tobytes())[0],
        bounds=[(0, 1)] * len(start),
        constraints=[constraint],
        options={"ftol": 1e-12, "maxiter": 200},
    )
    return trace.end(np.clip(found.x, 0, 1))


def scattered(task: DesignTask, evaluate: Rows, solve: Callable, start: np.ndarray) -> Trace:
    """The best that another method finds from many places, the start being the first."""
    trace, strides = Trace(task), STRIDES[: len(start)]
    us = [solve((start + i * strides) % 1, trace).answer for i in range(PLACES)]
    trace.count(len(us))
    rows = np.array([evaluate(u) for u in us])
    return trace.end(better((np.inf, np.inf, start), np.array(us), rows)[2])


def better(best: tuple, us: np.ndarray, rows: np.ndarray) -> tuple:
    """The better of `best` and designs us (n, v): (violation, objective, design)."""
    violation = np.maximum(rows[:, 1:].max(axis=1), MEETS)
    violation = np.where(np.isnan(violation), np.inf, violation)
    i = np.lexsort((rows[:, 0], violation))[0]
    found = violation[i], rows[i, 0], us[i]
    return found if found[:2] < best[:2] else best


def grid(task: DesignTask, rows: Rows, side: int, start: np.ndarray, levels: int = 1) -> Trace:
    """The best of a grid of side^v designs; on further levels of a smaller one about that.

    The grid is shifted by `start`, so that no answer is owed to where the optimum happens to lie.
    """
    trace, best = Trace(task), (np.inf, np.inf, start)
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(levels):
        points = itertools.product(*[(np.arange(side) + u) / side for u in start])
        while chunk := list(itertools.islice(points, CHUNK)):
            us = low + np.array(chunk) * (high - low)
            best = better(best, us, rows(us))
            trace.add(best[2][None], len(us))
        half = (high - low) / (2 * ZOOM)
        low, high = np.maximum(best[2] - half, 0), np.minimum(best[2] + half, 1)
    return trace.end(best[2])


class Method(NamedTuple):
    """A way to solve a task: `solve(start)` gives its trace."""

    name: str
    family: str  # of its style in the picture
    solve: Callable[[np.ndarray], Trace]
    compile_s: float | None  # before the first call; None where the first call compiles, 0 nowhere
    runs: int | None = None  # at most so many starts


def methods(task: DesignTask, sides, loop_runs: int) -> tuple[list[Method], Rows]:
    """Every method for a task, its programs compiled apart, and what evaluates designs (n, v)."""
    evaluate, loop, v = by_package(task), by_loop(task), len(task.bounds)
    one, one_s = compiled(evaluate, jnp.zeros(v))
    slopes, slopes_s = compiled(jax.jacfwd(evaluate), jnp.zeros(v))
    many, many_s = compiled(jax.vmap(evaluate), jnp.zeros((CHUNK, v)))
    of = functools.partial

    def rows(us):
        parts = (us[i : i + CHUNK] for i in range(0, len(us), CHUNK))
        whole = (np.asarray(many(jnp.asarray(np.resize(part, (CHUNK, v))))) for part in parts)
        return np.concatenate(list(whole))[: len(us)]

    def loop_rows(us):
        return np.array([loop(u) for u in us])

    def own(u):
        return np.asarray(one(u))

    def jacobian(u):
        return np.asarray(slopes(u))

    by_slopes, by_differences = of(slsqp, task, own, jacobian), of(slsqp, task, loop, None)
    simplex, plain_simplex = of(nelder_mead, task, own), of(nelder_mead, task, loop)
    on_package, on_loop = of(scattered, task, own), of(scattered, task, loop)
    places, all_s, n = f"from {PLACES} places", one_s + slopes_s, loop_runs
    grids, zooms, loop_grids = sides
    found = [
        Method("fj.design", "design", of(by_design, task), None),
        Method("SLSQP, package", "slsqp", by_slopes, all_s),
        Method("SLSQP, loop", "slsqp loop", by_differences, 0.0, n),
        Method(f"SLSQP {places}, package", "scattered", of(on_package, by_slopes), all_s),
        Method(f"SLSQP {places}, loop", "scattered loop", of(on_loop, by_differences), 0.0, n),
        Method("Nelder-Mead, package", "simplex", simplex, one_s),
        Method("Nelder-Mead, loop", "simplex loop", plain_simplex, 0.0, n),
        Method(f"Nelder-Mead {places}, package", "simplices", of(on_package, simplex), one_s),
        Method(f"Nelder-Mead {places}, loop", "simplices loop", of(on_loop, plain_simplex), 0.0, n),
    ]
    for side in grids:
        on_grid = of(grid, task, rows, side)
        found.append(Method(f"grid of {side}^{v}, package", "grid", on_grid, many_s))
    for side in zooms:
        zoomed = of(grid, task, rows, side, levels=LEVELS)
        found.append(Method(f"zoomed grid of {side}^{v}, package", "zoom", zoomed, many_s))
    for side in loop_grids:
        on_grid = of(grid, task, loop_rows, side)
        found.append(Method(f"grid of {side}^{v}, loop", "grid loop", on_grid, 0.0, n))
    return found if set(task.bounds) == {"D", "G"} else found[1:], rows


# Measuring


def optimum(task: DesignTask, rows: Rows, dense: int, polished: int) -> Result:
    """The best of a dense grid, polished on the loop; and its growth rate beside 40 digits."""
    variables, loop = len(task.bounds), by_loop(task)
    axes = [np.linspace(0, 1, round(dense ** (1 / variables)))] * variables
    us = np.array(list(itertools.product(*axes)))
    found = rows(us)
    values = np.where(found[:, 1:].max(axis=1) <= 0, found[:, 0], np.inf)
    merit = scaled_row(task, found)
    merit = merit[:, 0] + 10 * np.maximum(merit[:, 1:], 0).sum(axis=1)  # infeasible ones last
    order = np.argsort(np.where(np.isfinite(values), merit - 1e6, merit))
    chosen = order[: polished**3 : polished**2]
    ends = [slsqp(task, loop, None, us[i]).answer for i in chosen]
    met = [(u, row) for u in ends if u is not None and (row := loop(u))[1:].max() <= MEETS]
    best, row = min(met, key=lambda pair: pair[1][0])
    near = 1e-8 * task.scale(row[0])
    return {
        "value": float(row[0]),
        "quantities": task.quantities(best),
        "polished": len(ends),
        "agree": sum(bool(other[0] - row[0] <= near) for _, other in met),
        "dense": len(us),
        "dense_gap": float(values.min() - row[0]),
        "off_exact": off_exact(task, best, row),
    }


def off_exact(task: DesignTask, u: np.ndarray, row: np.ndarray) -> float:
    """The worst growth rate of the loop beside 40 digits [1/s]."""
    b = brake() | task.quantities(u)
    with mp.workdps(40):
        place = mpf(b["D"]), mp.log(mpf(b["G"]))
        exact = max(float(growth_of_surface(b | at, *place)) for at in task.every_condition)
    return abs(TARGET + GROWTH_SCALE * math.sinh(row[3]) - exact)


def curve(trace: Trace, rows: Rows, best: float, unit: float) -> np.ndarray:
    """When (n,), and the relative gap (n,) of the best design so far that meets everything."""
    found = rows(np.concatenate([us for _, us in trace.seen]))
    gaps = np.where(found[:, 1:].max(axis=1) <= MEETS, (found[:, 0] - best) / unit, np.inf)
    ends = np.cumsum([len(us) for _, us in trace.seen])
    least = np.minimum.accumulate(np.maximum(np.where(np.isnan(gaps), np.inf, gaps), FLOOR))
    return np.array([[t for t, _ in trace.seen], least[ends - 1]])


def thinned(points: np.ndarray) -> list[list[float]]:
    """The points of a curve where the gap falls, and the last."""
    kept, last = [], np.inf
    for point in points.T:
        if np.isfinite(point[1]) and point[1] * SHOWN < last:
            kept.append(point)
            last = point[1]
    kept += [point for point in [points[:, -1]] if np.isfinite(point[1])]
    return [[float(f"{x:.4g}") for x in point] for point in kept]


def reached(curves: list[np.ndarray], gap: float) -> Result:
    """How many starts come this near, and the median time over all of them, if half do."""
    times = [np.append(c[0][c[1] <= gap], math.inf)[0] for c in curves]
    return {"starts": sum(map(math.isfinite, times)), "seconds": finite(np.median(times))}


def finite(value: Any) -> float | None:
    """A number, or None where there is none."""
    return float(value) if math.isfinite(value) else None


def solved(task: DesignTask, method: Method, rows: Rows, best: float, starts) -> Result:
    """Every run of a method: times, evaluations, gaps, violations."""
    if method.compile_s is None:
        jax.clear_caches()
    first = seconds(method.solve, starts[0])[0] if method.compile_s != 0 else 0.0  # also imports
    traces = [method.solve(start) for start in starts[: method.runs]]
    walls = [trace.seen[-1][0] for trace in traces]
    curves = [curve(trace, rows, best, task.scale(best)) for trace in traces]
    answers = rows(np.array([trace.answer for trace in traces]))
    gaps = [float(c[1, -1]) for c in curves]
    counts = [trace.evaluations for trace in traces if trace.evaluations is not None]
    return {
        "task": task.name,
        "name": method.name,
        "family": method.family,
        "compile_s": first - walls[0] if method.compile_s is None else method.compile_s,
        "starts": len(traces),
        "seconds": float(np.median(walls)),
        "evaluations": float(np.median(counts)) if counts else None,
        "gap": {"median": finite(np.median(gaps)), "worst": finite(max(gaps))},
        "violation": float(np.maximum(answers[:, 1:].max(axis=1), 0).max()),
        "near": reached(curves, NEAR),
        "exact": reached(curves, EXACT),
        "curves": [thinned(c) for c in curves],
    }


def measure(starts: int, loop_runs: int, dense: int, polished: int, sides: Result) -> Result:
    """The optimum of every task, and every run of every method; on the loop from fewer starts."""
    tasks, runs = [], []
    for task in (task for task in TASKS if task.name in sides):
        ways, rows = methods(task, sides[task.name], loop_runs)
        best = optimum(task, rows, dense, polished)
        about = {"name": task.name, "title": task.title, "nearest": task.nearest}
        about |= {"conditions": len(task.every_condition), "bounds": dict(task.bounds)}
        tasks.append(about | {"optimum": best})
        given = rows, best["value"], task.starts(starts)
        runs += [solved(task, way, *given) for way in tqdm(ways, desc=task.name)]
    return {"starts": starts, "tasks": tasks, "runs": runs}


# The page


def took(run: Result, cold: bool) -> float:
    """Seconds of a whole run of a method, with compiling if it is cold."""
    return run["seconds"] + (run["compile_s"] if cold else 0)


def quickest(runs: list[Result], near: str, cold: bool) -> str | None:
    """The shortest whole run that comes near from every start, and None where none does.

    Whole, since only who knows the optimum can stop where a run first comes near it.
    """
    able = [run for run in runs if run[near]["starts"] == run["starts"]]
    best = min(able, key=lambda run: took(run, cold), default=None)
    return None if best is None else f"{best['name']}: {took(best, cold):.2g} s"


def task_blocks(task: Result, runs: list[Result]) -> list[str]:
    """The task, the optimum and how sure it is, and the table of the methods."""
    best = task["optimum"]
    bounds = ", ".join(f"{n} {low:g} to {high:g}" for n, (low, high) in task["bounds"].items())
    at = ", ".join(f"{name} = {value:.8g}" for name, value in best["quantities"].items())
    aim = "least squared scaled change" if task["nearest"] else "least growth rate"
    conditions = f"at the worst of {task['conditions']} conditions"
    return [
        f"## {task['title']}",
        f"""The {aim} within {bounds}{f", {conditions}" if task["conditions"] > 1 else ""}. The
        optimum is {best["value"]:.10g} {"-" if task["nearest"] else "1/s"} at {at}: {best["agree"]}
        of {best["polished"]} polished designs agree to 1e-8, the best of {best["dense"]} on a grid
        is {best["dense_gap"]:.1e} above it, and the growth rate there is
        {best["off_exact"]:.0e} 1/s off 40 digits.""",
        table(
            "method | compile [s] | a run [s] | evaluations | gap: median | gap: worst | violation"
            " | to 1 %: starts | time [s] | to 1e-6: starts | time [s]",
            (run | {"compile_s": run["compile_s"] or None} for run in runs),
            "{name} | {compile_s:.1f} | {seconds:.3g} | {evaluations:.0f} | {gap.median:.0e}"
            " | {gap.worst:.0e} | {violation:.0e} | {near.starts} of {starts} | {near.seconds:.3g}"
            " | {exact.starts} of {starts} | {exact.seconds:.3g}",
        ),
    ]


def page(result: Result) -> list[str]:
    tasks, runs = result["tasks"], result["runs"]
    own = {task["name"]: [run for run in runs if run["task"] == task["name"]] for task in tasks}
    all_by_design = all(rows[0]["family"] == "design" for rows in own.values())
    cases = [(near, cold) for near in ("near", "exact") for cold in (True, False)]
    best = {name: [quickest(rows, *case) for case in cases] for name, rows in own.items()}
    near, _, exact, later = (found or "no method" for found in best[tasks[0]["name"]])
    design = next(run for run in runs if run["family"] == "design")
    return [
        f"""The quickest ways to one design of D and G from any start are, to 1 % and compiling
        included, {near}; to 1e-6, {exact}; and for later designs, {later}. `fj.design` comes within
        1e-6 from {design["exact"]["starts"]} of {design["starts"]} starts, in
        {took(design, True):.2g} s the first time and {took(design, False):.2g} s after.""",
        "The shortest whole run that comes so near from every start:",
        table(
            "task | to 1 %, first design | later ones | to 1e-6, first design | later ones",
            (" | ".join([t["title"], *(x or "-" for x in best[t["name"]])]) for t in tasks),
        ),
        *(block for task in tasks for block in task_blocks(task, own[task["name"]])),
        f"""The reference brake, with the requirements of `fj.design`: growth rate at most
        {TARGET:.4f} 1/s, K_n no less than that of the brake, a_l at least {AREA_RATIO_MIN:g} a_e,
        Q_e at most {SLIP_RATIO_MAX:g} mu_s P. The peers evaluate them by a plain loop of NumPy,
        brentq and eigvals, which a user has without the package, or by the package. Gaps are to the
        optimum, relative to xi_1 omega_1 = {GROWTH_SCALE:.4f} 1/s or, for the nearest design, to
        the optimum itself, of the best design so far that meets every requirement to {MEETS:g};
        violation is the worst of the answers. Up to {result["starts"]} starts, the brake itself and
        random ones; a grid is shifted at random instead. Times are medians over all starts, those
        that never come so near counted as infinite, without compiling. Those beside a count of
        starts are when a run first comes so near, which only a user who knows the optimum would
        see. Compiling includes tracing and has its own column; for `fj.design` it is the extra time
        of the first call. Evaluations are of one design at one condition, with or without a
        gradient. `fj.design` keeps 1e-6 of every requirement in hand.{
            "" if all_by_design else " It is measured where D and G are the variables."
        }""",
    ]


STYLES = {
    "design": ("k", "D-", "fj.design"),
    "slsqp": ("C0", "o-", "SLSQP, package"),
    "slsqp loop": ("C0", "o:", "SLSQP, loop"),
    "scattered": ("C9", "P-", "SLSQP, many places, package"),
    "scattered loop": ("C9", "P:", "SLSQP, many places, loop"),
    "simplex": ("C3", "v-", "Nelder-Mead, package"),
    "simplex loop": ("C3", "v:", "Nelder-Mead, loop"),
    "simplices": ("C4", "^-", "Nelder-Mead, many places, package"),
    "simplices loop": ("C4", "^:", "Nelder-Mead, many places, loop"),
    "grid": ("C2", "s-", "grid, package"),
    "zoom": ("C8", "X--", "zoomed grid, package"),
    "grid loop": ("C2", "s:", "grid, loop"),
}


def median_curve(curves: list[list[list[float]]]) -> tuple[np.ndarray, np.ndarray]:
    """The median over the starts at every time at which one of them improves."""
    times = np.array(sorted({t for c in curves for t, _ in c}))
    gaps = np.full((len(curves), len(times)), np.inf)
    for row, c in zip(gaps, curves, strict=True):
        for t, gap in c:
            row[times >= t] = np.minimum(row[times >= t], gap)
    middle = np.median(gaps, axis=0) if len(times) else np.empty(0)
    known = np.isfinite(middle)
    return times[known], middle[known]


def picture(result: Result) -> bytes:
    """Median gap to the optimum over time: a row for every task, at the right with compiling."""
    tasks = result["tasks"]
    figure, axes = subplots(len(tasks), 2, figsize=(8.3, 4.2 * len(tasks) + 1.2), sharey=True)
    handles = {}
    for (row, task), cold in itertools.product(zip(axes, tasks, strict=True), (False, True)):
        ax, drawn = row[int(cold)], []
        for run in (run for run in result["runs"] if run["task"] == task["name"]):
            colour, style, label = STYLES[run["family"]]
            t, gap = median_curve(run["curves"])
            if not len(t):
                continue
            end = max(run["seconds"], t[0])
            t = np.append(t[t <= end], end) + (run["compile_s"] if cold else 0)
            gap = np.append(gap[: len(t) - 1], run["gap"]["median"])
            ax.step(t, gap, colour + style[1:], where="post", lw=1.5)
            drawn.append((t[-1], gap[-1], colour + style, label))
        xlabel = "time of the first design, with compiling [s]" if cold else "time [s]"
        draw(ax, drawn, xlabel, "gap to the optimum [-]", task["title"])
        ax.set_ylim(FLOOR / 2, 1e3)
        ax.get_legend().remove()
        handles |= {
            name: handle for handle, name in zip(*ax.get_legend_handles_labels(), strict=True)
        }
    names = [label for _, _, label in STYLES.values() if label in handles]
    shown = [handles[name] for name in names]
    figure.legend(shown, names, loc="outside lower center", ncols=3, fontsize="small")
    return png(figure, dpi=100)
