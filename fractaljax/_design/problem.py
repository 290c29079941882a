"""A design problem: what is moved, what is best, and what is required, as one compiled program.

A design is scaled variables u in [0, 1]^v, linear in a quantity or, where it is a scale, in its
logarithm. Every requirement is a residual: at most 0 where it is met, of order one, continuous and
informative on both sides of every regime boundary. A fully plastic joint knows by ln(a_l/a_e) how
far it is from carrying load elastically. Where quantities scatter, a residual is its quantile.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._contact.contact import Contact
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    joints_of,
    substituted,
    value_of,
)
from .._stability.linearise import assembled
from .._stability.quadratic import leading
from .._stability.stability import growth_rate
from .coalescence import of_neighbours, of_scene
from .constraints import Constraint, CycleConstraint
from .cuts import Cuts
from .followed import FollowedCycles
from .joints import (
    is_fractal,
    of_joint,
    slips,
    states_of,
    under,
    with_stiffness,
)
from .tolerance import Tolerance, quantile

UNKNOWN = 1e3  # stands for a residual without a number


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
