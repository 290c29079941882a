"""The joint under a given load: error against run time, by steps of the solver and by precision.

The rows of tests/reference/contact.json, 40 digits each, that are neither fully plastic nor slip:
every one has its own surface, material, load and friction. The package solves the load balance by
a fixed number of Halley's steps; beside it a loop that asks SciPy's brentq for less and less error.
"""

import dataclasses
import json
import math
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq
from tqdm import tqdm

import fractaljax as fj
from fractaljax.mechanism import contact

from .page import cell, png, subplots, table, versions
from .timing import compiled, others_running, ran_on, seconds, this_machine

TABLE = Path(__file__).parents[1] / "tests" / "reference" / "contact.json"
INPUTS = ("D", "G", "gamma", "E", "nu", "sigma_y", "H", "P", "mu_s", "mu_m")
OUTPUTS = ("a_l", "K_n", "K_t")
STEPS = range(1, 9)
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)  # of ln a_l
DEFAULT = contact._HALLEY_STEPS


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    rows: int  # of the table
    copies: int  # of them in one call of the package
    repeats: int


FULL, QUICK = Size(379, 100, 9), Size(40, 2, 3)


def rows_of_table(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (n, 10) and a_l, K_n, K_t (n, 3) of rows spread over the table."""
    rows = json.loads(TABLE.read_text())["rows"]
    rows = [row for row in rows if row["regime"] == "elastic_plastic"]
    rows = rows[:: math.ceil(len(rows) / count)]
    inputs = [[row[name] for name in INPUTS] for row in rows]
    truth = [[math.exp(float(row["ln_a_l"])), float(row["K_n"]), float(row["K_t"])] for row in rows]
    return np.array(inputs, float), np.array(truth)


# ---------------------------------------------------------------------------------------------
# The methods
# ---------------------------------------------------------------------------------------------


def joint(inputs: jax.Array) -> jax.Array:
    """a_l [m^2], K_n and K_t [N/m] (3,) of a row of inputs (10,)."""
    D, G, gamma, E, nu, sigma_y, H, P, mu_s, mu_m = inputs
    surface, material = fj.Surface(D, G, gamma), fj.Material(E, nu, sigma_y, H)
    # Not by `contact_state`, which refuses the rows of the table in which mu_m exceeds mu_s.
    state = fj.FractalContact(surface, material, P).state(mu_s, mu_m)
    return jnp.stack([state.a_l, state.K_n, state.K_t])


def package(steps: int, inputs: np.ndarray, dtype) -> tuple[Callable[[], Any], float]:
    """A call for all rows at once by this many Halley steps, and the seconds it took to compile."""
    contact._HALLEY_STEPS = steps
    try:
        rows = jnp.asarray(inputs, dtype)
        program, compile_s = compiled(jax.vmap(joint), rows)
    finally:
        contact._HALLEY_STEPS = DEFAULT
        jax.clear_caches()
    jax.block_until_ready(program(rows))
    return lambda: program(rows), compile_s


def brentq_loop(tolerance: float, inputs: np.ndarray) -> Callable[[], np.ndarray]:
    """A loop over the rows, ln a_l by brentq to this tolerance, the rest by Eqs. 30, 33 and 36."""
    rows = inputs.tolist()

    def one(D, G, gamma, E, nu, sigma_y, H, P, mu_s, mu_m):
        k_mu = 1 - 0.228 * mu_m if mu_m <= 0.3 else 0.932 * math.exp(-1.58 * (mu_m - 0.3))
        log_a_e = 2 * math.log(33 * k_mu * sigma_y / E / 40) + (3 * D - 11) * math.log(2)
        log_a_e += (4 - D) * math.log(math.pi) - math.log(math.log(gamma))
        log_a_e = log_a_e / (2 - D) + 2 * math.log(G)
        wanted = math.log(P * (3 - D) / (H * (D - 1))) - log_a_e
        half, r = (D - 1) / 2, (5 - 2 * D) / 2
        beta = 1.1 * k_mu * sigma_y / H * (3 - D) / 2

        def power(q, t):
            return math.expm1(q * t) / q if q else t

        def excess(t):
            return half * t + math.log1p(beta * power(r, t)) - wanted

        t: Any = brentq(excess, 0.0, wanted / half, xtol=tolerance, rtol=np.float64(1e-15))

        def moment(p):
            return half * math.exp(p * log_a_e + half * t) * power(p - half, t)

        J, ratio = moment(0.5), beta * power(r, t)
        elastic_load = P * ratio / (1 + ratio)
        Q_e = 8 / (math.pi * (6 - 3 * nu)) * (sigma_y * moment(1.0) + (2 * nu - 1) * elastic_load)
        grip = math.cbrt(max(1 - Q_e / (mu_s * P), 0))
        K_n = 4 * E * (4 - D) / (3 * math.sqrt(math.pi) * (3 - D)) * J
        K_t = 4 * E / ((1 + nu) * (2 - nu) * math.sqrt(math.pi)) * grip * J
        return math.exp(log_a_e + t), K_n, K_t

    return lambda: np.array([one(*row) for row in rows])


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size = QUICK if quick else FULL
    busy = others_running()
    inputs, truth = rows_of_table(size.rows)
    many = np.tile(inputs, (size.copies, 1))
    methods, calls = [], []
    for bits, dtype in ((64, np.float64), (32, np.float32)):
        for steps in tqdm(STEPS, desc=f"compile, {bits} bits"):
            call, compile_s = package(steps, many, dtype)
            methods.append({"family": f"fractaljax, float{bits}", "setting": f"{steps} steps"})
            methods[-1] |= {"default": steps == DEFAULT, "compile_s": compile_s, "n": len(many)}
            calls.append(call)
    for tolerance in TOLERANCES:
        methods.append({"family": "SciPy brentq, loop", "setting": f"xtol {tolerance:g}"})
        methods[-1] |= {"default": False, "compile_s": None, "n": len(inputs)}
        calls.append(brentq_loop(tolerance, inputs))
    times: list[list[float]] = [[] for _ in calls]
    for _ in tqdm(range(size.repeats), desc="run"):
        for kept, call, method in zip(times, calls, methods, strict=True):
            kept.append(seconds(call)[0] / method["n"])
    for kept, call, method in zip(times, calls, methods, strict=True):
        found = np.asarray(call(), float)[: len(inputs)]
        off = np.abs(found / truth - 1)
        method["seconds"] = statistics.median(kept)
        method["not_finite"] = int((~np.isfinite(found)).any(axis=1).sum())
        off = off[np.isfinite(off).all(axis=1)]
        method["median"] = dict(zip(OUTPUTS, np.median(off, axis=0).tolist(), strict=True))
        method["worst"] = dict(zip(OUTPUTS, off.max(axis=0).tolist(), strict=True))
    return {
        "quick": quick,
        "rows": len(inputs),
        "copies": size.copies,
        "repeats": size.repeats,
        "machine": this_machine(busy),
        "versions": versions("jax", "numpy", "scipy"),
        "methods": methods,
    }


# ---------------------------------------------------------------------------------------------
# Showing
# ---------------------------------------------------------------------------------------------


def choice(result: dict[str, Any]) -> str:
    """One sentence: what to take."""
    own = next(method for method in result["methods"] if method["default"])
    peer = result["methods"][-1]
    return (
        f"Take the default, {DEFAULT} of Halley's steps in float64: K_n to"
        f" {own['median']['K_n']:.0e} (median) and {own['worst']['K_n']:.0e} (worst) in"
        f" {own['seconds'] * 1e9:.3g} ns a joint, {peer['seconds'] / own['seconds']:.0f} times as"
        f" fast as a loop over brentq that reaches {peer['worst']['K_n']:.0e} (worst)."
    )


HEADINGS = [
    "method",
    "setting",
    "compile [s]",
    "time a joint [ns]",
    *(f"{name}: median, worst" for name in OUTPUTS),
    "not finite",
]


def cells(method: dict[str, Any]) -> list[str]:
    """One row of the table."""
    return [
        method["family"],
        method["setting"] + (" (default)" if method["default"] else ""),
        cell(method["compile_s"], ".1f"),
        f"{method['seconds'] * 1e9:.3g}",
        *(f"{method['median'][name]:.1e}, {method['worst'][name]:.1e}" for name in OUTPUTS),
        str(method["not_finite"]),
    ]


def text(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, the table, how it was measured."""
    lines = [
        "# The joint under a given load: error against run time",
        "",
        choice(result),
        "",
        *table(HEADINGS, [cells(method) for method in result["methods"]]),
        "",
        f"{result['rows']} joints, each with a surface, material, load and friction of its own,"
        " against 25 digits from quadrature; errors are relative. What is left of them after the"
        " last step is the conditioning: towards D = 2 a rounding of D moves a_e by many of its"
        f" digits. Times are medians of {result['repeats']} runs, the methods taking turns; the"
        f" package is given every joint {result['copies']} times in one call, the loop once."
        " Compile time includes tracing and is in no other column. Numbers that are not finite"
        " are counted, and left out of the errors.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


def picture(result: dict[str, Any]) -> bytes:
    """Worst error of K_n over the time of a joint, a line for each family."""
    figure, ax = subplots(figsize=(8.4, 5.4))
    families = list(dict.fromkeys(method["family"] for method in result["methods"]))
    styles = zip(families, ("o-", "s--", "^:"), ("tab:blue", "tab:cyan", "tab:orange"), strict=True)
    for family, style, colour in styles:
        own = [method for method in result["methods"] if method["family"] == family]
        times = [method["seconds"] * 1e9 for method in own]
        for how, size in (("worst", 8), ("median", 4)):
            errors = [max(method[how]["K_n"], 1e-17) for method in own]
            label = f"{family}, {how}"
            ax.plot(times, errors, style, c=colour, mec="k", ms=size, label=label)
    default = next(method for method in result["methods"] if method["default"])
    ax.annotate(
        f"default, {default['setting']}",
        (default["seconds"] * 1e9, default["worst"]["K_n"]),
        xytext=(30, 30),
        textcoords="offset points",
        arrowprops={"arrowstyle": "->"},
    )
    ax.set(xscale="log", yscale="log")
    ax.set(xlabel="time a joint [ns]", ylabel="relative error of K_n [-]")
    ax.grid(True, which="major", alpha=0.4)
    ax.legend(loc="best", fontsize="small")
    return png(figure, dpi=110)
