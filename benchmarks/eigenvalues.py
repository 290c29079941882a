"""Growth rate in closed form against LAPACK: systems a second, and the error where it is hardest.

All get the same linearised systems (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g, LAPACK as matrices made
before its time is taken. Batches go from one system to ten million; errors are taken to 40 digits
in families, each hard in its own way.
"""

import functools
import os
import statistics
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mpmath import mpf
from tqdm import tqdm

import fractaljax as fj
from fractaljax._mechanism.oscillator import Linearised
from fractaljax._stability.quartic import rightmost_root

from .page import cell, columns as column, draw, filled, png, spread, subplots, table, verdict
from .timing import in_batches, in_parts, ratio
from .truths import eigenvalues, mp

TITLE = "Growth rate of two directions in closed form"
PACKAGES = ("numpy", "mpmath")
WANTED = 100  # ratio of the rates to numpy.linalg.eigvals, in large batches
LIMIT = 20.0  # s: a call that would take longer is left out
CHUNK = 100_000  # systems at a time; what a program works on then stays in the cache
ZERO = 1e-14  # beside the largest modulus
LAST_DIGIT = 1e-40  # of the truth
SINGLE = 1e-4  # the closest to coalescence that float32 can tell from it
CLOSED, CLOSED_32 = "closed form", "closed form, float32"
SCENES, AT_ONCE = "closed form, from scenes", "closed form, all at once"
NUMPY, THREADS = "numpy.linalg.eigvals", "numpy.linalg.eigvals, a thread a core"
JAX, JAX_32 = "jax.numpy.linalg.eigvals", "jax.numpy.linalg.eigvals, float32"
TIMED: tuple[str, ...] = (CLOSED, SCENES, AT_ONCE, CLOSED_32, NUMPY, THREADS, JAX)
WITH_ERRORS = (CLOSED, NUMPY, JAX, CLOSED_32, JAX_32)
DISTANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
FLUTTER, STABLE = "flutter side", "stable side"
Columns = tuple[np.ndarray, ...]  # a, b, c_1, c_2, g


FULL = {"batches": tuple(10**k for k in range(8)), "repeats": 5, "exact": 100, "near": 40}
QUICK = {"batches": (1, 10_000), "repeats": 3, "exact": 10, "near": 4}


def stiffnesses(rng, n):
    """a and b [1/s^2] of a brake's size, and the coupling of mu from 0.05 to 0.8."""
    K_n, kappa, mu = 10 ** rng.uniform(7, 10, n), rng.uniform(0.1, 1, n), rng.uniform(0.05, 0.8, n)
    omega_1, omega_2 = 10 ** rng.uniform(3, 4.5, (2, n))
    return omega_1**2 + kappa * K_n, omega_2**2 + K_n, mu**2 * kappa * K_n**2


def damped(low, high) -> Callable[..., Columns]:
    """Damping ratios of both directions from 10^low to 10^high, even in the logarithm."""

    def family(rng, n):
        a, b, g = stiffnesses(rng, n)
        xi = 10 ** rng.uniform(low, high, (2, n))
        return a, b, 2 * xi[0] * np.sqrt(a), 2 * xi[1] * np.sqrt(b), g

    return family


def real_roots(rng, n) -> Columns:
    """Both directions overdamped and weakly coupled: four real eigenvalues."""
    a, b, c_1, c_2, _ = damped(0.2, 1)(rng, n)
    return a, b, c_1, c_2, 1e-3 * rng.uniform(0, 1, n) * a * b


def no_leading_term(rng, n) -> Columns:
    """More mean damping than stiffness: p <= 0 in Ferrari's resolvent."""
    a, b = rng.uniform(0.1, 1, (2, n))
    c_1, c_2 = rng.uniform(2.2, 6, (2, n))
    return a, b, c_1, c_2, rng.uniform(0, 4, n)


def half_damped(a, b, g) -> Columns:
    """Every other system damped, the same in both directions, which leaves coalescence in place."""
    c = np.where(np.arange(len(a)) % 2, 2e-3 * np.sqrt(a), 0)
    return a, b, c, c, g


def near_coalescence(distance: float) -> Callable[..., Columns]:
    """|a - b| = 2 sqrt(g) (1 + distance): below 0 on the flutter side of coalescence."""

    def family(rng, n):
        a, _, g = stiffnesses(rng, n)
        return half_damped(a, a + 2 * np.sqrt(g) * (1 + distance), g)

    return family


def at_coalescence(rng, n) -> Columns:
    """|a - b| = 2 sqrt(g) in whole numbers, which float32 holds too: no rounding of the roots."""
    a, h = rng.integers(1, (2**20, 2**12), (n, 2)).T.astype(float)
    return half_damped(a, a + 2 * h, h**2)


FAMILIES: dict[str, Callable[..., Columns]] = {
    "random": damped(-4, -1),  # lightly damped brakes, stable and unstable
    "strongly damped": damped(0, 3),
    "real roots": real_roots,
    "no positive leading term of the resolvent": no_leading_term,
}
# By distance and side; at 0 there are no sides.
COALESCING: dict[tuple[float, str], Callable[..., Columns]] = {
    (distance, side): near_coalescence(sign * distance)
    for distance in DISTANCES
    for side, sign in ((FLUTTER, -1), (STABLE, 1))
} | {(0.0, "both"): at_coalescence}


def state_matrices(columns: Columns) -> tuple[np.ndarray, np.ndarray]:
    """[[0, I], [-K, -C]] (n, 4, 4) in units of a power of two near sqrt(a + b), and that (n,).

    Powers of two round nothing: LAPACK gets the very systems of the closed form.
    """
    a, b, c_1, c_2, g = columns
    omega = np.exp2(np.round(np.log2(a + b) / 2))
    p = np.exp2(np.round(np.log2(g) / 2))  # of the coupling p (g/p)
    A = np.zeros((len(a), 4, 4))
    A[:, 0, 2] = A[:, 1, 3] = 1
    A[:, 2, 0], A[:, 3, 1] = -a / omega**2, -b / omega**2
    A[:, 2, 1], A[:, 3, 0] = p / omega**2, -g / p / omega**2
    A[:, 2, 2], A[:, 3, 3] = -c_1 / omega, -c_2 / omega
    return A, omega


closed_form = jax.vmap(lambda lin: rightmost_root(lin).real)


@functools.partial(jax.vmap, in_axes=0)
def scene_rates(K_n, K_t, mu) -> jax.Array:
    """Growth rates (n,) of the reference brake with joints of given stiffness and friction."""
    oscillator = fj.brake_scene().oscillator
    return fj.growth_rate(fj.Scene(fj.FixedContact(K_n, K_t), fj.Coulomb(mu), oscillator))


def largest(eigvals: Callable) -> Callable:
    """Largest real parts (n,) of the eigenvalues of matrices (n, 4, 4)."""
    return lambda A: eigvals(A).real.max(axis=1)


lapack, jax_lapack = largest(np.linalg.eigvals), largest(jnp.linalg.eigvals)


def threaded(parts: list[np.ndarray]) -> list[np.ndarray]:
    """NumPy's in as many threads as there are parts: it releases the interpreter's lock."""
    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(lapack, parts))


def timed(name: str, columns: Columns, scenes: Columns) -> tuple[Callable, float | None]:
    """The call of a method for these systems or scenes, and the seconds it took to compile."""
    if name == SCENES:
        return in_parts(scene_rates, map(jnp.asarray, scenes), CHUNK)
    if name in (CLOSED, CLOSED_32, AT_ONCE):
        size = len(columns[0]) if name == AT_ONCE else CHUNK
        dtype = np.float32 if name == CLOSED_32 else np.float64
        systems = [jnp.asarray(column, dtype) for column in columns]
        return in_parts(lambda *systems: closed_form(Linearised(*systems)), systems, size)
    matrices, _ = state_matrices(columns)
    if name == JAX:
        return in_parts(jax_lapack, [jnp.asarray(matrices)], len(matrices))
    if name == THREADS:
        return functools.partial(threaded, np.array_split(matrices, os.cpu_count() or 1)), None
    return functools.partial(lapack, matrices), None


def growth_rates(columns: Columns, dtype: Any) -> dict[str, np.ndarray]:
    """Growth rates (n,) by every method that has errors of its own in this precision."""
    matrices, omega = state_matrices(columns)
    A = matrices.astype(dtype)
    systems = Linearised(*(jnp.asarray(column, dtype) for column in columns))
    closed = np.asarray(jax.jit(closed_form)(systems))
    by_jax = np.asarray(jax.jit(jax_lapack)(A)) * omega
    if dtype == np.float32:  # NumPy computes these in double precision
        return {CLOSED_32: closed, JAX_32: by_jax}
    return {CLOSED: closed, NUMPY: lapack(A) * omega, JAX: by_jax}


def worth(name: str, many: int) -> bool:
    """Whether a method differs from the others in a batch of so many systems."""
    return name != AT_ONCE or many > CHUNK


def times(batches: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """Times of every method in every batch, except those that would take too long."""
    rng, most = np.random.default_rng(0), batches[-1]
    columns = FAMILIES["random"](rng, most)
    K_n = 10 ** rng.uniform(7, 10, most)
    scenes = K_n, K_n * rng.uniform(0.1, 1, most), rng.uniform(0.05, 0.8, most)
    compile_s, rows = {}, []

    def calls(many, quick):
        first = [tuple(column[:many] for column in group) for group in (columns, scenes)]
        names = [name for name in TIMED if worth(name, many) and quick(name)]
        made = {name: timed(name, *first) for name in names}
        compile_s.update({name: elapsed for name, (_, elapsed) in made.items()})
        return {name: call for name, (call, _) in made.items()}

    for many, turns in in_batches(calls, batches, repeats, LIMIT):
        found = {
            name: {
                "compile_s": compile_s[name],
                "systems_per_second": many / statistics.median(own),
                "ratio_to_numpy": ratio(turns[NUMPY], own) if NUMPY in turns else None,
                "ratio_to_threads": ratio(turns[THREADS], own) if THREADS in turns else None,
            }
            for name, own in turns.items()
        }
        rows.append({"systems": many, "methods": found})
    return rows


def exact_growth(a, b, c_1, c_2, g) -> tuple[Any, float]:
    """Largest real part with 40 digits, and the largest modulus."""
    # A coalescing eigenvalue has half the digits of the arithmetic.
    with mp.workdps(90):
        s = eigenvalues(*map(mpf, (a, b, c_1, c_2, g)))
        return mp.re(s[0]), float(max(map(abs, s)))


def errors_of(columns: Columns, dtype: Any) -> dict[str, Any]:
    """Errors beside the largest modulus of an eigenvalue; share unstable; wrong signs."""
    columns = tuple(column.astype(dtype).astype(float) for column in columns)
    truth = [exact_growth(*row) for row in zip(*(x.tolist() for x in columns), strict=True)]
    # Where the exact one is 0, as without damping or coupling, no sign can be wrong.
    signed = [abs(exact) > ZERO * size for exact, size in truth]
    errors, wrong = {}, {}
    for name, values in growth_rates(columns, dtype).items():
        pairs = list(zip(values.tolist(), truth, strict=True))
        off = [float(abs(mpf(value) - exact)) / size for value, (exact, size) in pairs]
        errors[name] = spread([error if error > LAST_DIGIT else 0.0 for error in off])
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


def measure(batches, repeats: int, exact: int, near: int) -> dict[str, Any]:
    """Rates by batch, errors by family and by distance from coalescence, at so many systems."""
    rows = times(batches, repeats)
    large = [row for row in rows if {NUMPY, THREADS} <= set(row["methods"])][-1]
    own = large["methods"][CLOSED]
    head = {"what": f"{CLOSED} beside {NUMPY}, {large['systems']:,} systems", "wanted": WANTED}
    head |= {"systems": large["systems"], "ratio": own["ratio_to_numpy"]}
    return {
        "headline": [head | {"ratio_to_threads": own["ratio_to_threads"]}],
        "repeats": repeats,
        "exact_points": {"family": exact, "distance": near},
        "batches": rows,
        "families": [
            {"family": name} | family(make, exact)
            for name, make in tqdm(FAMILIES.items(), desc="family")
        ],
        "coalescing": [
            {"distance": distance, "side": side}
            | family(make, near, distance >= SINGLE or distance == 0)
            for (distance, side), make in tqdm(COALESCING.items(), desc="distance")
        ],
    }


def name_of(row: dict[str, Any]) -> str:
    """A family as the page names it."""
    if "family" in row:
        return row["family"]
    if row["distance"] == 0:
        return "at coalescence"
    return f"{row['distance']:.0e} from coalescence, {row['side']}"


def worse(result: dict[str, Any], own: str, peer: str) -> str:
    """The families in which a method's worst error is above a peer's, in words."""
    found = [
        name_of(row)
        for row in result["families"] + result["coalescing"]
        if own in row["errors"] and row["errors"][own]["worst"] > row["errors"][peer]["worst"]
    ]
    return f"is above LAPACK's in: {'; '.join(found)}." if found else "is no larger in any family."


def rates(result: dict[str, Any], name: str) -> str:
    """One row of the table of rates: compile time, then rate and ratio in every batch."""
    found = [row["methods"].get(name) for row in result["batches"]]
    compile_s = max((x["compile_s"] or 0 for x in found if x), default=0)
    form = "{systems_per_second:.2g} ({ratio_to_numpy:.3g})"
    cells = [filled(form, x) if x else "-" for x in found]
    return " | ".join([name, cell(compile_s or None, ".1f"), *cells])


def error_cells(row: dict[str, Any]) -> str:
    """One row of the table of errors."""
    cells = [cell(row["errors"].get(name), ".1e") for name in WITH_ERRORS]
    cells += [str(row["wrong_signs"].get(name, "-")) for name in (CLOSED, CLOSED_32)]
    return " | ".join([name_of(row), f"{row['unstable']:.0%}", *cells])


def page(result: dict[str, Any]) -> list[str]:
    batches, exact, head = result["batches"], result["exact_points"], result["headline"][0]
    best = max((row["methods"] for row in batches), key=lambda x: x[CLOSED]["systems_per_second"])
    own, single = (best[name]["systems_per_second"] for name in (CLOSED, CLOSED_32))
    errors = [row["errors"] for row in result["families"]]
    worst = {n: max(row[n]["worst"] for row in errors) for n in (CLOSED, NUMPY, CLOSED_32)}
    ratios = {r["systems"]: r["methods"][CLOSED]["ratio_to_numpy"] for r in batches}
    slow = [f"{n:,} ({found:.3g})" for n, found in ratios.items() if found and found < WANTED]
    skipped = [
        f"{name} of {row['systems']:,}"
        for row in batches
        for name in TIMED
        if worth(name, row["systems"]) and name not in row["methods"]
    ]
    return [
        f"""Use the default, the closed form in float64 and many systems at a time: {own:.2g} a
        second, with a worst error, away from coalescence, of {worst[CLOSED]:.0e} of the largest
        modulus of an eigenvalue, where NumPy has {worst[NUMPY]:.0e}; float32 is
        {single / own:.1f} times as fast and good to {worst[CLOSED_32]:.0e}.""",
        f"""For {head["systems"]:,} systems it has {head["ratio"]:.0f} times the rate of {NUMPY}
        (wanted >= {head["wanted"]}: {verdict(head)}), and {head["ratio_to_threads"]:.0f} times that
        of the same spread by hand over a thread a core, as JAX does with the closed form.
        {f"The ratio is below {WANTED} in batches of {', '.join(slow)}." if slow else ""}
        In float64 its worst error {worse(result, CLOSED, NUMPY)}
        In float32 its worst error {worse(result, CLOSED_32, JAX_32)}""",
        "Systems a second by systems in a batch; in brackets the ratio to NumPy in that batch:",
        table(
            " | ".join(["method", "compile [s]", *(f"{row['systems']:,}" for row in batches)]),
            (rates(result, name) for name in TIMED),
        ),
        "Errors by family: median, worst:",
        table(
            f"family | unstable | {' | '.join(WITH_ERRORS)} | wrong signs | wrong signs, float32",
            map(error_cells, result["families"] + result["coalescing"]),
        ),
        f"""Times are medians of {result["repeats"]} turns over systems of the random family, the
        methods taking turns, and every ratio the median of the ratios within a turn; compile time,
        the longest of all batches, includes tracing and is in no other column. LAPACK gets its
        matrices ready made. The closed form works on at most {CHUNK} at a time, on all where it
        says so; from scenes it also linearises. A call that would take above {LIMIT:.0f} s is left
        out: {", ".join(skipped) or "none was"}.""",
        f"""Errors are beside the largest modulus of an eigenvalue, against mpmath with 40 digits,
        at {exact["family"]} systems of a family and {exact["distance"]} of a distance from
        coalescence, every other one of these damped, alike in both directions. The distance is that
        of |a - b| from 2 sqrt(g), relative to it; at 0 the systems are whole numbers, so that no
        rounding separates the eigenvalues. Near coalescence the eigenvalues move with the square
        root of a rounding, so that 1e-8, in float32 3e-4, is what any method can promise there.
        LAPACK's matrices are scaled by powers of two, which rounds nothing. In float32 the truth is
        that of the rounded systems, and no distance but 0 is shown below {SINGLE:.0e}, where
        rounding hides it. Wrong signs are those of the closed form, where the exact growth rate is
        not 0.""",
    ]


# Blue is the closed form, orange LAPACK.
STYLES = {
    CLOSED: "C0o-",
    SCENES: "C9v-",
    AT_ONCE: "C0P:",
    CLOSED_32: "C4D--",
    NUMPY: "C1s-",
    THREADS: "C3X--",
    JAX: "C8^:",
    JAX_32: "C5h--",
}
LEAST_SHOWN = 1e-19  # of errors


def picture(result: dict[str, Any]) -> bytes:
    """Systems a second over the batch; worst errors by distance from coalescence, and by family."""
    figure, (top, middle, bottom) = subplots(3, 1, figsize=(8.3, 16))
    lines = []
    for name in TIMED:
        rows = [row for row in result["batches"] if name in row["methods"]]
        rates = [row["methods"][name]["systems_per_second"] for row in rows]
        lines.append((*column(rows, "systems"), rates, STYLES[name], name))
    draw(top, lines, "systems in a batch [-]", "systems a second [1/s]")

    def worst(rows, name):
        return [max(r["errors"][name]["worst"], LEAST_SHOWN) for r in rows if name in r["errors"]]

    error, lines = "worst error / largest modulus of an eigenvalue [-]", []
    for name in (CLOSED, NUMPY, CLOSED_32, JAX_32):  # JAX in float64 is as NumPy
        for side, line in ((FLUTTER, "-"), (STABLE, "--")):
            rows = [r for r in result["coalescing"] if r["side"] == side and name in r["errors"]]
            style, label = STYLES[name][:3] + line, f"{name}, {side}"
            lines.append((*column(rows, "distance"), worst(rows, name), style, label))
    draw(middle, lines, "distance from coalescence [-]", error)
    families = result["families"]
    names = [row["family"].replace(" term", "\nterm") for row in families]
    for name in WITH_ERRORS:
        bottom.plot(worst(families, name), names, STYLES[name][:3], mec="k", ms=9, label=name)
    bottom.set(xscale="log", xlabel=error)
    bottom.grid(True, which="major", alpha=0.4)
    bottom.legend(loc="best", fontsize="small")
    return png(figure, dpi=100)
