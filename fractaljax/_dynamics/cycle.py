"""A limit cycle: its numbers, its orbit, its spectrum and its switches."""

import functools
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._base.parts import Record, concrete, nan_where, refused
from .._base.programs import exported_jit
from .contact_state import OPEN, STICK, find_state
from .extremes import extreme_values, time_below_zero
from .guard import NONE, UNUSED
from .hybrid import HybridSystem
from .lanes import log_spectral_radius, product
from .maps import exact_maps
from .orbit import block_diagonal
from .segments import Segments, flow, mean_square, next_start

VELOCITY_REFERENCE = 1e-9  # [m/s], of levels


class CycleResult(eqx.Enumeration):
    """How the search for a limit cycle ended."""

    converged = "a limit cycle was found"
    depends_on_eps = (
        "a limit cycle of the regularised law, which still differs from the exact law's: "
        "choose a smaller regularisation"
    )
    inaccurate = (
        "a limit cycle was found, but not to rtol: ask for more segments, for more meshes by "
        "search=CycleSearch(meshes=12), or for a larger rtol"
    )
    unstable = "a limit cycle was found, but it repels: nearby motions leave it"
    equilibrium = "the motion dies out: the sliding equilibrium attracts it"
    diverged = "the motion grows beyond all bounds"
    not_finite = (
        "the motion is not a number, as some number of the mechanism or of the start is not"
    )
    too_long = "a period takes more steps than are kept: ask for more segments"
    not_periodic = (
        "the motion does not repeat within the longest period that was looked for, 16 returns by "
        "default (a longer period, or none)"
    )
    too_stiff = (
        "the regularised law, or one with memory, takes more than max_steps steps: allow more, or "
        "choose a solver such as diffrax.Kvaerno5"
    )
    jumps = (
        "a joint with K_t opens, where friction that is smooth jumps: "
        "take a law without memory and without regularisation"
    )
    exhausted = (
        "the motion nearly repeats, but has not settled within max_returns: allow more of them"
    )


def repels(
    monodromy: Float[Array, "4 4"], rate: Float[Array, "4"], error: Float[Array, ""]
) -> Bool[Array, ""]:
    """True if small deviations from an orbit grow by more than the error of their growth.

    The exact monodromy maps the orbit's `rate` onto itself. The error is the deviation from that
    plus the relative `error` of the orbit.
    """
    along = rate / jnp.linalg.norm(rate)
    missed = jnp.max(jnp.abs(jnp.sum(monodromy * along[None], axis=1) - along))
    across = jnp.eye(len(along), dtype=along.dtype) - along[:, None] * along[None]

    log = log_spectral_radius(across @ monodromy @ across, squarings=40)  # exact to rounding
    tolerance = 10 * (missed + error) + 1e3 * jnp.finfo(along.dtype).eps
    return log > tolerance


class Switch(Record):
    """One change of the contact state, as `LimitCycle.switches` lists them."""

    time: float  # after `state` [s]
    direction: int  # number of the one that switches, from 1
    before: str  # "+" (slip, t.v < V), "-" (slip, t.v > V), "stick" or "open"
    after: str


class Ranges(eqx.Module):
    """Smallest and largest values over a period."""

    states: Float[Array, "2 2n"]  # [m, m/s]
    normal_force: Float[Array, "m 2"]  # [N]


class Fractions(eqx.Module):
    """Shares of a period."""

    stick: Float[Array, " f"]  # of each direction of friction
    open: Float[Array, " m"]
    tension: Float[Array, " m"]


class Orbit(eqx.Module):
    """The motion along the segments of a periodic orbit, and quantities computed from it."""

    segments: Segments

    def at(self, system: HybridSystem, times) -> Float[Array, "4 n"]:
        """Scaled states at scaled times (n,) within one period."""
        segments, k = self.segments, self._segment(times)
        after = times - (jnp.cumsum(segments.duration) - segments.duration)[k]
        return flow(system, segments.y[:, k], after, segments.s[:, k])

    def states_at(self, times) -> Float[Array, "f n"]:
        """Contact states from scaled times (n,) on."""
        return self.segments.s[:, self._segment(times)]

    def ranges(self, system: HybridSystem) -> Ranges:
        """Extremes of displacements, velocities and normal forces."""
        n = system.n - system.excited
        rows, offset = _normal_rows(system)
        state_rows = system.mechanism_state(jnp.eye(2 * system.n, dtype=rows.dtype))
        values = extreme_values(system, self.segments, jnp.concatenate([state_rows, rows]))
        if not system.joints:
            return Ranges(values[:, : 2 * n] * system.units[None], jnp.zeros((0, 2), rows.dtype))
        linear = jnp.zeros((len(system.P), 2), rows.dtype)
        linear = linear.at[_tangential(system)].set((values[:, 2 * n :] + offset[None]).T)
        # A load curve increases, so that its extremes are at the extremes of the approach.
        forces = system.normal_forces(linear) * system.force_unit
        opens = np.array(system.opens)[:, None]
        forces = jnp.where(opens, jnp.maximum(forces, 0), forces)
        return Ranges(values[:, : 2 * n] * system.units[None], forces)

    def fractions(self, system: HybridSystem) -> Fractions:
        """Shares of sticking, of being open, and of pulling."""
        s, duration = self.segments.s, self.segments.duration
        period = jnp.sum(duration)

        def share(state):
            return jnp.sum(jnp.where(s == state, duration[None], 0), axis=1) / period

        if not system.joints:
            return Fractions(*[jnp.zeros(0, period.dtype)] * 3)
        rows, offset = _normal_rows(system)
        pulls = [
            jnp.zeros_like(period)
            if opens or not faces[1:]
            else time_below_zero(system, self.segments, row, shift) / period
            for row, shift, faces, opens in zip(
                rows, offset, system.faces, system.opens, strict=True
            )
        ]
        return Fractions(share(STICK), share(OPEN)[_tangential(system)], jnp.stack(pulls))

    def monodromy(self, system: HybridSystem) -> Float[Array, "2n 2n"]:
        """The product of the maps of all segments, with the saltation at every switch."""
        segments = self.segments
        local = exact_maps(system, segments)
        ends, s = next_start(segments.y), segments.s
        before, after = system.field(ends, s), system.field(ends, jnp.roll(s, -1, axis=-1))
        switches = segments.used & (segments.guard != NONE)
        speed = jnp.where(switches, jnp.sum(local.c * before, axis=0), 1)
        jump = jnp.where(switches[None], (after - before) / speed[None], 0)
        eye = jnp.eye(len(ends), dtype=ends.dtype)

        def chain(so_far, segment):
            A, jump, c = segment
            so_far = product(A, so_far)
            return so_far + jump[:, None] * jnp.sum(c[:, None] * so_far, axis=0)[None], None

        monodromy = jax.lax.scan(chain, eye, (local.A, jump.T, local.c.T))[0]
        if system.excited:
            # Friction stops a face at rest within the period.
            resting = system.resting(s, segments.used)
            stopped = block_diagonal(jnp.zeros_like(resting), resting)
            monodromy = monodromy - product(monodromy, stopped)
        return system.mechanism_state(system.mechanism_state(monodromy).T).T

    def _segment(self, times) -> Int[Array, " n"]:
        ends = jax.lax.stop_gradient(jnp.cumsum(self.segments.duration))
        k = jnp.searchsorted(ends, jax.lax.stop_gradient(times), side="right")
        return jnp.minimum(k, len(ends) - 1)


def _tangential(system: HybridSystem) -> np.ndarray:
    """The tangential face of each joint."""
    return np.array([faces[0] for faces in system.joints], int)


def _normal_rows(system: HybridSystem) -> tuple[Float[Array, "m 2n"], Float[Array, " m"]]:
    """The loads of the tangential faces, which are the joints' normal forces: row @ y + offset."""
    L = system.L[_tangential(system)]
    return jnp.concatenate([L, jnp.zeros_like(L)], axis=1), system.P[_tangential(system)]


class LimitCycle(Record):
    """A limit cycle, as `limit_cycle` returns it. NaN throughout where there is none.

    Fields hold what the search finds. Everything else is computed from the orbit on access, so
    that a program that needs the period alone compiles nothing else.
    """

    period: Float[Array, ""]  # [s]
    # [x, v] [m, m/s] on the cycle, at the section: a maximum of t.x, or the time 0 of an excitation
    state: Float[Array, " 2n"]
    error: Float[Array, ""]  # estimated relative error of period and states
    returns: Int[Array, ""]  # of the Poincare map in one period
    regularisation_error: Float[Array, ""]  # largest relative difference from the exact law
    result: CycleResult  # a member of CycleResult
    of_scene: bool = eqx.field(static=True, repr=False)  # fractions are of directions, not joints
    _system: HybridSystem = eqx.field(repr=False)
    _orbit: Any = eqx.field(repr=False)  # Orbit, or smooth.SmoothOrbit
    # The states of the laws at `state`: of law by law, face by face; None of a law without
    internal: Float[Array, " s"] | None = eqx.field(default=None, repr=False)

    def _table_names(self):
        derived = "frequency amplitude velocity_min velocity_max normal_force stick_fraction"
        return [*super()._table_names(), *f"{derived} open_fraction multipliers".split()]

    def _shown(self) -> Iterator[str]:
        yield from super()._shown()
        if concrete(self.period) is not None:
            for name in (
                "amplitude",
                "velocity_min",
                "velocity_max",
                "normal_force",
                "stick_fraction",
                "open_fraction",
                "tension_fraction",
            ):
                yield f"{name}={np.asarray(getattr(self, name))!r}"

    @property
    def amplitude(self) -> Float[Array, " n"]:
        """Peak to peak of each degree of freedom [m]."""
        states = self._ranges.states
        low, high = jnp.split(states[..., : states.shape[-1] // 2], 2, axis=-2)
        return (high - low)[..., 0, :]

    @property
    def velocity_min(self) -> Float[Array, " n"]:
        """The least dx/dt of each degree of freedom [m/s]."""
        states = self._ranges.states
        return states[..., 0, states.shape[-1] // 2 :]

    @property
    def velocity_max(self) -> Float[Array, " n"]:
        """The largest dx/dt of each degree of freedom [m/s]."""
        states = self._ranges.states
        return states[..., 1, states.shape[-1] // 2 :]

    @property
    def normal_force(self) -> Float[Array, "m 2"]:
        """The smallest and the largest normal force of each joint [N]."""
        return self._ranges.normal_force

    @property
    def stick_fraction(self) -> Float[Array, " m"]:
        """The share of the period in stick: of a scene's two directions, or of each joint.

        For a regularised cycle, it is the share with abs(v) < eps. NaN for laws with memory, which
        creep instead.
        """
        stick = self._fractions.stick
        return stick if self.of_scene else stick[..., _tangential(self._system)]

    @property
    def open_fraction(self) -> Float[Array, " m"]:
        """The share of the period in which each joint is open."""
        return self._fractions.open

    @property
    def tension_fraction(self) -> Float[Array, "..."]:
        """The share of the period with K_n n.x < 0, in which the contact pulls.

        It is one number () for a scene, and one per joint (m,) for a structure.
        """
        tension = self._fractions.tension
        return tension[..., 0] if self.of_scene else tension

    @property
    def multipliers(self) -> Complex[Array, " 2n"]:
        """The Floquet multipliers, largest modulus first; one is 1 without an excitation."""
        return _multipliers(self._monodromy)

    @property
    def _ranges(self) -> Ranges:
        return _of_orbit(self._orbit, self._system, self.period, "ranges")

    @property
    def _fractions(self) -> Fractions:
        return _of_orbit(self._orbit, self._system, self.period, "fractions")

    @property
    def _monodromy(self) -> Float[Array, "2n 2n"]:
        return _of_orbit(self._orbit, self._system, self.period, "monodromy")

    @property
    def frequency(self) -> Float[Array, ""]:
        """1/period [Hz]."""
        return 1 / self.period

    @property
    def velocity_rms(self) -> Float[Array, " n"]:
        """The root mean square of each dx/dt over a period [m/s], of one cycle."""
        system = self._system
        if isinstance(self._orbit, Orbit):
            square = (
                system.mechanism_state(mean_square(system, self._orbit.segments)) * system.units**2
            )
            square = jnp.where(jnp.isfinite(self.period), square, jnp.nan)
        else:
            # The mean of a smooth periodic function converges fast with the number of samples.
            square = jnp.mean(self.orbit(1024)[1] ** 2, axis=0)
        return jnp.sqrt(square[len(square) // 2 :])

    @property
    def velocity_level(self) -> Float[Array, " n"]:
        """20 lg(`velocity_rms`/1 nm/s) [dB], as in ISO 1683.

        The sound power level of one radiator changes by as much.
        """
        return 20 * jnp.log10(self.velocity_rms / VELOCITY_REFERENCE)

    def orbit(self, n: int = 512) -> tuple[Float[Array, " n"], Float[Array, "n 2dofs"]]:
        """Times (n,) [s] and states (n, 2 dofs), [x, v] in m and m/s, over one period from `state`.

        They are evenly spaced; `n` is their number, 512 by default.
        """
        return _sampled(self._orbit, self._system, self.period, n=n)

    def spectrum(self, n: int = 512) -> tuple[Float[Array, " n/2"], Float[Array, "n/2 dofs"]]:
        """Harmonics: frequencies [Hz] and peak amplitudes [m] of the degrees of freedom.

        The Fourier coefficients of `n` samples of the orbit, 512 by default, without the mean.
        """
        return self.harmonics(jnp.eye(len(self.state) // 2, dtype=self.state.dtype), n)

    def harmonics(self, rows, n: int = 512) -> tuple[Float[Array, " n/2"], Float[Array, "n/2 k"]]:
        """As `spectrum` with its `n`, for the displacements rows @ x with `rows` (k, dofs)."""
        return _harmonics(self._orbit, self._system, self.period, rows, n=n)

    def contact_states(self, n: int = 512) -> Float[Array, "n f"]:
        """Contact states from the times of `orbit(n)` on: +1, -1 slip, 0 stick, 2 open.

        Slip is forward at +1 and backward at -1. As in a `Trajectory`, there is one for each
        direction of friction, the tangential one of a joint first. `n` is the number of times, 512
        by default.

        **Raises:** `ValueError` for the regularised law, which has none.
        """
        if not isinstance(self._orbit, Orbit):
            raise ValueError("a regularised cycle, or one with memory, has no contact states")
        system, share = self._system, jnp.arange(n) / n
        states = self._orbit.states_at(share * self.period * system.omega).T
        return jnp.where(jnp.isfinite(self.period), states, jnp.nan)

    def switches(self) -> list[Switch]:
        """Every change of contact state in one period, in order, with its time.

        **Raises:** `ValueError` for a batch of cycles, inside a compiled program, and for the
        regularised law, which has none.
        """
        if concrete(self.period) is None or self.period.ndim:
            raise ValueError("switches() needs one cycle, outside of jit: index the batch first")
        if not isinstance(self._orbit, Orbit):
            raise ValueError("a regularised cycle has no switches, nor has one with memory")
        segments = self._orbit.segments
        used = np.asarray(segments.guard) != UNUSED
        states = np.asarray(segments.s)[:, used].astype(int)
        times = np.cumsum(np.asarray(segments.duration)[used]) / float(self._system.omega)
        switches = []
        for k, time in enumerate(times):
            before, after = states[:, k], np.roll(states, -1, axis=1)[:, k]
            for i in np.flatnonzero(before != after):
                names = (find_state(states[i]).name for states in (before, after))
                switches.append(Switch(float(time), int(i) + 1, *names))
        return switches


@functools.partial(exported_jit, static_argnames="what")
def _of_orbit(orbit, system: HybridSystem, period, what: str) -> Any:
    """Result of an orbit's method for one cycle, or for each of a batch; NaN without a cycle."""

    def of_one(orbit, system, period):
        exists, values = jnp.isfinite(period), getattr(orbit, what)(system)
        # A selection, as for `period`: without a cycle its derivative is 0, which a batch can
        # select, but NaN for an invalid mechanism.
        values = jax.tree.map(lambda x: jnp.where(exists, x, jnp.nan), values)
        return values if (bad := refused(system)) is None else nan_where(bad, values)

    for _ in range(period.ndim):
        of_one = jax.vmap(of_one)
    return of_one(orbit, system, period)


@exported_jit
def _multipliers(monodromy):
    values = jnp.linalg.eigvals(monodromy)
    order = jnp.argsort(-jnp.abs(jax.lax.stop_gradient(values)), axis=-1)
    return jnp.take_along_axis(values, order, axis=-1)


@functools.partial(exported_jit, static_argnames="n")
def _harmonics(orbit, system: HybridSystem, period, rows, n: int):
    _, states = _sampled(orbit, system, period, n=n)
    x = states[:, : states.shape[1] // 2] @ jnp.asarray(rows, states.dtype).T
    lines = jnp.abs(jnp.fft.rfft(x, axis=0)) / n * 2
    harmonics = jnp.arange(1, n // 2 + 1)
    return harmonics / period, lines[1 : n // 2 + 1]


@functools.partial(exported_jit, static_argnames="n")
def _sampled(orbit, system: HybridSystem, period, n: int):
    share = jnp.arange(n) / n
    y = orbit.at(system, share * period * system.omega)
    y = jnp.where(jnp.isfinite(period), y, jnp.nan)
    return share * period, (system.mechanism_state(y) * system.units[:, None]).T
