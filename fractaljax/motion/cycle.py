"""A limit cycle: what is known of it, its orbit, its spectrum and its switches."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import Record, concrete
from .shooting import UNUSED, Segments, flow
from .stick_slip import StickSlip, units

_SQUARINGS = 40  # of a monodromy matrix


class CycleResult(eqx.Enumeration):
    """What became of the search for a limit cycle."""

    converged = "a limit cycle was found"
    depends_on_eps = (
        "a limit cycle of the regularised law, which still differs from the exact law's: "
        "choose a smaller regularisation"
    )
    inaccurate = "a limit cycle was found, but not to rtol: ask for more segments"
    unstable = "a limit cycle was found, but it repels: motions beside it leave it"
    equilibrium = "the motion dies out: the sliding equilibrium attracts it"
    diverged = "the motion grows beyond all bounds"
    not_periodic = "the motion does not repeat within four turns (a longer period, or none)"
    too_stiff = (
        "the regularised law takes more than max_steps steps: allow more, choose a solver such as "
        "diffrax.Kvaerno5, or leave the regularisation out"
    )
    exhausted = (
        "the motion nearly repeats, but has not settled within max_turns: allow more of them"
    )


def repels(monodromy, rate, error) -> jax.Array:
    """Whether small deviations from an orbit grow, by more than what is known of their growth.

    The monodromy (4, 4) maps the orbit's own `rate` (4,) onto itself. By how much it misses that,
    or by the relative `error` of the orbit, it may be wrong altogether.
    """
    along = rate / jnp.linalg.norm(rate)
    missed = jnp.max(jnp.abs(jnp.sum(monodromy * along[None], axis=1) - along))
    across = jnp.eye(4, dtype=along.dtype) - along[:, None] * along[None]

    def square(_, carry):
        # The largest multiplier to the power of 2^k, apart from its logarithm.
        power, log = carry
        size = jnp.max(jnp.abs(power))
        power = power / jnp.where(size > 0, size, 1)
        return power @ power, 2 * (log + jnp.log(size))

    start = across @ monodromy @ across, jnp.zeros_like(error)
    _, log = jax.lax.fori_loop(0, _SQUARINGS, square, start)
    known = 10 * (missed + error) + 1e3 * jnp.finfo(along.dtype).eps
    return log / 2.0**_SQUARINGS > known


class Switch(Record):
    """One change of mode, as `LimitCycle.switches` lists them."""

    time: float  # after `state` [s]
    direction: int  # which one switches, 1 or 2
    before: str  # "+", "-" or "stick"
    after: str


class Closed(eqx.Module):
    """The motion along closed segments."""

    segments: Segments

    def at(self, system: StickSlip, times) -> jax.Array:
        """Scaled states (4, n) at scaled times (n,) within one period."""
        segments = self.segments
        ends = jnp.cumsum(segments.duration)
        k = jnp.searchsorted(
            jax.lax.stop_gradient(ends), jax.lax.stop_gradient(times), side="right"
        )
        k = jnp.minimum(k, len(ends) - 1)
        after = times - (ends - segments.duration)[k]
        return flow(system, segments.y[:, k], after, segments.s[:, k])


class LimitCycle(Record):
    """A limit cycle, as `limit_cycle` returns it. NaN throughout where there is none."""

    period: jax.Array  # [s]
    amplitude: jax.Array  # (2,) peak to peak, one value a direction [m]
    velocity_min: jax.Array  # (2,) of dx/dt [m/s]
    velocity_max: jax.Array  # (2,) [m/s]
    stick_fraction: jax.Array  # (2,) share of the period in stick (regularised: abs(v) < eps)
    tension_fraction: jax.Array  # share of the period with K_n x2 < 0: the contact pulls
    state: jax.Array  # (4,) [x1, x2, v1, v2] on the cycle, where x1 is largest [m, m/s]
    error: jax.Array  # estimated relative error of period and states
    turns: jax.Array  # maxima of x1 in one period
    regularisation_error: jax.Array  # largest relative difference from the exact law's cycle
    result: CycleResult
    _monodromy: jax.Array = eqx.field(repr=False)  # (4, 4)
    _system: StickSlip = eqx.field(repr=False)
    _motion: Any = eqx.field(repr=False)  # Closed, or regularised.Smooth

    @property
    def multipliers(self) -> jax.Array:
        """(4,) complex: the Floquet multipliers, largest modulus first; one of them is 1."""
        # Worked out when asked for: eigenvalues have no second derivative in JAX.
        values = jnp.linalg.eigvals(self._monodromy)
        order = jnp.argsort(-jnp.abs(jax.lax.stop_gradient(values)), axis=-1)
        return jnp.take_along_axis(values, order, axis=-1)

    @property
    def frequency(self) -> jax.Array:
        """1/period [Hz]."""
        return 1 / self.period

    def orbit(self, n: int = 512) -> tuple[jax.Array, jax.Array]:
        """Times (n,) [s] and states (n, 4) [m, m/s], evenly over one period from `state`."""
        system = self._system
        share = jnp.arange(n) / n
        y = self._motion.at(system, share * self.period * system.omega)
        y = jnp.where(jnp.isfinite(self.period), y, jnp.nan)
        return share * self.period, (y * units(system)[:, None]).T

    def spectrum(self, n: int = 512) -> tuple[jax.Array, jax.Array]:
        """Harmonics: frequencies (n//2,) [Hz] and peak amplitudes (n//2, 2) [m] of x1 and x2.

        The Fourier coefficients of n samples of the orbit, without the mean.
        """
        _, states = self.orbit(n)
        lines = jnp.abs(jnp.fft.rfft(states[:, :2], axis=0)) / n * 2
        harmonics = jnp.arange(1, n // 2 + 1)
        return harmonics / self.period, lines[1 : n // 2 + 1]

    def switches(self) -> list[Switch]:
        """Every change of mode in one period, in order, with its time.

        **Raises:** `ValueError` for a batch of cycles, inside a compiled program, and for the
        regularised law, which has none.
        """
        if concrete(self.period) is None or self.period.ndim:
            raise ValueError("switches() needs one cycle, outside of jit: index the batch first")
        if not isinstance(self._motion, Closed):
            raise ValueError("a regularised cycle has no switches")
        segments, names = self._motion.segments, {1: "+", -1: "-", 0: "stick"}
        used = np.asarray(segments.guard) != UNUSED
        modes = np.asarray(segments.s)[:, used].astype(int)
        times = np.cumsum(np.asarray(segments.duration)[used]) / float(self._system.omega)
        found = []
        for k, time in enumerate(times):
            before, after = modes[:, k], np.roll(modes, -1, axis=1)[:, k]
            for i in np.flatnonzero(before != after):
                found.append(Switch(float(time), int(i) + 1, names[before[i]], names[after[i]]))
        return found
