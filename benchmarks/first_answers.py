"""First answers: what a user waits for, from the start of a process to its end.

Each command runs in a Python of its own, first with an empty cache of compiled programs, then again
with what the first run kept. Beside it is what SciPy's user waits for the same answer
(`scipy_user.py`), and how far the two answers are apart.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from .page import Result, cell, columns, png, subplots, table

TITLE = "First answers"
PACKAGES = ("equinox", "numpy", "scipy", "matplotlib")
EASY = ("import fractaljax", "fractaljax scene", "fractaljax stability")
LIMITS = {  # of a run that finds its programs in the cache [s]
    "import fractaljax": 0.5,
    "fractaljax stability": 1.5,
    "fractaljax cycle": 2.5,
    "fractaljax design": 3.0,
}


class Command(NamedTuple):
    """What is run in a folder of its own, what SciPy's user runs, and both answers by name."""

    arguments: list[str]
    peer: str | None = None
    answer: Callable[[str, Path], dict[str, float]] = lambda said, folder: {}


def _printed(**names: str) -> Callable[[str, Path], dict[str, float]]:
    """Numbers behind the words of a table that the command prints."""

    def read(said, folder):
        rows = {
            name: re.search(rf"^{re.escape(words)}\s+(\S+)", said, re.M)
            for name, words in names.items()
        }
        return {name: float(row[1]) for name, row in rows.items() if row}

    return read


def _designed(said: str, folder: Path) -> dict[str, float]:
    surface = tomllib.loads((folder / "out" / "design.toml").read_text())["contact"]["surface"]
    return {name: surface[name] for name in ("D", "G")}


def _own(command: str, *more: str) -> list[str]:
    return [sys.executable, "-m", "fractaljax", command, *more]


OUT = ("--out", "out")
COMMANDS = {
    "import fractaljax": Command([sys.executable, "-c", "import fractaljax"]),
    "fj.growth_rate": Command(
        [sys.executable, "-c", "import fractaljax as fj; fj.growth_rate(fj.brake_scene())"]
    ),
    "fractaljax scene": Command(_own("scene")),
    "fractaljax stability": Command(
        _own("stability"), "stability", _printed(growth_rate="growth rate [1/s]")
    ),
    "fractaljax cycle": Command(_own("cycle", *OUT), "cycle", _printed(frequency="frequency [Hz]")),
    "fractaljax design": Command(_own("design", "--quiet", *OUT), "design", _designed),
    "fractaljax contact": Command(_own("contact", "--area", "1e-4", "--quiet", *OUT)),
    "fractaljax identify": Command(
        _own("identify", "heights.npy", "--dx", "1e-6", "--unit", "m", *OUT)
    ),
    "fractaljax map": Command(
        _own("map", "--x", "V=0.1:0.2", "--y", "mu_s=0.35:0.45", "--starts", "8", "--quiet", *OUT)
    ),
    "fractaljax reduce": Command(_own("reduce", "chain.toml", "--quiet", *OUT)),
}
FULL: dict[str, Any] = {"names": list(COMMANDS), "repeats": 5}
QUICK: dict[str, Any] = {"names": EASY, "repeats": 1}


# --- measuring ----------------------------------------------------------------------------


def measure(names: Sequence[str], repeats: int) -> Result:
    """Medians of the seconds of every command, cold and again, and of SciPy's user."""
    rows = [_row(name, COMMANDS[name], repeats) for name in names]
    again = {row["name"]: row["again_s"] for row in rows}
    head = [
        {"what": f"{name}, again [s]", "value": again[name], "wanted": [0, most]}
        for name, most in LIMITS.items()
        if name in again
    ]
    return {
        "rows": rows,
        "repeats": repeats,
        "jax_s": _bare("import jax", repeats),
        "headline": head,
    }


def _row(name: str, command: Command, repeats: int) -> Result:
    cold, again, peer, apart = [], [], [], None
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            _inputs(folder)
            cold.append(_ran(command.arguments, folder)[0])
            seconds, said = _ran(command.arguments, folder)
            again.append(seconds)
            if command.peer is None:
                continue
            module = [sys.executable, "-m", "benchmarks.scipy_user", command.peer]
            seconds, theirs = _ran(module, folder)
            peer.append(seconds)
            own, theirs = command.answer(said, folder), json.loads(theirs)
            apart = max(abs(theirs[key] / own[key] - 1) for key in own)
    return {
        "name": name,
        "cold_s": median(cold),
        "again_s": median(again),
        "scipy_s": median(peer) if peer else None,
        "apart": apart,
    }


def _ran(arguments: list[str], folder: Path) -> tuple[float, str]:
    """Seconds of a process, and what it printed; its cache of programs is in the folder."""
    import matplotlib

    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    environment |= {name: str(folder / "cache") for name in ("XDG_CACHE_HOME", "LOCALAPPDATA")}
    # The list of fonts, which matplotlib makes once on a machine, is there already.
    environment["MPLCONFIGDIR"] = matplotlib.get_cachedir()
    source = str(Path(__file__).parents[1])
    environment["PYTHONPATH"] = os.pathsep.join([source, os.environ.get("PYTHONPATH", "")])
    start = time.perf_counter()
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    if done.returncode:
        raise RuntimeError(f"{arguments} failed: {done.stderr}")
    return seconds, done.stdout


def _bare(statement: str, repeats: int) -> float:
    here = Path(__file__).parent
    return median(_ran([sys.executable, "-c", statement], here)[0] for _ in range(repeats))


def _inputs(folder: Path) -> None:
    """Heights for `identify`, and a chain of masses for `reduce`."""
    import scipy.io
    from scipy.sparse import diags_array, eye_array

    rng, n, count = np.random.default_rng(0), 256, 2100
    q = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.rfftfreq(n), indexing="ij"))
    size = np.divide(1, q**1.6, out=np.zeros_like(q), where=q > 0)
    heights = np.fft.irfft2(size * np.fft.rfft2(rng.standard_normal((n, n))), s=(n, n))
    np.save(folder / "heights.npy", 1e-6 * heights / heights.std())
    offsets: Any = [-1, 0, 1]
    K = 1e8 * diags_array([-1.0, 2.0, -1.0], offsets=offsets, shape=(count, count))
    for name, matrix in (("K", K), ("M", eye_array(count))):
        scipy.io.mmwrite(folder / f"{name}.mtx", matrix.tocoo(), symmetry="symmetric")
    (folder / "chain.toml").write_text(
        '[structure]\nM = "M.mtx"\nC = [{coefficient = "alpha", matrix = "M.mtx"}]\nK = "K.mtx"\n'
        "[parameters]\nalpha = -3.0\n[reduction]\nband = [0, 50.0]\n"
    )


# --- the page -----------------------------------------------------------------------------


def page(result: Result) -> list[str]:
    rows = {row["name"]: row for row in result["rows"]}
    slowest = max(result["rows"], key=lambda row: row["cold_s"])
    first = f"""The command answers again in {rows["fractaljax stability"]["again_s"]:.2g} s
        (stability) to {max(row["again_s"] for row in rows.values()):.2g} s; the first time of all
        {slowest["name"]} takes longest, {slowest["cold_s"]:.2g} s, most of it compilation."""
    head = "from the start of a process | first time [s] | again [s] | SciPy's user [s] | apart"
    template = "{name} | {cold_s:.2f} | {again_s:.2f} | {scipy_s:.2f} | {apart:.0e}"
    return [
        first,
        table(head, result["rows"], template),
        f"""Medians of {result["repeats"]} processes. First time: with an empty cache of compiled
        programs; again: with what the first run kept. Of each `import jax` takes
        {cell(result["jax_s"], ".2f")} s; `import fractaljax` waits with it until a name is used.
        SciPy's user has a script with NumPy and SciPy (`benchmarks/scipy_user.py`), smooths the
        friction law of the cycle and starts the design at one place. Apart: the largest relative
        difference between both answers. A dash: there is no script.""",
    ]


def picture(result: Result) -> bytes:
    """Bars of each command: first time, again, and SciPy's user."""
    rows = result["rows"]
    figure, ax = subplots(figsize=(8, 0.6 * len(rows) + 1))
    names, *bars = columns(rows, "name", "cold_s", "again_s", "scipy_s")
    places = np.arange(len(rows))
    for k, (seconds, label) in enumerate(zip(bars, ("first time", "again", "SciPy"), strict=True)):
        ax.barh(places + 0.27 * (k - 1), [s or np.nan for s in seconds], 0.25, label=label)
    ax.set(xscale="log", yticks=places, yticklabels=names, xlabel="time [s]")
    ax.grid(True, axis="x", which="major", alpha=0.4)
    ax.set_axisbelow(True)
    ax.invert_yaxis()
    ax.legend()
    return png(figure)
