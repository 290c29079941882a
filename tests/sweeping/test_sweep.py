"""Sweeps: the grid, batches of one shape, folders to go on with, devices and processes."""

import builtins
import errno
import io
import json
import subprocess
import sys
import textwrap
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.base import scene_file
from fractaljax.base.versions import versions
from fractaljax.sweeping.shards import Shards
from fractaljax.sweeping.sweep import _batch

SCENE = fj.brake_scene()
D = np.linspace(2.35, 2.45, 5)
G = np.geomspace(5e-11, 3e-10, 3)


def measured(D, G):
    """Growth rates over the grid without a sweep."""
    return np.array([[fj.growth_rate(SCENE.replace(D=d, G=g)) for g in G] for d in D])


def grown(D=D, **options):
    return fj.sweep(fj.growth_rate, SCENE, progress=False, D=D, G=G, **options)


@pytest.mark.parametrize("batch_size", [None, 4, 64])
def test_every_point_once_and_in_its_place(batch_size):
    found = grown(batch_size=batch_size)
    assert isinstance(found, np.ndarray)
    np.testing.assert_allclose(found, measured(D, G), rtol=1e-9)


def test_axes_come_in_the_order_given():
    found = fj.sweep(fj.growth_rate, SCENE, progress=False, G=G, D=D)
    np.testing.assert_array_equal(found, grown().T)


def test_one_axis_of_one_point():
    found = fj.sweep(fj.growth_rate, SCENE, progress=False, P=[1907.3])
    np.testing.assert_allclose(found, [fj.growth_rate(SCENE)], rtol=1e-9)


def test_three_axes_and_the_trees_of_a_measure():
    mu = [0.3, 0.4]
    found = fj.sweep(fj.stability, SCENE, 7, False, D=D, G=G, mu_s=mu)
    assert isinstance(found, fj.Stability)
    assert found.eigenvalues.shape == (5, 3, 2, 4)
    np.testing.assert_allclose(found.growth_rate[:, :, 1], measured(D, G), rtol=1e-9)
    alone = fj.stability(SCENE.replace(D=D[4], G=G[1], mu_s=mu[0]))
    np.testing.assert_allclose(found.eigenvalues[4, 1, 0], alone.eigenvalues, rtol=1e-9)


def test_outcomes_are_measures_as_well():
    def regime(scene):
        return scene.contact.state(scene.friction.mu_s, scene.friction.mu_m).regime

    found = fj.sweep(regime, SCENE, progress=False, G=[1e-10, 1e-6])
    assert list(found == fj.Regime.fully_plastic) == [False, True]


def test_ratios_are_axes_as_well():
    ratios = [0.2, 0.4]
    axes: dict[str, Any] = {"K_t/K_n": ratios}
    found = fj.sweep(fj.growth_rate, SCENE, progress=False, **axes)
    each = [fj.growth_rate(SCENE.replace(stiffness_ratio=ratio)) for ratio in ratios]
    np.testing.assert_allclose(found, each, rtol=1e-9)


def test_one_program_serves_every_batch_and_every_sweep_of_a_kind():
    traces = []

    def measure(scene):
        traces.append(1)
        return fj.growth_rate(scene)

    programs: Any = _batch
    compiled = programs._cache_size()
    fj.sweep(measure, SCENE, 4, False, D=D, G=G)
    fj.sweep(measure, SCENE.replace(P=2000.0), 4, False, D=D + 0.01, G=G)
    fj.sweep(lambda scene: fj.growth_rate(scene), SCENE, 4, False, D=D, G=G)
    assert programs._cache_size() <= compiled + 1
    assert len(traces) == 2


def test_what_a_measure_captures_is_taken_as_it_is_now(tmp_path):
    factor = [1.0]

    def measure(scene):
        return factor[0] * scene.contact.surface.D

    for out in (None, tmp_path):
        factor[0] = 1.0
        np.testing.assert_array_equal(fj.sweep(measure, SCENE, None, False, out=out, D=D), D)
        factor[0] = 2.0
        if out is None:
            np.testing.assert_array_equal(fj.sweep(measure, SCENE, None, False, D=D), 2 * D)
        else:
            with pytest.raises(ValueError, match="holds another sweep: measure or scene differ"):
                fj.sweep(measure, SCENE, None, False, out=out, D=D)


def test_progress_goes_to_standard_error(capsys):
    fj.sweep(fj.growth_rate, SCENE, 4, D=D, G=G)
    shown = capsys.readouterr()
    assert shown.out == "" and "15.0/15.0" in shown.err
    grown()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "axes, said",
    [
        ({}, "sweep needs an axis, such as D=[2.3, 2.4]"),
        ({"d": [2.4]}, "scene has no quantity 'd'; it has D, G, "),
        ({"friction": [2.4]}, "scene has no quantity 'friction'; it has D, G, "),
        ({"mu": [0.3], "mu_s": [0.4]}, "quantities must be independent, got mu and mu_s"),
        ({"D": 2.4}, "the values of D must be a list, got shape ()"),
        ({"D": []}, "the values of D must be a list, got shape (0,)"),
        ({"D": [2.4, 3.1]}, "D must be above 2 and below 3, got 3.1"),
        ({"D": [2.4, np.nan]}, "D must be finite, got nan"),
        ({"mu_s": [0.4, 0.3], "mu_m": [0.2, 0.35]}, "mu_s must be at least mu_m = 0.35, got 0.3"),
        # At the corners the friction law is above its minimum, which is inside.
        ({"V": [0.05, 0.5, 0.95], "mu": [0.3, 1.2]}, "mu_m must be at most 0.9, got 1.2"),
        (
            {"D": [2.4], "v_m": [0.05, 0.15, 0.95], "P": [1e3, 2e3], "mu": [0.3, 1.2]},
            "mu_m must be at most 0.9, got 1.2",
        ),
    ],
)
def test_bad_axes(axes, said):
    with pytest.raises(ValueError) as error:
        fj.sweep(fj.growth_rate, SCENE, progress=False, **axes)
    assert said in str(error.value)


@pytest.mark.parametrize("batch_size", [0, -1, 2.5, True])
def test_bad_batch_size(batch_size):
    with pytest.raises(ValueError, match="batch_size must be an integer of at least 1, got"):
        grown(batch_size=batch_size)


def test_scene_with_arrays():
    with pytest.raises(ValueError, match="D must be a scalar"):
        fj.sweep(fj.growth_rate, SCENE.replace(D=D), G=G)


# --- folders ------------------------------------------------------------------------------


def test_an_interrupted_sweep_loses_one_batch(tmp_path, monkeypatch):
    written, write = [], Shards.write

    def interrupted(self, k, arrays):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(k)
        write(self, k, arrays)

    with monkeypatch.context() as patch:
        patch.setattr(Shards, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            grown(batch_size=4, out=tmp_path / "sweep")
    assert written == [0, 1]

    def counted(self, k, arrays):
        written.append(k)
        write(self, k, arrays)

    monkeypatch.setattr(Shards, "write", counted)
    found = grown(batch_size=4, out=tmp_path / "sweep")
    assert written == [0, 1, 2, 3]
    np.testing.assert_array_equal(found, grown(batch_size=4))
    np.testing.assert_array_equal(grown(out=tmp_path / "sweep"), found)  # batch size from there
    assert written == [0, 1, 2, 3]


def test_the_values_come_from_the_folder(tmp_path, monkeypatch):
    found = grown(batch_size=4, out=tmp_path)
    with np.load(tmp_path / "00000003.npz") as last:
        np.testing.assert_array_equal(last["arr_0"], found.ravel()[12:])
    monkeypatch.setattr(Shards, "write", None)
    np.testing.assert_array_equal(grown(batch_size=4, out=tmp_path), found)


@pytest.mark.parametrize("batch", ["own", "shorter", "other", "elsewhere"])
def test_a_batch_of_another_make_is_refused(tmp_path, batch):
    """Whole files of the right name: by hand, too short, of another place, of another sweep."""
    out, file = tmp_path / "sweep", tmp_path / "sweep" / "00000001.npz"
    grown(batch_size=4, out=out)
    if batch == "own":
        np.savez(file, arr_0=np.arange(4.0))
    elif batch == "shorter":
        np.savez(file, arr_0=np.arange(1.0))
    elif batch == "other":
        file.write_bytes((out / "00000000.npz").read_bytes())
    else:
        fj.sweep(fj.growth_rate, SCENE, 4, False, out=tmp_path / "b", D=D + 1e-9, G=G)
        file.write_bytes((tmp_path / "b" / "00000001.npz").read_bytes())
    with pytest.raises(
        ValueError, match=r"00000001\.npz cannot be read, remove it and sweep again"
    ):
        grown(batch_size=4, out=out)
    file.unlink()
    np.testing.assert_array_equal(grown(batch_size=4, out=out), grown(batch_size=4))


def test_a_folder_of_other_versions(tmp_path):
    """Gone on with under a warning, one line; without any versions, in silence."""
    found = grown(batch_size=4, out=tmp_path)
    file = tmp_path / "sweep.json"
    about = json.loads(file.read_text())
    assert about["versions"] == versions()
    file.write_text(json.dumps(about | {"versions": {"fractaljax": "0.0.9", "jax": "0.1"}}))
    with pytest.warns(UserWarning) as warned:
        again = grown(batch_size=4, out=tmp_path)
    message = str(warned.pop().message)
    assert "was written by fractaljax 0.0.9, jax 0.1, read by fractaljax" in message
    assert "\n" not in message
    np.testing.assert_array_equal(again, found)
    with pytest.raises(ValueError, match=r"axes differ \(it was written by fractaljax 0\.0\.9"):
        grown(batch_size=4, out=tmp_path, D=D + 1e-9)
    del about["versions"]
    file.write_text(json.dumps(about))
    np.testing.assert_array_equal(grown(batch_size=4, out=tmp_path), found)
    with pytest.raises(ValueError, match=r"axes differ \(it was begun by an older fractaljax\)"):
        grown(batch_size=4, out=tmp_path, D=D + 1e-9)


def test_axes_in_another_order_are_another_sweep(tmp_path):
    fj.sweep(fj.growth_rate, SCENE, 4, False, out=tmp_path, D=D, G=G)
    with pytest.raises(ValueError, match="holds another sweep: measure or scene, axes differ"):
        fj.sweep(fj.growth_rate, SCENE, 4, False, out=tmp_path, G=G, D=D)


@pytest.mark.parametrize("failing", range(1, 6))
def test_a_full_disk_loses_one_batch(tmp_path, monkeypatch, failing):
    """sweep.json, then four batches: the k-th that does not fit is named, the rest stays."""
    out, files = tmp_path / "sweep", []
    open_file = builtins.open

    class Full(io.FileIO):
        def write(self, _):
            raise OSError(errno.ENOSPC, "No space left on device")

    def open_full(file, mode="r", **options):
        files.append(file)
        return (Full if len(files) == failing else open_file)(file, mode, **options)

    with monkeypatch.context() as patch:
        patch.setattr(scene_file, "open", open_full, raising=False)
        with pytest.raises(OSError, match=r"No space left on device: .*sweep"):
            grown(batch_size=4, out=out)
    kept = sorted(file.name for file in out.iterdir())
    names = ["sweep.json", *(f"{k:08d}.npz" for k in range(4))]
    assert kept == sorted(names[: failing - 1])
    np.testing.assert_array_equal(grown(batch_size=4, out=out), grown(batch_size=4))


def test_more_points_than_memory():
    """Before any of it is taken."""
    many = np.full(10**5, 2.4)
    with pytest.raises(
        ValueError, match=r"a sweep of 1000000000000000 points would take 8\.00e.15 b"
    ):
        fj.sweep(fj.growth_rate, SCENE, progress=False, D=many, G=many * 1e-10, P=many * 1e3)
    with pytest.raises(ValueError, match="a batch of 1000000000000000 points would take"):
        grown(batch_size=10**15)


def test_a_folder_of_another_sweep_is_refused(tmp_path):
    grown(batch_size=4, out=tmp_path)
    before = sorted(file.name for file in tmp_path.iterdir())

    def refused(measure: Any = fj.growth_rate, scene=SCENE, batch_size=4, D=D):
        with pytest.raises(ValueError) as error:
            fj.sweep(measure, scene, batch_size, False, out=tmp_path, D=D, G=G)
        return str(error.value)

    other = f"out {tmp_path} holds another sweep: "
    assert refused(scene=SCENE.replace(P=1000.0)) == other + "measure or scene differ"
    assert refused(lambda scene: 2 * fj.growth_rate(scene)) == other + "measure or scene differ"
    assert refused(D=D + 1e-9) == other + "axes differ"
    assert refused(batch_size=8) == other + "batch size differ"
    assert refused(lambda s: (s.contact.P,)) == (
        other + "measure or scene, arrays of the measure differ"
    )
    assert sorted(file.name for file in tmp_path.iterdir()) == before


@pytest.mark.parametrize("jit", [jax.jit, eqx.filter_jit])
def test_what_a_jitted_measure_captures_makes_another_sweep(tmp_path, jit):
    def measure_for(a):
        a = jnp.asarray(a)
        return jit(lambda scene: a[0] + a[1] * scene.contact.surface.D)

    found = fj.sweep(measure_for([0.0, 1.0]), SCENE, None, False, out=tmp_path, D=D)
    np.testing.assert_array_equal(found, D)
    with pytest.raises(ValueError, match="holds another sweep: measure or scene differ"):
        fj.sweep(measure_for([100.0, 200.0]), SCENE, None, False, out=tmp_path, D=D)


def test_two_equal_functions_are_one_sweep(tmp_path):
    fj.sweep(lambda scene: 2 * fj.growth_rate(scene), SCENE, progress=False, out=tmp_path, D=D)
    fj.sweep(lambda scene: 2 * fj.growth_rate(scene), SCENE, progress=False, out=tmp_path, D=D)


# --- devices and processes ----------------------------------------------------------------

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


def start(program, *arguments, flags=""):
    """A Python process of its own that runs a program after the common lines."""
    text = textwrap.dedent(_SETUP) + textwrap.dedent(program)
    environment = {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PATH": "/usr/bin:/bin"}
    return subprocess.Popen(
        [sys.executable, "-c", text, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
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
        growth, steps = fj.sweep(measure, scene, 64, False, **axes)
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
    run = start(program, file, flags="--xla_force_host_platform_device_count=8")
    said, _ = run.communicate(timeout=300)
    assert run.returncode == 0, said
    assert "batch_size must be a multiple of the number of devices, 8, got 63" in said
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
        from fractaljax.sweeping.shards import Shards
        mine, write = [], Shards.write
        def counted(self, k, arrays):
            mine.append(k)
            write(self, k, arrays)
        Shards.write = counted
        growth = fj.sweep(fj.growth_rate, scene, 50, False, out=folder / "sweep", **axes)
        assert mine == list(range(rank, 20, 2)), mine
        np.save(folder / f"{rank}.npy", growth)
    """
    runs = [start(program, port, rank, tmp_path) for rank in range(2)]
    outputs = [run.communicate(timeout=300)[0] for run in runs]
    for rank, (run, said) in enumerate(zip(runs, outputs, strict=True)):
        assert run.returncode == 0, said
        assert "out must name a folder that all processes share, got None" in said
        np.testing.assert_allclose(np.load(tmp_path / f"{rank}.npy"), expected(), rtol=1e-9)


def test_several_arrays_a_point_and_batches_that_fit():
    found = fj.sweep(fj.stiffness, SCENE, 5, False, D=D, G=G)
    alone = fj.stiffness(SCENE.replace(D=D[2], G=G[2]))
    np.testing.assert_allclose([found[0][2, 2], found[1][2, 2]], jnp.stack(alone), rtol=1e-12)
