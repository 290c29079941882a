"""The equations of `shooting.py` for NumPy: itineraries, meshes and solutions on the host."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._base.programs import exported_jit
from .._continuation import Continuation
from .._mechanism.mechanism import Mechanism
from .contact_state import BACKWARD, FORWARD, STICK, find_state
from .cycle import LimitCycle
from .excitation import compiled_system
from .guard import NONE, SECTION, UNUSED
from .hybrid import HybridSystem
from .shooting import (
    Chain,
    Lifted,
    Place,
    Window,
    condensed,
    linearised,
    lowest,
    resampled,
    return_jacobian,
)
from .tracing import BranchTracing


class Phase(NamedTuple):
    s: tuple[int, ...]  # contact state
    guard: int  # the one that ends it


class Solution(NamedTuple):
    """A periodic orbit on a chain of segments, in scaled units."""

    x: Any  # the mechanism
    phases: tuple[Phase, ...]
    chain: Chain
    lifted: Lifted
    u: np.ndarray
    r: float = 0.0  # place of a second free quantity, if there is one

    @property
    def times(self) -> np.ndarray:
        """Start time of each phase, and the period, in scaled time."""
        k = len(self.lifted.y)
        return np.concatenate([[0], np.cumsum(self.u[k : k + len(self.phases)])])


@exported_jit
def _tangential_displacements(system: HybridSystem, y):
    """t.x of each face (f, k) in states (2n, k)."""
    return system.along(y[: system.n])


class Family:
    """The cycles of one mechanism with one quantity free, and how finely they are cut."""

    def __init__(
        self,
        x: Mechanism,
        window: Window,
        step: float,
        rtol: float,
        tracing: BranchTracing = BranchTracing(),
    ):
        self.x, self.window, self.step, self.tracing = x, window, step, tracing
        self.template = compiled_system(x, None)
        self.n = self.template.n
        self.h, self.rtol = tracing.segment * (rtol / 1e-9) ** 0.125, rtol
        self.segments = 0  # most so far; never fewer, since another number compiles anew

    def sampled(self, orbit: Solution, times, places: int):
        """States (2n, places) of an orbit at times, and how much shorter segments should be."""
        period = orbit.u[2 * self.n : -1].sum()
        wrapped = jnp.asarray(np.mod(times, period))
        arguments = orbit.x, self.window, orbit.chain, orbit.lifted, orbit.u
        return resampled(*arguments, wrapped, self.h, places=places)

    def linearised(self, q) -> tuple[np.ndarray, np.ndarray]:
        """The sliding equilibrium (2n,) and the Jacobian (2n, 2n) of the field there."""
        y, A = linearised(self.x, self.window, jnp.asarray(q, float))
        return np.asarray(y), np.asarray(A)

    def eigenvalue(self, q, frequency) -> complex:
        """The eigenvalue of the equilibrium nearest to a frequency, in scaled units."""
        values = np.linalg.eigvals(self.linearised(q)[1])
        return complex(values[np.argmin(np.abs(values - 1j * frequency))])

    def hopf_near(self, q, frequency) -> tuple[float, float] | None:
        """Quantity and frequency of the Hopf point near the given ones, or None."""
        import scipy.optimize  # imported here because it is slow to import

        try:
            at: Any = scipy.optimize.newton(
                lambda q: self.eigenvalue(q, frequency).real, q, x1=q + 1e-4, tol=1e-15, maxiter=50
            )
        except RuntimeError:
            return None
        value = self.eigenvalue(at, frequency)
        return (float(at), value.imag) if abs(value.real) < 1e-10 else None

    def maximum(self, orbit: Solution, period) -> float:
        """The approximate time of the largest t.x."""
        times = np.linspace(0, period, self.tracing.samples, endpoint=False)
        y, _ = self.sampled(orbit, times, len(times))
        return float(times[np.argmax(np.asarray(_tangential_displacements(self.template, y))[0])])


class Shooting:
    """The equations of one itinerary for NumPy: unknowns z are u without padding, scaled."""

    gap = 1e-7  # between segments, above which a zero is not accepted
    closable = 1e-3  # gap that Newton's method may close, and up to which a cubic serves
    linear = 1e-10  # distance within which an evaluation is extrapolated linearly
    closed = 1e-8  # gap between the segments of a solution

    def __init__(self, family: Family, old: Solution, phases, times):
        """`phases` begin at `times` (m + 1,) on an old orbit; the last time is their end."""
        self.family, self.phases, self.x = family, tuple(phases), old.x
        self.tracing = family.tracing
        n, m = family.n, len(self.phases)
        self.quantity = 2 * n + m  # its index among the unknowns
        chain, moments, N = self._mesh(old, np.asarray(times, float))
        y, _ = family.sampled(old, moments, N)
        h = np.diff(times)
        self.padded = bucket(m, 8)
        u = np.concatenate([np.asarray(y[:, 0]), h, np.zeros(self.padded - m), old.u[-1:]])
        self.chain, self.m, self.length = chain, m, h.copy()
        blank = jnp.zeros((2 * n, len(u), N), y.dtype)
        self.memory = [Lifted(jnp.asarray(u), y, blank)]
        self.keys = self.key(u, old.r)[None]  # of the memory
        self.gaps = np.array([self.tracing.kept_gap])
        self.evaluations: dict[bytes, Any] = {}  # at the last points
        self.spectra: dict[bytes, np.ndarray] = {}  # at the last two points
        self.last: tuple[Any, ...] | None = None  # point without gaps, its residual and Jacobian
        size = 1 + float(np.abs(np.asarray(y)).max())
        period = float(h.sum())
        self.scale = np.concatenate([np.full(2 * n, size), np.full(m, period), [1.0]])
        self.active = np.r_[np.arange(2 * n + m), len(u) - 1]
        self.begin = self.located(u, old.r)
        self.curves = self._curves()
        self.orders = self._orders()

    def again(self, old: Solution, phases, times) -> "Shooting":
        """The equations of another itinerary, or of the same one on a new mesh."""
        return Shooting(self.family, old, phases, times)

    def _curves(self) -> Continuation:
        """Continuation along the solutions, both ways, with the quantities in their windows."""
        inside = np.arange(len(self.begin)) >= self.quantity
        return Continuation(
            self.equations,
            low=np.where(inside, 0.0, -np.inf),
            high=np.where(inside, 1.0, np.inf),
            valid=lambda z: bool(np.isfinite(z).all()),
            tolerance=1e-9,
            settled=1e-11,
            small=1e-9,  # a cycle may repel so much inside that its start says little of its end
            oriented=False,
            longest=self.family.step,
            shortest=1e-8,
        )

    def _mesh(self, old, times):
        """The chain of segments, of equal weight within a phase, their start times and number."""
        starts, lengths = times[:-1], np.diff(times)
        span = times[-1] - times[0]
        clock = np.linspace(0, span, self.tracing.samples + 1)
        if self.family.template.scales is not None:
            # Where a law falls within a small part of the velocity the old segments are short.
            phase, begin = np.asarray(old.chain.phase), np.asarray(old.chain.begin)
            old_starts = old.times[phase] + begin * np.diff(old.times)[phase]
            old_starts = np.clip(np.mod(old_starts - times[0], old.times[-1]), 0, span)
            clock = np.sort(np.concatenate([clock, old_starts]))
        _, density = self.family.sampled(old, times[0] + clock, len(clock))
        density = np.maximum(1, np.asarray(density))
        steps = np.maximum(density[1:], density[:-1]) * np.diff(clock)
        total = np.concatenate([[0.0], np.cumsum(steps)])
        weight = np.interp(times - times[0], clock, total)
        counts = np.maximum(1, np.ceil(np.diff(weight) / self.family.h - 1e-6)).astype(int)
        N = self.family.segments = max(self.family.segments, bucket(counts.sum(), 64))
        s, guard, phase, begin, share, moments = [], [], [], [], [], []
        for p, (start, length, count) in enumerate(zip(starts, lengths, counts, strict=True)):
            inside = np.linspace(weight[p], weight[p + 1], count + 1)
            edges = np.interp(inside, total, clock) - (start - times[0])
            edges = edges / length if length > 0 else np.linspace(0, 1, count + 1)
            edges[0], edges[-1] = 0, 1
            s += [self.phases[p].s] * count
            guard += [NONE] * (count - 1) + [self.phases[p].guard]
            phase += [p] * count
            begin += list(edges[:-1])
            share += list(np.diff(edges))
            moments += list(start + edges[:-1] * length)
        rest = N - len(s)
        dtype = old.lifted.y.dtype
        chain = Chain(
            s=jnp.asarray(np.array(s + [s[-1]] * rest).T, dtype),
            guard=jnp.asarray(guard + [UNUSED] * rest),
            phase=jnp.asarray(phase + [phase[-1]] * rest),
            begin=jnp.asarray(begin + [1.0] * rest, dtype),
            share=jnp.asarray(share + [0.0] * rest, dtype),
            used=jnp.asarray(np.arange(bucket(len(lengths), 8)) < len(lengths), dtype),
        )
        return chain, np.array(moments + [times[0]] * rest), N

    def _orders(self):
        """Orders of the guards' zeros (k, M) at the start and at the end of each phase."""
        system = self.family.template
        numbers = system.guard_numbers
        # Where friction falls by a jump, w starts with its first derivative.
        jumps = np.zeros(len(system.P), bool)
        if system.has_jump:
            jumps = np.asarray(system.static_excess() > 64 * jnp.finfo(system.P.dtype).eps)
        count = numbers.count
        before, after = np.zeros((count, self.padded), int), np.zeros((count, self.padded), int)
        for p, phase in enumerate(self.phases):
            last = self.phases[p - 1]
            for i, (was, now) in enumerate(zip(last.s, phase.s, strict=True)):
                if now not in (FORWARD, BACKWARD):
                    continue
                if was == STICK:
                    # Released by its own limit w starts with its second derivative.
                    smooth = numbers.face(last.guard) == i and not jumps[i]
                    before[numbers.lower(i), p] = 2 if smooth else 1
                elif was == -now:
                    before[numbers.lower(i), p] = 1
            if numbers.opens_joint(last.guard) and last.s != phase.s:
                before[last.guard, p] = 1
            if phase.guard > 0:
                after[phase.guard, p] = 1
        return jnp.asarray(before), jnp.asarray(after)

    # --- unknowns ---

    def located(self, u, r=0.0) -> np.ndarray:
        """The unknowns z of u, and of a second quantity where there is one."""
        return u[self.active] / self.scale

    def full(self, z) -> np.ndarray:
        u, scale = np.zeros(2 * self.family.n + self.padded + 1), self.scale[: self.quantity + 1]
        u[self.active] = z[: self.quantity + 1] * scale
        return u

    def key(self, u, r=0.0) -> np.ndarray:
        """The key by which the memory holds an evaluation."""
        return u

    def durations(self, z) -> np.ndarray:
        """Scaled durations of the phases, which must be above zero."""
        return z[2 * self.family.n : self.quantity]

    def lengths(self, z) -> np.ndarray:
        """The durations of the phases in scaled time."""
        durations = slice(2 * self.family.n, self.quantity)
        return z[durations] * self.scale[durations]

    def times(self, z) -> np.ndarray:
        """Start time of each phase, and the end of the last."""
        return np.concatenate([[0], np.cumsum(self.lengths(z))])

    def mechanism(self, z) -> Any:
        return self.x

    def stale(self, z) -> bool:
        """True if a phase has grown so much that it must be cut anew."""
        h = self.lengths(z)
        return bool((h > self.tracing.growth * self.length + 1e-2).any())

    def index(self, p: int) -> int:
        """The coordinate that is the duration of phase p."""
        return 2 * self.family.n + p

    # --- equations ---

    def _nearest(self, key) -> int:
        """Index of the evaluation that predicts the states best: near, and with small gaps."""
        return int(np.argmin(np.abs(self.keys - key).max(axis=1) ** 2 + self.gaps**2))

    def extrapolated(self, key, u) -> Lifted:
        """The states at u, by a cubic through two evaluations where these lie in line with it."""
        i = self._nearest(key)
        near, ways, way = self.memory[i], self.keys[i] - self.keys, key - self.keys[i]
        distance = np.abs(way).max()
        if not self.closable or distance < self.linear or self.gaps[i] > self.closable:
            return near
        shares = ways @ way / np.maximum((ways**2).sum(axis=1), 1e-300)
        off = np.abs(way - shares[:, None] * ways).max(axis=1)
        # At 0 is the nearest evaluation and at -1 the other one.
        fits = (shares > -0.9) & (shares < 3.0) & (self.gaps < self.closable)
        fits &= off < 0.3 * distance
        if not fits.any():
            return near
        k = int(np.argmin(np.where(fits, np.abs(shares), np.inf)))
        first, last, D, before = map(
            np.asarray, (self.memory[k].y, near.y, near.D, self.memory[k].D)
        )
        step = np.asarray(near.u) - np.asarray(self.memory[k].u)
        slope, slope_before, change = (
            np.einsum("ikn,k->in", A, by)
            for A, by in ((D, step), (before, step), (D, u - np.asarray(near.u)))
        )
        square = 2 * slope + slope_before - 3 * (last - first)
        cube = slope + slope_before - 2 * (last - first)
        return Lifted(u, last + change + shares[k] ** 2 * (square + shares[k] * cube), near.D)

    def evaluated(self, z):
        """Residual and Jacobian of the orbit at z, the latter by the unscaled unknowns."""
        key = z.tobytes()
        if key in self.evaluations:
            return self.evaluations[key]
        if self.last is not None and np.abs(z - self.last[0]).max() < self.linear:
            at, residual, jacobian = self.last
            return residual + jacobian @ ((z - at) * self.scale), jacobian
        u, at = self.full(z), self.key(self.full(z), z[-1])
        x, window, states = (
            self.mechanism(z),
            self.family.window,
            self.extrapolated(at, self.full(z)),
        )
        rows = np.arange(2 * self.family.n + self.m)
        for _ in range(self.tracing.closings):
            arguments = x, window, self.chain, states, u
            residual, jacobian, states, gap = condensed(*arguments)
            residual, gap = np.asarray(residual)[rows], float(gap)
            # Newton's method closes gaps as well; the residual is uncertain by their squares.
            if not gap > self.gap or (gap < self.closable and 10 * gap**2 < np.abs(residual).max()):
                break
        last = self.tracing.memory
        if gap < self.tracing.kept_gap:
            self.memory = [*self.memory[-last:], states]
            self.keys = np.concatenate([self.keys[-last:], at[None]])
            self.gaps = np.append(self.gaps[-last:], gap)
        evaluation = residual, np.asarray(jacobian)[np.ix_(rows, self.active)]
        self.evaluations = dict([*self.evaluations.items()][-last:]) | {key: evaluation}
        if gap <= self.gap and self.linear:
            self.last = z, *evaluation
        return evaluation

    def equations(self, z):
        residual, jacobian = self.evaluated(z)
        return residual, jacobian * self.scale

    def solution(self, z) -> Solution:
        """The orbit at z, its gaps closed even where the evaluation at z left some."""
        u, x = self.full(z), self.mechanism(z)
        key = self.key(u, z[-1])
        i = self._nearest(key)
        lifted, gap = self.memory[i], max(np.abs(self.keys[i] - key).max(), self.gaps[i])
        for _ in range(self.tracing.closings):
            if gap <= self.closed:
                break
            *_, lifted, gap = condensed(x, self.family.window, self.chain, lifted, u)
        return Solution(x, self.phases, self.chain, lifted, u)

    def multipliers(self, z) -> np.ndarray:
        """Floquet multipliers (2n,) by size, and 1 last."""
        key = z.tobytes()
        if key not in self.spectra:
            jacobian = return_jacobian(self.evaluated(z)[1], 2 * self.family.n, np)
            multipliers = floquet_multipliers(jacobian)
            self.spectra = dict([*self.spectra.items()][-1:]) | {key: multipliers}
        return self.spectra[key]

    def lowest(self, z) -> tuple[float, Place]:
        """The least reduced guard on the orbit, and its place."""
        x, _, chain, lifted, u, _ = self.solution(z)
        value, place = lowest(x, self.family.window, chain, lifted, u, *self.orders)
        return float(value), jax.tree.map(lambda a: np.asarray(a)[()], place)

    def admissibility(self, z) -> float:
        """Above zero where every phase lasts and no guard is below zero."""
        shortest = float(self.durations(z).min())
        return shortest if shortest <= 0 else min(shortest, self.lowest(z)[0])

    def itinerary(self) -> str:
        return " ".join("".join(find_state(i).symbol for i in phase.s) for phase in self.phases)


def bucket(count: int, least: int) -> int:
    """The next `least` times a power of four: few shapes, hence few compilations.

    Beyond 256 a power of two: there half an evaluation pays for another compilation.
    """
    size = least
    while size < count:
        size *= 4 if size < 256 else 2
    return size


def floquet_multipliers(return_jacobian) -> np.ndarray:
    """Floquet multipliers by size, and 1 last, from the Jacobian of the return map.

    This Jacobian has the eigenvalue 0 in place of the multiplier 1.
    """
    values = np.linalg.eigvals(return_jacobian).astype(complex)
    order = np.argsort(-np.abs(values))
    return np.append(values[order[:-1]], 1.0)


def build_solution(cycle: LimitCycle, x: Mechanism, q: float) -> Solution:
    """The orbit of a limit cycle of x as phases, in its own scaled units."""
    segments = cycle._orbit.segments
    guard = np.asarray(segments.guard)
    used = guard != UNUSED
    guard, s = guard[used], np.asarray(segments.s)[:, used].astype(int)
    h, y = np.asarray(segments.duration)[used], np.asarray(segments.y)[:, used]
    switches = bool((guard > 0).any())
    ends = guard > 0 if switches else guard == SECTION
    if switches:
        # The chain begins after a switch.
        first = int(np.flatnonzero(ends)[0]) + 1
        guard, h, ends = (np.roll(a, -first) for a in (guard, h, ends))
        s, y = np.roll(s, -first, axis=1), np.roll(y, -first, axis=1)
    last = np.flatnonzero(ends)
    if not switches:
        last = last[-1:]
    phase = np.searchsorted(last, np.arange(len(h)))
    lengths = np.bincount(phase, h)
    before = np.concatenate([[0], np.cumsum(h)[:-1]])
    begin = before - np.concatenate([[0], np.cumsum(lengths)])[phase]
    phases = tuple(Phase(tuple(int(i) for i in s[:, k]), int(guard[k])) for k in last)
    M = bucket(len(lengths), 8)
    N = bucket(len(h), 64)
    inner = np.where(ends if switches else np.arange(len(h)) == last[-1], guard, NONE)
    rest = N - len(h)

    def padded(a, value):
        return jnp.asarray(np.concatenate([a, np.full(rest, value)]).astype(np.asarray(a).dtype))

    chain = Chain(
        s=jnp.asarray(np.pad(s, ((0, 0), (0, rest)), mode="edge").astype(y.dtype)),
        guard=padded(inner, UNUSED),
        phase=padded(phase, phase[-1]),
        begin=padded(begin / lengths[phase], 1.0),
        share=padded(h / lengths[phase], 0.0),
        used=jnp.asarray(np.arange(M) < len(lengths), y.dtype),
    )
    y = np.concatenate([y, np.repeat(y[:, :1], rest, axis=1)], axis=1)
    u = np.concatenate([y[:, 0], lengths, np.zeros(M - len(lengths)), [q]])
    blank = jnp.zeros((len(y), len(u), N), y.dtype)
    return Solution(x, phases, chain, Lifted(jnp.asarray(u), jnp.asarray(y), blank), u)
