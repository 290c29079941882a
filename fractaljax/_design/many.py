"""The designs of many mechanisms at once, by one compiled program."""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import Record, brief, flag, is_traced, whole
from .._contact.contact import Contact
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import replaced, require_one, separate_quantities, value_of
from .._sweep.program import Program
from .._sweep.sweep import run
from .constraints import CycleConstraint
from .growing_modes import largest_mode_count, needs_modes
from .optimum import Optimum, optimum
from .problem import DesignProblem
from .result import DesignResult, is_met
from .statement import DEFAULT_BOUNDS

_MEMBER = "member"  # the axis of a batch in a store


class DesignMany(Record):
    """What `design_many` returns: arrays in the shape of the batch, in SI units.

    The quantities are attributes, too: `designs.D`, and by name: `designs["left.D"]`.
    """

    mechanisms: Any = eqx.field(repr=False)  # as given; a batch
    quantities: Mapping[str, Float[Array, "..."]]  # the designed ones, by name
    value: Float[Array, "..."]  # the objective; by default the squared scaled distance
    growth_rate: Float[Array, "..."]  # [1/s]
    residuals: Float[Array, "... k"]  # at most 0 where a requirement is met
    result: Any  # members of `DesignResult`
    residual_names: tuple[str, ...] = eqx.field(static=True)  # names of the k requirements
    target: Float[Array, "..."]  # largest growth rate allowed [1/s]

    @property
    def met(self) -> Array:
        """True for each member whose design meets every requirement."""
        return is_met(self.result)

    @property
    def member(self) -> Any:
        """The first of the mechanisms as given."""
        return _members(self.mechanisms)[0]

    def mechanism_quantity(self, name: str) -> np.ndarray:
        """Values of the quantity `name` of the mechanisms as given, in the shape of the batch."""
        first, stacked, shape = _members(self.mechanisms)
        return np.asarray(_values(first, stacked, name)).reshape(shape)

    def designed(self) -> Any:
        """The designed mechanisms: a batch, or a list as given.

        Those without a number are as given.
        """
        values = {
            name: np.where(np.isnan(column), self.mechanism_quantity(name), column)
            for name, column in self.quantities.items()
        }
        if not isinstance(self.mechanisms, (list, tuple)):
            return replaced(self.mechanisms, values)
        rows = zip(*values.values(), strict=True)
        return [
            replaced(x, dict(zip(values, row, strict=True)))
            for x, row in zip(self.mechanisms, rows, strict=True)
        ]

    def __getitem__(self, name: str) -> Array:
        return self.quantities[name]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "quantities" or name not in self.quantities:
            raise AttributeError(f"a DesignMany has no attribute {name!r}")
        return self.quantities[name]

    def __repr__(self) -> str:
        if is_traced(self.value):
            return super().__repr__()
        met = np.asarray(self.met)
        lines = [f"{met.size} designs, {int(met.sum())} of which meet every requirement"]
        for name, values in self.quantities.items():
            inside = np.asarray(values)[met]
            if inside.size:
                lines.append(f"{name}: {inside.min():.6g} to {inside.max():.6g}")
        for member in (DesignResult.infeasible, DesignResult.undetermined):
            count = int(np.sum(np.asarray(self.result == member)))
            if count:
                lines.append(f"{count} {DesignResult[member]}")
        return "\n".join(lines)


def design_many(
    xs: Mechanism | Sequence[Mechanism],
    bounds: Mapping[str, Sequence[float]] | None = None,
    objective: Callable[[Any], Any] | None = None,
    target: ArrayLike | None = None,
    K_n_min: ArrayLike | None = None,
    constraints: Sequence[Callable[[Any], Any]] = (),
    *,
    laws: Sequence[Contact] = (),
    tolerance: Any = None,
    quantile: ArrayLike = 0.95,
    area_ratio_min: ArrayLike = 2.0,
    slip_ratio_max: ArrayLike = 0.9,
    friction_slope: bool = True,
    modes: int | None = None,
    starts: int = 10,
    lattice: int = 256,
    steps: int = 40,
    batch_size: int | None = None,
    progress: bool = True,
    out: str | os.PathLike | None = None,
    devices: Sequence[Any] | None = None,
) -> DesignMany:
    """The best design of each of many mechanisms, as `design` finds it, in one program.

    `design_many(scene.replace(P=loads), bounds={"D": (2.3, 2.8), "G": (1e-11, 1e-9)})` designs a
    surface for every load; `jax.grad` and `jax.vmap` go through it, with derivatives that follow
    from the conditions of an optimum.

    **Arguments:**

    - `xs`: a scene or structure whose named quantities are arrays of any shape, which broadcast, or
      a list of mechanisms of one kind.
    - `bounds`, `objective`, `target`, `K_n_min`, `constraints`, `laws`, `tolerance`, `quantile`,
      `area_ratio_min`, `slip_ratio_max`, `friction_slope`: as `design`, for every member alike;
      what is by default a member's own (`target`, `K_n_min`) is that of each.
    - `modes`: as `DesignProblem`; by default at most 16 of a structure.
    - `starts`: designs from which each is solved, 10 by default.
    - `lattice`: designs that are screened for them, 256 by default.
    - `steps`: most steps from each start, 40 by default.
    - `batch_size`: members side by side, by default 256 a device, 16 of structures. This and what
      follows have no meaning under `jax.jit`, `jax.grad` and `jax.vmap`, where all members are one
      program.
    - `progress`: shows a bar.
    - `out`: a folder in which batches are kept, so that the same call resumes (see `sweep`).
    - `devices`: those that share each batch, by default all of this process.

    A member without a design does not stop the others: its `result` says so, its quantities are
    those of the best design found, and derivatives by it are NaN. In single precision derivatives
    are good to a digit. The growth rate of a structure as the objective has kinks where modes
    change places, at which a search may end: then `design` is the better choice. Envelopes and
    limits on cycles are left to `design`.

    **Raises:** as `design`, and `ValueError` for members of different kinds.
    """
    request: dict[str, Any] = dict(
        objective=objective,
        constraints=constraints,
        target=target,
        K_n_min=K_n_min,
        laws=laws,
        tolerance=tolerance,
        quantile=quantile,
        area_ratio_min=area_ratio_min,
        slip_ratio_max=slip_ratio_max,
        friction_slope=friction_slope,
    )
    for each in (objective, *constraints):
        if isinstance(each, CycleConstraint):
            raise ValueError(f"design_many takes no {each.symbol}: use design")
    starts, lattice = whole("starts", starts, 1, 1000), whole("lattice", lattice, 8, 100_000)
    steps, progress = whole("steps", steps, 1, 1000), flag("progress", progress)
    bounds = DEFAULT_BOUNDS if bounds is None else bounds
    first, stacked, shape = _members(xs)
    if not is_traced(stacked):
        # What is wrong with the arguments is said of a member that is there.
        most = largest_mode_count(first) if needs_modes(first) else None
        lowest: Any = 0.0 if K_n_min is None else K_n_min  # its own would take a program
        checked = DesignProblem(
            first, bounds, modes=modes or most, **{**request, "K_n_min": lowest}
        )
        _check_inside(first, stacked, bounds)

    names: list[str] = []

    def designed(x) -> tuple[Optimum, Array]:
        problem = DesignProblem(x, bounds, modes=modes, **request)
        names[:] = problem.residual_names
        return optimum(problem, starts, lattice, steps), problem.target

    count = int(np.prod(shape, dtype=int))
    if is_traced((stacked, target, K_n_min)):
        every = jax.jit(jax.vmap(lambda leaves: designed(_at(first, leaves))))
        optima, targets = every(stacked)
    else:
        grid = {_MEMBER: np.arange(count, dtype=np.int32)}

        def place(leaves, values):
            return _at(first, [leaf[values[_MEMBER]] for leaf in leaves])

        program = Program(designed, (_MEMBER,), stacked, [*grid.values()], place)
        each = 16 if needs_modes(first) else 256
        if checked.scatter is not None:  # each design is as many as its quadrature has nodes
            each = max(1, each // len(checked.scatter.weights))
        how: dict[str, Any] = dict(each=each, batch_size=batch_size, progress=progress)
        optima, targets = run(
            program, stacked, grid, first, design_many, **how, out=out, devices=devices
        )
    optima, targets = jax.tree.map(lambda a: a.reshape(shape + a.shape[1:]), (optima, targets))
    return DesignMany(
        mechanisms=xs,
        quantities=optima.quantities,
        value=optima.value,
        growth_rate=optima.growth_rate,
        residuals=optima.residuals,
        result=optima.result,
        residual_names=tuple(names),
        target=targets,
    )


def _members(xs: Any) -> tuple[Any, list[Array], tuple[int, ...]]:
    """The first member, the leaves of all of them (n, ...) and the shape of the batch."""
    if isinstance(xs, (list, tuple)):
        if not xs:
            raise ValueError("xs must hold at least one mechanism, got none")
        for i, x in enumerate(xs):
            require_one(f"xs[{i}]", x)
            if not _same_kind(x, xs[0]):
                raise ValueError(f"xs must be mechanisms of one kind: xs[{i}] differs from xs[0]")
        leaves = zip(*(jax.tree.leaves(x) for x in xs), strict=True)
        return xs[0], [jnp.stack(each) for each in leaves], (len(xs),)
    if not isinstance(xs, Mechanism):
        raise TypeError(f"xs must be a mechanism with arrays, or a list, got {brief(xs)}")
    many = {
        name: each.value
        for name, each in separate_quantities(xs).items()
        if each.value is not None and each.value.ndim
    }
    shape = jnp.broadcast_shapes(*(value.shape for value in many.values()))
    first = replaced(xs, {name: value.reshape(-1)[0] for name, value in many.items()})
    require_one("a member of xs", first)
    pairs = zip(jax.tree.leaves(xs), jax.tree.leaves(first), strict=True)
    leaves = [jnp.broadcast_to(a if a.ndim > b.ndim else b, shape + b.shape) for a, b in pairs]
    return first, [a.reshape(-1, *a.shape[len(shape) :]) for a in leaves], shape


def _same_kind(x: Mechanism, other: Mechanism) -> bool:
    """True if two mechanisms differ in numbers alone."""
    kinds = [jax.tree.map(lambda a: (a.shape, a.dtype), each) for each in (x, other)]
    return kinds[0] == kinds[1] if jax.tree.structure(x) == jax.tree.structure(other) else False


def _at(first: Mechanism, leaves: Sequence[Array]) -> Any:
    """A mechanism like the first one, of these leaves."""
    return jax.tree.unflatten(jax.tree.structure(first), leaves)


def _values(first, stacked, name: str) -> Array:
    return jax.vmap(lambda leaves: value_of(_at(first, leaves), name))(stacked)


def _check_inside(first, stacked, bounds: Mapping[str, Sequence[float]]) -> None:
    """Refuse a member with a designed quantity outside its bounds."""
    for name, (low, high) in bounds.items():
        values = np.asarray(_values(first, stacked, name))
        outside = values[~((values >= low) & (values <= high))]
        if outside.size:
            raise ValueError(
                f"{name} must lie inside its bounds [{low:g}, {high:g}] in every member, got "
                f"{outside[0]:g}"
            )
