"""The joint under a given load: error against run time, by steps of the solver and by precision.

Every row of tests/reference/contact.json that is neither fully plastic nor in gross slip has its
own surface, material, load and friction, and 40 digits. The package solves the load balance by a
fixed number of Halley steps; the peer is a loop over SciPy's brentq at several tolerances.
"""

import functools
import inspect
import json
import math
import statistics
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import fractaljax as fj
from fractaljax._contact import fractal
from fractaljax._contact.load_balance import log_area_ratio

from .loops import scalar_joint
from .page import draw, png, subplots, table
from .timing import compiled, seconds

TITLE = "The joint under a given load: error against run time"
PACKAGES = ("numpy", "scipy")
FULL = {"count": 379, "copies": 100, "repeats": 9}
QUICK = {"count": 40, "copies": 2, "repeats": 3}
TABLE = Path(__file__).parents[1] / "tests" / "reference" / "contact.json"
INPUTS = ("D", "G", "gamma", "E", "nu", "sigma_y", "H", "P", "mu_s", "mu_m")
OUTPUTS = ("a_l", "K_n", "K_t")
STEPS = range(1, 9)
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)  # of ln a_l
DEFAULT = inspect.signature(log_area_ratio).parameters["steps"].default


def joint(inputs: jax.Array) -> jax.Array:
    """a_l [m^2], K_n and K_t [N/m] (3,) of a row of inputs (10,)."""
    D, G, gamma, E, nu, sigma_y, H, P, mu_s, mu_m = inputs
    surface, material = fj.Surface(D, G, gamma), fj.Material(E, nu, sigma_y, H)
    # Not by `contact_state`, which refuses the rows of the table in which mu_m exceeds mu_s.
    state = fj.FractalContact(surface, material, P).state(mu_s, mu_m)
    return jnp.stack([state.a_l, state.K_n, state.K_t])


def package(steps: int, rows: jax.Array) -> tuple[Any, float]:
    """A call for all rows at once by this many Halley steps, and the seconds to compile it."""
    fractal.log_area_ratio = functools.partial(log_area_ratio, steps=steps)
    try:
        program, compile_s = compiled(jax.vmap(joint), rows)
    finally:
        fractal.log_area_ratio = log_area_ratio
        jax.clear_caches()
    jax.block_until_ready(program(rows))
    return lambda: program(rows), compile_s


def loop(xtol: float, inputs: np.ndarray) -> Any:
    """A loop over the rows by brentq."""
    rows = [dict(zip(INPUTS, row, strict=True)) for row in inputs.tolist()]

    def one(row):
        log_a_l, K_n, K_t, *_ = scalar_joint(row, xtol)(row["D"], row["G"])
        return math.exp(log_a_l), K_n, K_t

    return lambda: np.array([one(row) for row in rows])


def measure(count: int, copies: int, repeats: int) -> dict[str, Any]:
    """Errors and times of every method at `count` rows; of the package at so many copies."""
    rows = json.loads(TABLE.read_text())["rows"]
    rows = [row for row in rows if row["regime"] == "elastic_plastic"]
    rows = rows[:: math.ceil(len(rows) / count)]
    truth = [[math.exp(float(r["ln_a_l"])), float(r["K_n"]), float(r["K_t"])] for r in rows]
    inputs = np.array([[row[name] for name in INPUTS] for row in rows], float)
    methods: list[dict[str, Any]] = []
    calls = []
    for bits in (64, 32):
        many = jnp.asarray(np.tile(inputs, (copies, 1)), f"float{bits}")
        for steps in tqdm(STEPS, desc=f"compile, {bits} bits"):
            call, compile_s = package(steps, many)
            method = {"family": f"fractaljax, float{bits}", "setting": f"{steps} steps"}
            method |= {"default": steps == DEFAULT, "compile_s": compile_s, "n": len(many)}
            methods.append(method)
            calls.append(call)
    for xtol in TOLERANCES:
        method = {"family": "SciPy brentq, loop", "setting": f"xtol {xtol:g}"}
        methods.append(method | {"default": False, "compile_s": None, "n": len(inputs)})
        calls.append(loop(xtol, inputs))
    times = [[seconds(call)[0] for call in calls] for _ in tqdm(range(repeats), desc="run")]
    for method, call, taken in zip(methods, calls, zip(*times, strict=True), strict=True):
        found = np.asarray(call(), float)[: len(inputs)]
        finite = np.isfinite(found).all(axis=1)
        off = np.abs(found / truth - 1)[finite]
        method["seconds"] = statistics.median(taken) / method["n"]
        method["not_finite"] = int((~finite).sum())
        method["median"] = dict(zip(OUTPUTS, np.median(off, axis=0).tolist(), strict=True))
        method["worst"] = dict(zip(OUTPUTS, off.max(axis=0).tolist(), strict=True))
    return {"rows": len(inputs), "copies": copies, "repeats": repeats, "methods": methods}


def page(result: dict[str, Any]) -> list[str]:
    own = next(method for method in result["methods"] if method["default"])
    peer = result["methods"][-1]
    errors = " | ".join(f"{{median.{x}:.1e}}, {{worst.{x}:.1e}}" for x in OUTPUTS)
    return [
        f"""Use the default, {own["setting"].split()[0]} Halley steps in float64: K_n to
        {own["median"]["K_n"]:.0e} (median) and {own["worst"]["K_n"]:.0e} (worst) in
        {own["seconds"] * 1e9:.3g} ns a joint,
        {peer["seconds"] / own["seconds"]:.0f} times as fast as a loop over brentq that reaches
        {peer["worst"]["K_n"]:.0e} (worst).""",
        table(
            "method | setting | compile [s] | time a joint [ns] | a_l: median, worst"
            " | K_n: median, worst | K_t: median, worst | not finite",
            (m | {"mark": " (default)" if m["default"] else ""} for m in result["methods"]),
            "{family} | {setting}{mark} | {compile_s:.1f} | {seconds!n:.3g}"
            f" | {errors} | {{not_finite}}",
        ),
        f"""{result["rows"]} joints, each with its own surface, material, load and friction, against
        25 digits from quadrature; errors are relative. The error left after the last step is the
        conditioning of the problem: towards D = 2 a rounding of D changes many digits of a_e. Times
        are medians of {result["repeats"]} runs, the methods taking turns; the package gets every
        joint {result["copies"]} times in one call, the loop once. Compile time includes tracing and
        is in no other column. Numbers that are not finite are counted and left out of the
        errors.""",
    ]


def picture(result: dict[str, Any]) -> bytes:
    """Error of K_n over the time of a joint, a line for each family."""
    figure, ax = subplots(figsize=(8.4, 5.4))
    families, lines = dict.fromkeys(method["family"] for method in result["methods"]), []
    for family, colour in zip(families, ("C0", "C9", "C1"), strict=True):
        own = [method for method in result["methods"] if method["family"] == family]
        times = [method["seconds"] * 1e9 for method in own]
        for how, style in (("worst", "o-"), ("median", ".--")):
            errors = [max(method[how]["K_n"], 1e-17) for method in own]
            lines.append((times, errors, colour + style, f"{family}, {how}"))
    default = next(method for method in result["methods"] if method["default"])
    place, label = (default["seconds"] * 1e9, default["worst"]["K_n"]), default["setting"]
    lines.append((*place, "k*", f"default, {label}"))
    draw(ax, lines, "time a joint [ns]", "relative error of K_n [-]")
    return png(figure)
