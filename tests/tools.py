"""What several test files share: scenes, a limit cycle, runs of the command."""

import contextlib
import functools
import importlib.util
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import fractaljax as fj
from fractaljax.__main__ import main
from fractaljax._base import programs
from mechanisms import PLAIN

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def scene_of(numbers) -> fj.Scene:
    """Of the numbers of `mechanisms.PLAIN`; constant friction is a Stribeck law without a drop."""
    x = [numbers[name] for name in PLAIN]
    return fj.Scene(fj.FixedContact(*x[7:9]), fj.Stribeck(*x[9:]), fj.Oscillator(*x[:7]))


def reference_scene() -> fj.Scene:
    """The brake of the source's section 3.3, with its middle stiffness: direction 1 sticks."""
    return scene_of(PLAIN)


def state_matrix(o: fj.Oscillator, mu, K_n, K_t) -> np.ndarray:
    """Of Eq. 43, (4, 4): constant friction mu on a joint of known stiffness."""
    m, w_1, w_2, xi_1, xi_2 = (float(x) for x in (o.m, o.omega_1, o.omega_2, o.xi_1, o.xi_2))
    K = np.array([[w_1**2 + K_t / m, -mu * K_n / m], [mu * K_t / m, w_2**2 + K_n / m]], float)
    C = np.diag([2 * xi_1 * w_1, 2 * xi_2 * w_2])
    return np.block([[np.zeros((2, 2)), np.eye(2)], [-K, -C]])


def motionless_scene() -> fj.Scene:
    """The same with little friction and much damping: steady sliding attracts."""
    return reference_scene().replace(mu_s=0.05, mu_m=0.04, xi_1=0.05, xi_2=0.05)


@functools.cache
def reference_cycle() -> fj.LimitCycle:
    """The limit cycle of the reference scene, computed once."""
    return fj.limit_cycle(reference_scene())


def both_modes(function, x, has_aux=False) -> tuple[Any, ...]:
    """Value, forward and reverse Jacobian (value's shape, n) at x (n,), and aux: from one trace.

    `jax.jacfwd` beside `jax.jacrev` would trace and compile the same function twice.
    """
    value, linear, *aux = jax.linearize(function, x, has_aux=has_aux)
    forward = jax.vmap(linear, out_axes=-1)(jnp.eye(x.size, dtype=x.dtype))
    rows = jnp.eye(value.size, dtype=value.dtype).reshape(-1, *value.shape)
    (reverse,) = jax.vmap(jax.linear_transpose(linear, x))(rows)
    return value, forward, reverse.reshape(*value.shape, x.size), *aux


def both_gradients(function, x) -> list[Any]:
    """Gradients of a scalar function by a pytree of numbers, in forward and in reverse mode."""
    row, unravel = ravel_pytree(x)
    _, *slopes = both_modes(lambda row: function(unravel(row)), row)
    return [unravel(slope) for slope in slopes]


def labels(ax) -> list[str]:
    """The words of a legend."""
    return [text.get_text() for text in ax.get_legend().get_texts()]


def assert_whole(figure, artists=None) -> None:
    """Nothing is cut off: of some artists, or of all axes with their labels and legends."""
    figure.draw_without_rendering()
    for artist in figure.axes if artists is None else artists:
        box = artist.get_tightbbox()
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1


def load_script(path: Path) -> Any:
    """The module of a Python file that lies in no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def assert_same_picture(drawn: Path, name: str) -> None:
    """A picture is the one in docs, up to the rendering of type."""
    found, shown = (matplotlib.image.imread(path) for path in (drawn, DOCS / name))
    assert found.shape == shown.shape
    assert np.abs(found - shown).mean() < 0.01


def run_command(capsys, *arguments) -> tuple[Any, str, str]:
    """Exit status, standard output and standard error of one call of the command.

    Its programs are those of the other tests. A process of its own keeps them on disk
    (tests/base/test_programs.py): here they would be compiled once more for that.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "keep_programs", contextlib.nullcontext)
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            status = stop.code
    return status, *capsys.readouterr()


def refused_command(capsys, *arguments) -> str:
    """What the command says where it refuses: one line, exit status 2, and nothing printed."""
    status, out, err = run_command(capsys, *arguments)
    assert (status, out) == (2, ""), arguments
    assert err.startswith("fractaljax: ") and err.count("\n") == 1, arguments
    return err.removeprefix("fractaljax: ").rstrip()


def equations(jaxpr) -> Iterator[Any]:
    """All equations of a jaxpr, those of loops and calls included."""
    for equation in jaxpr.eqns:
        yield equation
        for value in jax.tree.leaves(tuple(equation.params.values())):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from equations(inner)


def primitives(jaxpr) -> Counter[str]:
    """How often each primitive stands in a jaxpr, loops and calls and what is in them included."""
    return Counter(equation.primitive.name for equation in equations(jaxpr))


def mostly_slow(values, *quick) -> list:
    """Parameters of a test, of which only `quick` are in the default run."""
    return [x if x in quick else pytest.param(x, marks=pytest.mark.slow) for x in values]


def refusals(
    cases, call=lambda call: call(), kind: Any = ValueError, pattern="{}", plain=False
) -> Any:
    """A test that each case, arguments of `call` and a message, is refused in one line.

    Messages are regular expressions, or `plain` text; a pattern says what stands around them.
    """

    @pytest.mark.parametrize("case", cases, ids=lambda case: str(case[-1])[:40])
    def refused(case):
        *arguments, message = case
        match = pattern.format(re.escape(message) if plain else message)
        with pytest.raises(kind, match=match) as caught:
            call(*arguments)
        assert "\n" not in str(caught.value)

    return refused


def quick_benchmark(name: str, folder: Path) -> tuple[dict, str]:
    """What `python -m benchmarks NAME --quick` writes to a folder: the numbers and the page."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", name, "--quick", "--out", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    written = {path.name for path in folder.iterdir()}
    assert written == {f"{name}.{ending}" for ending in ("json", "md", "png")} | {"README.md"}
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    return json.loads((folder / f"{name}.json").read_text()), (folder / f"{name}.md").read_text()
