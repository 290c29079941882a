"""What a sweep computes at a point, as a traced program: equal programs have equal digests.

A digest covers every operation with its parameters, and every constant that any part of the
program captured. It leaves out what does not change a value: names, derivative rules, where
functions lie in memory.
"""

import enum
import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from ..mechanism.quantities import substituted

# Settings of JAX that change numbers and need not show in a program.
_SETTINGS = ("jax_enable_x64", "jax_threefry_partitionable", "jax_default_matmul_precision")
_OWN_VMAP = "custom_vmap_call"
# Of these operations other parameters change no value: shardings, rules of derivatives, names.
_MEANT = {
    "jit": ("jaxpr", "compiler_options_kvs"),
    "custom_jvp_call": ("call_jaxpr",),
    "custom_vjp_call": ("call_jaxpr",),
    "checkpoint": ("jaxpr",),
    _OWN_VMAP: ("call", "rule"),
    "reduce": ("jaxpr", "dimensions"),
}
_SHOWN = ("debug_callback", "debug_print")  # give no value


class Program:
    """`measure` at the point of a grid where the quantities `names` have given values.

    Traced anew for every sweep, so that what the measure captured is taken as it is now. Programs
    are equal where their results are.
    """

    def __init__(self, measure: Callable, names: Sequence[str], scene, grid: Sequence[np.ndarray]):
        def point(scene, values):
            moved = substituted(scene, dict(zip(names, values, strict=True)))
            return jax.tree.map(jnp.asarray, measure(moved))

        values = [jax.ShapeDtypeStruct((), axis.dtype) for axis in grid]
        self._jaxpr, shapes = jax.make_jaxpr(point, return_shape=True)(scene, values)
        self._scene_leaves = len(jax.tree.leaves(scene))
        self.shapes = shapes  # of a point: the pytree of the measure
        self._digest = Digest(self._jaxpr)

    def __call__(self, scene, values) -> list[jax.Array]:
        """The arrays of the measure at one point."""
        return jaxpr_as_fun(self._jaxpr)(*jax.tree.leaves((scene, values)))

    def __hash__(self):
        return hash(self._digest.digest)

    def __eq__(self, other):
        return isinstance(other, Program) and (
            (self._digest.digest, self._digest.python)
            == (other._digest.digest, other._digest.python)
        )

    def key(self) -> bytes:
        """The digest, the same in every process.

        **Raises:** `ValueError` for a measure that calls Python or native functions while it runs.
        """
        digest, harmless = self._digest, _SHOWN
        if any(name == _OWN_VMAP for name, _ in digest.python):
            # What is left of them is not mapped, and so not by their rules.
            digest, harmless = Digest(self._of_two()), (*_SHOWN, _OWN_VMAP)
        for name, called in digest.python:
            if name not in harmless and not _raises(called):
                raise ValueError(
                    f"out needs a measure that JAX traces as a whole: what its {name} does is not"
                    " in the program"
                )
        return digest.digest

    def _of_two(self) -> ClosedJaxpr:
        """The program of two points: the rules of `custom_vmap` are written out in it."""
        avals, fixed = self._jaxpr.in_avals, self._scene_leaves
        axes = [None] * fixed + [0] * (len(avals) - fixed)
        shapes = [
            jax.ShapeDtypeStruct(a.shape if axis is None else (2, *a.shape), a.dtype)
            for a, axis in zip(avals, axes, strict=True)
        ]
        return jax.make_jaxpr(jax.vmap(jaxpr_as_fun(self._jaxpr), axes))(*shapes)


def _raises(called) -> bool:
    """Whether a callback is that of `eqx.error_if`, which raises or is not called at all."""
    function = getattr(called, "callback_func", None)
    return getattr(function, "__module__", None) == "equinox._errors"


class Digest:
    """SHA-256 of a program; `python` lists what it calls that is not in it, (operation, object)."""

    def __init__(self, program: ClosedJaxpr):
        self.python: list[tuple[str, Any]] = []
        self._known: dict[int, bytes] = {}
        settings = [str(getattr(jax.config, name)) for name in _SETTINGS]
        self.digest = _sha(repr((settings, self._plain(program))).encode())

    def _plain(self, x, name: str = "") -> Any:
        """What tells x, of the operation `name`, from others: tuples of texts, numbers, bytes."""
        if x is None or isinstance(x, (str, bytes)):
            return x
        if isinstance(x, (bool, np.bool_, int, np.integer)):
            return int(x)
        if hasattr(x, "dtype") and hasattr(x, "__array__"):  # of NumPy, of JAX, or in between
            return array_digest(x)
        if isinstance(x, (float, complex)):
            return repr(x)
        if isinstance(x, ClosedJaxpr):
            return self._jaxpr(x.jaxpr), self._plain(x.consts, name)
        if isinstance(x, Jaxpr):
            return self._jaxpr(x)
        if isinstance(x, (np.dtype, jax.core.AbstractValue)):
            return _aval(x)
        if isinstance(x, enum.Enum):
            return type(x).__qualname__, x.name
        if isinstance(x, type):
            return x.__module__, x.__qualname__
        if isinstance(x, (jax.sharding.Sharding, jax.sharding.AbstractMesh)):
            return "sharding"  # where numbers are, not which
        if type(x).__name__ == "PRNGImpl":
            return "PRNGImpl", x.name
        if isinstance(x, (tuple, list)):
            return type(x).__name__, *(self._plain(member, name) for member in x)
        if isinstance(x, (set, frozenset)):
            return "set", *sorted(repr(self._plain(member, name)) for member in x)
        if isinstance(x, Mapping):
            return "mapping", *sorted(repr((k, self._plain(value, name))) for k, value in x.items())
        if isinstance(x, jax.tree_util.PyTreeDef):
            return "tree", self._plain(x.node_data(), name), self._plain(x.children(), name)
        self.python.append((name, x))
        return type(x).__qualname__

    def _jaxpr(self, jaxpr: Jaxpr) -> bytes:
        if id(jaxpr) in self._known:
            return self._known[id(jaxpr)]
        numbers: dict[Any, int] = {}

        def new(variable):
            numbers[variable] = len(numbers)
            return _aval(variable.aval)

        def old(variable):
            if isinstance(variable, Literal):
                aval: Any = variable.aval
                return _aval(aval), array_digest(np.asarray(variable.val, aval.dtype))
            return numbers[variable]

        lines: list[Any] = [[new(v) for v in (*jaxpr.constvars, *jaxpr.invars)]]
        for equation in jaxpr.eqns:
            name = equation.primitive.name
            parameters, meant = equation.params, _MEANT.get(name)
            # Of another version of JAX they may have other names: then all of them count.
            if meant is not None and set(meant) <= set(parameters):
                parameters = {key: parameters[key] for key in meant}
            if name == "ffi_call":
                self.python.append((name, equation.params["target_name"]))
            lines.append((name, *map(old, equation.invars), self._plain(parameters, name)))
            lines.append([new(v) for v in equation.outvars])
        lines.append([old(v) for v in jaxpr.outvars])
        # Parts of a program are shared: one that was read once is not read again.
        self._known[id(jaxpr)] = found = _sha(repr(lines).encode())
        return found


def _aval(x):
    return str(x), getattr(x, "weak_type", None)


def array_digest(x) -> bytes:
    """SHA-256 of an array, its dtype and shape; of a key of `jax.random`, of its data."""
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return _sha(str(x.dtype).encode() + array_digest(jax.random.key_data(x)))
    return _sha(repr((str(x.dtype), x.shape)).encode() + np.asarray(x).tobytes())


def _sha(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()
