"""Growth rate in closed form against LAPACK: systems a second, and the error where it is hardest.

Both get the same linearised systems, (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g, LAPACK as state
matrices in units of sqrt(a + b) that are made before its time is taken. Runs take turns, so that a
busy machine slows all alike, and errors of the same program are taken to 40 digits, family by
family.
"""

import dataclasses
import platform
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import mpmath
import numpy as np
from tqdm import tqdm

import fractaljax as fj
from fractaljax.mechanism.oscillator import Linearised
from fractaljax.modes.stability import growth_rate_of_linearised

from .page import png, write
from .timing import compiled, others_running, ran_on, seconds, this_machine

mp: Any = mpmath.mp  # it makes its functions at run time

WANTED = 100  # ratio of the rates to numpy.linalg.eigvals
NAME, NUMPY, JAX = "closed form", "numpy.linalg.eigvals", "jax.numpy.linalg.eigvals"
SCENES, AT_ONCE = "closed form, from scenes", "closed form, all at once"
CHUNK = 62_500  # systems at a time; what a program works on then stays in the cache

ZERO = 1e-14  # beside the largest modulus
Columns = tuple[np.ndarray, ...]  # a, b, c_1, c_2, g


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    systems: int
    exact: int  # of each family, for mpmath
    repeats: int


FULL, QUICK = Size(1_000_000, 100, 7), Size(20_000, 10, 3)


# ---------------------------------------------------------------------------------------------
# The systems
# ---------------------------------------------------------------------------------------------


def stiffnesses(rng, n):
    """a and b [1/s^2] of a brake's size, and the coupling of mu from 0.05 to 0.8."""
    K_n, kappa, mu = 10 ** rng.uniform(7, 10, n), rng.uniform(0.1, 1, n), rng.uniform(0.05, 0.8, n)
    omega_1, omega_2 = 10 ** rng.uniform(3, 4.5, (2, n))
    return omega_1**2 + kappa * K_n, omega_2**2 + K_n, mu**2 * kappa * K_n**2


def damped(rng, n, low, high):
    """Both damping ratios even in the logarithm."""
    a, b, g = stiffnesses(rng, n)
    xi = 10 ** rng.uniform(low, high, (2, n))
    return a, b, 2 * xi[0] * np.sqrt(a), 2 * xi[1] * np.sqrt(b), g


def random(rng, n) -> Columns:
    """Lightly damped brakes, stable and unstable."""
    return damped(rng, n, -4, -1)


def near_coalescence(rng, n) -> Columns:
    """|a - b| = 2 sqrt(g) (1 +- 1e-8), undamped."""
    a, _, g = stiffnesses(rng, n)
    b = a + 2 * np.sqrt(g) * (1 + 1e-8 * rng.choice([-1, 1], n))
    return a, b, 0 * a, 0 * a, g


def at_coalescence(rng, n) -> Columns:
    """|a - b| = 2 sqrt(g) in whole numbers, so that no rounding parts the eigenvalues."""
    a, h = rng.integers(1, 2**30, (2, n)).astype(float)
    h = np.floor(h / 64)
    return a, a + 2 * h, 0 * a, 0 * a, h**2


def strongly_damped(rng, n) -> Columns:
    """Damping ratios from 1 to 1000."""
    return damped(rng, n, 0, 3)


def real_roots(rng, n) -> Columns:
    """Both directions overdamped and weakly coupled: four real eigenvalues."""
    a, b, c_1, c_2, _ = damped(rng, n, 0.2, 1)
    return a, b, c_1, c_2, 1e-3 * rng.uniform(0, 1, n) * a * b


def no_leading_term(rng, n) -> Columns:
    """More mean damping than stiffness: p <= 0 in Ferrari's resolvent."""
    a, b = rng.uniform(0.1, 1, (2, n))
    c_1, c_2 = rng.uniform(2.2, 6, (2, n))
    return a, b, c_1, c_2, rng.uniform(0, 4, n)


FAMILIES: dict[str, Callable[..., Columns]] = {
    "random": random,
    "1e-8 from coalescence": near_coalescence,
    "at coalescence": at_coalescence,
    "strongly damped": strongly_damped,
    "real roots": real_roots,
    "no positive leading term of the resolvent": no_leading_term,
}


# ---------------------------------------------------------------------------------------------
# The methods
# ---------------------------------------------------------------------------------------------


def state_matrices(columns: Columns) -> tuple[np.ndarray, np.ndarray]:
    """[[0, I], [-K, -C]] (n, 4, 4) in units of omega = sqrt(a + b), and omega (n,)."""
    a, b, c_1, c_2, g = columns
    omega = np.sqrt(a + b)
    A = np.zeros((len(a), 4, 4))
    A[:, 0, 2] = A[:, 1, 3] = 1
    A[:, 2, 0], A[:, 3, 1] = -a / omega**2, -b / omega**2
    A[:, 2, 1], A[:, 3, 0] = np.sqrt(g) / omega**2, -np.sqrt(g) / omega**2
    A[:, 2, 2], A[:, 3, 3] = -c_1 / omega, -c_2 / omega
    return A, omega


def scene_rates(K_n, K_t, mu) -> jax.Array:
    """Growth rates (n,) of the reference brake with joints of given stiffness."""
    oscillator = fj.brake_scene().oscillator

    def one(K_n, K_t, mu):
        return fj.growth_rate(fj.Scene(fj.FixedContact(K_n, K_t), fj.Coulomb(mu), oscillator))

    return jax.vmap(one)(K_n, K_t, mu)


def linearised(columns: Columns) -> Linearised:
    """Systems as the package takes them."""
    return Linearised(*map(jnp.asarray, columns))


closed_form = jax.vmap(growth_rate_of_linearised)


def chunks(systems: Any) -> list[Any]:
    """A pytree of arrays (n,) as a list of them, of equal lengths."""
    leaves, structure = jax.tree.flatten(systems)
    parts = [jnp.split(leaf, max(1, leaf.size // CHUNK)) for leaf in leaves]
    return [jax.tree.unflatten(structure, part) for part in zip(*parts, strict=True)]


def timed(function: Callable, *parts) -> tuple[Callable, float]:
    """The program of a function, called for each of its arguments, and the seconds it took."""
    program, elapsed = compiled(function, parts[0])
    jax.block_until_ready(program(parts[0]))
    return lambda: [program(part) for part in parts], elapsed


# ---------------------------------------------------------------------------------------------
# The errors
# ---------------------------------------------------------------------------------------------


def exact_growth(a, b, c_1, c_2, g) -> tuple[Any, float]:
    """Largest real part with 40 digits, and the largest modulus."""
    # A coalescing eigenvalue has half the digits of the arithmetic.
    with mp.workdps(90):
        a, b, c_1, c_2, g = map(mp.mpf, (a, b, c_1, c_2, g))
        A = mp.zeros(4)
        A[0, 2] = A[1, 3] = 1
        A[2, 0], A[3, 1], A[2, 1], A[3, 0] = -a, -b, mp.sqrt(g), -mp.sqrt(g)
        A[2, 2], A[3, 3] = -c_1, -c_2
        s = mp.eig(A, left=False, right=False)
        return max(mp.re(z) for z in s), float(max(abs(z) for z in s))


def errors_of(family: str, count: int) -> dict[str, Any]:
    """Worst and median errors of a family, beside the largest modulus of an eigenvalue."""
    columns = FAMILIES[family](np.random.default_rng(1), count)
    matrices, omega = state_matrices(columns)
    found = {
        NAME: np.asarray(jax.jit(closed_form)(linearised(columns))),
        NUMPY: np.linalg.eigvals(matrices).real.max(axis=1) * omega,
    }
    rows = zip(*(x.tolist() for x in columns), strict=True)
    truth = [exact_growth(*row) for row in tqdm(rows, desc=family, total=count)]
    errors = {}
    for method, values in found.items():
        off = [
            float(abs(mp.mpf(value) - exact)) / size
            for value, (exact, size) in zip(values.tolist(), truth, strict=True)
        ]
        errors[method] = {"median": statistics.median(off), "worst": max(off)}
    # Where the exact one is 0, as without damping or coupling, there is no sign to get wrong.
    signs = [
        (v, float(x))
        for v, (x, size) in zip(found[NAME].tolist(), truth, strict=True)
        if abs(x) > ZERO * size
    ]
    return {
        "family": family,
        "errors": errors,
        "unstable": sum(x > 0 for _, x in signs) / count,
        "wrong_signs": sum(v * x <= 0 for v, x in signs),
    }


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size = QUICK if quick else FULL
    busy = others_running()
    rng = np.random.default_rng(0)
    columns = random(rng, size.systems)
    matrices, _ = state_matrices(columns)
    K_n = jnp.asarray(10 ** rng.uniform(7, 10, size.systems))
    K_t = K_n * rng.uniform(0.1, 1, size.systems)
    mu = jnp.asarray(rng.uniform(0.05, 0.8, size.systems))
    programs = {
        NAME: timed(closed_form, *chunks(linearised(columns))),
        SCENES: timed(lambda x: scene_rates(*x), *chunks((K_n, K_t, mu))),
        AT_ONCE: timed(closed_form, linearised(columns)),
        JAX: timed(lambda A: jnp.linalg.eigvals(A).real.max(axis=1), jnp.asarray(matrices)),
    }
    calls: dict[str, Callable] = {NUMPY: lambda: np.linalg.eigvals(matrices).real.max(axis=1)}
    calls |= {name: call for name, (call, _) in programs.items()}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in tqdm(range(size.repeats), desc="run"):
        for name, call in calls.items():
            times[name].append(seconds(call)[0] / size.systems)
    methods = [
        {
            "name": name,
            "compile_s": programs[name][1] if name in programs else None,
            "seconds_per_system": statistics.median(times[name]),
            "seconds_per_system_fastest": min(times[name]),
            "seconds_per_system_slowest": max(times[name]),
            "systems_per_second": 1 / statistics.median(times[name]),
            "ratio_to_numpy": statistics.median(
                a / b for a, b in zip(times[NUMPY], times[name], strict=True)
            ),
        }
        for name in calls
    ]
    headline = next(method for method in methods if method["name"] == NAME)
    return {
        "headline": {"ratio": headline["ratio_to_numpy"], "wanted": WANTED},
        "quick": quick,
        "systems": size.systems,
        "repeats": size.repeats,
        "exact_points": size.exact,
        "machine": this_machine(busy),
        "versions": {
            "python": platform.python_version(),
            "jax": jax.__version__,
            "numpy": np.__version__,
            "mpmath": mpmath.__version__,
        },
        "methods": methods,
        "families": [errors_of(family, size.exact) for family in FAMILIES],
    }


# ---------------------------------------------------------------------------------------------
# Showing
# ---------------------------------------------------------------------------------------------


def table(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, two tables, how it was measured."""
    head = result["headline"]
    met = "holds" if head["ratio"] >= head["wanted"] else "is missed"
    worse = [
        row["family"]
        for row in result["families"]
        if row["errors"][NAME]["worst"] > row["errors"][NUMPY]["worst"]
    ]
    lines = [
        "# Growth rate of two directions in closed form",
        "",
        f"The growth rate of {result['systems']} systems comes at {head['ratio']:.0f} times the"
        f" rate of numpy.linalg.eigvals (wanted >= {head['wanted']}: {met}), and its worst error is"
        + (f" larger in: {', '.join(worse)}." if worse else " no larger in any family."),
        "",
        "| method | compile [s] | time a system [ns] | systems a second | ratio to NumPy |",
        "|---|---|---|---|---|",
    ]
    for method in result["methods"]:
        compile_s = method["compile_s"]
        cells = [
            method["name"],
            "-" if compile_s is None else f"{compile_s:.1f}",
            f"{method['seconds_per_system'] * 1e9:.3g}",
            f"{method['systems_per_second']:.3g}",
            f"{method['ratio_to_numpy']:.3g}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "| family | unstable | closed form: median, worst | NumPy: median, worst | wrong signs |",
        "|---|---|---|---|---|",
    ]
    for row in result["families"]:
        errors = [
            ", ".join(f"{row['errors'][method][how]:.1e}" for how in ("median", "worst"))
            for method in (NAME, NUMPY)
        ]
        cells = [row["family"], f"{row['unstable']:.0%}", *errors, str(row["wrong_signs"])]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        f"Times are medians of {result['repeats']} runs over {result['systems']} systems of the"
        " random family, the methods taking turns, and every ratio the median of the ratios within"
        " a turn; compile time includes tracing and is in no other column. LAPACK gets its matrices"
        " ready made, in double precision like all else. The closed form works on at most"
        f" {CHUNK} at a time, on all where it says so; from scenes it also linearises."
        " Errors are beside the largest modulus of an eigenvalue, against mpmath at"
        f" {result['exact_points']} systems of each family. A wrong sign is one of the closed"
        " form's growth rates, where the exact one is not 0.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


def picture(result: dict[str, Any]) -> bytes:
    """Systems a second at the left, worst error of each family at the right."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
    names = [method["name"] for method in result["methods"]]
    rates = [method["systems_per_second"] for method in result["methods"]]
    colours = ["tab:blue" if name in (NAME, SCENES, AT_ONCE) else "tab:orange" for name in names]
    bars = left.barh(names, rates, color=colours, edgecolor="k")
    left.bar_label(bars, [f" {rate:.2g}" for rate in rates])
    left.set(xscale="log", xlabel="systems a second [1/s]")
    left.margins(x=0.35)
    families = [row["family"] for row in result["families"]]
    for method, marker, colour in ((NAME, "o", "tab:blue"), (NUMPY, "s", "tab:orange")):
        worst = [max(row["errors"][method]["worst"], 1e-18) for row in result["families"]]
        right.semilogx(worst, families, marker, color=colour, mec="k", ms=9, label=method)
    right.grid(True, which="major", alpha=0.4)
    right.set_xlabel("worst error / largest modulus of an eigenvalue [-]")
    right.legend(loc="best")
    for axis in (left, right):
        axis.invert_yaxis()
    return png(figure, dpi=110)


def run(out: Path, quick: bool = False) -> list[Path]:
    """Measure, and write eigenvalues.json, .md and .png into a folder; returns their paths."""
    result = measure(quick)
    return write(out, "eigenvalues", result, table(result), picture(result))
