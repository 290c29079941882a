"""The statement of a design problem: the arguments of `design`, checked."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._base.parts import brief, flag, require_kind, require_scalar, scalar
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
    value_of,
    with_optional,
)
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .constraints import Constraint, CycleConstraint, Plain
from .envelope import Envelope
from .followed import FollowedCycles
from .growing_modes import modes_to_keep
from .joints import least_damping, moved_contacts, of_joint, under
from .problem import DesignProblem, Scatter
from .rows import describe
from .tolerance import Tolerance, nodes

DEFAULT_BOUNDS: dict[str, tuple[float, float]] = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)}


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
        problem = dataclasses.replace(problem, modes=modes_to_keep(problem))
    # An average or a quantile of smooth residuals is not that of the growth rates.
    smooth = problem.least_growth or (scatter is None and risk == "worst")
    problem = dataclasses.replace(problem, smooth=smooth)
    if K_n_min is not None or not contacts:
        return problem
    given = describe(problem, np.asarray(problem.start)[None])
    own = tuple(jnp.asarray(given[of_joint(name) + "K_n"][0], dtype) for name in contacts)
    return dataclasses.replace(problem, K_n_min=own)


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
