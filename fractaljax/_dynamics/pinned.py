"""The equations of a cycle that is held at an event, with two quantities of the mechanism free.

One condition joins the equations of `itinerary.py`: a fold, a multiplier on the unit circle, a
guard that touches zero, or a phase of no duration. Newton's method solves the exact equations. In
its Jacobian the row of the condition and the column of the second quantity are finite differences,
accurate to some digits.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import substituted
from .guard import SECTION
from .itinerary import Family, Phase, Shooting, Solution
from .shooting import (
    Place,
    Window,
    descended,
    durations,
    reduced_guard,
    return_jacobian,
)


class Event(NamedTuple):
    """The event at which the cycle is held."""

    condition: str  # "fold", "multiplier", "touch" or "vanish"
    place: Any = None  # of "touch"
    phase: Phase | None = None  # the one of no duration, of "vanish"
    side: int = 0  # -1 where that is at the start of a phase, 1 at its end
    multiplier: complex | None = None  # by default the one nearest to the unit circle

    @classmethod
    def of(cls, condition: str, detail: Any, solution: Solution) -> "Event":
        """The event where `condition` vanishes on a branch, with its `detail`."""
        if condition == "vanish":
            return cls(condition, phase=solution.phases[detail])
        if condition != "touch":
            return cls(condition)
        k, theta, chain = int(detail.segment), float(detail.theta), solution.chain
        # Shares of a phase add up to 1 to rounding.
        begins, ends = chain.begin[k] == 0, chain.begin[k] + chain.share[k] > 1 - 1e-6
        if theta == 0 and begins:
            return cls(condition, detail, side=-1)
        return cls(condition, detail, side=1 if theta == 1 and ends else 0)


class Pinned(Shooting):
    """The equations of one itinerary held at an event; the second quantity comes last in z."""

    gap = 1e-11  # differences of the Jacobian need more than the orbit does
    closable = linear = 0.0
    difference = 1e-7  # step of the differences, half the digits of the residual

    def __init__(self, family: Family, second: Window, event: Event, old: Solution, phases, times):
        self.second, self.event, self.borders = second, event, None
        self.held: int | None = None  # the phase of no duration
        super().__init__(family, old, phases, times)
        self.scale = np.append(self.scale, 1.0)
        if event.condition == "vanish":
            self._hold(np.diff(times))
        if event.condition == "touch":
            self._locate(old, np.asarray(times, float))

    def again(self, old, phases, times) -> "Pinned":
        return Pinned(self.family, self.second, self.event, old, phases, times)

    def located(self, u, r=0.0) -> np.ndarray:
        return np.append(u[self.active] / self.scale[: len(self.active)], r)

    def key(self, u, r=0.0) -> np.ndarray:
        # The states between do not follow the second quantity: any change of it is a large one.
        return np.append(u, 1e4 * r)

    def mechanism(self, z) -> Mechanism:
        return mechanism(self.x, self.second, z[-1])

    def solution(self, z) -> Solution:
        return super().solution(z)._replace(r=float(z[-1]))

    def stale(self, z) -> bool:
        place = self.event.place
        outside = place is not None and not -0.2 < place.theta < 1.2
        return outside or super().stale(z)

    def durations(self, z) -> np.ndarray:
        of_phases = super().durations(z)
        return of_phases if self.held is None else np.delete(of_phases, self.held)

    def equations(self, z):
        residual, jacobian = self._orbit(z)
        beside = z.copy()
        step = beside[-1] = z[-1] + (self.difference if z[-1] < 0.5 else -self.difference)
        step -= z[-1]
        other, other_jacobian = self._orbit(beside)
        column = (other - residual) / step
        if self.event.condition == "touch":
            value, row = self._touch(z, keep=True)
            along = (self._touch(beside)[0] - value) / step
        elif self.event.condition == "vanish":
            place = np.nan if self.held is None else self.index(self.held)
            value, row, along = z[place], np.arange(len(z) - 1) == place, 0.0
        else:
            fold = self.event.condition == "fold"
            value, pairs = (self._fold if fold else self._multiplier)(jacobian)
            row, along = np.zeros(len(z) - 1), 0.0
            for left, right in pairs:
                # left . dJ right, by the symmetry of second derivatives, is left . dJ along right.
                displaced = z + self.difference * np.append(right, [0.0, 0.0])
                row = row + left @ (self._orbit(displaced)[1] - jacobian) / self.difference
                along += left @ (other_jacobian - jacobian)[:, :-1] @ right / step
        rows = np.column_stack([jacobian, column])
        return np.append(residual, value), np.vstack([rows, np.append(row, along)])

    def _orbit(self, z):
        """Residual and Jacobian of the orbit by all unknowns, scaled, but the second quantity."""
        residual, jacobian = self.evaluated(z)
        return residual, jacobian * self.scale[:-1]

    def _fold(self, jacobian):
        """The last element of the inverse of the bordered Jacobian, which vanishes at a fold."""
        A = jacobian[:, :-1]
        if self.borders is None:
            left, _, right = np.linalg.svd(A)
            self.borders = left[:, -1], right[-1]
        b, c = self.borders
        bordered = np.block([[A, b[:, None]], [c[None], np.zeros((1, 1))]])
        last = np.eye(len(bordered))[-1]
        right, left = np.linalg.solve(bordered, last), np.linalg.solve(bordered.T, last)
        return right[-1], [(-left[:-1], right[:-1])]

    def _multiplier(self, jacobian):
        """The modulus of the multiplier, less 1."""
        plain, k = jacobian / self.scale[:-1], 2 * self.family.n
        values, vectors = np.linalg.eig(return_jacobian(plain, k, np))
        last = self.event.multiplier
        distance = np.abs(np.abs(values) - 1) if last is None else np.abs(values - last)
        i = int(np.argmin(distance))
        value, right, left = values[i], vectors[:, i], np.linalg.inv(vectors)[i]
        self.event = self.event._replace(multiplier=complex(value))
        S, T, Q = plain[k:, k:-1], plain[k:, :k], plain[:k, k:-1]
        right = np.append(right, -np.linalg.solve(S, T @ right)) / self.scale[:-2]
        left = np.append(left, -np.linalg.solve(S.T, Q.T @ left)) * np.conj(value) / abs(value)
        return abs(value) - 1, [(left.real, right.real), (-left.imag, right.imag)]

    # --- a phase that has no duration ---

    def _hold(self, lengths) -> None:
        """Find the phase of no duration; guards that are zero there are ignored beside it."""
        alike = [phase == self.event.phase for phase in self.phases]
        matches = np.flatnonzero(np.array(alike) & (lengths <= 1e-9 * lengths.sum()))
        if not len(matches):
            return
        self.held = p = int(matches[0])
        last, following = p - 1, (p + 1) % self.m
        before = np.array(self.orders[0])
        before[:, p] = -1
        for guard in {self.phases[last].guard, self.phases[p].guard} - {SECTION}:
            before[guard, [last, following]] = -1
        self.orders = jnp.asarray(before), self.orders[1]

    # --- a guard that touches zero ---

    def _touch(self, z, keep=False):
        """The least value of the guard, and its gradient by the scaled unknowns but the second."""
        if self.event.place is None:
            return np.nan, np.full(len(z) - 1, np.nan)
        self.evaluated(z)
        x, _, chain, lifted, u, _ = self.solution(z)
        place, inside = self.event.place, self.event.side == 0
        value, row, theta = _touching(x, self.family.window, chain, lifted, u, place, inside)
        if keep and inside:
            self.event = self.event._replace(place=_at_share(place, float(theta)))
        return float(value), np.asarray(row)[self.active] * self.scale[:-1]

    def _locate(self, old: Solution, times) -> None:
        """Locate the touching guard on this mesh, from its place on the old orbit."""
        was, self.event = self.event.place, self.event._replace(place=None)
        if was is None:
            return
        k, h = int(was.segment), np.asarray(durations(old.chain, old.u, self.family.n))
        moment = h[:k].sum() + float(was.theta) * h[k]
        s = tuple(np.asarray(old.chain.s)[:, k].astype(int))
        period = times[-1] - times[0]
        first, last = times[:-1] - times[0], times[1:] - times[0]
        near = 1e-6  # scaled time within which the moment is that of a switch
        begun = (moment - times[0] - first + near) % period - near
        left, side = last - first - begun, self.event.side
        for p in np.flatnonzero([phase.s == s for phase in self.phases]):
            outside = left[p] < -near if side == 0 else abs((begun, left)[side > 0][p]) > near
            if not outside and last[p] > first[p]:
                self._place_in(int(p), begun[p] / (last[p] - first[p]), was)
                return

    def _place_in(self, p: int, share: float, was: Place) -> None:
        """Set the place at that share of phase p, where its guard is then ignored."""
        used = np.asarray(self.chain.share) > 0
        mine, side = np.flatnonzero(used & (np.asarray(self.chain.phase) == p)), self.event.side
        begin, length = np.asarray(self.chain.begin)[mine], np.asarray(self.chain.share)[mine]
        i = max(0, int(np.searchsorted(begin, share, side="right")) - 1)
        theta = float(np.clip((share - begin[i]) / length[i], 0, 1))
        if side:
            i, theta = (0, 0.0) if side < 0 else (len(mine) - 1, 1.0)
        before, after = map(np.array, self.orders)
        orders = before[was.guard, p], after[was.guard, p]
        place = Place(was.guard, mine[i], jnp.asarray(theta), *orders)
        self.event = self.event._replace(place=place)
        before[was.guard, p] = -1
        self.orders = jnp.asarray(before), jnp.asarray(after)


def _at_share(place: Place, theta: float) -> Place:
    return Place(place.guard, place.segment, jnp.asarray(theta), place.before, place.after)


@functools.partial(jax.jit, static_argnames="inside")
def _touching(x, window: Window, chain, lifted, u, place: Place, inside: bool):
    """The reduced guard near a place, its gradient by u, and the share of the segment there."""

    def guard(u, theta):
        system = window.system(x, u[-1])
        h = durations(chain, u, system.n)
        return reduced_guard(system, chain, lifted.at(u), h, place, theta)

    theta = jnp.asarray(place.theta, u.dtype)
    if inside:
        theta = descended(lambda at: guard(u, at), theta, (1 / 16, 1 / 64, 1 / 512, 1 / 2048))
    value, row = jax.value_and_grad(guard)(u, jax.lax.stop_gradient(theta))
    return value, row, theta


@jax.jit
def mechanism(x: Mechanism, second: Window, r) -> Mechanism:
    """The mechanism with the second quantity at its place r."""
    return substituted(x, {second.name: second.value(r)})
