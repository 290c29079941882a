"""What a scene costs, from a growth rate at given stiffness to stick-slip gradients in an envelope.

Every row is a question asked of a scene, measured in a Python of its own, and has more in it than
another one: a contact law, a slope of friction, a gradient, an envelope, motion. What a scene does
not need must not be there, so the row without it is the cheaper one in every count.
"""

import collections
import dataclasses
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import fractaljax as fj

from .page import png, subplots, table, versions
from .timing import others_running, ran_on, this_machine

HEAVY = ("diffrax", "optimistix", "optax", "matplotlib", "scipy", "tqdm")
REPEATS, QUICK_REPEATS = 51, 5


@dataclasses.dataclass(frozen=True)
class Row:
    """A question, and the row that has one part less."""

    name: str
    ask: Callable[[], tuple[Callable, fj.Scene]]  # the function, and the scene that it is given
    without: str | None = None
    quick: bool = True  # compiles in seconds


# ---------------------------------------------------------------------------------------------
# The questions
# ---------------------------------------------------------------------------------------------


def fixed(friction=None) -> fj.Scene:
    """The source's section 3.3: K_n and K_t given, constant friction unless another law is."""
    friction = fj.Coulomb(0.4) if friction is None else friction
    return fj.Scene(fj.FixedContact(4e8, 2e8), friction, fj.brake_scene().oscillator)


def fractal(ratio=None, friction=None) -> fj.Scene:
    """The reference brake; with a ratio K_t/K_n it has no tangential law."""
    scene = fj.brake_scene()
    contact = fj.FractalContact(scene.contact.surface, scene.contact.material, 1907.3, ratio)
    return fj.Scene(contact, scene.friction if friction is None else friction, scene.oscillator)


def amplitude(scene: fj.Scene) -> jax.Array:
    """Peak to peak of x_1 [m] on the limit cycle."""
    return fj.limit_cycle(scene, throw=False).amplitude[0]


def regularised_amplitude(scene: fj.Scene) -> jax.Array:
    """The same with sgn(v) replaced by tanh(v/eps), eps = 0.003 m/s."""
    return fj.limit_cycle(scene, regularisation=0.003, throw=False).amplitude[0]


def by_surface(measure: Callable) -> Callable:
    """A measure with its derivatives by D and G, in forward mode."""

    def both(scene):
        surface = scene.contact.surface

        def value(D, G):
            found = measure(scene.replace(D=D, G=G))
            return found, found

        return jax.jacfwd(value, argnums=(0, 1), has_aux=True)(surface.D, surface.G)

    return both


def worst(measure: Callable) -> Callable:
    """The largest value of a measure at nine conditions of load and friction."""
    loads, frictions = jnp.meshgrid(jnp.array([0.9, 1.0, 1.1]), jnp.array([0.36, 0.4, 0.44]))

    def over(scene):
        def at(load, mu_s):
            return measure(scene.replace(P=load * scene.contact.P, mu_s=mu_s))

        return jnp.max(jax.vmap(at)(loads.ravel(), frictions.ravel()))

    return over


LAW = fj.Stribeck(0.4, 0.25, 0.5)
ROWS = (
    Row("growth rate, stiffness given, Coulomb", lambda: (fj.growth_rate, fixed())),
    Row(
        "growth rate, stiffness given, Stribeck",
        lambda: (fj.growth_rate, fixed(LAW)),
        "growth rate, stiffness given, Coulomb",
    ),
    Row(
        "growth rate, normal contact law",
        lambda: (fj.growth_rate, fractal(0.5)),
        "growth rate, stiffness given, Stribeck",
    ),
    Row(
        "growth rate, both contact laws",
        lambda: (fj.growth_rate, fractal()),
        "growth rate, normal contact law",
    ),
    Row(
        "all eigenvalues, both contact laws",
        lambda: (fj.stability, fractal()),
        "growth rate, both contact laws",
    ),
    Row(
        "growth rate with gradient by D, G",
        lambda: (by_surface(fj.growth_rate), fractal()),
        "growth rate, both contact laws",
    ),
    Row(
        "worst growth rate of 9 conditions, with gradient",
        lambda: (by_surface(worst(fj.growth_rate)), fractal()),
        "growth rate with gradient by D, G",
    ),
    Row(
        "amplitude, stiffness given",
        lambda: (amplitude, fixed(LAW)),
        "growth rate, stiffness given, Stribeck",
        quick=False,
    ),
    Row(
        "amplitude, stiffness given, regularised law",
        lambda: (regularised_amplitude, fixed(LAW)),
        "growth rate, stiffness given, Stribeck",
        quick=False,
    ),
    Row(
        "amplitude, normal contact law",
        lambda: (amplitude, fractal(0.5)),
        "amplitude, stiffness given",
        quick=False,
    ),
    Row(
        "amplitude with gradient by D, G",
        lambda: (by_surface(amplitude), fractal(0.5)),
        "amplitude, normal contact law",
        quick=False,
    ),
    Row(
        "worst amplitude of 9 conditions, with gradient",
        lambda: (by_surface(worst(amplitude)), fractal(0.5)),
        "amplitude with gradient by D, G",
        quick=False,
    ),
)
BY_NAME = {row.name: row for row in ROWS}


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


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
    function, scene = row.ask()
    return jax.jit(function).trace(scene), scene


def cost(row: Row, repeats: int) -> dict[str, Any]:
    """Every number of a row, in this process."""
    start = time.perf_counter()
    program, scene = traced(row)
    traced_s = time.perf_counter() - start
    compiled = program.lower().compile()
    compile_s = time.perf_counter() - start
    found = compiled.cost_analysis() or {}
    found = found[0] if isinstance(found, list) else found  # so it was in older versions
    memory = compiled.memory_analysis()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(scene))
        times.append(time.perf_counter() - start)
    return {
        "name": row.name,
        "without": row.without,
        "operations": operations(program.jaxpr.jaxpr).total(),
        "flops": found.get("flops"),
        "bytes_accessed": found.get("bytes accessed"),
        "temporary_bytes": getattr(memory, "temp_size_in_bytes", None),
        "trace_s": traced_s,
        "compile_s": compile_s,
        "run_s": statistics.median(times),
        "heavy_modules": [name for name in HEAVY if name in sys.modules],
    }


def in_a_process(row: Row, repeats: int) -> dict[str, Any]:
    """`cost` in a Python that has done nothing else, and imported nothing that is not needed."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.scene_cost", row.name, str(repeats)],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{row.name}: {done.stderr}")
    return json.loads(done.stdout)


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    from tqdm import tqdm  # here, since every row is asked what it has imported

    busy = others_running()
    rows = [row for row in ROWS if row.quick or not quick]
    repeats = QUICK_REPEATS if quick else REPEATS
    return {
        "quick": quick,
        "repeats": repeats,
        "machine": this_machine(busy),
        "versions": versions("jax"),
        "rows": [in_a_process(row, repeats) for row in tqdm(rows, desc="scene")],
    }


# ---------------------------------------------------------------------------------------------
# Showing
# ---------------------------------------------------------------------------------------------

COUNTS = {"operations": "operations", "flops": "FLOPs", "bytes_accessed": "bytes moved"}


HEADINGS = [
    "question",
    "operations",
    "FLOPs",
    "bytes moved",
    "trace [s]",
    "compile [s]",
    "run [us]",
    "libraries loaded",
]


def cells(row: dict[str, Any]) -> list[str]:
    """One row of the table."""
    return [
        row["name"],
        f"{row['operations']}",
        *(f"{row[key]:.3g}" for key in ("flops", "bytes_accessed")),
        *(f"{row[key]:.2f}" for key in ("trace_s", "compile_s")),
        f"{row['run_s'] * 1e6:.3g}",
        ", ".join(row["heavy_modules"]) or "-",
    ]


def text(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, the table, how it was measured."""
    rows = {row["name"]: row for row in result["rows"]}
    dearer = [
        f"{name} ({words})"
        for name, row in rows.items()
        for key, words in COUNTS.items()
        if row["without"] and not rows[row["without"]][key] < row[key]
    ]
    lines = [
        "# What a scene costs",
        "",
        "Every scene costs more than the one that has a part less, in operations, FLOPs and bytes"
        + (f", but for: {', '.join(dearer)}." if dearer else "."),
        "",
        *table(HEADINGS, [cells(row) for row in result["rows"]]),
        "",
        "Each row is measured in a Python process of its own, in double precision. Operations are"
        " those of the traced program before any compiler has seen them; FLOPs and bytes are the"
        " compiler's own estimate, which counts the body of a loop once, so that of limit cycles"
        " it leaves out most of the search, and bytes depend on what it fuses. Run time is the"
        f" median of {result['repeats']} calls for one scene, that of the call itself (about 10"
        f" us) included. Libraries are those among {', '.join(HEAVY)} that have been imported by"
        " then.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


def picture(result: dict[str, Any]) -> bytes:
    """Operations at the left, times at the right, a bar for each row."""
    import numpy as np

    rows = result["rows"]
    names = [row["name"] for row in rows]
    places = np.arange(len(rows))
    figure, (left, right) = subplots(1, 2, figsize=(14, 0.45 * len(rows) + 1.6), sharey=True)
    left.barh(places, [row["operations"] for row in rows], color="tab:blue", edgecolor="k")
    left.set(xscale="log", xlabel="operations of the traced program [-]", yticks=places)
    left.set_yticklabels(names)
    left.invert_yaxis()
    for key, colour, marker, label in (
        ("compile_s", "tab:orange", "s", "compile"),
        ("run_s", "tab:blue", "o", "run"),
    ):
        right.plot([row[key] for row in rows], places, marker, c=colour, mec="k", label=label)
    right.set(xscale="log", xlabel="time for one scene [s]")
    right.grid(True, which="major", alpha=0.4)
    right.legend(loc="best")
    return png(figure, dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(cost(BY_NAME[sys.argv[1]], int(sys.argv[2]))))
