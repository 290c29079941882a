"""Executors: what travels to their workers, what comes back, and what happens when one dies."""

import collections
import contextlib
import multiprocessing
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._sweep.batches import Batches
from fractaljax._sweep.store import Store
from fractaljax._sweep.workers import Job

SCENE = fj.brake_scene()
AXES: dict[str, Any] = {"D": np.linspace(2.35, 2.45, 6), "G": np.geomspace(5e-11, 3e-10, 5)}


def slopes(scene):
    """Growth rate and its gradient."""

    def growth(D, G):
        return fj.growth_rate(scene.replace(D=D, G=G))

    surface = scene.contact.surface
    return jax.value_and_grad(growth, (0, 1))(surface.D, surface.G)


def swept(measure=slopes, batch_size=5, **options):
    return fj.sweep(measure, SCENE, batch_size, False, **options, **AXES)


def assert_same(found, wanted):
    """To the last bit."""
    assert found.names == wanted.names
    for ours, theirs in zip(*(jax.tree.leaves(one.values) for one in (found, wanted)), strict=True):
        assert ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes()


class Posted(Executor):
    """One worker, to which calls and results go as bytes, in a process that JAX left at 32 bits."""

    def __init__(self):
        self.calls, self._pool = 0, ThreadPoolExecutor(1)

    def submit(self, function, *args, **kwargs) -> Future:
        sent = pickle.dumps((function, args, kwargs))
        self.calls += 1

        def call():
            with jax.enable_x64(False):
                function, args, kwargs = pickle.loads(sent)
                return pickle.dumps(function(*args, **kwargs))

        result: Future = Future()

        def answer(done):
            if done.exception() is None:
                result.set_result(pickle.loads(done.result()))
            else:
                result.set_exception(pickle.loads(pickle.dumps(done.exception())))

        self._pool.submit(call).add_done_callback(answer)
        return result


@pytest.mark.parametrize("store", [False, True])
def test_threads(tmp_path, store, capsys):
    out = tmp_path / "run.zarr" if store else None
    with ThreadPoolExecutor(2) as executor:
        found = fj.sweep(slopes, SCENE, 5, out=out, executor=executor, **AXES)
        assert_same(found, swept())
        assert "30.0/30.0" in capsys.readouterr().err
        if store:
            assert_same(swept(out=out), found)
            assert_same(swept(out=out, executor=executor), found)


def test_what_travels(tmp_path):
    """A closure goes as it is now; the worker computes in 64 bits as its caller does."""
    factor, executor = np.array([1.0]), Posted()

    def measure(scene):
        return factor[0] * fj.growth_rate(scene), factor * scene.contact.surface.D

    found = swept(measure, executor=executor)
    assert executor.calls == 6
    factor[0] = 2.0
    again = swept(measure, executor=executor, out=tmp_path)
    assert_same(again, swept(measure))
    np.testing.assert_array_equal(found.values[1], again.values[1] / 2)
    assert found.values[0].dtype == np.float64
    executor.calls = 0
    (tmp_path / "computed" / "c.3.0").unlink()
    assert_same(swept(measure, executor=executor, out=tmp_path), again)
    assert executor.calls == 1


def test_what_is_traced_and_settings_of_jax_travel():
    """Numbers that the worker has otherwise are an error, not another result."""
    executor = Posted()
    with pytest.raises(RuntimeError, match=r"^a worker of executor has fractaljax .* another prog"):
        swept(_counted, executor=executor)

    def draws(scene):
        return jax.random.normal(jax.random.key(0), (3,)) * scene.contact.surface.D

    for changed in (jax.threefry_partitionable(False), jax.default_prng_impl("rbg")):
        with changed:
            assert_same(swept(draws, executor=Posted()), swept(draws))


def _counted(scene):
    """Another program each time it is traced."""
    _counted.times = getattr(_counted, "times", 0) + 1
    return _counted.times * fj.growth_rate(scene)


class Stubborn:
    def __call__(self, scene):
        return fj.growth_rate(scene)

    def __reduce__(self):
        raise RuntimeError("not for sale")


def test_what_cannot_be_sent_and_what_is_no_executor(tmp_path):
    with pytest.raises(TypeError, match=r"^executor cannot send measure and x to its .*not for sa"):
        swept(Stubborn(), executor=Posted())
    with ThreadPoolExecutor(1) as executor:
        assert_same(swept(Stubborn(), executor=executor), swept(Stubborn()))
    executor: Any
    for executor in (3, ThreadPoolExecutor, "threads", multiprocessing, print):
        with pytest.raises(TypeError, match=r"^executor must have the methods of conc"):
            swept(executor=executor, out=tmp_path / "run.zarr")
    assert not list(tmp_path.iterdir())


def test_without_cloudpickle_threads_alone_compute(monkeypatch, tmp_path):
    """Also a measure that fails there has its error."""
    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    with pytest.raises(
        ImportError, match=r"^executor needs cloudpickle unless .*threads: [^\n]*p\]"
    ):
        swept(executor=Posted())
    with ThreadPoolExecutor(1) as executor:
        assert_same(swept(executor=executor), swept())
        with pytest.raises(Exception, match="D is too large here"):
            swept(limited, executor=executor)


def limited(scene):
    """A measure that fails in the second half of the grid."""
    D = scene.contact.surface.D
    return eqx.error_if(D, D > 2.4, "D is too large here")


@pytest.mark.parametrize("kind", [Posted, lambda: ThreadPoolExecutor(1)])
def test_a_batch_that_fails(tmp_path, kind, capfd):
    """Its error is raised once the others are kept, with a note on that."""
    with pytest.raises(Exception, match="D is too large here") as caught:
        swept(limited, executor=kind(), out=tmp_path / "run.zarr")
    capfd.readouterr()  # JAX reports it too
    assert caught.value.__notes__[-1].startswith(f"out {tmp_path}")
    assert len(list((tmp_path / "run.zarr" / "computed").glob("c.*"))) == 3


class Dying(Posted):
    """A pool whose process dies while it computes the third batch."""

    def submit(self, function, *args, **kwargs) -> Future:
        from concurrent.futures.process import BrokenProcessPool

        if self.calls == 3:
            raise BrokenProcessPool("the pool is not usable anymore")
        result = super().submit(function, *args, **kwargs)
        if self.calls == 3:
            result = Future()
            result.set_exception(BrokenProcessPool("a process was terminated abruptly"))
        return result


def test_a_pool_that_dies(tmp_path):
    with pytest.raises(RuntimeError, match=r"^a worker of executor died; out would keep what is d"):
        swept(executor=Dying())
    with pytest.raises(RuntimeError, match=r"^a worker .* died; out .*run\.zarr keeps what is don"):
        swept(executor=Dying(), out=tmp_path / "run.zarr")
    executor = Posted()
    assert_same(swept(executor=executor, out=tmp_path / "run.zarr"), swept())
    assert executor.calls == 4
    with pytest.raises(ValueError, match="devices are those of this process"):
        swept(executor=Posted(), devices=jax.devices())


@pytest.mark.skipif(
    "fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork"
)
@pytest.mark.filterwarnings("ignore:.*fork")  # of Python and of JAX
@pytest.mark.parametrize("running", [False, True])
def test_forks_refuse_to_compute(running, tmp_path):
    """Also processes that the pool forked before the sweep was called."""
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(1, mp_context=context) as executor:
        if running:
            assert executor.submit(os.getppid).result() == os.getpid()
        with pytest.raises(ValueError, match="executor must not fork, which JAX does not survive"):
            swept(executor=executor, out=tmp_path / "run.zarr")
    assert not list((tmp_path / "run.zarr" / "computed").glob("c.*"))


def test_threads_share_what_is_compiled(monkeypatch):
    """One tracing, and no two threads at once where a program may be compiled."""
    traces, inside, begin = [], [], Batches.begin

    def measure(scene):
        traces.append(threading.get_ident())
        return fj.growth_rate(scene)

    def alone(self, k):
        assert not inside
        inside.append(k)
        time.sleep(0.01)
        found = begin(self, k)
        inside.remove(k)
        return found

    monkeypatch.setattr(Batches, "begin", alone)
    with ThreadPoolExecutor(4) as executor:
        swept(measure, executor=executor)
    assert traces == [threading.get_ident()]


def test_a_job_is_as_large_as_what_it_holds():
    """The grid goes along, the result does not."""
    kept = []

    class Weighed(Posted):
        def submit(self, function, *args, **kwargs):
            kept.append(len(pickle.dumps(args)))
            return super().submit(function, *args, **kwargs)

    swept(executor=Weighed())
    assert len(kept) == 6 and max(kept) < 10_000
    assert Job.__module__.startswith("fractaljax.")


def spawned(workers):
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


@pytest.mark.slow
def test_a_process_pool(tmp_path):
    """Its process has 32 bits, and begins with nothing."""
    with spawned(1) as executor:
        assert executor.submit(_bits).result() == "float32"
        assert_same(swept(executor=executor, out=tmp_path / "run.zarr"), swept())


def _bits():
    return str(jax.numpy.zeros(()).dtype)


@contextlib.contextmanager
def counted(kill=lambda: None, after=0):
    """How often each batch is written; when `after` of them are, `kill` is called."""
    writes: collections.Counter = collections.Counter()
    write = Store.write

    def counting(self, k, arrays):
        if writes.total() == after:
            kill()
        writes[k] += 1
        write(self, k, arrays)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "write", counting)
        yield writes


@pytest.mark.slow  # starts Python four times, and compiles there
def test_a_process_pool_of_which_a_worker_is_killed(tmp_path):
    with spawned(2) as executor:
        assert_same(swept(executor=executor), swept())

        def kill():
            os.kill(next(iter(executor._processes)), signal.SIGKILL)

        with (
            counted(kill, 2) as first,
            pytest.raises(RuntimeError, match="a worker of executor died"),
        ):
            swept(at_length, 1, executor=executor, out=tmp_path)
    assert 3 <= first.total() < 30
    with spawned(2) as executor, counted() as second:
        assert_same(swept(at_length, 1, executor=executor, out=tmp_path), swept(at_length, 1))
    assert first + second == dict.fromkeys(range(30), 1)


@pytest.mark.slow  # starts Python four times, and compiles there
@pytest.mark.filterwarnings("ignore")  # of Dask
def test_a_dask_cluster_of_which_a_worker_is_killed(tmp_path):
    """Nothing is lost, and nothing is written twice."""
    from distributed import Client, LocalCluster

    options: Any = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    axes: dict[str, Any] = {"D": np.linspace(2.35, 2.45, 40), "G": AXES["G"]}
    wanted = fj.sweep(lambda scene: at_length(scene), SCENE, 5, False, **axes)
    with LocalCluster(processes=True, **options) as cluster, Client(cluster) as client:
        executor = client.get_executor()
        first: Any = client.run(os.getpid)
        # Both workers have the program, so that both are at work when one is killed.
        assert_same(fj.sweep(at_length, SCENE, 5, False, executor=executor, **axes), wanted)

        def kill():
            os.kill(next(iter(first.values())), signal.SIGKILL)

        with counted(kill, 20) as writes:
            found = fj.sweep(
                lambda scene: at_length(scene), SCENE, 5, False, tmp_path, executor, **axes
            )
        assert_same(found, wanted)
        assert writes == dict.fromkeys(range(40), 1)
        # It was at work: some of the 2 * 40 batches were begun again.
        begun: Any = client.run_on_scheduler(_begun)
        assert begun > 80
    assert_same(fj.sweep(at_length, SCENE, out=tmp_path, progress=False, **axes), wanted)


def _begun(dask_scheduler):
    return sum(step.finish == "processing" for step in dask_scheduler.transition_log)


def at_length(scene):
    """A batch takes some hundredths of a second."""
    once = slopes(scene)
    again = jax.lax.fori_loop(0, 500_000, lambda _, x: jax.numpy.cos(x), once[0])
    return once, again


_MPI = """
import jax
jax.config.update("jax_enable_x64", True)
from mpi4py.futures import MPIPoolExecutor
import test_workers as t
if __name__ == "__main__":
    with MPIPoolExecutor() as executor:
        found = t.swept(lambda scene: t.slopes(scene), executor=executor, out="run.zarr")
    t.assert_same(found, t.swept())
    print("the same")
"""


@pytest.mark.slow  # starts Python three times, and compiles there
def test_mpi(tmp_path):
    pytest.importorskip("mpi4py", reason="MPI has wheels for Linux and macOS alone")
    mpiexec = shutil.which("mpiexec", path=f"{Path(sys.executable).parent}{os.pathsep}{os.defpath}")
    assert mpiexec is not None
    (tmp_path / "run.py").write_text(_MPI)
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    done = subprocess.run(
        [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures", "run.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0 and "the same" in done.stdout, done.stdout + done.stderr
    with ThreadPoolExecutor(1) as executor:
        assert_same(swept(executor=executor, out=tmp_path / "run.zarr"), swept())
