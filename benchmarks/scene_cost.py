"""What a scene costs, from a growth rate at given stiffness to stick-slip gradients in an envelope.

Every row is a question about a scene, measured in a Python of its own, and has one part more than
another row: a contact law, a slope of friction, a gradient, an envelope, motion. What a scene does
not need must not be there, so the row without it is the cheaper one in every count.
"""

import collections
import functools
import statistics
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj

from .page import columns, png, subplots, table
from .timing import ended, seconds, started

TITLE = "What a scene costs"
PACKAGES = ()
HEAVY = ("diffrax", "optimistix", "optax", "matplotlib", "scipy", "tqdm")
COUNTS = {"operations": "operations", "flops": "FLOPs", "bytes_accessed": "bytes moved"}


def fixed(friction: Any) -> fj.Scene:
    """The source's section 3.3: K_n and K_t given."""
    return fj.Scene(fj.FixedContact(4e8, 2e8), friction, fj.brake_scene().oscillator)


def coulomb() -> fj.Scene:
    return fixed(fj.Coulomb(0.4))


def stribeck() -> fj.Scene:
    return fixed(fj.Stribeck(0.4, 0.25, 0.5))


def normal() -> fj.Scene:
    """The reference brake with a ratio K_t/K_n in place of its tangential law."""
    scene = fj.brake_scene()
    contact = fj.FractalContact(scene.contact.surface, scene.contact.material, 1907.3, 0.5)
    return scene.replace(contact=contact)


def amplitude(scene: fj.Scene, **options: Any) -> jax.Array:
    """Peak to peak of x_1 [m] on the limit cycle."""
    return fj.limit_cycle(scene, throw=False, **options).amplitude[0]


def by_surface(measure: Callable) -> Callable:
    """A measure with its derivatives by D and G, in forward mode."""

    def value_and_slopes(scene):
        def value(D, G):
            found = measure(scene.replace(D=D, G=G))
            return found, found

        surface = scene.contact.surface
        return jax.jacfwd(value, argnums=(0, 1), has_aux=True)(surface.D, surface.G)

    return value_and_slopes


def worst(measure: Callable) -> Callable:
    """The largest value of a measure at nine conditions of load and friction."""
    loads, frictions = np.meshgrid([0.9, 1.0, 1.1], [0.36, 0.4, 0.44])

    def over(scene):
        def at(load, mu_s):
            return measure(scene.replace(P=load * scene.contact.P, mu_s=mu_s))

        return jnp.max(jax.vmap(at)(loads.ravel(), frictions.ravel()))

    return over


class Row(NamedTuple):
    """A question: its name, the place of the row with one part less, the function, its scene."""

    name: str
    without: int | None
    function: Callable
    scene: Callable[[], fj.Scene]


growth, brake = fj.growth_rate, fj.brake_scene
regularised = functools.partial(amplitude, regularisation=0.003)  # eps [m/s]
ROWS = (
    Row("growth rate, stiffness given, Coulomb", None, growth, coulomb),
    Row("growth rate, stiffness given, Stribeck", 0, growth, stribeck),
    Row("growth rate, normal contact law", 1, growth, normal),
    Row("growth rate, both contact laws", 2, growth, brake),
    Row("all eigenvalues, both contact laws", 3, fj.stability, brake),
    Row("growth rate with gradient by D, G", 3, by_surface(growth), brake),
    Row("worst growth rate of 9 conditions, with gradient", 5, by_surface(worst(growth)), brake),
    Row("amplitude, stiffness given", 1, amplitude, stribeck),
    Row("amplitude, stiffness given, regularised law", 1, regularised, stribeck),
    Row("amplitude, normal contact law", 7, amplitude, normal),
    Row("amplitude with gradient by D, G", 9, by_surface(amplitude), normal),
    Row("worst amplitude of 9 conditions, with gradient", 10, by_surface(worst(amplitude)), normal),
)
FULL, QUICK = {"repeats": 51, "rows": ROWS}, {"repeats": 5, "rows": ROWS[:4]}


def operations(jaxpr) -> collections.Counter:
    """How often each primitive stands in a jaxpr, those it calls included; loops count once."""
    found = collections.Counter()
    for equation in jaxpr.eqns:
        values = [x for v in equation.params.values() for x in (v if isinstance(v, tuple) else [v])]
        inner = [getattr(x, "jaxpr", x) for x in values if hasattr(getattr(x, "jaxpr", x), "eqns")]
        found[equation.primitive.name] += not inner
        for sub in inner:
            found += operations(sub)
    return +found


def traced(row: Row):
    """The program of a row, traced and not yet compiled, and the scene it is for."""
    scene = row.scene()
    return jax.jit(row.function).trace(scene), scene


def in_this_process(place: int, repeats: int) -> dict[str, Any]:
    """Every number of a row."""
    row = ROWS[place]
    trace_s, (program, scene) = seconds(traced, row)
    compile_s, compiled = seconds(lambda: program.lower().compile())
    found: Any = compiled.cost_analysis() or {}
    found = found[0] if isinstance(found, list) else found  # so it was in older versions
    return {
        "name": row.name,
        "without": None if row.without is None else ROWS[row.without].name,
        "operations": operations(program.jaxpr.jaxpr).total(),
        "flops": found.get("flops"),
        "bytes_accessed": found.get("bytes accessed"),
        "trace_s": trace_s,
        "compile_s": trace_s + compile_s,
        "run_s": statistics.median(seconds(compiled, scene)[0] for _ in range(repeats)),
        "heavy_modules": [name for name in HEAVY if name in sys.modules],
    }


def measure(repeats: int, rows: tuple[Row, ...]) -> dict[str, Any]:
    """Each row in a Python that has done nothing else, and imported nothing that is not needed."""
    from tqdm import tqdm  # here, since every row lists its imports

    places = tqdm([ROWS.index(row) for row in rows], desc="scene")
    found = [ended(started(__name__, {}, place=i, repeats=repeats)) for i in places]
    return {"repeats": repeats, "rows": found}


def page(result: dict[str, Any]) -> list[str]:
    rows = {row["name"]: row for row in result["rows"]}
    dearer = [
        f"{name} ({words})"
        for name, row in rows.items()
        for key, words in COUNTS.items()
        if row["without"] and not rows[row["without"]][key] < row[key]
    ]
    return [
        f"""Every scene costs more than the one that has a part less, in operations, FLOPs and
        bytes{f", except: {', '.join(dearer)}" if dearer else ""}.""",
        table(
            "question | operations | FLOPs | bytes moved | trace [s] | compile [s] | run [us]"
            " | libraries loaded",
            (r | {"heavy": ", ".join(r["heavy_modules"]) or None} for r in rows.values()),
            "{name} | {operations} | {flops:.3g} | {bytes_accessed:.3g} | {trace_s:.2f}"
            " | {compile_s:.2f} | {run_s!u:.3g} | {heavy}",
        ),
        f"""Each row is measured in a Python process of its own, in double precision. Operations are
        those of the traced program before any compiler has seen them. FLOPs and bytes are the
        compiler's own estimate, which counts the body of a loop once, so that for limit cycles it
        leaves out most of the search; bytes depend on what it fuses. Run time is the median of
        {result["repeats"]} calls for one scene, including that of the call itself (about 10 us).
        Libraries are those among {", ".join(HEAVY)} that have been imported by then.""",
    ]


def picture(result: dict[str, Any]) -> bytes:
    """Operations at the left, times at the right, a bar for each row."""
    names, counts, compile_s, run_s = columns(
        result["rows"], "name", "operations", "compile_s", "run_s"
    )
    places = range(len(names))
    figure, (left, right) = subplots(1, 2, figsize=(14, 0.45 * len(names) + 1.6), sharey=True)
    left.barh(places, counts, color="tab:blue", edgecolor="k")
    left.set(xscale="log", xlabel="operations of the traced program [-]", yticks=places)
    left.set_yticklabels(names)
    left.invert_yaxis()
    right.plot(compile_s, places, "s", c="tab:orange", mec="k", label="compile")
    right.plot(run_s, places, "o", c="tab:blue", mec="k", label="run")
    right.set(xscale="log", xlabel="time for one scene [s]")
    right.grid(True, which="major", alpha=0.4)
    right.legend(loc="best")
    return png(figure)
