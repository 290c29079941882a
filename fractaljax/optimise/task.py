"""The request for a design, checked: its numbers, its structure, and what judges a surface."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import brief, require_scalar, scalar, whole
from ..mechanism.scene import Scene, require_kind
from . import tolerance as scatter
from .constraints import Constraint
from .requirements import Model, Problem, Request, Scatter, expected_shortfall
from .worst_case import OnAverage, OneCondition, WorstCase

DEFAULT_BOUNDS: dict[str, tuple[float, float]] = {"D": (2.1, 2.9), "G": (1e-12, 1e-8)}

_LATTICE = {1: 1024, 2: 48}  # surfaces a side, judged to choose the starts
_ROBUST_LATTICE = {1: 256, 2: 24}  # the same against many conditions
_LATTICE_MAX = {1: 1_000_000, 2: 1000}  # what memory holds
_STARTS, _ROBUST_STARTS = 16, 12
_STARTS_MAX = 10_000
_SEED_MAX = 2**63 - 1  # of a JAX key
_SURVEYED = 64  # surfaces at a time
_TEMPERATURE = 0.02  # of the smooth maximum over an envelope


@dataclasses.dataclass(frozen=True)
class Task:
    """A checked request, ready to be searched."""

    problem: Problem
    request: Request
    options: Mapping[str, Any]
    bounds: Mapping[str, tuple[float, float]]
    tolerance: Mapping[str, float]  # standard deviations of D and ln G, under D and G
    starts: int
    lattice: int

    @property
    def robust(self) -> bool:
        """Whether there is more than one condition."""
        return bool(self.problem.conditions or self.tolerance)

    @property
    def slack(self) -> float:
        """By how much requirements are overfulfilled, so that rounding cannot undo them."""
        return max(1e-6, 10 * float(jnp.finfo(self.request.low.dtype).eps) ** 0.5)

    def surfaces(self) -> np.ndarray:
        """Those of the lattice, scaled (n, v): the centres of equal cells."""
        side = (np.arange(self.lattice) + 0.5) / self.lattice
        axes = np.meshgrid(*[side] * len(self.problem.variables), indexing="ij")
        return np.stack([axis.ravel() for axis in axes], axis=1)

    def judge(self, count: int) -> OneCondition:
        """What judges `count` surfaces."""
        # Of one condition many surfaces are surveyed, more than walk.
        batch = self.starts if self.robust else max(self.starts, _SURVEYED)
        model = Model(self.problem, self.request, batch)
        envelope = self.options["envelope"]
        if envelope is None:
            return OneCondition(model)
        if self.problem.risk == "worst":
            return WorstCase(model, envelope, count)
        places = envelope.coarse_grid() if self.problem.risk == "smooth" else envelope.cells()
        return OnAverage(model, envelope, places)


def pose(scene: Scene, options: Mapping[str, Any]) -> Task:
    """Check the arguments of `design` and turn them into numbers and structure."""
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    if not scene.contact.fractal:
        raise ValueError("design needs a FractalContact: a FixedContact has no surface to change")
    bounds, low, high, own = _bounds(scene, options["bounds"])
    dtype = scene.contact.surface.D.dtype
    oscillator = scene.oscillator
    omega = np.array([oscillator.omega_1, oscillator.omega_2], float)
    decay = (np.array([oscillator.xi_1, oscillator.xi_2]) * omega).min()
    state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
    target, K_n_min, constraints = (options[n] for n in ("target", "K_n_min", "constraints"))
    numbers: dict[str, Any] = dict(
        low=low,
        high=high,
        start=(own - low) / (high - low),
        target=-decay / 2 if target is None else scalar("target", target),
        growth_scale=max(decay, 1e-4 * omega.min()),
        K_n_min=state.K_n if K_n_min is None else scalar("K_n_min", K_n_min, at_least=0),
        area_ratio_min=scalar("area_ratio_min", options["area_ratio_min"], at_least=1),
        slip_ratio_max=scalar("slip_ratio_max", options["slip_ratio_max"], above=0, at_most=1),
        value_shift=0.0,
        value_scale=1.0,
        constraints=tuple(c if isinstance(c, Constraint) else None for c in constraints),
    )
    envelope, tolerance = options["envelope"], {}
    if envelope is not None:
        envelope.check(scene, tuple(bounds))
    risk, numbers["risk"] = _risk(options["risk"], envelope)
    level = scalar("quantile", options["quantile"], at_least=0.5, at_most=0.999)
    if options["tolerance"] is not None:
        tolerance = scatter.check_tolerance(options["tolerance"], scene, bounds)
        deviates, weights = scatter.nodes(len(tolerance))
        shifts = {
            name: sigma * z for (name, sigma), z in zip(tolerance.items(), deviates.T, strict=True)
        }
        numbers["scatter"] = Scatter(*jax.tree.map(jnp.asarray, (shifts, weights, level)))
    whole("seed", options["seed"], 0, _SEED_MAX)
    robust = envelope is not None or bool(tolerance)
    variables = len(bounds)
    starts, lattice = options["starts"], options["lattice"]
    if lattice is None:
        lattice = (_ROBUST_LATTICE if robust else _LATTICE)[variables]
    lattice = whole("lattice", lattice, 1, _LATTICE_MAX[variables])
    if starts is None:
        starts = min(_ROBUST_STARTS if robust else _STARTS, lattice**variables)
    # In the precision of the scene, whatever that of the arguments.
    numbers = jax.tree.map(lambda x: jnp.asarray(x, dtype), numbers)
    problem = Problem(
        tuple(bounds),
        options["objective"],
        tuple(None if isinstance(c, Constraint) else c for c in constraints),
        scene.contact.stiffness_ratio is None,
        options["friction_slope"],
        () if envelope is None else envelope.names,
        risk,
    )
    return Task(
        problem,
        Request(scene, **numbers),
        options,
        bounds,
        tolerance,
        whole("starts", starts, 1, _STARTS_MAX),
        lattice,
    )


def _bounds(scene, bounds):
    """Bounds as numbers by name, and the least, the largest and the own of D and ln G."""
    if not bounds or not set(bounds) <= set(DEFAULT_BOUNDS):
        raise ValueError(
            f"bounds must be on D, G or both, got {', '.join(map(str, bounds)) or 'none'}"
        )
    surface = scene.contact.surface
    low, high, own, checked = [], [], [], {}
    for name in sorted(bounds):
        scale = np.log if name == "G" else float
        if not isinstance(bounds[name], (tuple, list, np.ndarray)) or not np.ndim(bounds[name]):
            raise TypeError(f"bounds on {name} must be (lower, upper), got {brief(bounds[name])}")
        ends = [float(scalar(f"{name} bound", end)) for end in bounds[name]]
        for end in ends:
            scene.replace(**{name: end})  # refuses an end outside the domain of the model
        value = float(getattr(surface, name))
        if not (len(ends) == 2 and ends[0] < ends[1]):
            raise ValueError(f"bounds on {name} must be (lower, upper), got {bounds[name]!r}")
        if not ends[0] <= value <= ends[1]:
            raise ValueError(
                f"{name} must lie inside its bounds [{ends[0]:g}, {ends[1]:g}], got {value:g}"
            )
        low.append(scale(ends[0]))
        high.append(scale(ends[1]))
        own.append(scale(value))
        checked[name] = (ends[0], ends[1])
    return checked, np.array(low), np.array(high), np.array(own)


def _risk(risk, envelope):
    """The kind of risk, and its number: weights of ordered conditions, or a temperature."""
    pair = (risk, None) if isinstance(risk, str) else risk
    kind, parameter = pair if isinstance(pair, (tuple, list)) and len(pair) == 2 else (None, None)
    if kind == "worst" and parameter is None:
        return "worst", None
    if kind == "smooth":
        temperature = _TEMPERATURE if parameter is None else parameter
        parameter = scalar("temperature of risk", temperature, above=0)
    elif kind == "cvar" and parameter is not None:
        alpha = float(scalar("alpha of risk", parameter, at_least=0, below=1))
        count = 1 if envelope is None else len(envelope.cells())
        parameter = expected_shortfall(count, alpha)
    else:
        raise ValueError(
            f'risk must be "worst", "smooth", ("smooth", T) or ("cvar", alpha), got {brief(risk)}'
        )
    if envelope is None:
        raise ValueError(f"risk {risk!r} needs an envelope")
    return kind, parameter
