"""What a scene costs, from a growth rate at given stiffness to stick-slip gradients in an envelope.

Every row is a question about a scene, measured in a Python of its own, and has one part more than
another row: a contact law, a slope of friction, a gradient, an envelope, motion. What a scene does
not need must not be there, so the row without it is the cheaper one in every count.
"""

import collections
import json
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import fractaljax as fj

from .page import png, subplots, table
from .timing import seconds

TITLE = "What a scene costs"
PACKAGES = ()
HEAVY = ("diffrax", "optimistix", "optax", "matplotlib", "scipy", "tqdm")
COUNTS = {"operations": "operations", "flops": "FLOPs", "bytes_accessed": "bytes moved"}


# Questions ----------------------------------------------------------------------------------------


def fixed(friction=None) -> fj.Scene:
    """The source's section 3.3: K_n and K_t given, constant friction unless another law is."""
    friction = fj.Coulomb(0.4) if friction is None else friction
    return fj.Scene(fj.FixedContact(4e8, 2e8), friction, fj.brake_scene().oscillator)


def fractal(ratio=None) -> fj.Scene:
    """The reference brake; with a ratio K_t/K_n it has no tangential law."""
    scene = fj.brake_scene()
    contact = fj.FractalContact(scene.contact.surface, scene.contact.material, 1907.3, ratio)
    return fj.Scene(contact, scene.friction, scene.oscillator)


def amplitude(scene: fj.Scene, **options: Any) -> jax.Array:
    """Peak to peak of x_1 [m] on the limit cycle."""
    return fj.limit_cycle(scene, throw=False, **options).amplitude[0]


def regularised_amplitude(scene: fj.Scene) -> jax.Array:
    """The same with sgn(v) replaced by tanh(v/eps), eps = 0.003 m/s."""
    return amplitude(scene, regularisation=0.003)


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
    loads, frictions = jnp.meshgrid(jnp.array([0.9, 1.0, 1.1]), jnp.array([0.36, 0.4, 0.44]))

    def over(scene):
        def at(load, mu_s):
            return measure(scene.replace(P=load * scene.contact.P, mu_s=mu_s))

        return jnp.max(jax.vmap(at)(loads.ravel(), frictions.ravel()))

    return over


class Row(NamedTuple):
    """A question, and the row that has one part less."""

    name: str
    without: str | None
    ask: Callable[[], tuple[Callable, fj.Scene]]  # the function, and the scene that it is given
    quick: bool = True  # compiles in seconds


def stribeck() -> fj.Scene:
    """Known stiffness, friction that falls."""
    return fixed(fj.Stribeck(0.4, 0.25, 0.5))


def worst_growth_rate() -> tuple[Callable, fj.Scene]:
    """The question of the envelope, at equilibrium."""
    return by_surface(worst(fj.growth_rate)), fractal()


def worst_amplitude() -> tuple[Callable, fj.Scene]:
    """The same in motion."""
    return by_surface(worst(amplitude)), fractal(0.5)


COULOMB = "growth rate, stiffness given, Coulomb"
STRIBECK = "growth rate, stiffness given, Stribeck"
NORMAL, LAWS = "growth rate, normal contact law", "growth rate, both contact laws"
GRADIENT, SLOPES = "growth rate with gradient by D, G", "amplitude with gradient by D, G"
AMPLITUDE, NORMAL_AMPLITUDE = "amplitude, stiffness given", "amplitude, normal contact law"
REGULARISED = "amplitude, stiffness given, regularised law"
ROWS = (
    Row(COULOMB, None, lambda: (fj.growth_rate, fixed())),
    Row(STRIBECK, COULOMB, lambda: (fj.growth_rate, stribeck())),
    Row(NORMAL, STRIBECK, lambda: (fj.growth_rate, fractal(0.5))),
    Row(LAWS, NORMAL, lambda: (fj.growth_rate, fractal())),
    Row("all eigenvalues, both contact laws", LAWS, lambda: (fj.stability, fractal())),
    Row(GRADIENT, LAWS, lambda: (by_surface(fj.growth_rate), fractal())),
    Row("worst growth rate of 9 conditions, with gradient", GRADIENT, worst_growth_rate),
    Row(AMPLITUDE, STRIBECK, lambda: (amplitude, stribeck()), False),
    Row(REGULARISED, STRIBECK, lambda: (regularised_amplitude, stribeck()), False),
    Row(NORMAL_AMPLITUDE, AMPLITUDE, lambda: (amplitude, fractal(0.5)), False),
    Row(SLOPES, NORMAL_AMPLITUDE, lambda: (by_surface(amplitude), fractal(0.5)), False),
    Row("worst amplitude of 9 conditions, with gradient", SLOPES, worst_amplitude, False),
)
BY_NAME = {row.name: row for row in ROWS}


# Measuring ----------------------------------------------------------------------------------------


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
    trace_s, (program, scene) = seconds(traced, row)
    compile_s, compiled = seconds(lambda: program.lower().compile())
    found: Any = compiled.cost_analysis() or {}
    found = found[0] if isinstance(found, list) else found  # so it was in older versions
    return {
        "name": row.name,
        "without": row.without,
        "operations": operations(program.jaxpr.jaxpr).total(),
        "flops": found.get("flops"),
        "bytes_accessed": found.get("bytes accessed"),
        "trace_s": trace_s,
        "compile_s": trace_s + compile_s,
        "run_s": statistics.median(seconds(compiled, scene)[0] for _ in range(repeats)),
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


def measure(quick: bool) -> dict[str, Any]:
    """The cost of every row."""
    from tqdm import tqdm  # here, since every row lists its imports

    repeats, rows = 5 if quick else 51, [row for row in ROWS if row.quick or not quick]
    found = [in_a_process(row, repeats) for row in tqdm(rows, desc="scene")]
    return {"repeats": repeats, "rows": found}


# The page -----------------------------------------------------------------------------------------


def page(result: dict[str, Any]) -> list[str]:
    """One sentence, the table, how it was measured."""
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
            (
                f"{r['name']} | {r['operations']} | {r['flops']:.3g} | {r['bytes_accessed']:.3g}"
                f" | {r['trace_s']:.2f} | {r['compile_s']:.2f} | {r['run_s'] * 1e6:.3g}"
                f" | {', '.join(r['heavy_modules']) or '-'}"
                for r in result["rows"]
            ),
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
    rows = result["rows"]
    places = range(len(rows))
    figure, (left, right) = subplots(1, 2, figsize=(14, 0.45 * len(rows) + 1.6), sharey=True)
    left.barh(places, [row["operations"] for row in rows], color="tab:blue", edgecolor="k")
    left.set(xscale="log", xlabel="operations of the traced program [-]", yticks=places)
    left.set_yticklabels([row["name"] for row in rows])
    left.invert_yaxis()
    for key, marker, colour in (("compile", "s", "tab:orange"), ("run", "o", "tab:blue")):
        times = [row[f"{key}_s"] for row in rows]
        right.plot(times, places, marker, c=colour, mec="k", label=key)
    right.set(xscale="log", xlabel="time for one scene [s]")
    right.grid(True, which="major", alpha=0.4)
    right.legend(loc="best")
    return png(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(cost(BY_NAME[sys.argv[1]], int(sys.argv[2]))))
