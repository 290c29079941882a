"""Every mode of a mechanism over one quantity, followed through crossing, veering and coalescence.

Modes at two values are compared as states (x, x'), with left and right eigenvectors: a left state
of eigenvalue s is w = (y (s M + C), y M), a right one v = (x, s x), and w v = 1. For modes i and j,

    B_ij = (w_i v_j') (w_j' v_i),    sum_j B_ij = sum_i B_ij = 1,

where the prime marks the second value and the sums are over all 2n states. Without damping and
friction B is the modal assurance criterion |x_i^T M x_j|^2 of unit modal masses (R. J. Allemang,
Sound and Vibration 37 (2003) 14), and in general the product of two such with left vectors. Where
right vectors alone become parallel, as at a coalescence, it still tends to the identity as the step
becomes small.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Complex, Float

from .._base.parts import Record, flag
from .._mechanism.quantities import (
    axis_values,
    has_memory,
    require_inside,
    require_one,
    substituted,
    with_optional,
)
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .band import in_band
from .field_modes import linearised_with_memory
from .linearise import assembled

_NONE = complex(np.nan, np.nan)


class ModeCrossing(NamedTuple):
    """Where a mode starts to grow, or ceases to, over the quantity of `ModeTracks`."""

    mode: int  # its column
    value: float  # of the quantity
    frequency: float  # [Hz]; 0 where static divergence begins
    starts: bool  # whether it grows above the value


class ModeTracks(Record):
    """Modes over p values of one quantity, as `track_modes` returns them: one in each column.

    k is the number of modes that are there at any value, the lowest frequency first. NaN stands
    where a mode is absent: outside the band of a reduced structure, where its joint is open, and
    for the second of two real eigenvalues where the two are still one conjugate pair.
    """

    name: str = eqx.field(static=True)  # of the quantity
    values: Float[np.ndarray, " p"]  # of the quantity, in SI units
    eigenvalues: Complex[np.ndarray, "p k"]  # [1/s], in the upper half plane
    shapes: Complex[np.ndarray, "p k n"]  # displacements, the largest of each 1
    mac: Float[np.ndarray, "p-1 k"]  # the least within each step; below 0.8 it is no certain match
    x: Any = eqx.field(repr=False)  # the Scene or Structure
    # True if the slope of friction counts
    friction_slope: bool = eqx.field(static=True, default=True)

    @property
    def growth_rates(self) -> Float[np.ndarray, "p k"]:
        """[1/s]"""
        return np.real(self.eigenvalues)

    @property
    def frequencies(self) -> Float[np.ndarray, "p k"]:
        """[Hz]"""
        return np.imag(self.eigenvalues) / (2 * np.pi)

    @property
    def damping_ratios(self) -> Float[np.ndarray, "p k"]:
        """-Re/|s| of each eigenvalue s."""
        return -np.real(self.eigenvalues) / np.abs(self.eigenvalues)

    def crossings(self) -> list[ModeCrossing]:
        """Where modes start or cease to grow between two of the values, in the order of the values.

        Each is the root of the growth rate of its mode, to the rounding of the eigenvalues. Where
        the growth rate is 0 to rounding on one side, as of undamped modes, it is where that ends:
        the frequencies of two modes meet there. Two changes between neighbouring values are missed.
        """
        from scipy.optimize import brentq

        growth = self.growth_rates
        # A smaller growth rate is one of an undamped mode.
        growth = np.where(np.abs(growth) > 1e-9 * np.abs(self.eigenvalues), growth, 0)
        at, crossings = _modes_of(self.x, self.name, self.friction_slope), []
        grows, present = growth > 0, np.isfinite(growth)
        changes = (grows[:-1] != grows[1:]) & present[:-1] & present[1:]
        for i, k in np.argwhere(changes).tolist():
            begin = at(self.values[i])
            index = int(np.abs(begin.s - self.eigenvalues[i, k]).argmin())

            def eigenvalue(value, begin=begin, index=index):
                return complex(_step(begin, at(value), at)[0].s[index])

            ends = self.values[i], self.values[i + 1]
            if growth[i, k] * growth[i + 1, k] < 0:
                more: Any = {"xtol": 1e-300, "rtol": 1e-14}
                value: Any = brentq(lambda value: eigenvalue(value).real, *ends, **more)
            else:
                value = _bisected(lambda value: _grows(eigenvalue(value)), *ends)
            frequency = abs(eigenvalue(value).imag) / (2 * np.pi)
            starts = (growth[i + 1, k] > 0) == (ends[0] < ends[1])
            crossings.append(ModeCrossing(k, float(value), frequency, bool(starts)))
        return crossings

    def _shown(self):
        yield f"{self.name}: {len(self.values)} values"
        yield f"modes: {self.eigenvalues.shape[1]}"
        unstable = (self.growth_rates > 0).any(axis=0).sum()
        yield f"with positive growth rate: {unstable}"


def _grows(s: complex) -> bool:
    """True where a mode grows by more than the rounding of eigenvalues that coalesce."""
    return s.real > 1e-7 * abs(s)


def _bisected(test: Callable[[float], bool], low: float, high: float) -> float:
    """The value where a test that differs at the ends changes, to the last digit."""
    at_low = test(low)
    while True:
        middle = low + (high - low) / 2
        if middle in (low, high):
            return middle
        low, high = (middle, high) if test(middle) == at_low else (low, middle)


def track_modes(
    x: Scene | Structure,
    name: str,
    values: ArrayLike | Sequence[float],
    *,
    friction_slope: bool = True,
) -> ModeTracks:
    """Eigenvalues and shapes of all modes over the values of a quantity, each mode a column.

    Neighbours are paired by the modal assurance criterion of left and right eigenvectors
    (`tracks.py`), MAC = max(0, 1 - |1 - B|), in the best way for all modes together. A step in
    which a MAC is below 0.8 is halved, up to twelve times, and so is one in which two modes swap
    their order: a veering wider than 1/2000 of the step is followed, and a narrower one is a
    crossing. Equal eigenvalues with independent shapes, as in an exact crossing, get the shapes
    that continue those of the value before.

    Where two modes coalesce exactly, no continuation is better than the other: all MACs are at most
    1/2. Then the mode with the higher frequency goes on as the one that grows faster, and that one
    as the higher frequency where they part. With any difference in damping, modes pass the
    coalescence at some distance, and their own continuation decides. `mac` tells which it was.

    Rigid-body modes, with s = 0, are left out.

    **Arguments:**

    - `x`: a scene or structure of scalars.
    - `name`: a quantity by its name in `x.replace`.
    - `values`: (p,), values of the quantity in SI units.
    - `friction_slope`: False leaves the slope of friction out.

    **Returns:** `ModeTracks`.

    **Raises:** `ValueError` for an unknown quantity, values outside its domain or not a list, and a
    structure that is large and sparse; `TypeError` for what is neither a scene nor a structure.
    """
    require_one("x", x)
    flag("friction_slope", friction_slope)
    grid = np.asarray(axis_values(x, name, values), float)
    require_inside(x, {name: grid})
    at = _modes_of(x, name, friction_slope)
    modes, steps, last = [], [], None
    for value in grid:
        current, mac = at(value), np.nan
        if np.isfinite(current.s).all():
            if last is None:
                current = _aligned(current, current)
            else:
                current, mac = _step(last, current, at)
            # Modes that have just coalesced cannot be told apart: the next step passes over.
            unsure = _shown(current) & _uncertain(mac)
            together = np.triu(_equal(current.s[unsure], 100), 1).any()
            last = last if last is not None and together else current
        modes.append(current)
        steps.append(np.broadcast_to(mac, current.s.shape))
    s: Any = np.stack([each.s for each in modes])
    there = np.stack([_shown(each) for each in modes])
    first = there.argmax(axis=0), np.arange(s.shape[1])
    columns = np.argsort(np.where(there.any(axis=0), s[first].imag, np.inf), kind="stable")
    columns = columns[: there.any(axis=0).sum()]
    s, there = s[:, columns], there[:, columns]
    shapes = np.stack([each.right[columns, : x.n] for each in modes])
    # Where the states of a friction law move alone, any shape will do.
    moves = there[..., None] & (shapes != 0).any(axis=2, keepdims=True)
    shapes = np.where(moves, shapes, 1)
    largest = np.abs(shapes).argmax(axis=2)[..., None]
    shapes = shapes / np.take_along_axis(shapes, largest, axis=2)
    return ModeTracks(
        name=name,
        values=grid,
        eigenvalues=np.where(there, s, _NONE),
        shapes=np.where(there[..., None], shapes, _NONE),
        mac=np.where(there[1:] & there[:-1], np.stack(steps)[1:, columns], np.nan),
        x=x,
        friction_slope=friction_slope,
    )


def _modes_of(x: Scene | Structure, name: str, friction_slope: bool) -> Callable[[Any], "_Modes"]:
    """All modes as a function of the quantity's value."""
    whole = with_optional(x, [name])

    def at(value):
        return _Modes(value, *map(np.asarray, _states(whole, name, value, friction_slope)))

    return at


@functools.partial(jax.jit, static_argnames=("name", "friction_slope"))
def _states(x: Scene | Structure, name: str, value: Any, friction_slope: bool):
    """Eigenvalues, right and left states, and which are counted, at a value of the quantity."""
    x = substituted(x, {name: value})
    if has_memory(x):
        field = linearised_with_memory(x, friction_slope)
        right = field.vectors
        left = jnp.linalg.inv(right).T
        return field.s, right, left, in_band(field.s, x.band)
    system = assembled(x.as_structure(), friction_slope)
    (M, C, _), modes = system.matrices, system.solve()
    s, Y = modes.s[:, None], modes.y
    left = jnp.concatenate([s * (Y @ M) + Y @ C, Y @ M], axis=1)
    right = jnp.concatenate([modes.x, s * modes.x], axis=1)
    counted = in_band(modes.s, x.band)
    if jnp.iscomplexobj(system.K):  # structural damping: some places may be left over
        counted &= jnp.isfinite(modes.error)
    return modes.s, right, left, counted


class _Modes(NamedTuple):
    """All states at a value, in the order of the tracks."""

    value: Any
    s: Any  # (k,), k = 2n without friction with memory
    right: np.ndarray  # (k, k), one a row, the displacements first
    left: np.ndarray  # (k, k) likewise; left @ right.T is the identity
    counted: np.ndarray  # (k,)

    def ordered(self, order: np.ndarray) -> "_Modes":
        return _Modes(self.value, *(each[order] for each in self[1:]))


def _step(a: _Modes, b: _Modes, at: Any, halvings: int = 12) -> tuple[_Modes, np.ndarray]:
    """b in the order of a, and the MAC of each mode, with as many values between as it takes.

    The step is halved at most `halvings` times.
    """
    following, mac = _matched(a, b, last=halvings == 0)
    if halvings == 0 or not _doubtful(a, following, mac):
        return following, mac
    # Not quite one half: a round number would meet the places of coalescence.
    between = at(a.value + 0.48 * (b.value - a.value))
    if not np.isfinite(between.s).all():
        return _matched(a, b, last=True)
    between, first = _step(a, between, at, halvings - 1)
    following, second = _step(between, b, at, halvings - 1)
    return following, np.minimum(first, second)


def _doubtful(a: _Modes, b: _Modes, mac: np.ndarray) -> bool:
    """True if a mode that is shown has no sure partner, or passes another one."""
    shown = _shown(a) | _shown(b)
    if _uncertain(mac[shown]).any():
        return True
    before, after = (each.s[shown, None] - each.s[None, shown] for each in (a, b))
    passes = np.real(before.conj() * after) < 0
    # Rounding decides the order of equal eigenvalues.
    return bool((passes & ~_equal(a.s[shown]) & ~_equal(b.s[shown])).any())


def _uncertain(mac: Any) -> np.ndarray:
    """True for a MAC too small for two modes to be surely the same."""
    return np.asarray(mac) < 0.8


def _shown(modes: _Modes) -> np.ndarray:
    return modes.counted & (modes.s.imag >= 0) & (modes.s != 0)


def _equal(s: np.ndarray, factor: float = 1) -> np.ndarray:
    """True for pairs (k, k) of eigenvalues equal to rounding; never for rigid bodies."""
    size = np.abs(s)
    least = np.minimum(size[:, None], size[None])
    return (np.abs(s[:, None] - s[None]) <= factor * _rounding(s) * least) & (least > 0)


def _rounding(s: np.ndarray) -> float:
    return float(np.sqrt(np.finfo(s.dtype).eps))


def _matched(a: _Modes, b: _Modes, last: bool) -> tuple[_Modes, np.ndarray]:
    """b in the order of a, and the MAC of each mode; the `last` step breaks ties by a rule."""
    from scipy.optimize import linear_sum_assignment

    weight = np.minimum(1, np.abs(_overlaps(a, b)))
    b = _aligned(a, b.ordered(linear_sum_assignment(weight, maximize=True)[1]))
    overlaps, order = _overlaps(a, b), np.arange(len(b.s))
    mac = np.maximum(0, 1 - np.abs(1 - overlaps))
    if last:
        weight = np.minimum(1, np.abs(overlaps))
        unsure = np.flatnonzero(_uncertain(np.diagonal(mac)))
        # Two modes that coalesce have one real part before and one imaginary part after it, or the
        # other way round: the sum orders both.
        ranks = [each.s.real + each.s.imag for each in (a, b)]
        for i, j in itertools.combinations(unsure, 2):
            here, there = weight[i, i] + weight[j, j], weight[i, j] + weight[j, i]
            tie = not _uncertain(there) and abs(here - there) < 0.1
            if tie and (ranks[0][i] > ranks[0][j]) != (ranks[1][i] > ranks[1][j]):
                order[[i, j]] = order[[j, i]]
    return b.ordered(order), mac[np.arange(len(order)), order]


def _overlaps(a: _Modes, b: _Modes) -> np.ndarray:
    """B (2n, 2n), rows of a and columns of b."""
    return (a.left @ b.right.T) * (a.right @ b.left.T)


def _aligned(a: _Modes, b: _Modes) -> _Modes:
    """b with the shapes of equal eigenvalues chosen so that they continue the shapes of a."""
    from scipy.sparse.csgraph import connected_components

    equal = _equal(b.s)
    if not np.triu(equal, 1).any():
        return b
    right, left = b.right.copy(), b.left.copy()
    dependent = 1e4  # condition number from which on shapes count as dependent
    labels = connected_components(equal)[1]
    for label in np.flatnonzero(np.bincount(labels) > 1):
        (group,) = np.nonzero(labels == label)
        # A defective pair has one shape only.
        length = np.linalg.norm(right[group], axis=1, keepdims=True)
        if np.linalg.cond(right[group] / length) > dependent:
            continue
        # LAPACK's left vectors of equal eigenvalues do not belong to its right ones.
        dual = np.linalg.pinv(left[group] @ right[group].T) @ left[group]
        rotation = a.right[group] @ dual.T  # rows: modes of a in the space of the group
        if np.linalg.cond(rotation) < dependent:
            right[group], left[group] = rotation @ right[group], np.linalg.inv(rotation).T @ dual
    return b._replace(right=right, left=left)
