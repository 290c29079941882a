"""Reduction of a structure to few degrees of freedom, with the error that it makes.

Right and left eigenvectors in a band of frequencies, at points of the parameters that are chosen
one after the other where the error is largest, span the reduced space after a proper orthogonal
decomposition (N. Graebner, V. Mehrmann, S. Quraishi, C. Schroeder and U. von Wagner, Z. Angew.
Math. Mech. 96 (2016) 1388). With right vectors x = V q and left ones in W,

    W^T M V q'' + W^T C V q' + W^T K V q = W^T F,

an eigenvalue s with vectors q and p is off by

    (Q^T W p)^T Q^-1 (Q V q) / (p^T W^T Q'(s) V q),   Q(s) = s^2 M + s C + K,

the product of two residuals. One factorised Q for all estimates it, and the residuals of all terms
are known beforehand, so that an estimate takes no work of size n.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._base.parts import flag, require_kind, scalar, whole
from .._mechanism.quantities import (
    replaced,
    require_independent,
    require_quantity,
    substituted,
    with_optional,
)
from .._mechanism.reduced import ReducedStructure, Reduction
from .._mechanism.structure import Structure, require_single
from .band import in_band
from .reduced_space import Space, estimated_errors
from .reduction_search import ReductionSearch
from .snapshots import Snapshot, Snapshots, joint_numbers, plain, projected
from .sparse_modes import Factors
from .stability import stability


def reduce(
    structure: Structure,
    over: Mapping[str, Sequence[float]] | None = None,
    band: Sequence[float] = (0.0, np.inf),
    tol: float = 1e-8,
    *,
    friction_slope: bool = True,
    points: int = 40,
    progress: bool = False,
    search: ReductionSearch = ReductionSearch(),
) -> ReducedStructure:
    """A small structure with the eigenvalues of a large one in a band of frequencies.

    In the band, every eigenvalue s is right to `tol` |s| at all candidates, by an estimate, and at
    two fresh points, by comparison. Candidates are 33 along one quantity, 32 for each of several,
    128 at most, besides the corners; `search` can change these numbers. Modes with |Re s| > 0.3
    |s|, static divergence among them, are not looked for.

    The result keeps parameters, joints and their directions, and derivatives; `.full(q)` leads back
    to all degrees of freedom, `.reduction` has the bases, the points and the largest error, and
    `reduction_errors` estimates that of each eigenvalue. Without joints, and with a mass matrix
    that does not depend on parameters, the projection is oblique, left vectors against right ones;
    otherwise one space holds both, so that a joint pulls where it is pulled, and static
    displacements under F and along the joints' directions as well.

    Not for use under `jit`; what it returns is.

    **Arguments:**

    - `structure`: a `Structure`, also a large and sparse one.
    - `over`: {name: (low, high)} of quantities, parameters or those of joints, in SI units: the
      ranges in which the reduction holds. By default it holds for the quantities as they are.
    - `band`: (low, high) of |Im s| [rad/s], by default all frequencies.
    - `tol`: largest relative error of an eigenvalue, 1e-8 by default.
    - `friction_slope`: False leaves the slope of friction out.
    - `points`: the most points at which eigenvectors are computed, 40 by default.
    - `progress`: shows a bar; False by default.
    - `search`: numbers of the search, a `ReductionSearch`.

    **Raises:** `ValueError` for a band or a range that is empty or outside the domain, an unknown
    quantity, and if `tol` is not met with so many points.
    """
    require_kind("structure", structure, Structure)
    require_single(structure)
    low, high = _range("band", band)
    if not (low >= 0 and np.isfinite(high)):
        raise ValueError(f"band must be (low, high) in rad/s, 0 <= low < high, got {band!r}")
    ranges = {name: _range(name, ends) for name, ends in (over or {}).items()}
    for name in ranges:
        require_quantity(structure, name)
    require_independent(structure, list(ranges))
    for ends in zip(*ranges.values(), strict=True):
        replaced(structure, dict(zip(ranges, ends, strict=True)))
    tol = float(scalar("tol", tol, above=1e-12, at_most=0.1))
    flag("friction_slope", friction_slope)
    require_kind("search", search, ReductionSearch)
    structure = with_optional(structure, list(ranges))
    snapshots = Snapshots(structure, ranges, (low, high), friction_slope, search)
    most = whole("points", points, 1)
    return _Greedy(snapshots, tol, most, flag("progress", progress), search).run()


def reduction_errors(reduced: ReducedStructure) -> Float[np.ndarray, " 2*r"]:
    """The approximate error (2r,) of each eigenvalue of `stability` due to the reduction [1/s].

    In the same order; infinite outside the band. It is the product of the residuals of the right
    and the left vector (see `reduction.py`): an estimate, right to leading order. Not for use under
    `jit`.

    **Arguments:**

    - `reduced`: a structure as `reduce` returns it.
    """
    numbers = joint_numbers(reduced, reduced.reduction.friction_slope)
    s, errors = estimated_errors(reduced, reduced.parameters, np.asarray(numbers))
    modes = stability(reduced, reduced.reduction.friction_slope)
    counted, z = np.asarray(modes.counted), np.asarray(modes.eigenvalues)
    if not s.size:
        return np.full(z.shape, np.inf)
    # Errors are estimated for one of each conjugate pair.
    z = np.where(np.imag(z) < 0, np.conj(z), z)
    distance = np.abs(z[:, None] - s[None])
    return np.where(counted, errors[distance.argmin(axis=1)], np.inf)


def _range(name: str, ends: Any) -> tuple[float, float]:
    try:
        low, high = map(float, ends)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be (low, high), got {ends!r}") from None
    if not low < high:
        raise ValueError(f"{name} must be (low, high) with low < high, got {ends!r}")
    return low, high


_Estimate = tuple[np.ndarray, np.ndarray]  # eigenvalues and their errors at a point


class _Greedy:
    """Points one after the other, where the error is largest, until it is small everywhere."""

    def __init__(
        self,
        snapshots: Snapshots,
        tol: float,
        most: int,
        progress: bool,
        search: ReductionSearch,
    ):
        from tqdm import tqdm

        self.snapshots, self.tol, self.most, self.search = snapshots, tol, most, search
        self.bar = tqdm(disable=not progress, unit="point", desc="reduce")
        self.cut = search.cut * np.sqrt(tol)
        self.points: list[np.ndarray] = []
        self.taken: list[Snapshot] = []
        middle = np.full(len(snapshots.ranges), 0.5)
        x = snapshots.at(middle)
        self.weight = np.sqrt(plain(x, "M").diagonal())
        statics, _ = snapshots.statics(x)
        numbers = snapshots.numbers(x, statics)
        low, high = snapshots.band
        shift = 1e-3 * high + 1j * (low + high) / 2
        self.factors = Factors(snapshots.matrices(x, numbers({})), shift)
        candidates, fresh = snapshots.candidates(), snapshots.fresh()
        self.candidates = [(u, numbers(snapshots.values(u))) for u in candidates]
        self.errors = np.full(len(candidates), np.inf)  # of |s|, as last estimated
        self.fresh = [(u, numbers(snapshots.values(u))) for u in fresh]
        for u in [middle, *(np.full_like(middle, end) for end in (0.0, 1.0) if middle.size)]:
            self.add(u)

    def add(self, u: np.ndarray) -> Snapshot:
        """Take the eigenvectors at a point."""
        if len(self.points) >= self.most:
            raise ValueError(
                f"tol = {self.tol:g} is not met with {self.most} points: take more, a narrower "
                "band or narrower ranges"
            )
        self.points.append(u)
        self.taken.append(self.snapshots.take(u))
        self.bar.update()
        return self.taken[-1]

    def run(self) -> ReducedStructure:
        """The smallest reduced structure found that meets the tolerance."""
        before, finer = np.inf, False
        least_cut = 1e-10
        while True:
            space = Space(self.snapshots, self.taken, self.weight, self.cut, self.factors)
            reduced, estimates = self.sound(space)
            error, at = max((_relative(errors, s), i) for i, (s, errors) in estimates.items())
            self.bar.set_postfix_str(f"error {error:.1e}, {reduced.n} degrees of freedom")
            worst, _ = self.candidates[at]
            if error > self.search.safe * self.tol:
                # Where the worst point's own vectors are in the space, what was cut off of them is
                # the error; where one more point did not halve the error, it is most of it.
                sampled = any(np.array_equal(worst, u) for u in self.points)
                stuck = error > 0.5 * before and not finer and self.cut >= least_cut
                before, finer = error, sampled or stuck
                if not finer:
                    self.add(worst)
                elif self.cut < least_cut:
                    raise ValueError(f"tol = {self.tol:g} is below what rounding allows")
                else:
                    self.cut *= 0.1
                continue
            targets = {i: s for i, (s, _) in estimates.items()}
            trimmed = self.trimmed(space, targets, self.tol)
            reduced, estimate = trimmed or (reduced, error)
            compared = self.compared(reduced)
            if compared <= self.tol:
                break
        self.bar.close()
        reduced.reduction.error = max(estimate, compared)
        search = self.search
        if self.tol < search.coarse_tol and reduced.n >= search.coarse_from:
            coarse = self.trimmed(space, targets, search.coarse_tol)
            if coarse and coarse[0].n <= search.coarse_share * reduced.n:
                reduced.reduction.coarse = space.coarse(reduced.n, coarse[0].n, search.coarse_tol)
        return reduced

    def sound(self, space: Space) -> tuple[ReducedStructure, dict[int, _Estimate]]:
        """The largest structure without spurious modes in the band, and `estimates` of it.

        A spurious mode has an error of its own size, and comes and goes with the directions kept:
        five sizes are tried, two degrees of freedom apart.
        """
        best: Any = None
        for r in range(space.size, max(space.size - 10, 1), -2):
            if best is not None and not space.regular(r):
                continue
            reduced = self.reduced(space, r)
            estimates = self.estimates(reduced)
            largest = _largest(estimates.values()).max()
            if best is None or largest < best[0]:
                best = largest, reduced, estimates
            if largest < 0.02:  # of |s|: all of these are modes
                break
        return best[1:]

    def estimates(self, reduced: ReducedStructure) -> dict[int, _Estimate]:
        """Eigenvalues and errors at candidates, the largest errors of before first.

        At all of them, unless a few have an error that is too large already.
        """
        estimates: dict[int, _Estimate] = {}
        for i in map(int, np.argsort(-self.errors, kind="stable")):
            if (
                len(estimates) % self.search.together == 0
                and max(self.errors[[*estimates]], default=0) > self.search.safe * self.tol
            ):
                break
            s, errors = estimates[i] = self.estimated(reduced, self.candidates[i])
            self.errors[i] = _relative(errors, s)
        return estimates

    def trimmed(
        self, space: Space, targets: dict[int, np.ndarray], tol: float
    ) -> tuple[ReducedStructure, float] | None:
        """The smallest with the eigenvalues `targets` at all candidates, and its error there.

        None if that is the space itself. Sizes are tried at a few candidates, and every one at
        which the smallest that holds there fails is added to them.
        """
        hard = {int(i): targets[i] for i in np.argsort(-self.errors)[: self.search.together]}
        # In one degree of freedom the two directions of a joint would be one.
        joints = self.snapshots.structure.joints
        fails, holds = int(any(joint.normal is not None for joint in joints)), space.size
        while True:
            while holds - fails > 1:
                r = (fails + holds) // 2
                near = range(r, max(r - 4, fails), -1)  # one may have a spurious mode
                sound = next((x for x in near if self.holds(space, x, hard, tol)), None)
                fails, holds = (r, holds) if sound is None else (fails, sound)
            if holds == space.size:
                return None
            smaller = self.reduced(space, holds)
            largest, at = self.failing(smaller, targets, tol)
            if at is None:
                return smaller, largest
            hard = {at: targets[at], **hard}
            fails, holds = holds, space.size

    def holds(self, space: Space, r: int, targets: dict[int, np.ndarray], tol: float) -> bool:
        """True if r degrees of freedom have the eigenvalues `targets` at their candidates."""
        return space.regular(r) and self.failing(self.reduced(space, r), targets, tol)[1] is None

    def failing(
        self, reduced: ReducedStructure, targets: dict[int, np.ndarray], tol: float
    ) -> tuple[float, int | None]:
        """The largest error against `targets` at their candidates, and where one is too large."""
        largest = 0.0
        for i, s in targets.items():
            there, errors = self.estimated(reduced, self.candidates[i])
            # A mode that is lost has no error.
            largest = max(largest, _relative(errors, there), _distance(there, s))
            if largest > self.search.safe * tol:
                return largest, i
        return largest, None

    def reduced(self, space: Space, r: int) -> ReducedStructure:
        """The structure in a space of r degrees of freedom."""
        snapshots = self.snapshots
        V, W, residuals = space.bases(r)
        reduction = Reduction(
            V=V,
            W=W,
            names=snapshots.structure.names,
            over=snapshots.ranges,
            band=snapshots.band,
            tol=self.tol,
            friction_slope=snapshots.friction_slope,
            residuals=residuals,
            points=[snapshots.values(u) for u in self.points],
            touched=snapshots.structure._touched(),
            error=np.inf,
        )
        small = projected(snapshots.structure, V, W)
        return ReducedStructure(**small, reduction=reduction, mesh=snapshots.structure.mesh)

    def estimated(self, reduced, at: tuple[np.ndarray, np.ndarray]):
        """Eigenvalues and their errors at a point with its numbers of the joints."""
        u, numbers = at
        return estimated_errors(reduced, self.snapshots.at(u).parameters, numbers)

    def compared(self, reduced) -> float:
        """The largest error at the worst fresh points, of |s|, against their own eigenvalues."""
        largest = 0.0
        worst = np.argsort(-_largest([self.estimated(reduced, at) for at in self.fresh]))
        low, high = self.snapshots.band
        for i in worst[: self.search.compared if self.snapshots.ranges else 0]:
            u, _ = self.fresh[i]
            values = {name: jnp.asarray(x) for name, x in self.snapshots.values(u).items()}
            # With its own equilibrium.
            numbers = joint_numbers(substituted(reduced, values), self.snapshots.friction_slope)
            s, _ = self.estimated(reduced, (u, np.asarray(numbers)))
            exact: Any = self.add(u).modes.s
            edge, frequency = self.tol * np.abs(exact), np.imag(exact)
            well_inside = (frequency > low + edge) & (frequency < high - edge)
            well_inside &= in_band(exact, self.snapshots.band)
            largest = max(largest, _distance(s, exact[well_inside]))
        return largest


def _largest(estimates: Iterable[_Estimate]) -> np.ndarray:
    """The largest error at each point, of |s|."""
    return np.array([_relative(errors, s) for s, errors in estimates])


def _relative(errors: np.ndarray, s: np.ndarray) -> float:
    return float((errors / np.abs(s)).max(initial=0.0))


def _distance(s: np.ndarray, targets: np.ndarray) -> float:
    """The largest distance from a target eigenvalue to the nearest of s, of |s|."""
    nearest = np.abs(s[None] - targets[:, None]).min(axis=1, initial=np.inf)
    return _relative(nearest, targets)
