"""What a sweep computes at a point, as a traced program: equal programs have equal digests.

A digest covers every operation with its parameters, every constant that any part of the program
captured, and the settings of JAX that change numbers. It leaves out what changes no value: names,
derivative rules, addresses. (The StableHLO text of JAX would be shorter to hash. It takes four
times as long, and whether it holds the captured constants depends on a flag of JAX.)
"""

import contextlib
import enum
import hashlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend.core import (
    ClosedJaxpr,  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]
    Jaxpr,
    Literal,
    jaxpr_as_fun,
)
from jaxtyping import ArrayLike, PyTree

from .._base.programs import TRACED_UNDER
from .._mechanism.quantities import substituted
from .._mechanism.scene import Scene

_SETTINGS = ("jax_enable_x64", "jax_threefry_partitionable", "jax_default_matmul_precision")
# Other parameters of these operations change no value: shardings, derivative rules, names.
_MEANT = {
    "jit": ("jaxpr", "compiler_options_kvs"),
    "custom_jvp_call": ("call_jaxpr",),
    "custom_vjp_call": ("call_jaxpr",),
    "checkpoint": ("jaxpr",),
    "custom_vmap_call": ("call", "rule"),
    "reduce": ("jaxpr", "dimensions"),
}
_HARMLESS = ("debug_callback", "debug_print")  # return no value
_PLAIN = (type(None), str, bytes, bool, int, float, complex, np.dtype, enum.Enum, type)


class Program:
    """`measure` at the point of a grid where the quantities `names` have given values.

    Traced anew for every sweep, so that captured values are current. Programs are equal if their
    results are.
    """

    def __init__(
        self,
        measure: Callable[[Scene], PyTree[ArrayLike]],
        names: Sequence[str],
        scene: Any,
        grid: Sequence[np.ndarray],
        place: Callable[[Any, Mapping[str, Any]], Any] = substituted,
    ):
        """`place` gives the scene at a point, from the whole and the values there by name."""

        def point(scene, values):
            scene_at_point = place(scene, dict(zip(names, values, strict=True)))
            return jax.tree.map(jnp.asarray, measure(scene_at_point))

        values = [jax.ShapeDtypeStruct((), axis.dtype) for axis in grid]
        # `shapes` is the pytree of the measure at one point.
        self._jaxpr, self.shapes = jax.make_jaxpr(point, return_shape=True)(scene, values)
        self._axes = [None] * len(jax.tree.leaves(scene)) + [0] * len(names)
        self._digest = Digest(self._jaxpr)

    def __call__(self, scene: Scene, values: Sequence[jax.Array]) -> list[jax.Array]:
        """The arrays of the measure at one point."""
        return jaxpr_as_fun(self._jaxpr)(*jax.tree.leaves((scene, values)))

    @property
    def digest(self) -> bytes:
        """Equal for equal programs, in every process; external calls of a program do not count."""
        return self._digest.digest

    @property
    def branches(self) -> bool:
        """True for a program whose length depends on its numbers."""
        return _branches(self._jaxpr.jaxpr)

    def _identity(self):
        return self._digest.digest, self._digest.outside

    def __hash__(self):
        return hash(self._digest.digest)

    def __eq__(self, other):
        return isinstance(other, Program) and self._identity() == other._identity()

    def __repr__(self):
        outside = self._digest.outside
        return f"{type(self).__name__}({self._digest.digest.hex()}, {outside})"

    def key(self) -> bytes:
        """The digest, the same in every process.

        **Raises:** `ValueError` for a measure that calls Python or native functions while it runs.
        """
        digest = self._digest
        if any(name == "custom_vmap_call" for name, _ in digest.outside):
            # For two points the rules of `custom_vmap` are written out. Calls that are left are
            # not mapped, and their rules not used.
            avals: Any = self._jaxpr.in_avals
            pair = [
                jax.ShapeDtypeStruct(aval.shape if axis is None else (2, *aval.shape), aval.dtype)
                for aval, axis in zip(avals, self._axes, strict=True)
            ]
            mapped = jax.vmap(jaxpr_as_fun(self._jaxpr), self._axes)
            digest = Digest(jax.make_jaxpr(mapped)(*pair))
        for name, called in digest.outside:
            if name not in (*_HARMLESS, "custom_vmap_call") and not _only_raises(called):
                raise ValueError(
                    f"out needs a measure that JAX traces as a whole: what its {name} does is not"
                    " in the program"
                )
        return digest.digest


def _branches(jaxpr: Jaxpr) -> bool:
    inner = (jax.tree.leaves(equation.params, is_leaf=_is_program) for equation in jaxpr.eqns)
    return any(equation.primitive.name in ("while", "cond") for equation in jaxpr.eqns) or any(
        _branches(x.jaxpr if isinstance(x, ClosedJaxpr) else x)
        for x in itertools.chain.from_iterable(inner)
        if _is_program(x)
    )


def _is_program(x: Any) -> bool:
    return isinstance(x, (Jaxpr, ClosedJaxpr))


def settings() -> dict[str, Any]:
    """The settings of JAX under which this thread traces programs."""
    return {name: getattr(jax.config, name) for name in TRACED_UNDER}


@contextlib.contextmanager
def use_settings(settings: Mapping[str, Any]) -> Iterator[None]:
    """Let this thread trace and run programs under the settings of another one."""
    with contextlib.ExitStack() as stack:
        for name, value in settings.items():
            stack.enter_context(getattr(jax, name.removeprefix("jax_"))(value))
        yield


def _only_raises(called) -> bool:
    """True for the callback of `eqx.error_if`, which raises or is never called."""
    function = getattr(called, "callback_func", None)
    return getattr(function, "__module__", None) == "equinox._errors"


class Digest:
    """SHA-256 of a program; `outside` lists what it calls and does not contain, by operation."""

    def __init__(self, program: ClosedJaxpr):
        self.outside: list[tuple[str, Any]] = []
        self._digests: dict[int, bytes] = {}
        settings = [str(getattr(jax.config, name)) for name in _SETTINGS]
        self.digest = _sha(repr((settings, self._plain(program, ""))).encode())

    def _plain(self, x: Any, name: str) -> Any:
        """x, a parameter of the operation `name`, as tuples of text and bytes unique to it."""
        if isinstance(x, _PLAIN):
            return repr(x)
        if isinstance(x, jax.core.Tracer):  # of a rule for derivatives of an implicit solver
            return "traced", *_aval(x.aval)
        if hasattr(x, "dtype") and hasattr(x, "__array__"):  # an array of NumPy or JAX, or similar
            return array_digest(x)
        if isinstance(x, ClosedJaxpr):
            return self._jaxpr(x.jaxpr), self._plain(x.consts, name)
        if isinstance(x, Jaxpr):
            return self._jaxpr(x)
        if isinstance(x, jax.core.AbstractValue):
            return _aval(x)
        if type(x).__name__ == "PRNGImpl":  # a tuple of functions
            return "PRNGImpl", x.name
        if isinstance(x, (tuple, list)):
            return type(x).__name__, *(self._plain(member, name) for member in x)
        if isinstance(x, (set, frozenset, Mapping)):
            members = x.items() if isinstance(x, Mapping) else x
            return "unordered", *sorted(repr(self._plain(member, name)) for member in members)
        if isinstance(x, jax.tree_util.PyTreeDef):
            return "tree", self._plain(x.node_data(), name), self._plain(x.children(), name)
        if isinstance(x, (jax.sharding.Sharding, jax.sharding.AbstractMesh)):
            return "sharding"  # where numbers are stored, not their values
        text = repr(x)
        if type(x).__module__.startswith("jax.") and not any(w in text for w in (" at 0x", "...")):
            return type(x).__qualname__, text  # a JAX object that its text describes fully
        self.outside.append((name, x))
        return type(x).__qualname__

    def _jaxpr(self, jaxpr: Jaxpr) -> bytes:
        # Parts of a program are shared: each is read once.
        if id(jaxpr) in self._digests:
            return self._digests[id(jaxpr)]
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
            name, parameters = equation.primitive.name, equation.params
            # In another version of JAX they may have other names: then all of them count.
            if set(meant := _MEANT.get(name, parameters)) <= set(parameters):
                parameters = {key: parameters[key] for key in meant}
            if name == "ffi_call":
                self.outside.append((name, equation.params["target_name"]))
            lines.append((name, *map(old, equation.invars), self._plain(parameters, name)))
            lines.append([new(v) for v in equation.outvars])
        lines.append([old(v) for v in jaxpr.outvars])
        self._digests[id(jaxpr)] = digest = _sha(repr(lines).encode())
        return digest


def _aval(x):
    return str(x), getattr(x, "weak_type", None)


def array_digest(x) -> bytes:
    """SHA-256 of an array with its dtype and shape, or of the data of a `jax.random` key."""
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return _sha(str(x.dtype).encode() + array_digest(jax.random.key_data(x)))
    return _sha(repr((str(x.dtype), x.shape)).encode() + np.asarray(x).tobytes())


def _sha(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()
