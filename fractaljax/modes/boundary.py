"""The stability boundary as a curve in two quantities of a scene.

Both axes are scaled to [0, 1]. On the boundary the reserve of coupling (g_c - g)/(a + b)^2 is 0: a
function smooth on the scale of stiffness, however light the damping. `continuation.py` follows it.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.batches import in_batches
from ..base.parts import Record, flag, require_scalar, scalar, whole
from ..base.ranges import is_logarithmic
from ..mechanism.oscillator import linearise
from ..mechanism.quantities import (
    own_quantities,
    require_independent,
    require_inside,
    require_known,
    substituted,
    with_optional,
)
from ..mechanism.scene import Scene, require_kind
from .continuation import BranchEnd, trace
from .critical_friction import coupling_reserve, critical_frequency
from .stability import growth_rate_of

_BATCH = 512  # points judged at once
_LINES_MAX = 2000  # of which the square is evaluated
_UNDAMPED = 1e-12  # damping that passes for none, beside sqrt(a + b)
_STEP = 0.3  # the mu_m at which Eq. 19 has one

Window = tuple[str, float, float]


class Branch(Record):
    """One connected piece of a stability boundary; arrays (n,), squeal on its right."""

    x: np.ndarray
    y: np.ndarray
    frequency: np.ndarray  # of the imaginary pair of eigenvalues [Hz]
    growth_rate: np.ndarray  # [1/s], 0 up to rounding
    start: BranchEnd
    end: BranchEnd

    @property
    def closed(self) -> bool:
        """Whether it is a loop; its last point is then its first."""
        return bool(self.end == BranchEnd.closed)


class Boundary(Record):
    """Where growth rate is 0 in a window of two quantities, as `hopf_boundary` returns it."""

    scene: Scene
    x: Window  # name and range
    y: Window
    branches: tuple[Branch, ...]
    friction_slope: bool
    squeals: bool  # at the corner (low, low) of the window
    untraced: int  # crossings of the lattice that could not be followed

    def __repr__(self) -> str:
        x, y = (f"{name} from {low:g} to {high:g}" for name, low, high in (self.x, self.y))
        plural = "" if len(self.branches) == 1 else "es"
        rows = [f"stability boundary, {x}, {y}: {len(self.branches)} branch{plural}"]
        for branch in self.branches:
            ends = f"begins {BranchEnd[branch.start]}, ends {BranchEnd[branch.end]}"
            rows.append(f"  {len(branch.x)} points, {'a loop' if branch.closed else ends}")
        if not self.branches and not self.untraced:
            side = "it squeals" if self.squeals else "stable against small disturbances"
            rows.append(f"  none found: {side}")
        if self.untraced:
            rows.append(f"  {self.untraced} crossings of the lattice could not be followed")
        return "\n".join(rows)


# --- the function that vanishes on the boundary -------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Problem:
    """What programs are compiled for."""

    names: tuple[str, str]
    logarithmic: tuple[bool, bool]
    friction_slope: bool

    def values(self, request, p):
        """The two quantities at the scaled point p (2,)."""
        found = request.low + p * (request.high - request.low)
        return [jnp.exp(found[i]) if log else found[i] for i, log in enumerate(self.logarithmic)]


class _Request(eqx.Module):
    scene: Scene
    low: jax.Array  # of each quantity, or of its logarithm
    high: jax.Array


class _Point(eqx.Module):
    """What is known at a point: the reserve of coupling, and what the result shows."""

    reserve: jax.Array
    frequency: jax.Array
    growth_rate: jax.Array
    damping: jax.Array  # (2,), beside sqrt(a + b)
    regime: Any  # of a fractal joint
    mu_m: Any  # the friction that Eq. 19 corrects for


def _judge(problem, request, p) -> _Point:
    values = dict(zip(problem.names, problem.values(request, p), strict=True))
    scene = substituted(request.scene, values)
    contact, friction = scene.contact, scene.friction
    if contact.fractal:
        state = contact.state(friction.mu_s, friction.mu_m)
        K_n, K_t, law = state.K_n, state.K_t, (state.regime, friction.mu_m)
    else:
        (K_n, K_t), law = contact.stiffness(friction.mu_s, friction.mu_m), (None, None)
    lin = linearise(scene.oscillator, friction, K_n, K_t, problem.friction_slope)
    growth = growth_rate_of(scene, K_n, K_t, problem.friction_slope)
    damping = jnp.stack([lin.c_1, lin.c_2]) / jnp.sqrt(lin.a + lin.b)
    return _Point(coupling_reserve(lin), critical_frequency(lin), growth, damping, *law)


@functools.partial(jax.jit, static_argnums=0)
def _reserves(problem: _Problem, request: _Request, ps):
    """Reserve (n,) and gradient (n, 2) at points (n, 2)."""

    def both(p):
        reserve = _judge(problem, request, p).reserve
        return reserve, reserve

    gradients, reserves = jax.vmap(jax.jacfwd(both, has_aux=True))(ps)
    return reserves, gradients


@functools.partial(jax.jit, static_argnums=0)
def _linearised(problem: _Problem, request: _Request, p):
    def both(p):
        point = _judge(problem, request, p)
        return point.reserve, point

    gradient, point = jax.jacfwd(both, has_aux=True)(p)
    return point, gradient


class _Field:
    """The reserve over the window for NumPy: many values, or one with everything."""

    def __init__(self, problem, request):
        self.problem, self.request = problem, request
        self.dtype = request.low.dtype
        self.rounding = 10 * float(jnp.finfo(self.dtype).eps)

    def values(self, ps):
        """Reserve (n,) and gradient (n, 2) at any number of points."""

        def program(ps):
            return _reserves(self.problem, self.request, jnp.asarray(ps, self.dtype))

        reserves, gradients = (np.asarray(x, float) for x in in_batches(program, _BATCH, ps))
        if np.isnan(reserves).any():
            place = self.quantities(ps[np.isnan(reserves)][0])
            raise ValueError(
                "stability cannot be computed at "
                + ", ".join(
                    f"{n} = {x:.6g}" for n, x in zip(self.problem.names, place, strict=True)
                )
            )
        return reserves, gradients

    def at(self, p):
        """Reserve, its gradient (2,) and the rest at one point."""
        point, gradient = _linearised(self.problem, self.request, jnp.asarray(p, self.dtype))
        return float(point.reserve), np.asarray(gradient, float), point

    def accepts(self, point) -> bool:
        # Where a direction is driven the reserve can be 0 without changing its sign.
        return np.asarray(point.damping).min() >= -max(_UNDAMPED, self.rounding**2)

    def broken(self, p, ahead):
        """Why a branch stops inside the window."""
        here = self.at(p)[2]
        if np.abs(here.damping).max() < 1e-5:
            return BranchEnd.undamped
        if here.regime is None:
            return BranchEnd.lost
        if abs(float(here.mu_m) - _STEP) < 1e-6:
            return BranchEnd.friction_correction
        for reach in 10.0 ** np.arange(-7, -2):
            for direction in (ahead, ahead[::-1], -ahead[::-1]):
                beside = self.at(np.clip(p + reach * direction, 0, 1))[2]
                if not bool(beside.regime == here.regime):
                    return BranchEnd.regime
        return BranchEnd.lost

    def quantities(self, p):
        return [float(x) for x in self.problem.values(self.request, jnp.asarray(p, self.dtype))]


# --- the question -------------------------------------------------------------------------


def hopf_boundary(
    scene: Scene,
    x: Window,
    y: Window,
    *,
    friction_slope: bool = True,
    lines: int = 49,
) -> Boundary:
    """Trace where the growth rate is 0 in the window of two quantities of a scene.

    `x` and `y` are (name, low, high): any quantity of the scene, or "K_t/K_n" with K_n as it is
    (in a fractal contact a given stiffness ratio takes the place of the tangential law),
    "omega_1/omega_2" with omega_2 as it is, and "mu", the friction at the velocity of the belt,
    with which a `Stribeck` law is scaled as a whole. A range from a positive number to ten times
    that or more is gone along in logarithms. Every point lies on the boundary within 1e-12 of the
    window, or what the rounding of the scene allows. Branches are found where they cross one of
    `lines` lines each way, or dip between two of them; a loop within a cell can be missed. Where
    both directions lose all their damping at once, as without any but a friction law whose slope
    changes sign, stability ends without a reserve of coupling: that is counted as `untraced`.

    Not differentiable, and not for use under `jit`; see `critical_friction` for that.

    **Raises:** `ValueError` for a name that is no quantity of the scene, two names that set the
    same one, a range that is empty, inverted or outside the domain, or a scene that holds arrays.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    friction_slope = flag("friction_slope", friction_slope)
    lines = whole("lines", lines, 2, _LINES_MAX)
    windows = [_window(scene, which, window) for which, window in (("x", x), ("y", y))]
    names = (windows[0][0], windows[1][0])
    require_independent(scene, names)
    require_inside(scene, {window[0]: _decisive(scene, *window) for window in windows})
    scene = with_optional(scene, names)
    logarithmic = [is_logarithmic(*window[1:]) for window in windows]
    ends = np.array([window[1:] for window in windows])
    ends[logarithmic] = np.log(ends[logarithmic])
    low, high = jnp.asarray(ends.T, scene.oscillator.m.dtype)
    problem = _Problem(names, (logarithmic[0], logarithmic[1]), friction_slope)
    field = _Field(problem, _Request(scene, low, high))
    branches, squeals, untraced = trace(field, lines)
    return Boundary(
        scene=scene,
        x=windows[0],
        y=windows[1],
        branches=tuple(_branch(field, windows, *branch) for branch in branches),
        friction_slope=friction_slope,
        squeals=squeals,
        untraced=untraced,
    )


def _decisive(scene, name, low, high) -> np.ndarray:
    """The values of a range that decide whether all of it is inside the domain of the scene."""
    own = own_quantities(scene)
    # mu(V), by which mu scales the friction law, is least at V = v_m: between the ends, or at one.
    other = {"V": "v_m", "v_m": "V"}.get(name)
    value = own[other].value if other in own else None
    least = low if value is None else min(max(float(value), low), high)
    return np.array([low, least, high])


def _branch(field, windows, points, start, end) -> Branch:
    found = [field.at(p)[2] for p in points]
    places = np.array([field.quantities(p) for p in points])
    # An end on the edge is the number that was asked for, not what its logarithm gives back.
    for i, (_, low, high) in enumerate(windows):
        scaled = np.array([p[i] for p in points])
        places[:, i] = np.where(scaled == 0, low, np.where(scaled == 1, high, places[:, i]))
    return Branch(
        x=places[:, 0],
        y=places[:, 1],
        frequency=np.array([float(point.frequency) for point in found]),
        growth_rate=np.array([float(point.growth_rate) for point in found]),
        start=start,
        end=end,
    )


def _window(scene, which, window) -> Window:
    """A range, checked; not yet against the domain of the scene."""
    if not (isinstance(window, (tuple, list)) and len(window) == 3 and isinstance(window[0], str)):
        raise ValueError(f"{which} must be (name, low, high), got {window!r}")
    name, *ends = window
    require_known(scene, name)
    low, high = (float(scalar(f"{which} limit", end)) for end in ends)
    if not low < high:
        raise ValueError(f"{which} must go from a lower to a higher value, got {window!r}")
    return name, low, high
