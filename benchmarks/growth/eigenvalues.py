"""Growth rate in closed form against LAPACK: systems a second, and the error where it is hardest.

All get the same linearised systems, (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g. Batches go from one
system to ten million, the methods taking turns, so that a busy machine slows all alike; errors are
taken to 40 digits, family by family.
"""

import dataclasses
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
from mpmath import mpf
from tqdm import tqdm

from ..page import cell, png, spread, subplots, table, verdict, versions
from ..timing import others_running, ran_on, taking_turns, this_machine, too_long
from .eigenvalue_methods import (
    AT_ONCE,
    CHUNK,
    CLOSED,
    CLOSED_32,
    JAX,
    JAX_32,
    NUMPY,
    SCENES,
    THREADS,
    TIMED,
    WITH_ERRORS,
    growth_rates,
    timed,
    worth,
)
from .systems import (
    COALESCING,
    FAMILIES,
    FLUTTER,
    STABLE,
    Columns,
    exact_growth,
    random as random_systems,
)

WANTED = 100  # ratio of the rates to numpy.linalg.eigvals, in large batches
LIMIT = 20.0  # s: a call that would take longer is left out
ZERO = 1e-14  # beside the largest modulus
LAST_DIGIT = 1e-40  # of the truth
SINGLE = 1e-4  # the closest to coalescence that float32 can tell from it


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    batches: tuple[int, ...]
    repeats: int
    exact: int  # systems of each family, for mpmath
    near: int  # of each distance from coalescence


FULL = Size(tuple(10**k for k in range(8)), 5, 100, 40)
QUICK = Size((1, 10_000), 3, 10, 4)


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def ratio(turns: dict[str, list[float]], peer: str, name: str) -> float | None:
    """How many times as fast as a peer in the same batch, where that has run."""
    if peer not in turns:
        return None
    return statistics.median(a / b for a, b in zip(turns[peer], turns[name], strict=True))


def times(size: Size) -> list[dict[str, Any]]:
    """Times of every method in every batch, but for those that would take too long."""
    rng = np.random.default_rng(0)
    most = size.batches[-1]
    columns = random_systems(rng, most)
    K_n = 10 ** rng.uniform(7, 10, most)
    scenes = K_n, K_n * rng.uniform(0.1, 1, most), rng.uniform(0.05, 0.8, most)
    # Systems, and seconds for all of them.
    last: dict[str, tuple[int, float]] = dict.fromkeys(TIMED, (1, 0.0))
    rows = []

    def wanted(name: str, many: int) -> bool:
        systems, elapsed = last[name]
        return worth(name, many) and not too_long(elapsed, many / systems, LIMIT)

    for many in tqdm(size.batches, desc="batch"):
        names = [name for name in TIMED if wanted(name, many)]
        first = [tuple(column[:many] for column in group) for group in (columns, scenes)]
        made = {name: timed(name, *first) for name in names}
        turns = taking_turns({name: call for name, (call, _) in made.items()}, size.repeats)
        found = {}
        for name in names:
            median = statistics.median(turns[name])
            last[name] = many, median
            found[name] = {
                "compile_s": made[name][1],
                "seconds_per_system": median / many,
                "seconds_per_system_fastest": min(turns[name]) / many,
                "seconds_per_system_slowest": max(turns[name]) / many,
                "systems_per_second": many / median,
                "ratio_to_numpy": ratio(turns, NUMPY, name),
                "ratio_to_threads": ratio(turns, THREADS, name),
            }
        rows.append({"systems": many, "methods": found})
    return rows


def errors_of(columns: Columns, dtype: Any) -> dict[str, Any]:
    """Errors beside the largest modulus of an eigenvalue; share unstable; signs got wrong."""
    columns = tuple(column.astype(dtype).astype(float) for column in columns)
    truth = [exact_growth(*row) for row in zip(*(x.tolist() for x in columns), strict=True)]
    # Where the exact one is 0, as without damping or coupling, there is no sign to get wrong.
    signed = [abs(exact) > ZERO * size for exact, size in truth]
    errors, wrong = {}, {}
    for name, values in growth_rates(columns, dtype).items():
        pairs = list(zip(values.tolist(), truth, strict=True))
        off = [float(abs(mpf(value) - exact)) / size for value, (exact, size) in pairs]
        off = [error if error > LAST_DIGIT else 0.0 for error in off]
        errors[name] = spread(off)
        wrong[name] = sum(s and v * x <= 0 for s, (v, (x, _)) in zip(signed, pairs, strict=True))
    unstable = sum(s and x > 0 for s, (x, _) in zip(signed, truth, strict=True)) / len(truth)
    return {"unstable": unstable, "errors": errors, "wrong_signs": wrong}


def family(make: Callable[..., Columns], count: int, single: bool = True) -> dict[str, Any]:
    """`errors_of` a family in float64 and, if asked for, of the same rounded to float32."""
    columns = make(np.random.default_rng(1), count)
    found = errors_of(columns, np.float64)
    if single:
        rounded = errors_of(columns, np.float32)
        for key in ("errors", "wrong_signs"):
            found[key] |= rounded[key]
    return found


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size = QUICK if quick else FULL
    busy = others_running()
    batches = times(size)
    large = [row for row in batches if {NUMPY, THREADS} <= set(row["methods"])][-1]
    return {
        "headline": [
            {
                "what": f"{CLOSED} beside {NUMPY}, {large['systems']:,} systems",
                "systems": large["systems"],
                "ratio": large["methods"][CLOSED]["ratio_to_numpy"],
                "ratio_to_threads": large["methods"][CLOSED]["ratio_to_threads"],
                "wanted": WANTED,
            }
        ],
        "quick": quick,
        "repeats": size.repeats,
        "exact_points": {"family": size.exact, "distance": size.near},
        "machine": this_machine(busy),
        "versions": versions("jax", "numpy", "mpmath"),
        "batches": batches,
        "families": [
            {"family": name} | family(make, size.exact)
            for name, make in tqdm(FAMILIES.items(), desc="family")
        ],
        "coalescing": [
            {"distance": distance, "side": side}
            | family(make, size.near, distance >= SINGLE or distance == 0)
            for (distance, side), make in tqdm(COALESCING.items(), desc="distance")
        ],
    }


# ---------------------------------------------------------------------------------------------
# The page
# ---------------------------------------------------------------------------------------------


def choice(result: dict[str, Any]) -> str:
    """One sentence: what to take."""
    best = max(result["batches"], key=lambda row: row["methods"][CLOSED]["systems_per_second"])
    own, single = (best["methods"][name]["systems_per_second"] for name in (CLOSED, CLOSED_32))
    worst = {
        name: max(row["errors"][name]["worst"] for row in result["families"])
        for name in (CLOSED, NUMPY, CLOSED_32)
    }
    return (
        f"Take the default, the closed form in float64 and many systems at a time: {own:.2g} a"
        f" second, with a worst error, away from coalescence, of {worst[CLOSED]:.0e} of the"
        f" largest modulus of an eigenvalue, where NumPy has {worst[NUMPY]:.0e}; float32 is"
        f" {single / own:.1f} times as fast and good to {worst[CLOSED_32]:.0e}."
    )


def worse(result: dict[str, Any], own: str, peer: str) -> str:
    """The families in which a method's worst error is above a peer's, in words."""
    found = [
        name_of(row)
        for row in result["families"] + result["coalescing"]
        if own in row["errors"] and row["errors"][own]["worst"] > row["errors"][peer]["worst"]
    ]
    return f"is above LAPACK's in: {'; '.join(found)}." if found else "is no larger in any family."


def in_figures(result: dict[str, Any]) -> str:
    """Whether the closed form is what was wanted of it: ratio by batch, error by family."""
    head = result["headline"][0]
    slow = [
        f"{row['systems']:,} ({found:.3g})"
        for row in result["batches"]
        if (found := row["methods"][CLOSED]["ratio_to_numpy"]) is not None and found < WANTED
    ]
    sentences = [
        f"For {head['systems']:,} systems it has {head['ratio']:.0f} times the rate of {NUMPY}"
        f" (wanted >= {head['wanted']}: {verdict(head)}), and"
        f" {head['ratio_to_threads']:.0f} times that of"
        " the same spread by hand over a thread a core, as JAX does with the closed form.",
        f"In float64 its worst error {worse(result, CLOSED, NUMPY)}",
        f"In float32 its worst error {worse(result, CLOSED_32, JAX_32)}",
    ]
    if slow:
        sentences.insert(1, f"The ratio is below {WANTED} in batches of {', '.join(slow)}.")
    return " ".join(sentences)


def name_of(row: dict[str, Any]) -> str:
    """A family as the page names it."""
    if "family" in row:
        return row["family"]
    if row["distance"] == 0:
        return "at coalescence"
    return f"{row['distance']:.0e} from coalescence, {row['side']}"


def rate_cells(result: dict[str, Any], name: str) -> list[str]:
    """One row of the table of rates: compile time, then rate and ratio in every batch."""
    found = [row["methods"].get(name) for row in result["batches"]]
    compile_s = max((x["compile_s"] or 0 for x in found if x), default=0)
    cells = [
        f"{x['systems_per_second']:.2g} ({cell(x['ratio_to_numpy'], '.3g')})" if x else "-"
        for x in found
    ]
    return [name, cell(compile_s or None, ".1f"), *cells]


def error_cells(row: dict[str, Any]) -> list[str]:
    """One row of the table of errors."""
    errors = [row["errors"].get(name) for name in WITH_ERRORS]
    return [
        name_of(row),
        f"{row['unstable']:.0%}",
        *(f"{x['median']:.1e}, {x['worst']:.1e}" if x else "-" for x in errors),
        *(str(row["wrong_signs"].get(name, "-")) for name in (CLOSED, CLOSED_32)),
    ]


def text(result: dict[str, Any]) -> str:
    """The Markdown page: what to take, what is missed, two tables, how it was measured."""
    rows = result["families"] + result["coalescing"]
    batches = [f"{row['systems']:,}" for row in result["batches"]]
    skipped = [
        f"{name} of {row['systems']:,}"
        for row in result["batches"]
        for name in TIMED
        if worth(name, row["systems"]) and name not in row["methods"]
    ]
    exact = result["exact_points"]
    lines = [
        "# Growth rate of two directions in closed form",
        "",
        choice(result),
        "",
        in_figures(result),
        "",
        "Systems a second by systems in a batch; in brackets the ratio to NumPy in that batch:",
        "",
        *table(["method", "compile [s]", *batches], [rate_cells(result, name) for name in TIMED]),
        "",
        "Errors by family: median, worst:",
        "",
        *table(
            ["family", "unstable", *WITH_ERRORS, "wrong signs", "wrong signs, float32"],
            [error_cells(row) for row in rows],
        ),
        "",
        f"Times are medians of {result['repeats']} turns over systems of the random family, the"
        " methods taking turns, and every ratio the median of the ratios within a turn; compile"
        " time, the longest of all batches, includes tracing and is in no other column. LAPACK"
        f" gets its matrices ready made. The closed form works on at most {CHUNK} at a time, on"
        f" all where it says so; from scenes it also linearises. A call that would take above"
        f" {LIMIT:.0f} s is left out: {', '.join(skipped) or 'none was'}.",
        "",
        "Errors are beside the largest modulus of an eigenvalue, against mpmath with 40 digits, at"
        f" {exact['family']} systems of a family and {exact['distance']} of a distance from"
        " coalescence, every other one of these damped, alike in both directions. That distance is"
        " the one of |a - b| from 2 sqrt(g), as a share of it; at 0 the systems are whole numbers,"
        " so that no rounding parts the eigenvalues. Towards it they move with the square root of"
        " what is rounded, so that 1e-8, in float32 3e-4, is what any method can promise there."
        " LAPACK's matrices are scaled by powers of two, which rounds nothing. In float32 the"
        " truth is that of the rounded systems, and no distance but 0 is shown below"
        f" {SINGLE:.0e}, where rounding hides it. Wrong signs are those of the closed form,"
        " where the exact growth rate is not 0.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


# ---------------------------------------------------------------------------------------------
# The picture
# ---------------------------------------------------------------------------------------------

# Marker, line and colour: blue is the closed form, orange LAPACK.
STYLES = {
    CLOSED: ("o", "-", "tab:blue"),
    SCENES: ("v", "-", "tab:cyan"),
    AT_ONCE: ("P", ":", "tab:blue"),
    CLOSED_32: ("D", "--", "tab:purple"),
    NUMPY: ("s", "-", "tab:orange"),
    THREADS: ("X", "--", "tab:red"),
    JAX: ("^", ":", "goldenrod"),
    JAX_32: ("h", "--", "tab:brown"),
}
LEAST_SHOWN = 1e-19  # of errors
ERROR = "worst error / largest modulus of an eigenvalue [-]"


def draw_rates(axis, batches: list[dict[str, Any]]) -> None:
    """A line for each method."""
    for name in TIMED:
        marker, line, colour = STYLES[name]
        own = [row for row in batches if name in row["methods"]]
        rate = [row["methods"][name]["systems_per_second"] for row in own]
        style = {"marker": marker, "ls": line, "c": colour, "mec": "k", "label": name}
        axis.loglog([row["systems"] for row in own], rate, **style)
    axis.set(xlabel="systems in a batch [-]", ylabel="systems a second [1/s]")


def draw_families(axis, families: list[dict[str, Any]]) -> None:
    """A marker for each method that has errors of its own."""
    names = [row["family"].replace(" term", "\nterm") for row in families]
    for name in WITH_ERRORS:
        marker, _, colour = STYLES[name]
        worst = [max(row["errors"][name]["worst"], LEAST_SHOWN) for row in families]
        axis.semilogx(worst, names, marker, c=colour, mec="k", ms=9, alpha=0.8, label=name)
    axis.set(xlabel=ERROR)
    axis.margins(y=0.15)
    axis.invert_yaxis()


def draw_distances(axis, rows: list[dict[str, Any]]) -> None:
    """A line for each method and side, the distances side by side with 0 at the end."""
    distances = list(dict.fromkeys(row["distance"] for row in rows))
    for name in (CLOSED, NUMPY, CLOSED_32, JAX_32):  # JAX in float64 is as NumPy
        marker, _, colour = STYLES[name]
        for side, line, fill in ((FLUTTER, "-", colour), (STABLE, "--", "w")):
            errors = [row["errors"].get(name) for row in rows if row["side"] in (side, "both")]
            worst = [max(x["worst"], LEAST_SHOWN) if x else np.nan for x in errors]
            style = {"marker": marker, "ls": line, "c": colour, "mfc": fill, "mec": "k"}
            label = name if side == FLUTTER else None
            axis.semilogy(range(len(distances)), worst, **style, label=label)
    axis.set(xlabel="distance from coalescence [-]", ylabel=ERROR)
    axis.set(title=f"filled: {FLUTTER}, open: {STABLE}; no error is at the bottom")
    axis.set_xticks(range(len(distances)), [f"{d:.0e}" if d else "0" for d in distances])


def picture(result: dict[str, Any]) -> bytes:
    """Systems a second over the batch; worst errors by family, and by distance."""
    figure, axes = subplots(1, 3, figsize=(19, 6.4))
    draw_rates(axes[0], result["batches"])
    draw_families(axes[1], result["families"])
    draw_distances(axes[2], result["coalescing"])
    for axis in axes:
        axis.grid(True, which="major", alpha=0.4)
    for axis, place in zip(axes, ("lower right", "lower center", "upper center"), strict=True):
        axis.legend(loc=place, fontsize="small")
    return png(figure, dpi=100)
