"""Basins of attraction: what each of many starts ends in, and the share of each outcome.

All starts run side by side, coarsely, as in `search.py`, and leave the run once they are labelled:
near an attracting orbit that an earlier start led to, decaying at the equilibrium, or diverging.
One that stays without a label is searched in full; its orbit then labels others.
"""

import concurrent.futures
import dataclasses
import functools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, Int

from .._base.parts import Record, concrete, flag, require_kind, whole
from .._base.programs import exported_jit
from .._base.table import table
from .._mechanism.mechanism import Mechanism
from .basin_search import BasinSearch
from .contact_state import FORWARD
from .cycle import CycleResult, LimitCycle
from .events import step
from .excitation import Excitation, compiled_system
from .guard import NONE, SECTION
from .hybrid import HybridSystem
from .limit_cycle import limit_cycle
from .scaled import check_rtol, degrees_of_freedom, require_drive
from .segments import next_start
from .starts import starts_of
from .transition import first_contact_state

# A cycle is labelled by its index.
_RUNNING, _EQUILIBRIUM, _DIVERGES, _UNDECIDED, _LOST = -1, -2, -3, -4, -5


class Basin(Record):
    """What the starts end in, as `basin` returns it, in NumPy arrays. It prints as a table."""

    starts: Float[np.ndarray, "k 2n"]  # [x, v] [m, m/s]
    labels: Int[np.ndarray, " k"]  # indices into `outcomes`
    outcomes: tuple[str, ...]  # "equilibrium", "cycle 1", ..., "diverges", "undecided"
    cycles: tuple[LimitCycle, ...]  # "cycle 1", ..., from the largest share to the smallest
    reasons: Mapping[int, CycleResult]  # why a start is undecided, by its index

    @property
    def shares(self) -> dict[str, float]:
        """The share of the starts by outcome."""
        counts = np.bincount(self.labels, minlength=len(self.outcomes))
        return dict(zip(self.outcomes, (counts / len(self.labels)).tolist(), strict=True))

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the shares: sqrt(p (1 - p)/k), as for k independent starts.

        Low-discrepancy starts are mostly closer. A share of 0 is below 3/k with 95 % confidence.
        """
        k = len(self.labels)
        return {name: float(np.sqrt(p * (1 - p) / k)) for name, p in self.shares.items()}

    def __repr__(self) -> str:
        counts = np.bincount(self.labels, minlength=len(self.outcomes))
        errors = self.standard_errors
        cycles = [None, *self.cycles, None, None]
        columns = [
            {
                "starts": f"{count}",
                "share": f"{share:.2%} +- {errors[name]:.2%}",
                "frequency [Hz]": "-" if cycle is None else f"{cycle.frequency:.6g}",
                "largest peak to peak [m]": "-"
                if cycle is None
                else f"{cycle.amplitude.max():.6g}",
            }
            for (name, share), count, cycle in zip(self.shares.items(), counts, cycles, strict=True)
        ]
        lines = [table(list(self.outcomes), columns)]
        texts = [CycleResult[reason] for reason in self.reasons.values()]
        lines += [f"undecided, {texts.count(text)}: {text}" for text in dict.fromkeys(texts)]
        return "\n".join(lines)


class _Lanes(Record):
    """Motions side by side, along the last axis."""

    y: Float[Array, "2n k"]
    s: Float[Array, "f k"]
    guard: Int[Array, " k"]  # that ended the last step
    section_state: Float[Array, "2n k"]  # at the last return to the section
    returns: Int[Array, " k"]
    rounds: Int[Array, " k"]
    smooth: Int[Array, " k"]  # rounds since the last switch
    energy: Float[Array, "2n k"]  # of the modes, summed over samples of this window
    log: Float[Array, "2n k"]  # amplitude of the modes in the last window
    rate: Float[Array, "2n k"]  # change of `log` since the previous window
    owner: Int[Array, " k"]  # the nearest cycle
    distance: Float[Array, " k"]  # from it
    approach: Int[Array, " k"]  # rounds in which the distance fell
    near: Int[Array, " k"]  # rounds in which it was small
    label: Int[Array, " k"]


@exported_jit
def _linearised(system: HybridSystem, starts) -> tuple[Array, ...]:
    """The equilibrium (2n,), the field's Jacobian there, the normal forces and their Jacobian.

    The last value is the size beyond which a motion from `starts` (2n, k) diverges.
    """
    y, slip = system.equilibrium(), jnp.ones(len(system.P), system.P.dtype)
    x = y[: system.n]
    slope = jax.jacfwd(lambda y: system.field(y, slip))(y)
    bound = system.bound(starts.ravel(), y)
    return y, slope, system.closures(x), jax.jacfwd(system.closures)(x), bound


class _Modes(eqx.Module):
    """Linear modes of small motions about the sliding equilibrium."""

    equilibrium: Float[Array, " 2n"]
    values: Complex[Array, " 2n"]
    vectors: Complex[Array, "2n 2n"]
    inverse: Complex[Array, "2n 2n"]
    reach: Float[Array, "g 2n"]  # share of the way to each switch per unit of each mode
    attracts: Bool[Array, ""]
    bound: Float[Array, ""]  # beyond which a motion diverges
    free: bool = eqx.field(static=True)  # not excited: only then is there an equilibrium

    @classmethod
    def from_system(cls, system: HybridSystem, starts) -> "_Modes":
        n, linearisation = system.n, map(np.asarray, _linearised(system, starts))
        equilibrium, A, closures, normals, bound = linearisation
        values, vectors = map(np.asarray, np.linalg.eig(A))
        T = np.eye(n) if system.T is None else np.asarray(system.T)
        rows = [T @ vectors[n:] / np.asarray(system.V)[:, None]]
        opens = list(system.opens)
        rows.append(normals[opens] @ vectors[:n] / closures[opens, None])
        inverse, reach = np.linalg.inv(vectors), abs(np.concatenate(rows))
        arrays = equilibrium, values, vectors, inverse, reach, np.real(values).max() < 0, bound
        return cls(*map(jnp.asarray, arrays), free=not system.excited)

    def amplitudes(self, y) -> Array:
        """Complex modal amplitudes (2n, k) of states (2n, k)."""
        deviation = y - self.equilibrium[:, None]
        return jnp.sum(self.inverse[:, :, None] * deviation[None], axis=1)

    def grow(self, y, log) -> Array:
        """States (2n, k) after the amplitudes have grown by exp(log), log (2n, k)."""
        c = self.amplitudes(y) * jnp.exp(log)
        return self.equilibrium[:, None] + jnp.sum(self.vectors[:, :, None] * c[None], axis=1).real


@jax.jit
def _start_lanes(system: HybridSystem, y) -> _Lanes:
    """Lanes that start from states (2n, k)."""
    none, zero = jnp.zeros(y.shape[1], int), jnp.zeros(y.shape[1], y.dtype)
    return _Lanes(
        y=y,
        s=first_contact_state(system, y),
        guard=none + NONE,
        section_state=y,
        returns=none,
        rounds=none,
        smooth=none,
        energy=jnp.zeros_like(y),
        log=jnp.full_like(y, jnp.nan),
        rate=jnp.full_like(y, jnp.nan),
        owner=none - 1,
        distance=zero + jnp.inf,
        approach=none,
        near=none,
        label=none + _RUNNING,
    )


def _step_length(search: BasinSearch, rounds, dtype) -> Array:
    fine = rounds < search.fine_rounds
    return jnp.where(fine, search.step / 2, search.step).astype(dtype)


def _advance(search: BasinSearch, system: HybridSystem, modes: _Modes, lanes: _Lanes) -> _Lanes:
    """Advance every lane by one round of steps."""
    h = _step_length(search, lanes.rounds, lanes.y.dtype)

    def one(_, carry):
        y, s, guard, section_state, returns, switches = carry
        y, s, _, guard, *_ = step(system, y, s, guard, h)
        returned = guard == SECTION
        section_state = jnp.where(returned[None], y, section_state)
        return y, s, guard, section_state, returns + returned, switches + (guard > 0)

    def some(_, carry):
        carry, energy = carry
        carry = jax.lax.fori_loop(0, search.sample_steps, one, carry)
        return carry, energy + jnp.abs(modes.amplitudes(carry[0])) ** 2

    names = "y", "s", "guard", "section_state", "returns"
    start = *(getattr(lanes, name) for name in names), jnp.zeros_like(lanes.returns)
    (*state, switches), energy = jax.lax.fori_loop(0, search.samples, some, (start, lanes.energy))
    updates = dict(zip(names, state, strict=True))
    updates |= {"rounds": lanes.rounds + 1, "energy": energy}
    updates |= {"smooth": jnp.where(switches > 0, 0, lanes.smooth + 1)}
    return dataclasses.replace(lanes, **updates)


def _decay(search: BasinSearch, modes: _Modes, lanes: _Lanes):
    """Mask of the lanes that come to rest, and the lanes with slow changes extrapolated.

    For a motion without switches, the mean energy of its modes is tracked over windows of several
    rounds, in which ripples average out.
    """
    switched = lanes.smooth == 0
    slips = jnp.all(lanes.s == FORWARD, axis=0) & modes.free
    full = ~switched & slips & (lanes.smooth % search.window == 0)
    samples = search.window * search.samples
    log = jnp.log(lanes.energy / samples + jnp.finfo(lanes.y.dtype).tiny) / 2
    rate, before = log - lanes.log, lanes.rate
    ways = modes.reach[:, :, None] * jnp.exp(log)[None]
    way, share = jnp.max(jnp.sum(ways, axis=1), axis=0), jnp.max(ways, axis=0)
    small = share < 0.02 * way[None]
    step = _step_length(search, lanes.rounds - 1, lanes.y.dtype)
    window = samples * search.sample_steps * step
    linear = modes.values.real[:, None] * window[None]
    steady = jnp.abs(rate - before) < 0.2 * jnp.abs(rate)
    # No switch is reached any more, and every mode decays about as fast as in small motions.
    decays = (way < 0.9) & jnp.all(small | (steady & (rate < 0.6 * linear)), axis=0)
    decays = modes.attracts & full & (decays | (way < 1e-6))
    # At most half of the rest of a slow change is skipped, if that slows down geometrically.
    left = jnp.abs(rate * before) / jnp.maximum(jnp.abs(before) - jnp.abs(rate), 1e-300)
    windows = jnp.minimum(0.25, left / 2) / jnp.maximum(jnp.abs(rate), 1e-300)
    windows = jnp.min(jnp.where(small, jnp.inf, windows), axis=0)
    skips = full & jnp.all(small | steady, axis=0) & (windows > 1) & (windows < 1000)
    log_skipped = windows[None] * jnp.where(small, jnp.minimum(linear, 0), rate)
    y = jnp.where(skips & ~decays, modes.grow(lanes.y, jnp.where(skips, log_skipped, 0)), lanes.y)
    reset = switched | skips
    return decays, dataclasses.replace(
        lanes,
        y=y,
        energy=jnp.where(switched | full, 0, lanes.energy),
        log=jnp.where(reset, jnp.nan, jnp.where(full, log, lanes.log)),
        rate=jnp.where(reset, jnp.nan, jnp.where(full, rate, before)),
    )


def _label(search: BasinSearch, modes: _Modes, lanes: _Lanes, returned, points, owners) -> _Lanes:
    """The lanes after a round, labelled where their outcome is certain."""
    centre = modes.equilibrium[:, None]
    size = jnp.max(jnp.abs(lanes.y), axis=0)
    decays, lanes = _decay(search, modes, lanes)
    at = lanes.section_state
    gaps = jnp.max(jnp.abs(at[:, None] - points[:, :, None]), axis=0)
    owner = owners[jnp.argmin(gaps, axis=0)]
    distance = jnp.min(gaps, axis=0) / (1 + jnp.max(jnp.abs(at - centre), axis=0))
    same = owner == lanes.owner
    closer = same & (distance < lanes.distance) & (distance < search.approach_distance)
    approach = jnp.where(closer, lanes.approach + 1, 0)
    is_near = distance < search.near_distance
    near = jnp.where(same & is_near, lanes.near + 1, 0)
    patience = jnp.where(is_near, search.near_rounds, search.approach_rounds)
    arrived = (approach >= patience) | (near >= search.approach_rounds)
    label = jnp.where(decays, _EQUILIBRIUM, jnp.where(arrived & returned, owner, _RUNNING))

    def update(new, old):
        return jnp.where(returned, new, old)

    return dataclasses.replace(
        lanes,
        owner=update(owner, lanes.owner),
        distance=update(distance, lanes.distance),
        approach=update(approach, lanes.approach),
        near=update(near, lanes.near),
        label=jnp.where(size > modes.bound, _DIVERGES, jnp.where(jnp.isnan(size), _LOST, label)),
    )


@functools.partial(jax.jit, static_argnums=0)
def _run(search: BasinSearch, system, modes: _Modes, points, owners, lanes: _Lanes) -> _Lanes:
    """Run rounds until a quarter of the lanes are labelled, at most `search.rounds`."""
    most = 3 * jnp.sum(lanes.label == _RUNNING) // 4

    def going(carry):
        lanes, rounds = carry
        running = jnp.sum(lanes.label == _RUNNING)
        return (running > most) & (rounds < search.rounds)

    def body(carry):
        old, rounds = carry
        new = _advance(search, system, modes, old)
        new = _label(search, modes, new, new.returns > old.returns, points, owners)
        running = old.label == _RUNNING
        return jax.tree.map(lambda new, old: jnp.where(running, new, old), new, old), rounds + 1

    return jax.lax.while_loop(going, body, (lanes, 0))[0]


def section_points(cycle: LimitCycle) -> Float[np.ndarray, "2n m"]:
    """The scaled states of a cycle at its returns to the section."""
    segments = cycle._orbit.segments
    return np.asarray(next_start(segments.y))[:, np.asarray(segments.guard) == SECTION]


class _Orbits:
    """The attracting orbits so far."""

    def __init__(self, size: int):
        self.cycles: list[LimitCycle] = []
        self._points, self._owners = np.zeros((size, 0)), np.zeros(0, int)

    def index_of(self, cycle: LimitCycle) -> int:
        """Index of a cycle among the orbits; a new one is added to them."""
        points = section_points(cycle)
        if self._owners.size:
            gaps = np.abs(self._points - points[:, :1]).max(axis=0)
            if gaps.min() < 1e-4 * (1 + np.abs(points[:, 0]).max()):
                return int(self._owners[gaps.argmin()])
        self.cycles.append(cycle)
        self._points = np.concatenate([self._points, points], axis=1)
        self._owners = np.append(self._owners, np.full(points.shape[1], len(self.cycles) - 1))
        return len(self.cycles) - 1

    def padded(self, dtype) -> tuple[np.ndarray, np.ndarray]:
        """Points (2n, m) at the returns and the indices (m,) of their cycles; m grows rarely."""
        m = 16
        while m < len(self._owners):
            m *= 4
        points = np.full((len(self._points), m), np.inf, dtype)
        points[:, : len(self._owners)] = self._points
        return points, np.append(self._owners, np.full(m - len(self._owners), -1))


def basin(
    mechanism: Mechanism,
    low: ArrayLike | Sequence[float] | None = None,
    high: ArrayLike | Sequence[float] | None = None,
    starts: int | ArrayLike | Sequence[Sequence[float]] = 4000,
    seed: int = 0,
    *,
    radius: ArrayLike | Sequence[float] | None = None,
    excitation: Excitation | None = None,
    rtol: float | None = None,
    max_returns: int = 5000,
    progress: bool = True,
    search: BasinSearch = BasinSearch(),
) -> Basin:
    """What the motions from many starts end in: the equilibrium, which limit cycle, or neither.

    Every start runs on, coarsely, until its returns to the section of `limit_cycle` approach those
    of an attracting orbit: in three rounds of several returns within 2 % of its size, or in eight
    within 15 %. It comes to rest once its linear modes reach no switch and each decays at 0.6 of
    its linear rate or faster. A start that gets no label is searched in full by `limit_cycle`, and
    from then on others may approach its orbit. Starts without a label after `max_returns` are
    undecided; the reason is that of their own full search, or else that of the last full search
    that led to no orbit.

    **Arguments:**

    - `mechanism`: a scene, or a structure of n degrees of freedom whose joints all have a V.
    - `low`, `high`: (2n,), corners of a box of starts [x, v] in m and m/s. Where they are equal a
      coordinate is fixed, so that a section of two coordinates is a box as well.
    - `radius`: instead of a box, a ball about the sliding equilibrium. It is the Euclidean norm of
      the state in units of V/omega and V, with omega as in `limit_cycle`; or the semi-axes (2n,) of
      an ellipsoid in m and m/s.
    - `starts`: the number of Sobol points, 4000 by default; or the starts, (k, 2n), then without
      box and ball.
    - `seed`: scrambles the Sobol points, 0 by default.
    - `excitation`, `rtol`, `max_returns`: as in `limit_cycle`; no excited motion ends in
      equilibrium.
    - `progress`: shows a bar.
    - `search`: numbers of the coarse run, such as how near an orbit a start gets its label.

    **Returns:** a `Basin`.

    **Raises:** `ValueError` for corners, semi-axes or starts of another shape, a box that is empty,
    for box, ball or starts given twice or not at all, and what `limit_cycle` raises.
    """
    n = degrees_of_freedom(mechanism)
    require_drive(mechanism, excitation)
    if any(concrete(jnp.asarray(x)) is None for x in jax.tree.leaves((mechanism, excitation))):
        raise ValueError("basin runs many programs: call it outside of jit, vmap and grad")
    system = compiled_system(mechanism, excitation)
    dtype = system.F.dtype
    tolerance = check_rtol(rtol, dtype)
    max_returns, progress = whole("max_returns", max_returns, 1), flag("progress", progress)
    require_kind("search", search, BasinSearch)
    initial_states = starts_of(system, n, low, high, starts, whole("seed", seed, 0), radius)
    y = system.with_excitation(
        jnp.asarray(initial_states.T / np.asarray(system.units)[:, None], dtype), 0.0
    )
    lanes, modes = jax.tree.map(np.array, _start_lanes(system, y)), _Modes.from_system(system, y)
    options: dict[str, Any] = {"excitation": excitation, "rtol": tolerance, "throw": False}
    orbits, reasons = _Orbits(2 * system.n), {}
    find_cycle = functools.partial(limit_cycle, mechanism, max_returns=max_returns, **options)
    _label_all(search, system, lanes, orbits, reasons, find_cycle, modes, max_returns, progress)
    return _conclude(initial_states, lanes.label, orbits.cycles, reasons)


def _label_all(search, system, lanes, orbits, reasons, find_cycle, modes, max_returns, progress):
    """Label every lane of NumPy arrays in place."""
    from tqdm import tqdm

    k = len(lanes.label)
    searched, failures, patience = np.zeros(k, bool), 0, search.patience
    failure, failure_by_start = CycleResult.exhausted, {}  # of the last full search
    bar = tqdm(total=k, desc="basin", unit="start", disable=not progress)
    with bar, concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        while (running := np.flatnonzero(lanes.label == _RUNNING)).size:
            bar.update(k - running.size - bar.n)
            few = max(1, search.lanes // 8)
            size = few if running.size <= few * search.chunks else search.lanes
            chosen = running[: size * search.chunks]
            chunks = [chosen[i : i + size] for i in range(0, len(chosen), size)]
            run = functools.partial(_run, search, system, modes, *orbits.padded(lanes.y.dtype))
            results = pool.map(run, [_select(lanes, chunk, size) for chunk in chunks])
            for chunk, result in zip(chunks, results, strict=True):
                for whole_array, piece in zip(
                    jax.tree.leaves(lanes), jax.tree.leaves(result), strict=True
                ):
                    whole_array[..., chunk] = np.asarray(piece)[..., : len(chunk)]
            lost = np.flatnonzero(lanes.label == _LOST)
            lanes.label[lost] = _UNDECIDED
            reasons |= dict.fromkeys(lost.tolist(), CycleResult.not_finite)
            left = lanes.label == _RUNNING
            over = left & ((lanes.returns >= max_returns) | (lanes.rounds >= max_returns))
            lanes.label[over] = _UNDECIDED
            reasons |= {i: failure_by_start.get(i, failure) for i in np.flatnonzero(over).tolist()}
            # A motion without switches is slow, but not lost.
            slow = (lanes.smooth >= search.window) & (lanes.rounds < 16 * patience)
            lost = left & ~over & ~searched & (lanes.rounds >= patience)
            lost &= (lanes.approach == 0) & ~slow
            if failures >= search.failures or not lost.any():
                continue
            i = int(np.argmax(np.where(lost, lanes.rounds, -1)))
            searched[i] = True
            # At a return the time of an excitation is 0 again.
            state = lanes.section_state[:, i] if lanes.returns[i] else lanes.y[:, i]
            cycle = find_cycle(system.mechanism_state(jnp.asarray(state)) * system.units)
            result, before = cycle.result, len(orbits.cycles)
            if bool((result == CycleResult.converged) | (result == CycleResult.inaccurate)):
                lanes.label[i] = orbits.index_of(cycle)
            elif bool(result == CycleResult.equilibrium):
                lanes.label[i] = _EQUILIBRIUM
            elif bool(result == CycleResult.diverged):
                lanes.label[i] = _DIVERGES
            else:
                # Perhaps a long transient: its coarse run continues.
                failures, failure = failures + 1, result
                failure_by_start[i] = result
            # Full searches that find nothing new become less and less frequent.
            patience = search.patience if len(orbits.cycles) > before else 2 * patience
        bar.update(k - bar.n)


def _select(lanes: _Lanes, chosen: np.ndarray, size: int) -> _Lanes:
    """The chosen lanes, padded to `size` with one that counts as labelled."""
    padded = np.concatenate([chosen, np.repeat(chosen[-1:], size - len(chosen))])
    selected = jax.tree.map(lambda x: x[..., padded], lanes)
    selected.label[len(chosen) :] = _UNDECIDED
    return selected


def _conclude(starts, labels, cycles, reasons) -> Basin:
    """The result, with the cycles in the order of their shares."""
    counts = [int(np.sum(labels == i)) for i in range(len(cycles))]
    order = sorted(range(len(cycles)), key=lambda i: -counts[i])
    names = [f"cycle {i}" for i in range(1, len(order) + 1)]
    codes = [_EQUILIBRIUM, *order, _DIVERGES, _UNDECIDED]
    return Basin(
        starts=starts,
        labels=np.array([codes.index(label) for label in labels.tolist()]),
        outcomes=("equilibrium", *names, "diverges", "undecided"),
        cycles=tuple(cycles[i] for i in order),
        reasons=reasons,
    )
