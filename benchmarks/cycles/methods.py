"""The ways to a limit cycle that are compared: each a row of the page, and a call."""

from collections.abc import Callable
from typing import Any

import diffrax
from tqdm import tqdm

import fractaljax as fj

from ..timing import compiled
from . import transients
from .events import TOLERANCE, heyoka_events
from .reference import K_N, MEMBERS, V, member, reference

OWN, OWN_TANH, EVENTS = "fractaljax, exact", "fractaljax, tanh", "heyoka, exact, by events"
SHARES = (1e-1, 1e-2, 1e-3, 1e-4)  # eps/V of the tanh law
EXPLICIT = (1e-4, 1e-6, 1e-8, 1e-10)
IMPLICIT = (1e-4, 1e-6, 1e-8)
# Families of peers on the tanh law, and their tolerances.
PEERS = {
    "SciPy RK45": EXPLICIT,
    "SciPy DOP853": EXPLICIT,
    "SciPy LSODA": EXPLICIT,
    "SciPy Radau": IMPLICIT,
    "diffrax Tsit5": EXPLICIT,
    "diffrax Dopri5": EXPLICIT,
    "diffrax Dopri8": EXPLICIT,
    "diffrax Kvaerno5": IMPLICIT,
    "diffrax KenCarp4": IMPLICIT,
    "numbalsoda LSODA": EXPLICIT,
    "numbalsoda DOP853": EXPLICIT,
    "heyoka, step capped": EXPLICIT,
}

# A row that is not timed yet, and the call that gives period and amplitude.
Method = tuple[dict[str, Any], Callable[[], tuple[float, float]]]


def row(group: str, setting: str, compile_s: float | None = None, **more: Any) -> dict[str, Any]:
    """What is known of a method before it is run."""
    name = f"{group}, {setting}"
    return {"name": name, "group": group, "setting": setting, "compile_s": compile_s, **more}


def own_exact(segments: tuple[int, ...]) -> list[Method]:
    """The package, by the number of segments."""

    def method(n: int) -> Method:
        def cycle(K):
            found = fj.limit_cycle(reference(K), segments=n, throw=False)
            return found.period, found.amplitude[0]

        program, compile_s = compiled(cycle, K_N)
        return row(OWN, f"{n} segments", compile_s), lambda: program(K_N)

    return [method(n) for n in tqdm(segments, desc="compile")]


def own_tanh(shares: tuple[float, ...]) -> list[Method]:
    """The package's own cycle of the tanh law, by eps; an implicit solver where it is stiff."""

    def method(share: float) -> Method:
        solver, steps = (None, 16384) if share > 5e-4 else (diffrax.Kvaerno5(), 8192)
        options = {"regularisation": share * V, "solver": solver, "max_steps": steps}

        def cycle(K):
            found = fj.limit_cycle(reference(K), throw=False, **options)
            return found.period, found.amplitude[0], member(found)

        program, compile_s = compiled(cycle, K_N)
        more = {"eps": share, "result": MEMBERS[int(program(K_N)[2])]}
        name = f"eps {share:g} V, {type(solver).__name__ if solver else 'Tsit5'}"
        return row(OWN_TANH, name, compile_s, **more), lambda: program(K_N)[:2]

    return [method(share) for share in tqdm(shares, desc="compile, tanh")]


def by_events(periods: tuple[int, ...]) -> list[Method]:
    """heyoka on the exact law, by the number of periods that are run."""
    law = transients.law()

    def method(count: int) -> Method:
        run = heyoka_events(law, TOLERANCE, count)
        found = row(EVENTS, f"{count} periods", periods=count)
        return found, lambda: transients.last_turn(law, run())

    return [method(count) for count in periods]


def on_tanh(family: str, share: float) -> list[Method]:
    """One peer on the tanh law by its tolerances, the loosest first."""
    library, _, solver = family.replace(",", "").partition(" ")
    law, periods = transients.law(), transients.PERIODS[share]

    def runner(rtol: float) -> Callable[[], transients.Extremes]:
        if library == "SciPy":
            return transients.scipy_run(law, share, solver, rtol, periods)
        if library == "diffrax":
            program, _ = transients.diffrax_program(solver)
            return transients.diffrax_run(program, law, share, rtol, periods)
        if library == "numbalsoda":
            return transients.numbalsoda_run(law, share, solver, rtol, periods)
        return transients.heyoka_run(law, share, rtol, periods)

    def method(rtol: float) -> Method:
        run = runner(rtol)
        compile_s = transients.diffrax_program(solver)[1] if library == "diffrax" else None
        more = {"eps": share, "rtol": rtol, "periods": periods}
        found = row(family, f"eps {share:g} V, rtol {rtol:g}", compile_s, **more)
        return found, lambda: transients.last_turn(law, run())

    return [method(rtol) for rtol in PEERS[family]]
