"""The stability boundary as a curve in two quantities of a scene or a structure.

Both axes are scaled to [0, 1]. The boundary is where the Hopf test function is 0, which is smooth
on the scale of the stiffness however light the damping. `_continuation.py` follows it.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.batches import in_batches
from .._base.parts import Record, flag, scalar, whole
from .._base.ranges import is_logarithmic
from .._contact.contact import Regime
from .._continuation import Continuation, Curve, CurveEnd, trace
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    has_memory,
    require_independent,
    require_inside,
    require_one,
    require_quantity,
    substituted,
    with_friction_times,
    with_optional,
    with_stiffness,
)
from .._mechanism.structure import Structure
from .linearise import assembled, linearised, with_equilibrium

Window = tuple[str, float, float]


class BoundaryEnd(eqx.Enumeration):
    """Why a branch of a stability boundary ends."""

    window = "at the edge of the window"
    closed = "where it began"
    regime = "where the regime of the joint changes"
    undamped = "where both directions have lost their damping"
    corner = "at a corner, where a second mode loses its damping"
    friction_correction = "at mu_m = 0.3, where Eq. 19 has a step"
    lost = "where it could not be followed"


class BoundaryBranch(Record):
    """One connected piece of a stability boundary, with squeal on its right."""

    x: Float[np.ndarray, " k"]  # values of the first quantity
    y: Float[np.ndarray, " k"]  # values of the second one
    frequency: Float[np.ndarray, " k"]  # of the imaginary pair of eigenvalues [Hz]; 0: divergence
    growth_rate: Float[np.ndarray, " k"]  # [1/s], 0 up to rounding
    start: BoundaryEnd  # what it begins at
    end: BoundaryEnd  # what it ends at

    @property
    def closed(self) -> bool:
        """True if it is a loop, whose last point is its first."""
        return bool(self.end == BoundaryEnd.closed)

    @property
    def divergence(self) -> bool:
        """True if a real eigenvalue is 0 on it, not an imaginary pair: static instability."""
        return not self.frequency.any()


class Boundary(Record):
    """Where the growth rate is 0 in a window of two quantities, as `hopf_boundary` returns it."""

    scene: Mechanism  # scene or structure with all other quantities
    x: Window  # name and range
    y: Window  # name and range
    branches: tuple[BoundaryBranch, ...]  # each one connected piece
    friction_slope: bool  # True if growth rates count the slope of friction
    squeals: bool  # at the corner (low, low) of the window
    untraced: int  # crossings of the lattice that could not be followed

    def __repr__(self) -> str:
        x, y = (f"{name} from {low:g} to {high:g}" for name, low, high in (self.x, self.y))
        plural = "" if len(self.branches) == 1 else "es"
        rows = [f"stability boundary, {x}, {y}: {len(self.branches)} branch{plural}"]
        for branch in self.branches:
            ends = f"begins {BoundaryEnd[branch.start]}, ends {BoundaryEnd[branch.end]}"
            kind = "static divergence, " if branch.divergence else ""
            rows.append(f"  {len(branch.x)} points, {kind}{'a loop' if branch.closed else ends}")
        if not self.branches and not self.untraced:
            side = "it squeals" if self.squeals else "stable against small disturbances"
            rows.append(f"  none found: {side}")
        if self.untraced:
            rows.append(f"  {self.untraced} crossings of the lattice could not be followed")
        return "\n".join(rows)


def hopf_boundary(
    scene: Mechanism,
    x: Window,
    y: Window,
    *,
    friction_slope: bool = True,
    lines: int = 49,
) -> Boundary:
    """Trace where the growth rate is 0 in the window of two quantities of a scene or structure.

    Every point lies on the boundary within 1e-12 of the window, or what the rounding of the scene
    allows. Branches are found where they cross a line of a lattice, or dip between two of them; a
    loop within a cell can be missed. Where both directions lose all their damping at once, along a
    whole line, the Hopf test function does not change sign smoothly: such crossings are counted as
    `untraced`.

    For a structure, or friction with memory, the boundary is flutter or static divergence
    (`BoundaryBranch.divergence`). A branch ends at a corner, where a second mode loses its damping
    too; the next branch begins there. Points lie on it within 1e-10 of the window, or eps over the
    damping ratio.

    Not differentiable, and not for use under `jit`; see `critical_friction` for that.

    **Arguments:**

    - `scene`: a scene or structure of scalars.
    - `x`, `y`: (name, low, high) of any quantity in SI units; for a structure also "left.D"; for a
      scene also "K_t/K_n" at the scene's K_n (the given stiffness ratio of a fractal contact),
      "omega_1/omega_2" at the scene's omega_2, and "mu", the friction at the belt velocity, which
      scales the friction law as a whole. A range over a decade or more is logarithmic.
    - `friction_slope`: False leaves the slope of friction out of growth rates.
    - `lines`: lines of the lattice each way, 49 by default. Each point takes a full eigenvalue
      solution of a structure: choose fewer for many degrees of freedom.

    **Returns:** a `Boundary`.

    **Raises:** `ValueError` for a name that is no quantity of the scene, two names that set the
    same one, a range that is empty, inverted or outside the domain, a scene that holds arrays, and
    where stability cannot be computed in the window: a preloaded joint is open, or there is no
    equilibrium.
    """
    require_one("scene", scene)
    friction_slope = flag("friction_slope", friction_slope)
    lines = whole("lines", lines, 2, 2000)  # the lattice has the square of them in points
    windows = [_check_window(scene, which, window) for which, window in (("x", x), ("y", y))]
    names = (windows[0][0], windows[1][0])
    require_independent(scene, names)
    require_inside(scene, {window[0]: _decisive_values(scene, *window) for window in windows})
    logarithmic = tuple(is_logarithmic(*window[1:]) for window in windows)
    ends = np.array([window[1:] for window in windows])
    ends[list(logarithmic)] = np.log(ends[list(logarithmic)])
    low, high = jnp.asarray(ends.T, jax.tree.leaves(scene)[0].dtype)
    scene = with_optional(scene, names)
    rigid = None
    if has_memory(scene):
        rigid = jnp.zeros((), int)
    elif not scene.uncoupled:
        with_equilibrium(scene, friction_slope)
        rigid = _rigid(scene, friction_slope)
    field = _Field(_Plane(scene, low, high, rigid, names, logarithmic, friction_slope))
    curves = Continuation(
        field.equations,
        low=np.zeros(2),
        high=np.ones(2),
        valid=field.damped,
        tolerance=field.tolerance,
    )
    branch_curves, squeals, untraced = trace(curves, field.values, lines)
    return Boundary(
        scene=scene,
        x=windows[0],
        y=windows[1],
        branches=tuple(_branch(field, windows, curve) for curve in branch_curves),
        friction_slope=friction_slope,
        squeals=squeals,
        untraced=untraced,
    )


def _check_window(scene, which, window) -> Window:
    """The validated range, not yet checked against the domain of the scene."""
    if not (isinstance(window, (tuple, list)) and len(window) == 3 and isinstance(window[0], str)):
        raise ValueError(
            f'{which} must be (name, low, high), such as ("D", 2.3, 2.8), got {window!r}'
        )
    name, *ends = window
    require_quantity(scene, name)
    low, high = (float(scalar(f"{which} limit", end)) for end in ends)
    if not low < high:
        raise ValueError(f"{which} must go from a lower to a higher value, got {window!r}")
    return name, low, high


def _decisive_values(scene, name, low, high) -> np.ndarray:
    """The values of a range that decide if all of it is inside the domain of the scene."""
    quantities = scene.stored_quantities()
    # mu(V), by which "mu" scales the friction law, is least at V = v_m: perhaps between the ends.
    other = {"V": "v_m", "v_m": "V"}.get(name)
    value = quantities[other].value if other in quantities else None
    least = low if value is None else min(max(float(value), low), high)
    return np.array([low, least, high])


# --- the function that vanishes on the boundary -------------------------------------------


class _Point(eqx.Module):
    """The Hopf test function at a point, and what the result shows of it."""

    test: jax.Array
    frequency: jax.Array
    growth_rate: jax.Array
    damping: Float[Array, "2"]  # over sqrt(a + b); of a structure the two least damping ratios
    open: jax.Array  # whether a preloaded joint is
    regimes: tuple[Regime, ...]  # of the fractal joints
    mu_m: tuple[jax.Array, ...]  # of the fractal joints, for which Eq. 19 corrects


class _Plane(eqx.Module):
    """A scene or structure over the unit square: two of its quantities, scaled to their ranges."""

    scene: Any
    low: Float[Array, "2"]  # of each quantity, or of its logarithm
    high: Float[Array, "2"]
    rigid: Any  # number of rigid-body eigenvalues, None of a scene in closed form
    names: tuple[str, str] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    friction_slope: bool = eqx.field(static=True)

    def quantities(self, u) -> list[jax.Array]:
        coordinates = self.low + u * (self.high - self.low)
        return [
            jnp.exp(coordinates[i]) if log else coordinates[i]
            for i, log in enumerate(self.logarithmic)
        ]

    def at(self, u) -> _Point:
        scene = substituted(self.scene, dict(zip(self.names, self.quantities(u), strict=True)))
        joints = scene.joints_by_name().items()
        laws = {name: joint.friction for name, joint in joints if joint.contact.fractal}
        states = {
            name: joint.contact.state(laws[name].mu_s, laws[name].mu_m)
            for name, joint in joints
            if name in laws
        }
        regimes = tuple(state.regime for state in states.values())
        lowest = tuple(law.mu_m for law in laws.values())
        # The state of a fractal joint includes its stiffness.
        system = linearised(with_stiffness(scene, states), self.friction_slope, refuse=False)
        return _Point(*system.critical(self.rigid), system.open, regimes, lowest)


@functools.partial(jax.jit, static_argnums=1)
def _rigid(structure: Structure, friction_slope: bool):
    """The number of rigid-body eigenvalues, at little friction."""
    x = with_friction_times(structure, 1e-3)
    return (assembled(x, friction_slope).solve().s == 0).sum()


@jax.jit
def _evaluate(plane: _Plane, u):
    """Gradient (2,) of the test function, and the point."""

    def both(u):
        point = plane.at(u)
        return point.test, point

    return jax.jacfwd(both, has_aux=True)(u)


@jax.jit
def _tests(plane: _Plane, us):
    """Test function (k,), gradient (k, 2) and open joints (k,) at points (k, 2)."""
    gradients, points = jax.vmap(_evaluate, (None, 0))(plane, us)
    return points.test, gradients, points.open


class _Field:
    """The test function for NumPy: at many points, or at one with what the result shows of it."""

    def __init__(self, plane: _Plane):
        self.plane, self.dtype, self.entered = plane, plane.low.dtype, False
        eps = float(jnp.finfo(self.dtype).eps)
        # Negative damping that may be rounding: over sqrt(a + b), or the ratio in a structure,
        # whose eigenvalues resolve light damping to eps of the frequency.
        self.tolerance, self.undamped = max(1e-12, 10 * eps), max(1e-12, (10 * eps) ** 2)
        if plane.rigid is not None:
            self.tolerance, self.undamped = max(1e-10, 1e4 * eps), 1e2 * eps**0.5
        # Each point is evaluated for its zero, its damping and what the result shows.
        self._at = functools.lru_cache(8)(lambda u: _evaluate(plane, jnp.asarray(u, self.dtype)))

    def at(self, u) -> _Point:
        return self._at(tuple(u))[1]

    def equations(self, u):
        gradient, point = self._at(tuple(u))
        return np.asarray(point.test, float)[None], np.asarray(gradient, float)[None]

    def values(self, us):
        """Test function (k,) and gradient (k, 2) at any number of points, the lattice first."""

        def program(us):
            return _tests(self.plane, jnp.asarray(us, self.dtype))

        batch = 64 if len(us) <= 64**2 else 512  # bisections have few points, a lattice has many
        tests, gradients, lifted = map(np.asarray, in_batches(program, batch, us))
        lost = np.isnan(tests)
        if not self.entered:
            # Beyond a static divergence the force has the other sign: it passed through infinity.
            # There the test is at most 0, which it is where the mode nearest to the one that grows
            # is undamped. On it rounding decides.
            lost |= lifted & (tests > 0)
            self.entered = True
        if lost.any():
            place = zip(self.plane.names, self.quantities(us[lost][0]), strict=True)
            where = ", ".join(f"{name} = {value:.6g}" for name, value in place)
            loaded = any(
                x.normal_load is not None for x in self.plane.scene.joints_by_name().values()
            )
            may = "; the joint may be open there" if loaded else ""
            raise ValueError(f"stability cannot be computed at {where}{may}")
        return tests.astype(float), gradients.astype(float)

    def damped(self, u) -> bool:
        """True if all modes are damped; else the test function can be 0 without a Hopf point."""
        return bool(np.asarray(self.at(u).damping).min() >= -self.undamped)

    def quantities(self, u) -> list[float]:
        return [float(x) for x in self.plane.quantities(jnp.asarray(u, self.dtype))]

    def reason_of_end(self, end: CurveEnd, u, before) -> BoundaryEnd:
        """Why a branch ends at u, coming from the point `before`."""
        if end in (CurveEnd.edge, CurveEnd.closed):
            return BoundaryEnd.window if end is CurveEnd.edge else BoundaryEnd.closed
        here = self.at(u)
        if np.abs(here.damping).max() < 1e-5:  # of two modes at once
            return BoundaryEnd.undamped if self.plane.rigid is None else BoundaryEnd.corner
        if any(abs(float(mu_m) - 0.3) < 1e-6 for mu_m in here.mu_m):
            return BoundaryEnd.friction_correction
        ahead = (u - before) / np.linalg.norm(u - before)
        for reach in 10.0 ** np.arange(-7, -2):
            for direction in (ahead, ahead[::-1], -ahead[::-1]):
                beside = self.at(np.clip(u + reach * direction, 0, 1))
                pairs = zip(here.regimes, beside.regimes, strict=True)
                if not all(bool(one == other) for one, other in pairs):
                    return BoundaryEnd.regime
        return BoundaryEnd.lost


def _branch(field: _Field, windows, curve: Curve) -> BoundaryBranch:
    points = [field.at(u) for u in curve.points]
    places = np.array([field.quantities(u) for u in curve.points])
    # A point on the edge has the limit itself, not the exponential of its logarithm.
    for i, (_, low, high) in enumerate(windows):
        scaled = curve.points[:, i]
        places[:, i] = np.where(scaled == 0, low, np.where(scaled == 1, high, places[:, i]))
    return BoundaryBranch(
        x=places[:, 0],
        y=places[:, 1],
        frequency=np.array([float(point.frequency) for point in points]),
        growth_rate=np.array([float(point.growth_rate) for point in points]),
        start=field.reason_of_end(curve.start, *curve.points[:2]),
        end=field.reason_of_end(curve.end, *curve.points[:-3:-1]),
    )
