"""A limit cycle: its numbers, its orbit, its spectrum and its switches."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from .._base.parts import Record, concrete
from .._base.quick import command_jit
from .hybrid import OPEN, UNUSED, HybridSystem
from .lanes import log_spectral_radius
from .segments import Segments, flow, mean_square

SQUARINGS = 40  # of a monodromy matrix
_SAMPLES = 1024  # of a smooth orbit, for a mean
VELOCITY_REFERENCE = 1e-9  # [m/s], of levels
STATE_NAMES = {1: "+", -1: "-", 0: "stick", OPEN: "open"}  # of contact states, in a `Switch`


class CycleResult(eqx.Enumeration):
    """How the search for a limit cycle ended."""

    converged = "a limit cycle was found"
    depends_on_eps = (
        "a limit cycle of the regularised law, which still differs from the exact law's: "
        "choose a smaller regularisation"
    )
    inaccurate = "a limit cycle was found, but not to rtol: ask for more segments"
    unstable = "a limit cycle was found, but it repels: nearby motions leave it"
    equilibrium = "the motion dies out: the sliding equilibrium attracts it"
    diverged = "the motion grows beyond all bounds"
    too_long = "a period takes more steps than are kept: ask for more segments"
    not_periodic = "the motion does not repeat within 16 returns (a longer period, or none)"
    too_stiff = (
        "the regularised law takes more than max_steps steps: allow more, choose a solver such as "
        "diffrax.Kvaerno5, or leave the regularisation out"
    )
    jumps = "a joint with K_t opens, where the regularised law jumps: leave the regularisation out"
    exhausted = (
        "the motion nearly repeats, but has not settled within max_returns: allow more of them"
    )


def repels(
    monodromy: Float[Array, "4 4"], rate: Float[Array, "4"], error: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether small deviations from an orbit grow, by more than the error of their growth.

    The monodromy maps the orbit's own `rate` onto itself. Its error is how far it misses that,
    plus the relative `error` of the orbit.
    """
    along = rate / jnp.linalg.norm(rate)
    missed = jnp.max(jnp.abs(jnp.sum(monodromy * along[None], axis=1) - along))
    across = jnp.eye(len(along), dtype=along.dtype) - along[:, None] * along[None]

    log = log_spectral_radius(across @ monodromy @ across, SQUARINGS)
    tolerance = 10 * (missed + error) + 1e3 * jnp.finfo(along.dtype).eps
    return log > tolerance


class Switch(Record):
    """One change of the contact state, as `LimitCycle.switches` lists them."""

    time: float  # after `state` [s]
    direction: int  # which one switches, from 1
    before: str  # "+" (slip, t.v < V), "-" (slip, t.v > V), "stick" or "open"
    after: str


class Orbit(eqx.Module):
    """The motion along the segments of a periodic orbit."""

    segments: Segments

    def at(self, system: HybridSystem, times) -> Float[Array, "4 n"]:
        """Scaled states at scaled times (n,) within one period."""
        segments, k = self.segments, self._segment(times)
        after = times - (jnp.cumsum(segments.duration) - segments.duration)[k]
        return flow(system, segments.y[:, k], after, segments.s[:, k])

    def states_at(self, times) -> Float[Array, "f n"]:
        """Contact states from scaled times (n,) on."""
        return self.segments.s[:, self._segment(times)]

    def _segment(self, times) -> Int[Array, " n"]:
        ends = jax.lax.stop_gradient(jnp.cumsum(self.segments.duration))
        k = jnp.searchsorted(ends, jax.lax.stop_gradient(times), side="right")
        return jnp.minimum(k, len(ends) - 1)


class LimitCycle(Record):
    """A limit cycle, as `limit_cycle` returns it. NaN throughout where there is none."""

    period: Float[Array, ""]  # [s]
    amplitude: Float[Array, " n"]  # peak to peak of each degree of freedom [m]
    velocity_min: Float[Array, " n"]  # of dx/dt [m/s]
    velocity_max: Float[Array, " n"]  # [m/s]
    stick_fraction: Float[Array, " m"]  # of the period in stick (regularised: abs(v) < eps)
    open_fraction: Float[Array, " m"]  # of the period open, one value a joint
    tension_fraction: Float[Array, "..."]  # of the period with K_n n.x < 0: the contact pulls
    normal_force: Float[Array, "m 2"]  # smallest and largest of each joint [N]
    # [x, v] [m, m/s] on the cycle, at the section: a maximum of t.x, or the time 0 of an excitation
    state: Float[Array, " 2n"]
    error: Float[Array, ""]  # estimated relative error of period and states
    returns: Int[Array, ""]  # of the Poincare map in one period
    regularisation_error: Float[Array, ""]  # largest relative difference from the exact law
    result: CycleResult
    _monodromy: Float[Array, "2n 2n"] = eqx.field(repr=False)
    _system: HybridSystem = eqx.field(repr=False)
    _orbit: Any = eqx.field(repr=False)  # Orbit, or regularised.SmoothOrbit

    @property
    def multipliers(self) -> Complex[Array, " 2n"]:
        """The Floquet multipliers, largest modulus first; one is 1 where nothing excites."""
        # Computed only when asked for: eigenvalues have no second derivative in JAX.
        return _multipliers(self._monodromy)

    @property
    def of_scene(self) -> bool:
        """Whether `stick_fraction` is of the two directions of a scene, not of joints."""
        return self.stick_fraction.shape[-1] != len(self._system.faces)

    @property
    def frequency(self) -> Float[Array, ""]:
        """1/period [Hz]."""
        return 1 / self.period

    @property
    def velocity_rms(self) -> Float[Array, " n"]:
        """The root mean square of each dx/dt over a period [m/s], of one cycle."""
        system = self._system
        if isinstance(self._orbit, Orbit):
            square = system.own(mean_square(system, self._orbit.segments)) * system.units**2
            square = jnp.where(jnp.isfinite(self.period), square, jnp.nan)
        else:
            square = jnp.mean(self.orbit(_SAMPLES)[1] ** 2, axis=0)
        return jnp.sqrt(square[len(self.amplitude) :])

    @property
    def velocity_level(self) -> Float[Array, " n"]:
        """20 lg(`velocity_rms`/1 nm/s) [dB], as ISO 1683 has it.

        The sound power level of one radiator rises and falls by as much.
        """
        return 20 * jnp.log10(self.velocity_rms / VELOCITY_REFERENCE)

    def orbit(self, n: int = 512) -> tuple[Float[Array, " n"], Float[Array, "n 2dofs"]]:
        """Times [s] and states [x, v] in m and m/s, evenly spaced over one period from `state`."""
        return _sampled(self._orbit, self._system, self.period, n=n)

    def spectrum(self, n: int = 512) -> tuple[Float[Array, " n/2"], Float[Array, "n/2 dofs"]]:
        """Harmonics: frequencies [Hz] and peak amplitudes [m] of the degrees of freedom.

        The Fourier coefficients of n samples of the orbit, without the mean.
        """
        return self.harmonics(jnp.eye(len(self.amplitude), dtype=self.amplitude.dtype), n)

    def harmonics(self, rows, n: int = 512) -> tuple[Float[Array, " n/2"], Float[Array, "n/2 k"]]:
        """As `spectrum`, of the displacements rows @ x, rows (k, dofs)."""
        return _harmonics(self._orbit, self._system, self.period, rows, n=n)

    def contact_states(self, n: int = 512) -> Float[Array, "n f"]:
        """From the times of `orbit(n)` on: +1, -1 slip forward, backward, 0 stick, 2 open.

        As of a `Trajectory`: of each direction of friction, the tangential one of a joint first.

        **Raises:** `ValueError` for the regularised law, which has none.
        """
        if not isinstance(self._orbit, Orbit):
            raise ValueError("a regularised cycle has no contact states: leave regularisation out")
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
            raise ValueError("a regularised cycle has no switches")
        segments, names = self._orbit.segments, STATE_NAMES
        used = np.asarray(segments.guard) != UNUSED
        states = np.asarray(segments.s)[:, used].astype(int)
        times = np.cumsum(np.asarray(segments.duration)[used]) / float(self._system.omega)
        found = []
        for k, time in enumerate(times):
            before, after = states[:, k], np.roll(states, -1, axis=1)[:, k]
            for i in np.flatnonzero(before != after):
                found.append(Switch(float(time), int(i) + 1, names[before[i]], names[after[i]]))
        return found


@command_jit
def _multipliers(monodromy):
    values = jnp.linalg.eigvals(monodromy)
    order = jnp.argsort(-jnp.abs(jax.lax.stop_gradient(values)), axis=-1)
    return jnp.take_along_axis(values, order, axis=-1)


@functools.partial(command_jit, static_argnames="n", once=True)
def _harmonics(orbit, system: HybridSystem, period, rows, n: int):
    _, states = _sampled(orbit, system, period, n=n)
    x = states[:, : states.shape[1] // 2] @ jnp.asarray(rows, states.dtype).T
    lines = jnp.abs(jnp.fft.rfft(x, axis=0)) / n * 2
    harmonics = jnp.arange(1, n // 2 + 1)
    return harmonics / period, lines[1 : n // 2 + 1]


@functools.partial(command_jit, static_argnames="n", once=True)
def _sampled(orbit, system: HybridSystem, period, n: int):
    share = jnp.arange(n) / n
    y = orbit.at(system, share * period * system.omega)
    y = jnp.where(jnp.isfinite(period), y, jnp.nan)
    return share * period, (system.own(y) * system.units[:, None]).T
