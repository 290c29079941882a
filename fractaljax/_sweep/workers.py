"""The batches of a sweep on the workers of an executor: threads, processes, other machines.

The measure, the scene and the axes are sent. A worker traces them itself, under the settings of JAX
that the sweep was called under, and refuses unless its program has the digest of the caller's: no
worker computes in 32 bits, or something else, unnoticed. Results are sent back, and the caller
alone stores them: a batch that an executor computes again, because its worker died, counts once.
"""

import functools
import os
import queue
import secrets
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from typing import Any

import numpy as np

from .._base import process
from .._base.parts import brief, one_line
from .._base.versions import version_text
from .batches import Batches, mesh_of
from .blocks import Blocks
from .program import Program, settings, use_settings

Computed = Generator[
    tuple[int, list[np.ndarray]], None, None
]  # the number of a batch, and its leaves
_lock = threading.RLock()  # a worker may have several threads, and compiles once


class Job:
    """One sweep, sent to another process as bytes that are read when it is first needed."""

    def __init__(
        self,
        measure: Callable,
        names: Sequence[str],
        scene: Any,
        grid: Sequence[np.ndarray],
        blocks: Blocks,
        program: Program,
    ):
        self._token = secrets.token_hex(16)
        self._caller = os.getpid(), process.MARK
        self._settings = settings()
        self._bytes: bytes | None = None
        self._parts = measure, names, scene, grid, blocks, program.digest, version_text()
        self._batches: Batches | None = Batches(program, scene, grid, blocks, mesh_of(None))

    def __eq__(self, other):
        return isinstance(other, Job) and self._token == other._token

    def __hash__(self):
        return hash(self._token)

    def __reduce__(self):
        return _arrived, (self._token, self._caller, self._settings, self.pack())

    def pack(self) -> bytes:
        """The measure, scene and axes as bytes.

        **Raises:** `TypeError` if they cannot be sent, `ImportError` without cloudpickle.
        """
        if self._bytes is not None:
            return self._bytes
        pickler = cloudpickle()
        try:
            self._bytes = content = pickler.dumps(self._parts)
        except Exception as error:  # whatever the classes in it raise
            raise TypeError(
                f"executor cannot send measure and x to its workers: {one_line(error)}"
            ) from None
        return content

    @property
    def sent(self) -> bool:
        """True in a worker, to which the job came as bytes."""
        return self._batches is None

    def require_no_fork(self) -> None:
        """Refuse to compute in a fork of the caller, where JAX stops for good."""
        pid, mark = self._caller
        if mark == process.MARK and pid != os.getpid():
            raise ValueError(
                "executor must not fork, which JAX does not survive:"
                ' ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
            )

    def compute(self, k: int) -> list[np.ndarray]:
        """The leaves (*shape of batch k, ...)."""
        self.require_no_fork()
        with use_settings(self._settings):
            with _lock:
                batches = self._batches or _prepared(self)
                begun = batches.begin(k)
            return batches.end(k, begun)


def _arrived(token: str, caller: tuple, jax_settings: dict[str, Any], content: bytes) -> Job:
    job = Job.__new__(Job)
    job._token, job._caller, job._settings = token, caller, jax_settings
    job._bytes, job._batches = content, None
    return job


def cloudpickle() -> Any:
    """The package that sends functions and arrays. **Raises:** `ImportError` without it."""
    try:
        import cloudpickle
    except ImportError:
        raise ImportError(
            "executor needs cloudpickle unless its workers are threads: "
            'python -m pip install "fractaljax[sweep]"'
        ) from None
    return cloudpickle


@functools.lru_cache(maxsize=4)
def _prepared(job: Job) -> Batches:
    # Under the settings of the job: without 64 bits its arrays would be rounded.
    measure, names, scene, grid, blocks, digest, versions = cloudpickle().loads(job.pack())
    program = Program(measure, names, scene, grid)
    if program.digest != digest:
        raise RuntimeError(
            f"a worker of executor has {version_text()}, and traces another program than its caller"
            f" with {versions}: the same packages and numbers at the top of modules are needed"
        )
    return Batches(program, scene, grid, blocks, mesh_of(None))


def _computed(job: Job, k: int) -> list[np.ndarray]:
    """Compute batch k in a worker; errors that cannot be sent become `RuntimeError`."""
    try:
        return job.compute(k)
    except Exception as error:
        if not job.sent:
            raise
        pickler = cloudpickle()
        try:
            pickler.loads(pickler.dumps(error))
        except Exception:  # some errors of Equinox: they would end a process pool
            raise RuntimeError(f"batch {k}: {one_line(error)}") from None
        raise


def gathered(executor: Any, job: Job, batches: Sequence[int], hint: str) -> Computed:
    """Each batch by its number with its leaves, in the order of completion.

    If one fails, those that are running are still yielded before its error is raised.
    """
    if not isinstance(executor, ThreadPoolExecutor):
        job.pack()
    done: queue.SimpleQueue = queue.SimpleQueue()
    running: dict[Any, int] = {}
    failed: BaseException | None = None
    try:
        try:
            for k in batches:
                future = executor.submit(_computed, job, k)
                running[future] = k
                future.add_done_callback(done.put)
        except BrokenExecutor as error:
            failed = error
        while running:
            future = done.get()
            k = running.pop(future)
            if future.cancelled():
                continue
            if (error := future.exception()) is None:
                yield k, future.result()
            elif failed is None:
                failed = error
                for other in list(running):
                    other.cancel()
    finally:
        for future in running:
            future.cancel()
    if isinstance(failed, BrokenExecutor):
        raise RuntimeError(f"a worker of executor died; {hint}: {one_line(failed)}") from failed
    if failed is not None:
        failed.add_note(hint)
        raise failed


def require_executor(executor: Any) -> None:
    """Refuse an object without the interface of `concurrent.futures`.

    **Raises:** `TypeError`.
    """
    methods = (getattr(executor, name, None) for name in ("submit", "map"))
    if isinstance(executor, type) or not all(map(callable, methods)):
        raise TypeError(
            "executor must have the methods of concurrent.futures.Executor, such as"
            f" ThreadPoolExecutor() has, got {brief(executor)}"
        )
