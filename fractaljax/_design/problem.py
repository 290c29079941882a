"""A design problem: what is moved, what is best, and what is required, as one compiled program.

A design is scaled variables u in [0, 1]^v, linear in a quantity or, where it is a scale, in its
logarithm. Every requirement is a residual: at most 0 where it is met, of order one, continuous and
informative on both sides of every regime boundary. A fully plastic joint knows by ln(a_l/a_e) how
far it is from carrying load elastically. Where quantities scatter, a residual is its quantile.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.parts import is_traced, nan_where, refused, whole
from .._base.programs import exported_jit
from .._contact.contact import Contact
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import substituted, value_of, with_stiffness
from .._stability.stability import growth_rate
from .coalescence import neighbour_residuals, scene_residuals
from .constraints import Constraint, CycleConstraint
from .cuts import Cuts
from .envelope import Envelope
from .followed import FollowedCycles
from .growing_modes import largest_mode_count, leading_modes, modes_to_keep, needs_modes
from .joints import (
    is_fractal,
    joint_prefix,
    joint_states,
    slips,
    with_contact_law,
)
from .statement import stated_fields
from .tolerance import Scatter, quantile

UNKNOWN = 1e3  # stands for a residual without a number


class DesignProblem(eqx.Module):
    """What `design` solves, as plain functions of scaled variables u (v,) in [0, 1]^v.

    A variable is linear in its quantity between the bounds or, where the quantity is a scale such
    as G, P or a stiffness, in its logarithm. `loss`, `residuals`, `quantities` and `mechanism` are
    pure JAX: they take `jax.jit`, `jax.vmap` and both modes of derivatives, and a problem may be
    made of a traced mechanism, so that designs can be mapped over mechanisms too.

    **Arguments**, which mean what they mean for `design`:

    - `x`: a `Scene` or a `Structure`.
    - `bounds`: {name: (lower, upper)} in SI units, of the quantities that are designed.
    - `objective`: a function of a mechanism, which is minimised; by default the squared scaled
      distance from the quantities that `x` has.
    - `constraints`: functions of a mechanism that are at most 0 where they are met, of order one.
    - `target`: the largest growth rate allowed [1/s]; by default minus half the least damping rate
      without friction.
    - `K_n_min`: the least normal stiffness [N/m] of each contact that the bounds move; by default
      its own.
    - `laws`: other contact laws, under each of which the growth rate must be as low.
    - `envelope`: ranges or samples of other quantities; loss and residuals are the largest of those
      at the points of a grid over it (`design` searches between them, too).
    - `tolerance`, `quantile`: scatter of quantities; loss and residuals are their quantiles.
    - `area_ratio_min`, `slip_ratio_max`: limits of each fractal contact that the bounds move.
    - `friction_slope`: False leaves the slope of friction out of growth rates.
    - `modes`: how many modes of a structure have a growth rate of their own to keep low; by default
      two more than grow in any of a few designs, of a traced structure at most 16.

    **Raises:** `ValueError` or `TypeError` as `design`.
    """

    x: Any  # the given scene or structure
    ends: Float[Array, "2 v"]  # bounds of the quantities
    low: Float[Array, " v"]  # bounds of the variables, logarithms of scales
    high: Float[Array, " v"]  # the upper ones
    start: Float[Array, " v"]  # the given design, scaled
    nominal_condition: Float[Array, " c"]  # what the quantities of the envelope are in `x`
    target: Float[Array, ""]  # largest growth rate allowed [1/s]
    growth_scale: Float[Array, ""]  # growth rates are divided by it in residuals [1/s]
    K_n_min: tuple[Float[Array, ""], ...]  # of each of the contacts
    area_ratio_min: Float[Array, ""]
    slip_ratio_max: Float[Array, ""]
    constraints: tuple[Constraint, ...]
    laws: tuple[Contact, ...]  # under each of which the growth rate must be as low
    scatter: Scatter | None  # of the tolerance
    grid: Float[Array, "m c"] | None  # conditions over which loss and residuals are the largest
    names: tuple[str, ...] = eqx.field(static=True)  # of the variables
    # True where a variable is the logarithm of its quantity
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    contacts: tuple[str, ...] = eqx.field(static=True)  # with a law, that the design moves
    objective: Callable[[Any], Any] | None = eqx.field(static=True)
    friction_slope: bool = eqx.field(static=True)
    conditions: tuple[str, ...] = eqx.field(static=True)  # quantities of the envelope
    modes: int = eqx.field(static=True)  # that a structure must keep from growing
    # True if rows end with what solvers follow in the place of growth rates.
    smooth: bool = eqx.field(static=True)
    cuts: Cuts | None  # neighbourhoods that a design has to leave
    # Where a requirement or the objective is of a cycle.
    cycles: FollowedCycles | None = eqx.field(static=True)

    def __init__(
        self,
        x: Mechanism,
        bounds: Mapping[str, Sequence[float]],
        objective: Callable[[Any], Any] | None = None,
        constraints: Sequence[Callable[[Any], Any]] = (),
        target: ArrayLike | None = None,
        K_n_min: ArrayLike | None = None,
        *,
        laws: Sequence[Contact] = (),
        envelope: Envelope | Mapping[str, Any] | None = None,
        tolerance: Any = None,
        quantile: ArrayLike = 0.95,
        area_ratio_min: ArrayLike = 2.0,
        slip_ratio_max: ArrayLike = 0.9,
        friction_slope: bool = True,
        modes: int | None = None,
    ):
        fields = stated_fields(
            x,
            bounds,
            objective=objective,
            constraints=constraints,
            target=target,
            K_n_min=K_n_min,
            laws=laws,
            envelope=envelope,
            tolerance=tolerance,
            quantile=quantile,
            area_ratio_min=area_ratio_min,
            slip_ratio_max=slip_ratio_max,
            friction_slope=friction_slope,
        )
        for name, value in fields.items():
            setattr(self, name, value)
        self.modes, self.smooth, self.cuts = 0, False, None
        if needs_modes(x):
            most = largest_mode_count(x)
            if modes is not None:
                self.modes = whole("modes", modes, 1, most)
            else:
                self.modes = most if is_traced(x) else modes_to_keep(self)
        # A quantile of smooth residuals is not that of the growth rates.
        self.smooth = self.least_growth or self.scatter is None
        if K_n_min is None and self.contacts:
            self.K_n_min = _initial_stiffness(self)

    def with_fields(self, **changes: Any) -> "DesignProblem":
        """The same problem with some of its fields set to `changes`, unchecked."""
        changed = copy.copy(self)
        for name, value in changes.items():
            object.__setattr__(changed, name, value)
        return changed

    # --- for users: a design -------------------------------------------------------------

    @eqx.filter_jit
    def loss(self, u: Float[ArrayLike, " v"]) -> Float[Array, ""]:
        """The objective at `u` (v,), in its own unit.

        By default it is the squared scaled distance from `start`.
        """
        return self._named_row(u)[0]

    @eqx.filter_jit
    def residuals(self, u: Float[ArrayLike, " v"]) -> Float[Array, " k"]:
        """The requirements (k,) at `u` (v,), at most 0 where met, of order one.

        `residual_names` names them.
        """
        return self._named_row(u)[1:]

    def mechanism(self, u: Float[ArrayLike, " v"]) -> Any:
        """The scene or structure of a design `u` (v,)."""
        return self.mechanism_at(jnp.asarray(u, self.low.dtype), self.nominal_condition)

    def _named_row(self, u) -> Float[Array, " k"]:
        """Objective and residuals, the largest of those at all conditions."""
        if isinstance(u, Mapping):
            raise TypeError("u must be an array of numbers from 0 to 1, as problem.start is")
        u = jnp.asarray(u, self.low.dtype)
        if u.shape != self.low.shape:
            raise ValueError(f"u must have the shape {self.low.shape}, got {u.shape}")
        bad = refused(self.x)
        assert bad is not None  # traced, by `loss` and `residuals`
        u = nan_where(bad, u)  # so that slopes are NaN, too
        if self.grid is not None:
            rows = jax.vmap(lambda condition: self.at(u, condition)[0])(self.grid)
            return jnp.max(rows[:, self.named_columns], axis=0)
        row = self.at(u, self.nominal_condition)[0][self.named_columns]
        if self.cycles is None:
            return row
        x = self.mechanism(u)
        for column, cycle in self.cycles.columns(self):
            row = row.at[column].set(cycle(x))
        return row

    # --- in JAX: one design at one condition ---------------------------------------------

    def quantities(self, u: Float[ArrayLike, " v"]) -> dict[str, Array]:
        """The designed quantities at `u` (v,), by name and in SI units."""
        values = self.low + jnp.asarray(u, self.low.dtype) * (self.high - self.low)
        scales = np.array(self.logarithmic)
        values = jnp.where(scales, jnp.exp(jnp.where(scales, values, 0)), values)
        # A rounding beyond a bound would be outside a domain; slopes are not those of a limit.
        inside = jnp.clip(values, *self.ends)
        near = jnp.abs(inside - values) <= 1e3 * jnp.finfo(values.dtype).eps * jnp.abs(inside)
        values = values + jax.lax.stop_gradient(jnp.where(near, inside - values, 0))
        return dict(zip(self.names, values, strict=True))

    def mechanism_at(self, u: Float[Array, " v"], condition: Float[Array, " c"], shift=None) -> Any:
        """The scene or structure at `u` (v,), a `condition` (c,) and perhaps a `shift` (k,)."""
        values = self.quantities(u) | dict(zip(self.conditions, condition, strict=True))
        if self.scatter is not None and shift is not None:
            values |= self.scatter.tolerance.scattered(self.x, self.scatter.base | values, shift)
        return substituted(self.x, values)

    def _row(self, u, condition, shift=None):
        """Objective and residuals (1 + k,), and the numbers that describe a design, by name."""
        x = self.mechanism_at(u, condition, shift)
        states, stiff_x = self.stiffened(x)
        smooth, rates = [], []
        for each in (stiff_x, *(with_contact_law(x, law) for law in self.laws)):
            if self.modes:
                modes, growing = leading_modes(each, self.friction_slope, self.modes)
                rates += list(growing)
                if not self.least_growth:
                    smooth += list(neighbour_residuals(modes, self.target, self.growth_scale))
                elif each is stiff_x:
                    smooth += list(jnp.arcsinh(modes.s.real / self.growth_scale))
            else:
                rates.append(growth_rate(each, self.friction_slope))
                smooth += scene_residuals(
                    each, self.friction_slope, rates[-1], self.target, self.growth_scale
                )
        growth = rates[0]
        model, stiff = self.joint_residuals(states)
        pressing = [jnp.arcsinh((rate - self.target) / self.growth_scale) for rate in rates]
        # Cycles are followed outside of this program.
        others = [
            jnp.zeros_like(growth)
            if isinstance(constraint, CycleConstraint)
            else jnp.asarray(constraint(x))
            for constraint in self.constraints
        ]
        if self.cuts is not None:
            others += list(self.cuts.residuals(u))
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
                    numbers[joint_prefix(name) + key] = getattr(state, key)
        row = [jnp.asarray(value, growth.dtype), *model, *pressing, *stiff, *others]
        return jnp.stack(row + smooth * self.smooth), numbers

    def stiffened(self, x) -> tuple[dict[str, Any], Any]:
        """States of the contacts of `x` that have one or move, and `x` with their stiffness."""
        parts = x.joints_by_name()
        designed_parts = {
            name: part
            for name, part in parts.items()
            if part.contact.fractal or name in self.contacts
        }
        states = joint_states(designed_parts)
        # The load curve of a joint is that of its own law.
        constant_states = {
            name: state for name, state in states.items() if not parts[name].follows_load_curve
        }
        return states, with_stiffness(x, constant_states)

    def joint_residuals(self, states: Mapping[str, Any]) -> tuple[list[Array], list[Array]]:
        """Residuals of contacts in known `states`: inside the model, and stiff enough."""
        model, stiff = [], []
        for name, K_n_min in zip(self.contacts, self.K_n_min, strict=True):
            state = states[name]
            if state.log_area_ratio is not None:
                model.append(2 * (jnp.log(self.area_ratio_min) - state.log_area_ratio))
            if state.slip_ratio is not None:
                model.append(10 * (state.slip_ratio - self.slip_ratio_max))
            scale = jnp.where(K_n_min > 0, K_n_min, jnp.maximum(state.K_n, 1))
            stiff.append((K_n_min - state.K_n) / scale)
        return model, stiff

    def at(self, u: Float[Array, " v"], condition: Float[Array, " c"]):
        """As `_row` at `u` (v,) and a `condition` (c,); quantiles where quantities scatter.

        There is no more than the row then. The default objective is the distance of the design as
        ordered, without scatter.
        """
        if self.scatter is None:
            return self._row(u, condition)
        rows = jax.vmap(lambda shift: self._row(u, condition, shift)[0])(self.scatter.shifts)
        row = quantile(rows, self.scatter.weights, self.scatter.level)
        return (row if self.objective is not None else row.at[0].set(rows[0, 0])), {}

    # --- in NumPy: many ------------------------------------------------------------------

    @property
    def robust(self) -> bool:
        """True with an envelope or a tolerance."""
        return bool(self.conditions) or self.scatter is not None

    @property
    def has_many_joints(self) -> bool:
        """True if nearly no design of an even spread is inside the limits of all joints."""
        return len(self.contacts) > 2

    @property
    def least_growth(self) -> bool:
        """True if the growth rate of a structure, the largest of many modes', is minimised."""
        # The public function wraps it, to explain calls that do not fit.
        objective = getattr(self.objective, "__wrapped__", self.objective)
        return self.modes > 0 and objective is growth_rate

    @property
    def growth_columns(self) -> slice:
        """Where in a row the growth rates are, of the modes by each law."""
        first = 1 + self.model_residuals
        return slice(first, first + max(self.modes, 1) * (1 + len(self.laws)))

    @property
    def growing(self) -> np.ndarray:
        """Which columns (1 + k,) of a row are growth rates."""
        growing = np.zeros(len(self.named_columns), bool)
        growing[self.growth_columns] = True
        return growing

    @property
    def limited(self) -> np.ndarray:
        """Which columns (1 + k,) of a row a search keeps at most 0.

        Smooth residuals stand for growth rates where there are some.
        """
        columns = np.arange(len(self.named_columns))
        if self.least_growth:
            # What is minimised needs no limit of its own.
            objectives = self.growing & (columns < self.growth_columns.start + self.modes)
            return (columns > 0) & self.named_columns & ~objectives
        return (columns > 0) & ~(self.growing & self.smooth)

    @property
    def joint_columns(self) -> np.ndarray:
        """Which columns (1 + k,) of a row `make_joint_limits` gives."""
        columns = np.arange(len(self.named_columns))
        last = self.growth_columns.stop
        stiff = (columns >= last) & (columns < last + len(self.contacts))
        return stiff | ((columns > 0) & (columns <= self.model_residuals))

    @property
    def named_columns(self) -> np.ndarray:
        """Which columns (1 + k,) of a row are the objective and the requirements by name."""
        named, laws = 1 + self.requirements, 1 + len(self.laws)
        smooth = self.modes if self.least_growth else (self.modes or 2) * laws
        return np.arange(named + self.smooth * smooth) < named

    @property
    def rounding(self) -> float:
        """Rounding error of a residual."""
        return 3e4 * float(np.finfo(self.low.dtype).eps)

    @property
    def requirements(self) -> int:
        """How many residuals have names."""
        rates = self.growth_columns.stop - self.growth_columns.start
        cuts = 0 if self.cuts is None else len(self.cuts.reach)
        others = len(self.contacts) + len(self.constraints)
        return self.model_residuals + rates + others + cuts

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
        others = [constraint.name for constraint in self.constraints]
        if self.cuts is not None:
            others += [f"cut {k}" for k in range(len(self.cuts.reach))]
        growing = ["growth_rate <= target"]
        growing += [f"growth_rate of mode {i} <= target" for i in range(2, self.modes + 1)]
        by = [f"{name} by {type(law).__name__}" for law in self.laws for name in growing]
        return [*model, *growing, *by, *stiff, *others]

    def scaled(self, x: Mechanism) -> np.ndarray:
        """The scaled variables (v,) of a scene or structure `x`."""
        values = np.array([float(value_of(x, name)) for name in self.names])
        values = np.log(values, out=values, where=self.logarithmic)
        low, high = np.asarray(self.low, float), np.asarray(self.high, float)
        return np.clip((values - low) / (high - low), 0, 1)


@exported_jit
def _initial_stiffness(problem: DesignProblem) -> tuple[Array, ...]:
    """K_n [N/m] of each contact that a design moves, as it is given."""
    states = problem.stiffened(problem.mechanism(problem.start))[0]
    return tuple(states[name].K_n for name in problem.contacts)
