"""Sweeps: the grid, batches of one shape, stores that resume, devices and processes."""

import errno
import io
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import xarray
import zarr

import fractaljax as fj
from fractaljax._base.versions import versions
from fractaljax._sweep.program import Program
from fractaljax._sweep.store import Store
from tools import reference_scene, refusals

SCENE, GIVEN = fj.brake_scene(), reference_scene()
D = np.linspace(2.35, 2.45, 5)
G = np.geomspace(5e-11, 3e-10, 3)


def measured(D, G):
    """Growth rates over the grid without a sweep."""
    return np.array([[fj.growth_rate(SCENE.replace(D=d, G=g)) for g in G] for d in D])


def grown(D=D, **options):
    return fj.sweep(fj.growth_rate, SCENE, progress=False, D=D, G=G, **options)


def regime(scene):
    return scene.contact.state(scene.friction.mu_s, scene.friction.mu_m).regime


@pytest.mark.parametrize("batch_size", [None, 4, 64])
def test_every_point_once_and_in_its_place(batch_size):
    found = grown(batch_size=batch_size)
    assert isinstance(found.values, np.ndarray) and found.names == ("D", "G")
    np.testing.assert_allclose(found, measured(D, G), rtol=1e-9)
    assert list(found.axes) == ["D", "G"] and found.axes["D"].tolist() == D.tolist()
    assert found.shape == (5, 3) and found[2, 1] == found.values[2, 1]
    again = pickle.loads(pickle.dumps(jax.tree.map(lambda x: 2 * x, found)))
    np.testing.assert_array_equal(again, 2 * np.asarray(found))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="an accelerator takes all together")
def test_points_of_a_measure_that_branches_do_not_wait_for_one_another():
    """A loop runs as often as each point needs, also where it is deep in the program."""
    seen = []

    def halvings(scene):
        def halve(carry):
            jax.debug.callback(lambda: seen.append(1))
            return carry[0] / 2, carry[1] + 1

        loop = jax.jit(lambda P: jax.lax.while_loop(lambda carry: carry[0] > 100, halve, (P, 0)))
        return jax.lax.scan(lambda total, P: (total + loop(P)[1], None), 0, scene.contact.P[None])[
            0
        ]

    P = 100 * 2.0 ** np.arange(6)
    found = fj.sweep(halvings, SCENE, progress=False, P=P)
    jax.effects_barrier()
    assert found.values.tolist() == [0, 1, 2, 3, 4, 5] and len(seen) == 15


def friction_at(mu, V):
    factor = mu / float(GIVEN.friction.mu(V))
    return GIVEN.replace(mu_s=0.4 * factor, mu_m=0.25 * factor, V=V)


def ratio_at(ratio, K_n):
    return GIVEN.replace(K_n=K_n, K_t=ratio * K_n)


def omega_at(ratio, omega):
    return GIVEN.replace(omega_1=ratio * omega, omega_2=omega)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "axes", "moved"),
    [
        # Ratios are those of the stiffness and frequency at the same point, whatever the order.
        (GIVEN, {"K_t/K_n": [0.2, 0.9], "K_n": [1e8, 9e8]}, ratio_at),
        (GIVEN, {"omega_1/omega_2": [0.2, 0.9], "omega_2": [3e3, 2e4]}, omega_at),
        (GIVEN, {"mu": [0.2, 0.5], "V": [0.1, 0.3]}, friction_at),
        (SCENE, {"G": G, "D": D}, lambda G, D: SCENE.replace(G=G, D=D)),
        (SCENE, {"K_t/K_n": [0.2, 0.4]}, lambda ratio: SCENE.replace(stiffness_ratio=ratio)),
        (SCENE, {"P": [1907.3]}, lambda P: SCENE),
    ],
    ids=["K_t/K_n", "omega_1/omega_2", "mu", "order", "given ratio", "one point"],
)
def test_quantities_are_those_of_replace(scene, axes, moved):
    found = fj.sweep(fj.growth_rate, scene, progress=False, **axes)
    for places in np.ndindex(found.shape):
        point = [values[i] for values, i in zip(axes.values(), places, strict=True)]
        assert found[places] == pytest.approx(float(fj.growth_rate(moved(*point))), rel=1e-9)


@pytest.mark.slow
def test_pytrees_of_a_measure():
    mu = [0.3, 0.4]

    def measure(scene):
        return fj.stability(scene), fj.stiffness(scene), regime(scene)

    stability, (K_n, _), regimes = fj.sweep(measure, SCENE, 7, False, D=D, G=G, mu_s=mu).values
    assert isinstance(stability, fj.Stability) and stability.eigenvalues.shape == (5, 3, 2, 4)
    np.testing.assert_allclose(stability.growth_rate[:, :, 1], measured(D, G), rtol=1e-9)
    alone = SCENE.replace(D=D[4], G=G[1], mu_s=mu[0])
    wanted = fj.stability(alone).eigenvalues
    np.testing.assert_allclose(stability.eigenvalues[4, 1, 0], wanted, rtol=1e-9)
    np.testing.assert_allclose(K_n[4, 1, 0], fj.stiffness(alone)[0], rtol=1e-12)
    assert bool((regimes == regime(alone))[4, 1, 0])


def test_sweeps_of_several_arrays_and_of_a_scene_with_arrays():
    found = fj.sweep(fj.stiffness, SCENE, progress=False, P=[1e3, 2e3])
    np.testing.assert_array_equal(found[0], found.values[0])
    with pytest.raises(TypeError, match="take them from"):
        np.asarray(found)
    with pytest.raises(AttributeError, match="growth"):
        _ = found.growth
    with pytest.raises(ValueError, match="D must be a scalar"):
        fj.sweep(fj.growth_rate, SCENE.replace(D=D), G=G)


@pytest.mark.slow
def test_xarray_has_names_and_units(monkeypatch):
    array = grown().to_xarray()
    assert array.dims == ("D", "G") and array.G.attrs["units"] == "m"
    np.testing.assert_array_equal(array.sel(D=D[1]), grown()[1])
    data = fj.sweep(fj.stability, SCENE, progress=False, D=D, G=G).to_xarray()
    assert data.growth_rate.dims == ("D", "G") and data.eigenvalues.shape == (5, 3, 4)


def test_without_xarray_it_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match="to_xarray needs xarray"):
        grown().to_xarray()


def test_one_program_serves_every_batch_and_every_sweep_of_a_kind(tmp_path, monkeypatch):
    traces, programs, point = [], [], Program.__call__

    def traced(self, *given):  # the point of a batch is called where that is traced
        programs.append(self)
        return point(self, *given)

    monkeypatch.setattr(Program, "__call__", traced)

    def measure(scene):
        traces.append(1)
        return fj.growth_rate(scene)

    fj.sweep(measure, SCENE, 4, False, D=D, G=G)
    fj.sweep(measure, SCENE.replace(P=2000.0), 4, False, D=D + 0.01, G=G)
    fj.sweep(lambda scene: fj.growth_rate(scene), SCENE, 4, False, D=D, G=G)
    assert len(programs) <= 1
    assert len(traces) == 2
    factor = [1.0]

    def captured(scene):
        return factor[0] * scene.contact.surface.D

    for out in (None, tmp_path):
        factor[0] = 1.0
        np.testing.assert_array_equal(fj.sweep(captured, SCENE, None, False, out=out, D=D), D)
    factor[0] = 2.0
    np.testing.assert_array_equal(fj.sweep(captured, SCENE, None, False, D=D), 2 * D)
    with pytest.raises(ValueError, match="holds another sweep: measure or scene differ"):
        fj.sweep(captured, SCENE, None, False, out=tmp_path, D=D)


def test_progress_goes_to_standard_error(capsys):
    fj.sweep(fj.growth_rate, SCENE, 4, D=D, G=G)
    shown = capsys.readouterr()
    assert shown.out == "" and "15.0/15.0" in shown.err
    grown()
    assert capsys.readouterr().err == ""


# Refused before any memory is taken.
LARGE = {name: np.full(10**5, x) for name, x in {"D": 2.4, "G": 1e-10, "P": 1e3}.items()}


test_refusals = refusals(
    [
        ({}, "sweep needs an axis"),
        ({"d": [2.4]}, "scene has no quantity 'd'; it has D, G, "),
        ({"mu": [0.3], "mu_s": [0.4]}, "must be independent, got mu and mu_s"),
        ({"D": 2.4}, r"values of D must be a list, got shape \(\)"),
        ({"D": [2.4, 3.1]}, "D must be above 2 and below 3, got 3.1"),
        ({"mu_s": [0.4, 0.3], "mu_m": [0.2, 0.35]}, "mu_s must be at least mu_m = 0.35, got 0.3"),
        # At the corners the friction law is above its minimum, which is inside.
        ({"V": [0.05, 0.5, 0.95], "mu": [0.3, 1.2]}, "mu_m must be at most 0.9, got 1.2"),
        ({"batch_size": 0, "D": D}, "batch_size must be an integer of at least 1"),
        ({"devices": [], "D": D}, "at least one device"),
        (LARGE, "a sweep of 1000000000000000 points would take 8.00e.15 b"),
    ],
    lambda axes: fj.sweep(fj.growth_rate, SCENE, progress=False, **axes),
)


def test_an_interrupted_sweep_loses_what_is_not_written(tmp_path, monkeypatch):
    written, write = [], Store.write

    def recorded(self, k, arrays):
        if len(written) == 2 and interrupt:
            raise KeyboardInterrupt
        written.append(k)
        write(self, k, arrays)

    monkeypatch.setattr(Store, "write", recorded)
    interrupt = True
    with pytest.raises(KeyboardInterrupt):
        grown(batch_size=4, out=tmp_path / "sweep")
    interrupt = False
    found = grown(batch_size=4, out=tmp_path / "sweep")
    assert written == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(found, grown(batch_size=4))
    np.testing.assert_array_equal(grown(out=tmp_path / "sweep"), found)  # batch size from there
    assert written == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(xarray.open_zarr(tmp_path / "sweep").growth_rate, found)


@pytest.mark.parametrize("batch", ["by hand", "another place", "another sweep"])
def test_a_foreign_batch_is_refused(tmp_path, batch):
    """Whole chunks of the right name."""
    out = tmp_path / "sweep"
    grown(batch_size=4, out=out)
    file, mark = (out / name / "c.1.0" for name in ("growth_rate", "computed"))
    if batch == "by hand":
        zarr.open_array(out / "growth_rate")[1] = 7.0
    elif batch == "another place":
        for each in (file, mark):
            each.write_bytes(each.with_name("c.0.0").read_bytes())
    else:
        grown(D=D + 1e-9, batch_size=4, out=tmp_path / "b")
        for each in (file, mark):
            each.write_bytes((tmp_path / "b" / each.relative_to(out)).read_bytes())
    with pytest.raises(
        ValueError, match=r"batch 1 .* cannot be read, remove .*computed.c\.1\.0 and"
    ):
        grown(batch_size=4, out=out)
    mark.unlink()
    np.testing.assert_array_equal(grown(batch_size=4, out=out), grown(batch_size=4))


@pytest.mark.parametrize("array", ["growth_rate", "computed"])
def test_what_is_gone_is_computed_again(tmp_path, array):
    found = grown(batch_size=4, out=tmp_path)
    (tmp_path / array / "c.3.0").unlink()
    np.testing.assert_array_equal(grown(batch_size=4, out=tmp_path), found)
    assert (tmp_path / array / "c.3.0").exists()


def test_a_store_of_other_versions(tmp_path):
    """Resumed under a warning of one line."""
    found = grown(batch_size=4, out=tmp_path)
    group = zarr.open_group(tmp_path, mode="r+")
    about: Any = group.attrs["fractaljax"]
    assert about["versions"] == versions()
    group.attrs["fractaljax"] = about | {"versions": {"fractaljax": "0.0.9", "jax": "0.1"}}
    with pytest.warns(UserWarning, match=r"\A.*written by fractaljax 0.0.9, jax 0.1, read by.*\Z"):
        again = grown(batch_size=4, out=tmp_path)
    np.testing.assert_array_equal(again, found)
    with pytest.raises(ValueError, match=r"axes differ \(it was written by fractaljax 0\.0\.9"):
        grown(batch_size=4, out=tmp_path, D=D + 1e-9)


def test_a_store_of_another_sweep_is_refused(tmp_path):
    def swept(measure: Any = fj.growth_rate, scene=SCENE, batch_size=4, D=D):
        return fj.sweep(measure, scene, batch_size, False, out=tmp_path, D=D, G=G)

    def files():
        return {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}

    swept()
    swept(lambda scene: fj.growth_rate(scene))  # an equal program is the same sweep
    before = files()
    changes: list[tuple[str, Any]] = [
        ("measure or scene", {"scene": SCENE.replace(P=1000.0)}),
        ("measure or scene", {"measure": lambda scene: 2 * fj.growth_rate(scene)}),
        ("axes", {"D": D + 1e-9}),
        ("batch size", {"batch_size": 8}),
        ("measure or scene, arrays of the measure", {"measure": lambda s: (s.contact.P,)}),
    ]
    for differ, change in changes:
        with pytest.raises(ValueError, match=f"holds another sweep: {differ} differ$"):
            swept(**change)
    with pytest.raises(ValueError, match="holds another sweep: measure or scene, axes differ"):
        fj.sweep(fj.growth_rate, SCENE, 4, False, out=tmp_path, G=G, D=D)
    assert files() == before


def test_a_full_disk_loses_one_batch(tmp_path, monkeypatch):
    """The k-th file that does not fit: what was there before it stays, and is used."""
    open_file, written = Path.open, []

    class Full(io.FileIO):
        def write(self, _):
            raise OSError(errno.ENOSPC, "No space left on device")

    def open_full(path, mode="r", *args, **options):
        if "w" not in mode:
            return open_file(path, mode, *args, **options)
        written.append(path)
        return (Full if len(written) == failing else open_file)(path, mode)

    monkeypatch.setattr(Path, "open", open_full)
    failing = 0
    whole = grown(batch_size=4, out=tmp_path / "whole")
    files, store = len(written), len(written) - 2 * 5  # in all, and before the first of 5 batches
    for k in (1, 4, store, store + 1, store + 2, store + 5, files):
        out, failing = tmp_path / str(k), k
        written.clear()
        with pytest.raises(OSError, match=rf"No space left on device: .*{k}"):
            grown(batch_size=4, out=out)
        complete = max(0, k - 1 - store) // 2
        assert out.exists() == (k > store)
        if out.exists():
            assert (xarray.open_zarr(out).computed.values > 0).sum() == 3 * complete
        there, failing = store if out.exists() else 0, 0
        written.clear()
        np.testing.assert_array_equal(grown(batch_size=4, out=out), whole)
        assert len(written) == files - there - 2 * complete
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


_SETUP = """
    import sys
    import jax
    jax.config.update("jax_enable_x64", True)
    import numpy as np
    import fractaljax as fj
    if len(sys.argv) > 2:  # one of several processes
        jax.distributed.initialize(f"127.0.0.1:{sys.argv[1]}", 2, int(sys.argv[2]))
    scene = fj.brake_scene()
    axes = dict(D=np.linspace(2.35, 2.45, 40), G=np.geomspace(5e-11, 3e-10, 25))
"""


def start(program, *arguments, devices=1):
    """A Python process of its own that runs a program after the common lines."""
    text = textwrap.dedent(_SETUP) + textwrap.dedent(program)
    return subprocess.Popen(
        [sys.executable, "-c", text, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={
            "JAX_NUM_CPU_DEVICES": str(devices),
            "JAX_PLATFORMS": "cpu",
            "PATH": "/usr/bin:/bin",
        },
    )


def expected():
    axes: dict[str, Any] = {"D": np.linspace(2.35, 2.45, 40), "G": np.geomspace(5e-11, 3e-10, 25)}
    return fj.sweep(fj.growth_rate, SCENE, progress=False, **axes)


@pytest.mark.slow  # starts Python with eight devices, and compiles there
def test_eight_devices(tmp_path):
    program = """
        assert len(jax.devices()) == 8
        def measure(scene):
            # A loop whose length is each point's own.
            steps = jax.lax.while_loop(lambda i: i < 100 * (scene.contact.surface.D - 2),
                                       lambda i: i + 1, 0)
            return fj.growth_rate(scene), steps
        growth, steps = fj.sweep(measure, scene, 64, False, **axes).values
        np.testing.assert_array_equal(steps[:, 0], np.ceil(100 * (axes["D"] - 2)))
        three = fj.sweep(fj.growth_rate, scene, devices=jax.devices()[:3], progress=False, **axes)
        np.testing.assert_allclose(three, growth, rtol=1e-9)
        try:
            fj.sweep(fj.growth_rate, scene, 63, False, **axes)
        except ValueError as error:
            print(error)
        np.save(sys.argv[1], growth)
    """
    file = tmp_path / "growth.npy"
    run = start(program, file, devices=8)
    output, _ = run.communicate(timeout=300)
    assert run.returncode == 0, output
    assert "batch_size must be a multiple of the number of devices, 8, got 63" in output
    np.testing.assert_allclose(np.load(file), expected(), rtol=1e-9)


@pytest.mark.slow  # starts Python twice, and compiles there
def test_two_processes(tmp_path):
    import socket

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = """
        import pathlib
        rank, folder = int(sys.argv[2]), pathlib.Path(sys.argv[3])
        assert jax.process_count() == 2
        try:
            fj.sweep(fj.growth_rate, scene, 50, False, **axes)
        except ValueError as error:
            print(error)
        from fractaljax._sweep.store import Store
        mine, write = [], Store.write
        def counted(self, k, arrays):
            mine.append(k)
            write(self, k, arrays)
        Store.write = counted
        growth = fj.sweep(fj.growth_rate, scene, 50, False, out=folder / "sweep", **axes)
        assert mine == list(range(rank, 20, 2)), mine
        np.save(folder / f"{rank}.npy", growth)
    """
    runs = [start(program, port, rank, tmp_path) for rank in range(2)]
    outputs = [run.communicate(timeout=300)[0] for run in runs]
    for rank, (run, output) in enumerate(zip(runs, outputs, strict=True)):
        assert run.returncode == 0, output
        assert "out must name a folder that all processes share, got None" in output
        np.testing.assert_allclose(np.load(tmp_path / f"{rank}.npy"), expected(), rtol=1e-9)
