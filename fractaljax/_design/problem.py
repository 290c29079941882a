"""A design problem: what is moved, what is best, and what is required, as one compiled program.

A design is scaled variables u in [0, 1]^v, linear in a quantity or, where it is a scale, in its
logarithm. Every requirement is a residual: at most 0 where it is met, of order one, continuous and
informative on both sides of every regime boundary. A fully plastic joint knows by ln(a_l/a_e) how
far it is from carrying load elastically. Where quantities scatter, a residual is its quantile.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.batches import in_batches
from .._base.parts import brief, flag, require_kind, require_scalar, scalar
from .._base.quick import quick_jit
from .._base.ranges import low_discrepancy
from .._contact.contact import Contact
from .._dynamics.scaled import degrees_of_freedom, hybrid_system
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    joints_of,
    known_quantities,
    own_quantities,
    replaced,
    require_independent,
    require_one,
    substituted,
    value_of,
    with_optional,
)
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .._stability.linearise import assembled
from .._stability.quadratic import leading
from .._stability.stability import growth_rate
from .coalescence import of_neighbours, of_scene
from .constraints import Constraint, CycleConstraint, Plain
from .cuts import Cuts
from .envelope import Envelope
from .followed import FollowedCycles
from .joints import (
    is_fractal,
    least_damping,
    moved_contacts,
    of_joint,
    slips,
    states_of,
    under,
    with_stiffness,
)
from .tolerance import Tolerance, nodes, quantile

DEFAULT_BOUNDS: dict[str, tuple[float, float]] = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)}

_LOOKED_AT = 15  # designs, besides the given one, in which growing modes are counted
_MODES_MOST = 16  # that requirements are made of
UNKNOWN = 1e3  # stands for a residual without a number
_BATCH = 32  # designs, each at one condition, evaluated at once
# Structures take so long that filling up a batch costs more than a call.
_BATCH_OF_STRUCTURES, _SMALL = 8, 16  # of at most so many degrees of freedom; of larger ones 1


class Scatter(eqx.Module):
    """The quadrature over a tolerance, and the quantile that counts."""

    tolerance: Tolerance
    base: dict[str, Float[Array, ""]]  # what the quantities are where nothing moves them
    shifts: Float[Array, "n k"]
    weights: Float[Array, " n"]
    level: Float[Array, ""]


class DesignProblem(eqx.Module):
    """What a design asks; problems that differ in leaves alone share one compiled program."""

    x: Any  # the given scene or structure
    low: Float[Array, " v"]  # bounds of the variables, logarithms of scales
    high: Float[Array, " v"]
    start: Float[Array, " v"]  # the given design, scaled
    own_condition: Float[Array, " c"]  # what the quantities of the envelope are in `x`
    target: Float[Array, ""]  # largest growth rate allowed [1/s]
    growth_scale: Float[Array, ""]
    K_n_min: tuple[Float[Array, ""], ...]  # of each of the contacts
    area_ratio_min: Float[Array, ""]
    slip_ratio_max: Float[Array, ""]
    constraints: tuple[Constraint, ...]
    laws: tuple[Contact, ...]  # under each of which the growth rate must be as low
    scatter: Scatter | None
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    contacts: tuple[str, ...] = eqx.field(static=True)  # with a law, that the design moves
    objective: Callable[[Any], Any] | None = eqx.field(static=True)
    friction_slope: bool = eqx.field(static=True)
    conditions: tuple[str, ...] = eqx.field(static=True)  # quantities of the envelope
    modes: int = eqx.field(static=True, default=0)  # that a structure must keep from growing
    # Whether rows end with what solvers follow in the place of growth rates.
    smooth: bool = eqx.field(static=True, default=False)
    cuts: Cuts | None = None
    cycles: FollowedCycles | None = None  # where a requirement or the objective is of a cycle

    # --- in JAX: one design at one condition ---------------------------------------------

    def quantities(self, u: Float[Array, " v"]) -> dict[str, Array]:
        """The designed quantities at scaled variables u."""
        values = self.low + u * (self.high - self.low)
        return {
            name: jnp.exp(value) if logarithmic else value
            for name, logarithmic, value in zip(self.names, self.logarithmic, values, strict=True)
        }

    def moved(self, u: Float[Array, " v"], condition: Float[Array, " c"], shift=None) -> Any:
        """The scene or structure at scaled variables u, a condition and perhaps a shift (k,)."""
        values = self.quantities(u) | dict(zip(self.conditions, condition, strict=True))
        if self.scatter is not None and shift is not None:
            values |= self.scatter.tolerance.scattered(self.x, self.scatter.base | values, shift)
        return substituted(self.x, values)

    def _row(self, u, condition, shift=None):
        """Objective and residuals (1 + k,), and the numbers that describe a design, by name."""
        x = self.moved(u, condition, shift)
        states, stiff_x = self.stiffened(x)
        smooth, rates = [], []
        for each in (stiff_x, *(under(x, law) for law in self.laws)):
            if self.modes:
                # The rates are NaN where there is no steady sliding; LAPACK gets numbers even so.
                attached = assembled(each, self.friction_slope, refuse=False)
                found = leading(*attached[:3], self.modes, x.band)
                rates += list(jnp.where(attached.lost, jnp.nan, found.s.real))
                if not self.least_growth:
                    smooth += list(of_neighbours(found, self.target, self.growth_scale))
                elif each is stiff_x:
                    smooth += list(jnp.arcsinh(found.s.real / self.growth_scale))
            else:
                rates.append(growth_rate(each, self.friction_slope))
                smooth += of_scene(
                    each, self.friction_slope, rates[-1], self.target, self.growth_scale
                )
        growth = rates[0]
        model, stiff = self.of_joints(states)
        pressing = [jnp.arcsinh((rate - self.target) / self.growth_scale) for rate in rates]
        # Cycles are followed outside of this program.
        own = [
            jnp.zeros_like(growth) if isinstance(asked, CycleConstraint) else jnp.asarray(asked(x))
            for asked in self.constraints
        ]
        if self.cuts is not None:
            own += list(self.cuts.residuals(u))
        if self.objective is None:
            value = jnp.sum((u - self.start) ** 2)
        else:
            value = growth if self.least_growth else self.objective(x)
        numbers = {}
        if "" in states and x.contact.has_surface:  # of a scene
            numbers |= {"D": x.contact.surface.D, "G": x.contact.surface.G}
        numbers |= self.quantities(u) | {"objective": value, "growth_rate": growth}
        for name, state in states.items():
            for key in ("K_n", "K_t", "log_area_ratio", "slip_ratio"):
                if getattr(state, key) is not None:
                    numbers[of_joint(name) + key] = getattr(state, key)
        row = [jnp.asarray(value, growth.dtype), *model, *pressing, *stiff, *own]
        return jnp.stack(row + smooth * self.smooth), numbers

    def stiffened(self, x) -> tuple[dict[str, Any], Any]:
        """States of the contacts of `x` that have one or move, and `x` with their stiffness."""
        parts = joints_of(x)
        asked = {
            name: part
            for name, part in parts.items()
            if part.contact.fractal or name in self.contacts
        }
        states = states_of(asked)
        # The load curve of a joint is that of its own law.
        known = {
            name: state for name, state in states.items() if not parts[name].follows_load_curve
        }
        return states, with_stiffness(x, known)

    def of_joints(self, states: Mapping[str, Any]) -> tuple[list[Array], list[Array]]:
        """Residuals of contacts in known states: inside the model, and stiff enough."""
        model, stiff = [], []
        for name, K_n_min in zip(self.contacts, self.K_n_min, strict=True):
            state = states[name]
            if state.log_area_ratio is not None:
                model.append(2 * (jnp.log(self.area_ratio_min) - state.log_area_ratio))
            if state.slip_ratio is not None:
                model.append(10 * (state.slip_ratio - self.slip_ratio_max))
            stiff.append((K_n_min - state.K_n) / jnp.where(K_n_min > 0, K_n_min, 1))
        return model, stiff

    def at(self, u: Float[Array, " v"], condition: Float[Array, " c"]):
        """As `_row`; quantiles, and no more than the row, where quantities scatter.

        The default objective is the distance of the design as ordered, without scatter.
        """
        if self.scatter is None:
            return self._row(u, condition)
        rows = jax.vmap(lambda shift: self._row(u, condition, shift)[0])(self.scatter.shifts)
        row = quantile(rows, self.scatter.weights, self.scatter.level)
        return (row if self.objective is not None else row.at[0].set(rows[0, 0])), {}

    # --- in NumPy: many ------------------------------------------------------------------

    @property
    def robust(self) -> bool:
        """Whether there is an envelope or a tolerance."""
        return bool(self.conditions) or self.scatter is not None

    @property
    def light(self) -> bool:
        """Whether a row takes less time than its call: the source's law, and nothing besides."""
        more = self.robust or self.modes or self.laws or self.constraints or self.objective
        return isinstance(self.x, Scene) and self.x.contact.fractal and not more

    @property
    def least_growth(self) -> bool:
        """Whether the objective is the growth rate of a structure, the largest of many modes'."""
        return self.modes > 0 and self.objective is growth_rate

    @property
    def growth_columns(self) -> slice:
        """Where in a row the growth rates are, of the modes by each law."""
        first = 1 + self.model_residuals
        return slice(first, first + max(self.modes, 1) * (1 + len(self.laws)))

    @property
    def joint_columns(self) -> np.ndarray:
        """Which columns (1 + k,) of a row `limits_of_joints` gives."""
        columns = np.arange(len(self.asked))
        last = self.growth_columns.stop
        stiff = (columns >= last) & (columns < last + len(self.contacts))
        return stiff | ((columns > 0) & (columns <= self.model_residuals))

    @property
    def asked(self) -> np.ndarray:
        """Which columns (1 + k,) of a row are the objective and the requirements by name."""
        named, laws = 1 + len(self.residual_names), 1 + len(self.laws)
        smooth = self.modes if self.least_growth else (self.modes or 2) * laws
        return np.arange(named + self.smooth * smooth) < named

    @property
    def rounding(self) -> float:
        """Of a residual."""
        return 3e4 * float(np.finfo(self.low.dtype).eps)

    @property
    def model_residuals(self) -> int:
        """How many residuals, the first, keep the joints inside the model."""
        return sum(is_fractal(self.x, name) + slips(self.x, name) for name in self.contacts)

    @property
    def residual_names(self) -> list[str]:
        """The requirements, as results show them and in their order."""
        model, stiff = [], []
        for name in self.contacts:
            of = f"{name}: " if name else ""
            model += [f"{of}a_l >= area_ratio_min a_e"] * is_fractal(self.x, name)
            model += [f"{of}Q_e <= slip_ratio_max mu_s P"] * slips(self.x, name)
            stiff.append(f"{of}K_n >= K_n_min")
        own = [asked.name for asked in self.constraints]
        if self.cuts is not None:
            own += [f"cut {k}" for k in range(len(self.cuts.reach))]
        growing = ["growth_rate <= target"]
        growing += [f"growth_rate of mode {i} <= target" for i in range(2, self.modes + 1)]
        by = [f"{name} by {type(law).__name__}" for law in self.laws for name in growing]
        return [*model, *growing, *by, *stiff, *own]

    def scaled(self, x: Mechanism) -> np.ndarray:
        """The scaled variables (v,) of a scene or structure."""
        values = np.array([float(value_of(x, name)) for name in self.names])
        values = np.log(values, out=values, where=self.logarithmic)
        low, high = np.asarray(self.low, float), np.asarray(self.high, float)
        return np.clip((values - low) / (high - low), 0, 1)


def linearise(problem: DesignProblem, us: np.ndarray, conditions: np.ndarray):
    """Rows (n, 1 + k), their Jacobians (n, 1 + k, v), and what describes designs us (n, v).

    Each design is at a condition (n, c).
    """
    program = _linearise_light if problem.light else _linearise
    rows, jacobians, numbers = _in_batches(program, problem, us, conditions)
    rows, jacobians = rows.astype(float), jacobians.astype(float)
    if problem.cycles is not None:
        problem.cycles.fill(problem, us, rows, jacobians)
        numbers = numbers | {"objective": rows[:, 0]}
    return rows, jacobians, numbers


def evaluate(problem: DesignProblem, us: np.ndarray, conditions: np.ndarray) -> np.ndarray:
    """Objective and residuals (n, 1 + k) of designs us (n, v), each at a condition (n, c)."""
    if not problem.robust:
        return linearise(problem, us, conditions)[0]  # compiled already
    return _in_batches(_evaluate, problem, us, conditions).astype(float)


def limits_of_joints(
    problem: DesignProblem, us: np.ndarray, conditions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What joints alone require (n, r) of designs us (n, v), and Jacobians: no eigenvalues.

    Each design is at a condition (n, c). Stiffness counts by its logarithm, which many steps of a
    design change evenly.
    """
    dtype = problem.low.dtype
    pairs = np.asarray(us, dtype), np.asarray(conditions, dtype)
    return in_batches(functools.partial(_limits_of_joints, problem), _BATCH, *pairs)


def describe(problem: DesignProblem, us: np.ndarray) -> dict[str, np.ndarray]:
    """Quantities and results (n,) of designs us (n, v), as they are, without scatter."""
    nominal = dataclasses.replace(problem, scatter=None)
    own = np.broadcast_to(np.asarray(problem.own_condition), (len(us), len(problem.conditions)))
    return linearise(nominal, us, own)[2]


def _in_batches(program, problem, us, conditions):
    problem = dataclasses.replace(problem, cycles=None)
    dtype = problem.low.dtype
    pairs = np.asarray(us, dtype), np.asarray(conditions, dtype)
    batch = _BATCH
    if problem.modes:
        batch = _BATCH_OF_STRUCTURES if problem.x.n <= _SMALL else 1
    return in_batches(functools.partial(program, problem), batch, *pairs)


def linearised(problem: DesignProblem, us, conditions):
    """What `linearise` compiles."""

    def one(u, condition):
        def row(u):
            row, numbers = problem.at(u, condition)
            return row, (row, numbers)

        jacobian, (value, numbers) = jax.jacfwd(row, has_aux=True)(u)
        return value, jacobian, numbers

    return jax.vmap(one)(us, conditions)


_linearise, _linearise_light = quick_jit(linearised), quick_jit(linearised, once=True)


@quick_jit
def _evaluate(problem: DesignProblem, us, conditions):
    return jax.vmap(lambda u, condition: problem.at(u, condition)[0])(us, conditions)


@quick_jit
def _limits_of_joints(problem: DesignProblem, us, conditions):
    def required(u, condition, shift=None):
        joints = joints_of(problem.moved(u, condition, shift))
        model, stiff = problem.of_joints(
            states_of({name: joints[name] for name in problem.contacts})
        )
        return jnp.stack([*model, *stiff])

    def residuals(u, condition):
        if problem.scatter is None:
            found = required(u, condition)
        else:
            found = jax.vmap(lambda shift: required(u, condition, shift))(problem.scatter.shifts)
            found = quantile(found, problem.scatter.weights, problem.scatter.level)
        model, stiff = jnp.split(found, [problem.model_residuals])
        both = jnp.concatenate([model, -jnp.log1p(-stiff)])
        return both, both

    def one(u, condition):
        slopes, values = jax.jacfwd(residuals, has_aux=True)(u, condition)
        return values, slopes

    return jax.vmap(one)(us, conditions)


# --- checks --------------------------------------------------------------------------------


def state_problem(
    x: Mechanism,
    bounds: Mapping[str, Sequence[float]],
    *,
    objective: Callable[[Any], Any] | None,
    target: float | None,
    K_n_min: float | None,
    constraints: Sequence[Callable[[Any], Any]],
    envelope: Envelope | None,
    tolerance: Tolerance | None,
    quantile: float,
    area_ratio_min: float,
    slip_ratio_max: float,
    friction_slope: bool,
    risk: Any = "worst",
    laws: Sequence[Contact] = (),
    **_: Any,
) -> DesignProblem:
    """Check the arguments of `design` that state a problem, which that documents; no others."""
    require_one("x", x)
    if objective is not None and not callable(objective):
        raise TypeError(f"objective must be a function of a scene, got {brief(objective)}")
    if not isinstance(constraints, (list, tuple)) or not all(map(callable, constraints)):
        raise TypeError(
            f"constraints must be a list of functions of a scene, got {brief(constraints)}"
        )
    if not isinstance(laws, (list, tuple)):
        raise TypeError(f"laws must be a list of contacts, got {brief(laws)}")
    for i, law in enumerate(laws):
        require_kind(f"laws[{i}]", law, Contact)
        require_scalar(law)
    if (
        laws
        and not isinstance(x, Scene)
        and not any(joint.contact.has_surface for joint in joints_of(x).values())
    ):
        raise ValueError("laws of a structure need a joint whose contact has a surface")
    for law in laws:
        under(x, law)  # refuses one that a joint cannot have
    bounds = checked_bounds(x, bounds)
    cycles = _cycles(x, objective, constraints, envelope is not None or tolerance is not None)
    objective = _followed if isinstance(objective, CycleConstraint) else objective
    numbers: dict[str, Any] = dict(
        area_ratio_min=scalar("area_ratio_min", area_ratio_min, at_least=1),
        slip_ratio_max=scalar("slip_ratio_max", slip_ratio_max, above=0, at_most=1),
    )
    level = scalar("quantile", quantile, at_least=0.5, at_most=0.999)
    ranges: dict[str, Sequence[float]] = dict(bounds)
    conditions = ()
    if envelope is not None:
        envelope.check(x, tuple(bounds))
        conditions = envelope.names
        ranges |= envelope.ranges | envelope.samples
    scatter = None
    if tolerance is not None:
        tolerance.check(x, ranges)
        z, weights = nodes(len(tolerance.names))
        shifts = tolerance.shifts(z)
        scatter = Scatter(
            tolerance, tolerance.base(x), jnp.asarray(shifts), jnp.asarray(weights), level
        )
    require_independent(x, tuple(ranges))
    everything = dict.fromkeys([*ranges, *(tolerance.quantities if tolerance else ())])
    logarithmic = tuple(_is_scale(x, name) and low > 0 for name, (low, _) in bounds.items())
    own = [float(value_of(x, name)) for name in bounds]
    ends = np.array([*zip(*bounds.values(), strict=True), own])
    low, high, own = np.log(ends, out=ends, where=logarithmic)
    damping, frequency = least_damping(x)
    own_condition = np.array([float(value_of(x, name)) for name in conditions])
    x = with_optional(x, tuple(everything))
    contacts = moved_contacts(x, bounds)
    least = 0.0 if K_n_min is None else scalar("K_n_min", K_n_min, at_least=0)
    dtype = jax.tree.leaves(x)[0].dtype
    numbers |= dict(
        low=low,
        high=high,
        start=(own - low) / (high - low),
        own_condition=own_condition,
        target=-damping / 2 if target is None else scalar("target", target),
        growth_scale=max(damping, 1e-4 * frequency),
        K_n_min=(least,) * len(contacts),
        constraints=tuple(c if isinstance(c, Constraint) else Plain(c) for c in constraints),
        laws=tuple(laws),
        scatter=scatter,
    )
    # In the precision of the scene, whatever that of the arguments.
    numbers = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), numbers)
    problem = DesignProblem(
        x=x,
        **numbers,
        names=tuple(bounds),
        logarithmic=logarithmic,
        contacts=contacts,
        objective=objective,
        friction_slope=flag("friction_slope", friction_slope),
        conditions=conditions,
        cycles=cycles,
    )
    if isinstance(x, Structure):
        problem = dataclasses.replace(problem, modes=_modes_to_keep(problem))
    # An average or a quantile of smooth residuals is not that of the growth rates.
    smooth = problem.least_growth or (scatter is None and risk == "worst")
    problem = dataclasses.replace(problem, smooth=smooth)
    if K_n_min is not None or not contacts:
        return problem
    given = describe(problem, np.asarray(problem.start)[None])
    own = tuple(jnp.asarray(given[of_joint(name) + "K_n"][0], dtype) for name in contacts)
    return dataclasses.replace(problem, K_n_min=own)


def _modes_to_keep(problem: DesignProblem) -> int:
    """How many modes may grow: two more than grow in any of a few designs."""
    designs = np.concatenate(
        [np.asarray(problem.start)[None], low_discrepancy(_LOOKED_AT, len(problem.names))]
    )
    modes = max(2, min(_MODES_MOST, problem.x.n))
    looking = dataclasses.replace(problem, scatter=None, modes=modes)
    own = np.broadcast_to(
        np.asarray(problem.own_condition), (len(designs), len(problem.conditions))
    )
    rows = _in_batches(_evaluate, looking, designs, own)[:, looking.growth_columns]
    growing = (rows > 0).reshape(len(rows), -1, modes).sum(axis=2)  # by each law
    return min(int(growing.max()) + 2, modes)


def _followed(x) -> float:
    """Stands for an objective that `FollowedCycles` fills in."""
    return 0.0


def _cycles(x, objective, constraints, robust: bool) -> FollowedCycles | None:
    """What follows the cycles of the designs, where something is asked of them."""
    of_cycle = objective if isinstance(objective, CycleConstraint) else None
    asked = [each for each in constraints if isinstance(each, CycleConstraint)]
    if of_cycle is None and not asked:
        return None
    if robust:
        raise ValueError(f"{(of_cycle or asked[0]).symbol} takes no envelope and no tolerance")
    n = degrees_of_freedom(x)
    hybrid_system(x)  # refuses a joint without V
    for each in asked if of_cycle is None else [of_cycle, *asked]:
        if each.dof >= n:
            raise ValueError(f"dof of {each.symbol} must be below {n}, got {each.dof}")
        if each is not of_cycle and each.at_most is None:
            raise ValueError(f"{each.symbol} as a requirement needs at_most")
    return FollowedCycles(of_cycle)


def checked_bounds(x: Mechanism, bounds: Mapping[str, Sequence[float]]) -> dict[str, tuple]:
    """Bounds by name, each (lower, upper), in their domain and around the value that `x` has."""
    if not isinstance(bounds, Mapping):
        raise TypeError(f"bounds must be a mapping, got {brief(bounds)}")
    known = known_quantities(x)
    for name in bounds:
        if name not in known:
            raise ValueError(f"bounds on {brief(name)}: there are {', '.join(known)}")
    if not bounds:
        raise ValueError("bounds must name a quantity, got none")
    checked = {}
    for name, given in bounds.items():
        if not isinstance(given, (tuple, list, np.ndarray)) or not np.ndim(given):
            raise TypeError(f"bounds on {name} must be (lower, upper), got {brief(given)}")
        ends = tuple(float(scalar(f"{name} bound", end)) for end in given)
        for end in ends:
            replaced(x, {name: end})  # refuses an end outside the domain of the model
        if not (len(ends) == 2 and ends[0] < ends[1]):
            raise ValueError(f"bounds on {name} must be (lower, upper), got {given!r}")
        value = float(value_of(x, name))
        if not ends[0] <= value <= ends[1]:
            raise ValueError(
                f"{name} must lie inside its bounds [{ends[0]:g}, {ends[1]:g}], got {value:g}"
            )
        checked[name] = ends
    return checked


def _is_scale(x, name) -> bool:
    own = own_quantities(x)
    return name in own and own[name].log
