"""The statement of a design problem: the arguments of `design`, checked."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._base.parts import brief, flag, is_traced, nan_where, require_kind, require_scalar, scalar
from .._base.suggest import did_you_mean
from .._contact.contact import Contact
from .._dynamics.scaled import degrees_of_freedom, hybrid_system
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    quantity_names,
    replaced,
    require_independent,
    require_one,
    value_of,
    with_optional,
)
from .constraints import Constraint, CycleConstraint, Plain
from .envelope import Envelope
from .followed import FollowedCycles
from .joints import changed_contacts, least_damping, with_contact_law
from .tolerance import Scatter, Tolerance, nodes

DEFAULT_BOUNDS: dict[str, tuple[float, float]] = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)}


def stated_fields(
    x: Mechanism,
    bounds: Mapping[str, Sequence[float]],
    *,
    objective: Callable[[Any], Any] | None,
    constraints: Sequence[Callable[[Any], Any]],
    target: Any,
    K_n_min: Any,
    laws: Sequence[Contact],
    envelope: Any,
    tolerance: Any,
    quantile: Any,
    area_ratio_min: Any,
    slip_ratio_max: Any,
    friction_slope: bool,
) -> dict[str, Any]:
    """Check the arguments of a `DesignProblem`, which documents them; most of its fields."""
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
        and x.sole_joint is None
        and not any(joint.contact.has_surface for joint in x.joints_by_name().values())
    ):
        raise ValueError("laws of a structure need a joint whose contact has a surface")
    for law in laws:
        with_contact_law(x, law)  # refuses one that a joint cannot have
    envelope = None if envelope is None else Envelope.of(envelope)
    tolerance = None if tolerance is None else Tolerance.of(tolerance)
    bounds = checked_bounds(x, bounds)
    cycles = _make_cycles(x, objective, constraints, envelope is not None or tolerance is not None)
    objective = _zero if isinstance(objective, CycleConstraint) else objective
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
        shifts = jnp.asarray(tolerance.shifts(z))
        scatter = Scatter(tolerance, tolerance.base(x), shifts, jnp.asarray(weights), level)
    require_independent(x, tuple(ranges))
    everything = dict.fromkeys([*ranges, *(tolerance.quantities if tolerance else ())])
    logarithmic = tuple(_is_scale(x, name) and low > 0 for name, (low, _) in bounds.items())
    xp = jnp if is_traced(x) else np
    low, high = ends = np.array([*bounds.values()]).T
    start = xp.stack([xp.asarray(value_of(x, name), float) for name in bounds])
    if is_traced(x):
        start = nan_where((start < low) | (start > high), start)
    scales = np.array(logarithmic)
    low, high, start = (
        xp.where(scales, xp.log(xp.where(scales, each, 1)), each) for each in (low, high, start)
    )
    damping, frequency = least_damping(x)
    nominal_condition = xp.asarray([value_of(x, name) for name in conditions], float)
    x = with_optional(x, tuple(everything))
    contacts = changed_contacts(x, bounds)
    least = 0.0 if K_n_min is None else scalar("K_n_min", K_n_min, at_least=0)
    dtype = jax.tree.leaves(x)[0].dtype
    numbers |= dict(
        ends=ends,
        low=low,
        high=high,
        start=(start - low) / (high - low),
        nominal_condition=nominal_condition,
        target=-damping / 2 if target is None else scalar("target", target),
        growth_scale=xp.maximum(damping, 1e-4 * frequency),
        K_n_min=(least,) * len(contacts),
        constraints=tuple(c if isinstance(c, Constraint) else Plain(c) for c in constraints),
        laws=tuple(laws),
        scatter=scatter,
        grid=None if envelope is None else envelope.values(envelope.grid()),
    )
    # In the precision of the scene, whatever that of the arguments.
    numbers = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), numbers)
    return numbers | dict(
        x=x,
        names=tuple(bounds),
        logarithmic=logarithmic,
        contacts=contacts,
        objective=objective,
        friction_slope=flag("friction_slope", friction_slope),
        conditions=conditions,
        cycles=cycles,
    )


def _zero(x) -> float:
    """Stands for an objective that `FollowedCycles` fills in."""
    return 0.0


def _make_cycles(x, objective, constraints, robust: bool) -> FollowedCycles | None:
    """The cycles of the designs, where they are limited or minimised."""
    of_cycle = objective if isinstance(objective, CycleConstraint) else None
    limits = [each for each in constraints if isinstance(each, CycleConstraint)]
    if of_cycle is None and not limits:
        return None
    if robust:
        raise ValueError(f"{(of_cycle or limits[0]).symbol} takes no envelope and no tolerance")
    n = degrees_of_freedom(x)
    hybrid_system(x)  # refuses a joint without V
    for each in limits if of_cycle is None else [of_cycle, *limits]:
        if each.dof >= n:
            raise ValueError(f"dof of {each.symbol} must be below {n}, got {each.dof}")
        if each is not of_cycle and each.at_most is None:
            raise ValueError(f"{each.symbol} as a requirement needs at_most")
    return FollowedCycles(of_cycle)


def checked_bounds(x: Mechanism, bounds: Mapping[str, Sequence[float]]) -> dict[str, tuple]:
    """Bounds by name, each (lower, upper), in their domain and around the value that `x` has."""
    if not isinstance(bounds, Mapping):
        raise TypeError(
            f'bounds must be a mapping such as {{"D": (2.3, 2.8)}}, got {brief(bounds)}'
        )
    names = quantity_names(x)
    for name in bounds:
        if name not in names:
            near = did_you_mean(str(name), names)
            raise ValueError(f"bounds on {brief(name)}: there are {', '.join(names)}{near}")
    if not bounds:
        raise ValueError("bounds must name a quantity, got none")
    checked = {}
    for name, pair in bounds.items():
        if not isinstance(pair, (tuple, list, np.ndarray)) or not np.ndim(pair):
            raise TypeError(f"bounds on {name} must be (lower, upper), got {brief(pair)}")
        ends = tuple(float(scalar(f"{name} bound", end)) for end in pair)
        for end in ends:
            replaced(x, {name: end})  # refuses an end outside the domain of the model
        if not (len(ends) == 2 and ends[0] < ends[1]):
            raise ValueError(f"bounds on {name} must be (lower, upper), got {pair!r}")
        value = value_of(x, name)
        if not is_traced(value) and not ends[0] <= float(value) <= ends[1]:
            raise ValueError(
                f"{name} must lie inside its bounds [{ends[0]:g}, {ends[1]:g}], got "
                f"{float(value):g}"
            )
        checked[name] = ends
    return checked


def _is_scale(x, name) -> bool:
    quantities = x.stored_quantities()
    return name in quantities and quantities[name].log
