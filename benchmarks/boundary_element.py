"""Boundary elements beside Tamaas and ContactMechanics: error against run time; what else costs.

Three surfaces of the same joint are pressed: the reference brake's, a smoother and a rougher one.
The package gives pressure, gap and stiffness at once, the others pressure and gap alone.
"""

import functools
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import fractaljax as fj

from .half_spaces import PEERS, installed, residual, tamaas
from .page import columns, draw, in_words, png, subplots, table, verdict
from .timing import compiled, ratio, seconds, taking_turns

TITLE = "Boundary elements: error against run time"
PACKAGES = ("jaxlib", "numpy", "tamaas", "ContactMechanics")
FULL = {"n": 512, "repeats": 3, "waves": 128, "tolerances": 5, "loads": 9}
QUICK = {"n": 64, "repeats": 1, "waves": 16, "tolerances": 4, "loads": 2}
OWN, SIDE = "fractaljax", 1e-2  # m
# D and load [N] of surfaces of the height of the reference one.
CASES = ((2.4, 1907.3), (2.1, 1e4), (2.8, 1e4))
RTOLS, DEFAULT = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11), 1e-9
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)  # of the peers
EXACT, STEP = 1e-12, 1e-5  # tolerance of the truth; of the load, for its stiffness
# How fast beside each peer, at the same residual or a smaller one; the gradient over the value; s.
WANTED, MOST_GRADIENT, MOST_COMPARE = {"Tamaas": 1 / 1.5, "ContactMechanics": 1.0}, 3.0, 5.0
Result = dict[str, Any]


def case(D: float, P: float, n: int, waves: int) -> dict[str, Any]:
    """Heights (n, n) of a surface of Eq. 13, and what presses it."""
    contact: Any = fj.brake_scene().contact
    L_s = SIDE / waves
    Sq = fj.roughness(contact.surface, SIDE, L_s).Sq
    G = contact.surface.G
    unit = fj.roughness(fj.Surface(D, G), SIDE, L_s).Sq
    surface = fj.Surface(D, G * (Sq / unit) ** (1 / (D - 2)))
    key = jax.random.key(0)
    heights = fj.topography(surface, SIDE, n, key=key, L_s=L_s, periodic=True)
    return {
        "heights": np.array(heights),
        "dx": SIDE / n,
        "material": contact.material,
        "P": P,
        "surface": surface,
    }


def peer_arguments(
    given: dict[str, Any], step: float = 0.0
) -> tuple[np.ndarray, float, float, float]:
    """Heights, dx, E and the mean pressure, as half_spaces takes them."""
    area = given["heights"].size * given["dx"] ** 2
    mean = given["P"] * (1 + step) / area
    return given["heights"], given["dx"], float(given["material"].E), mean


def truth(given: dict[str, Any]) -> tuple[np.ndarray, float, float]:
    """Pressure [Pa], mean gap [m] and K_n [N/m] by Tamaas at its tightest, K_n by differences."""

    def found(step):
        pressure, gap = tamaas(*peer_arguments(given, step), EXACT)
        return pressure, float(gap.mean() - gap[pressure > 0].mean())

    (pressure, mean_gap), (_, more), (_, less) = (found(step) for step in (0, STEP, -STEP))
    return pressure, mean_gap, 2 * STEP * given["P"] / (less - more)


def own_call(given: dict[str, Any], rtol: float) -> tuple[Callable, float]:
    """A call that gives pressure, mean gap and K_n, and the seconds to compile it."""
    dx, material = given["dx"], given["material"]

    def press(heights, P):
        found = fj.boundary_element(heights, dx, material, P, rtol=rtol, throw=False)
        return found.pressure, found.mean_gap, found.K_n

    arguments = jnp.asarray(given["heights"]), jnp.asarray(given["P"])
    program, compile_s = compiled(press, *arguments)
    return lambda: program(*arguments), compile_s


def errors(found: tuple, exact: tuple | None, given: dict[str, Any]) -> Result:
    """Residual of a solution, and what it is off in pressure, mean gap and stiffness."""
    pressure, mean_gap, K_n = found
    row: Result = {"residual": residual(np.asarray(pressure), *peer_arguments(given)[:3])}
    if exact is not None:
        row["pressure"] = float(np.abs(pressure - exact[0]).max() / exact[0].max())
        row["mean_gap"] = abs(float(mean_gap) / exact[1] - 1)
        row["K_n"] = None if K_n is None else abs(float(K_n) / exact[2] - 1)
    return row


def beside(rows: list[Result], times: list[list[float]]) -> None:
    """How many times as fast as each row of a peer we are, with no larger a residual."""
    own = [i for i, row in enumerate(rows) if row["family"] == OWN]
    for i, row in enumerate(rows):
        no_worse = [k for k in own if rows[k]["residual"] <= row["residual"]]
        quickest = min(no_worse, key=lambda k: rows[k]["seconds"], default=None)
        if row["family"] != OWN and quickest is not None:
            row["beside"] = rows[quickest]["setting"]
            row["ratio"] = ratio(times[i], times[quickest])


def one_surface(D: float, P: float, n: int, waves: int, repeats: int, tolerances: int) -> Result:
    """Rows of all methods on one surface."""
    given, peers = case(D, P, n, waves), installed()
    exact = truth(given) if "Tamaas" in peers else None
    rows, calls = [], {}
    for rtol in RTOLS[:tolerances]:
        call, compile_s = own_call(given, rtol)
        found = {"family": OWN, "setting": f"rtol {rtol:.0e}", "default": rtol == DEFAULT}
        rows.append(found | {"compile_s": compile_s} | errors(call(), exact, given))
        calls[found["setting"]] = call
    for name, solve in peers.items():
        for tolerance in TOLERANCES[:tolerances]:
            call = functools.partial(solve, *peer_arguments(given), tolerance)
            pressure, gap = call()
            solution = pressure, gap.mean() - gap[pressure > 0].mean(), None
            setting = f"tolerance {tolerance:.0e}"
            rows.append({"family": name, "setting": setting} | errors(solution, exact, given))
            calls[f"{name}, {setting}"] = call
    turns = list(taking_turns(calls, repeats).values())
    for row, own in zip(rows, turns, strict=True):
        row["seconds"] = statistics.median(own)
    beside(rows, turns)
    touching = float((np.asarray(calls[rows[0]["setting"]]()[0]) > 0).mean())
    return {"D": D, "G": float(given["surface"].G), "P": P, "touching": touching, "methods": rows}


def gradients(n: int, waves: int, repeats: int) -> Result:
    """Seconds of K_n, and of K_n and its gradient by all heights, on the first surface."""
    given = case(*CASES[0], n, waves)
    heights, made = jnp.asarray(given["heights"]), {}

    def K_n(heights):
        return fj.boundary_element(
            heights, given["dx"], given["material"], given["P"], throw=False
        ).K_n

    for name, function in {"value": K_n, "gradient": jax.value_and_grad(K_n)}.items():
        made[name] = compiled(function, heights)
    calls = {name: functools.partial(program, heights) for name, (program, _) in made.items()}
    turns = taking_turns(calls, repeats)
    return {
        "ratio": ratio(turns["gradient"], turns["value"]),
        "seconds": {name: statistics.median(own) for name, own in turns.items()},
        "compile_s": {name: compile_s for name, (_, compile_s) in made.items()},
    }


def comparison(repeats: int, loads: int) -> Result:
    """Seconds of `compare_laws` on the reference surface, the first time and after."""
    contact: Any = fj.brake_scene().contact
    call = functools.partial(
        fj.compare_laws,
        contact.surface,
        contact.material,
        np.geomspace(contact.P / 10, contact.P * 10, loads),
        area=SIDE**2,
        progress=False,
    )
    jax.clear_caches()
    cold = seconds(call)[0]
    return {"cold": cold, "warm": statistics.median(seconds(call)[0] for _ in range(repeats))}


def measure(n: int, repeats: int, waves: int, tolerances: int, loads: int) -> Result:
    """Methods on every surface, the gradient, and a comparison of laws."""
    surfaces = [
        one_surface(D, P, n, waves, repeats, tolerances) for D, P in tqdm(CASES, desc="surface")
    ]
    cost, laws = gradients(n, waves, repeats), comparison(repeats, loads)
    heads: list[Result] = []
    for name, wanted in WANTED.items():
        rows = [row for each in surfaces for row in each["methods"] if row["family"] == name]
        if found := [row["ratio"] for row in rows if "ratio" in row]:
            what = f"value and stiffness of {n} x {n} points beside {name}'s value, at its residual"
            heads.append({"what": what, "ratio": min(found), "wanted": wanted})
    what = "value and gradient of K_n by all heights, in units of the value"
    heads.append({"what": what, "value": cost["ratio"], "wanted": [0, MOST_GRADIENT]})
    what = f"compare_laws at {loads} loads, warm [s]"
    heads.append({"what": what, "value": laws["warm"], "wanted": [0, MOST_COMPARE]})
    return {
        "headline": heads,
        "n": n,
        "repeats": repeats,
        "waves": waves,
        "loads": loads,
        "not_installed": [name for name in PEERS if name not in installed()],
        "surfaces": surfaces,
        "gradient": cost,
        "compare_laws": laws,
    }


def shown(row: Result) -> Result:
    """What a table needs of a row; the truth has no errors."""
    row = {"compile_s": None, "ratio": None, "beside": "-"} | row
    row["mark"] = " (default)" if row.get("default") else ""
    if (row["family"], row["setting"]) == ("Tamaas", f"tolerance {EXACT:.0e}"):
        row |= {"mark": " (the truth)", "pressure": None, "mean_gap": None}
    return row


def page(result: Result) -> list[str]:
    surfaces, n, missing = result["surfaces"], result["n"], ", ".join(result["not_installed"])
    own = [row for surface in surfaces for row in surface["methods"] if row.get("default")]
    heads = [f"{in_words(head).split(' | ')[1]}" for head in result["headline"]]
    slowest, worst = max(row["seconds"] for row in own), max(row["residual"] for row in own)
    pressure, stiff = (max(row[name] for row in own) for name in ("pressure", "K_n"))
    peers = [
        f"at least {head['ratio']:.1f} times as fast as {name} ({verdict(head)})"
        for name, head in zip(WANTED, result["headline"], strict=False)
        if "ratio" in head
    ]
    blocks = [
        f"""Use the default, rtol {DEFAULT:.0e}: pressure, gap and stiffness of {n} x {n} points in
        {slowest:.2g} s at most, with a residual of {worst:.0e}, off by {pressure:.0e} of the
        largest pressure and {stiff:.0e} of K_n; {", ".join(peers)}, which give no stiffness, at
        their residual or a smaller one.""",
        f"""A gradient of K_n by all heights takes {heads[-2]} times the value
        ({result["gradient"]["seconds"]["gradient"]:.2g} s), and `compare_laws` of
        {result["loads"]} loads, 4 surfaces of 128 x 128 points each, {heads[-1]} s after
        {result["compare_laws"]["cold"]:.1f} s the first time.""",
    ]
    for surface in surfaces:
        blocks += [
            f"""D = {surface["D"]}, G = {surface["G"]:.3g} m, P = {surface["P"]:.6g} N:
            {surface["touching"]:.1%} of the area touches.""",
            table(
                "method | setting | compile [s] | time [s] | residual | pressure | mean gap | K_n"
                " | we are so many times as fast | with",
                map(shown, surface["methods"]),
                "{family} | {setting}{mark} | {compile_s:.1f} | {seconds:.3g} | {residual:.1e}"
                " | {pressure:.1e} | {mean_gap:.1e} | {K_n:.1e} | {ratio:.1f} | {beside}",
            ),
        ]
    return [
        *blocks,
        f"""Periodic surfaces of Eq. 13 as high as the reference brake's, over
        ({SIDE * 1e3:.0f} mm)^2, with wavelengths from the side to 1/{result["waves"]} of it. The
        residual is the largest gap in contact or overlap outside it over the rms height, by NumPy's
        transform of each pressure. The truth is Tamaas at a tolerance of {EXACT:.0e}, whose K_n is
        a difference between loads {STEP:.0e} apart; errors are relative, of the pressure to the
        largest. K_n of the package is that of the outline found. Where a point joins the contact
        between the two loads of the truth, the difference is off by about 1e-5. Times are medians
        of {result["repeats"]} turns, the methods taking turns, and ratios medians of those within a
        turn; compile time includes tracing and is in no other column. A ratio is to our quickest
        setting whose residual is no
        larger. {f"Not installed: {missing}." if missing else ""}""",
    ]


def picture(result: Result) -> bytes:
    """Residual over the time of a solution, a panel for each surface."""
    surfaces = result["surfaces"]
    figure, panels = subplots(
        len(surfaces), 1, figsize=(8.3, 4.4 * len(surfaces)), sharex=True, sharey=True
    )
    for ax, surface in zip(panels, surfaces, strict=True):
        lines = []
        for name, style in {OWN: "C0o-", "Tamaas": "C1s-", "ContactMechanics": "C2^-"}.items():
            rows = [row for row in surface["methods"] if row["family"] == name]
            label = f"{name}, with K_n" if name == OWN else name
            lines.append((*columns(rows, "seconds", "residual"), style, label))
        title = f"D = {surface['D']}, {surface['touching']:.1%} in contact"
        draw(ax, lines, "time [s]", "residual over the rms height [-]", title)
        ax.xaxis.set_minor_formatter("")
    times = [row["seconds"] for surface in surfaces for row in surface["methods"]]
    # Whole decades have labels.
    panels[0].set_xlim(10 ** np.floor(np.log10(min(times))), 10 ** np.ceil(np.log10(max(times))))
    return png(figure)
