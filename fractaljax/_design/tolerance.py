"""Scatter of quantities as machined: quantiles over a fixed quadrature, and draws at random.

The scatter is normal, with any covariance; that of a fractal dimension, a Hurst exponent or a
roll-off is truncated where it would leave its domain, and what is correlated with it follows. The
height of a fractal surface scatters as ln m(q) at one wavenumber, from which ln G follows at each D
(`surface_scatter.py`). The nodes of the quadrature are a lattice of a
normal distribution twice as wide, weighted back, so that the tails which decide a quantile are well
resolved. The same nodes serve every design, so that a quantile is continuous in the design.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.batches import in_batches
from .._base.parts import Record, brief, is_traced, number, scalar
from .._base.ranges import low_discrepancy
from .._base.suggest import did_you_mean
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import (
    quantity_names,
    replaced,
    require_independent,
    substituted,
    target_quantities,
    value_of,
    with_optional,
)
from .._mechanism.scene import Scene, stiffness
from .._stability.stability import growth_rate
from .._surface.surface_scatter import HEIGHT, SurfaceScatter
from .envelope import Envelope
from .truncated import REACH, ends_of, truncated


class Tolerance(Record):
    """Scatter of named quantities: `Tolerance(("D", "ln G"), covariance)`, covariance (k, k).

    "ln G" scatters ln G. "ln m(q)" scatters the height of a fractal surface at the wavenumber `q`
    [rad/m], where the error of a measured height is uncorrelated with D; G follows from it and D.
    `Tolerance.of` takes a mapping of independent standard deviations, a `SurfaceScatter`, and what
    has one, as an `Identification` does.

    Scatter is normal. A fractal dimension D whose six standard deviations would leave (2, 3) has
    the normal distribution truncated to it, at any standard deviation; whatever is correlated with
    D keeps its normal distribution at each D. A Hurst exponent is truncated to (0, 1) and a
    roll-off to the wavelengths of its spectrum likewise. Others must stay inside their domains
    within six standard deviations.

    **Raises:** `ValueError` unless the covariance is symmetric, positive semidefinite and not 0,
    and for a q without "ln m(q)" or that without a q above 0.
    """

    names: tuple[str, ...] = eqx.field(static=True)  # of the quantities, or of their logarithms
    covariance: Float[Array, "k k"]  # of what is named, in SI units
    q: Float[Array, ""] | None  # rad/m: wavenumber of "ln m(q)"

    def __init__(self, names: Sequence[str], covariance: ArrayLike, q: ArrayLike | None = None):
        self.names = tuple(names)
        if (q is not None) != any(map(_is_height, self.names)):
            raise ValueError(f'tolerance takes q with "ln {HEIGHT}", got {self.names} and q = {q}')
        self.q = None if q is None else scalar("q", q, above=0)
        array = covariance if hasattr(covariance, "dtype") else np.asarray(covariance)
        self.covariance = number("covariance", array)
        if self.covariance.shape != (len(self.names),) * 2 or not self.names:
            raise ValueError(
                f"tolerance must name the rows of its covariance, got {len(self.names)} names and "
                f"shape {self.covariance.shape}"
            )
        C = np.asarray(self.covariance)
        spread = np.sqrt(np.maximum(np.diagonal(C), 0))
        scale = np.outer(spread, spread)
        small = 1e-9 + 1e3 * np.finfo(C.dtype).eps
        correlation = np.divide(C, scale, out=np.zeros_like(C), where=scale > 0)
        if not (np.abs(C - C.T) <= small * scale).all() or (
            np.linalg.eigvalsh(correlation)[0] < -small * len(C)
        ):
            raise ValueError("tolerance must have a symmetric, positive semidefinite covariance")
        if not spread.any():
            raise ValueError("tolerance must be above 0 for some quantity, got 0 for all")

    @classmethod
    def of(cls, scatter: Any) -> "Tolerance":
        """A tolerance from `scatter`.

        It is a tolerance, a mapping of names to standard deviations, a `SurfaceScatter` or what
        has one as `scatter`: an identification.
        """
        scatter = getattr(scatter, "scatter", scatter)
        if isinstance(scatter, Tolerance):
            return scatter
        if isinstance(scatter, SurfaceScatter):
            return cls(scatter.names, scatter.covariance, scatter.q)
        if hasattr(scatter, "D_standard_error") and hasattr(scatter, "covariance"):
            return cls(("D", "ln G"), scatter.covariance)
        if not isinstance(scatter, Mapping):
            raise TypeError(
                "tolerance must be a mapping, a Tolerance or an Identification, got "
                + brief(scatter)
            )
        if not scatter:
            raise ValueError("tolerance must name a quantity, got none")
        sigmas = {n: float(scalar(f"tolerance of {n}", s, at_least=0)) for n, s in scatter.items()}
        names = [name for name in sigmas if sigmas[name] > 0] or [*sigmas]
        return cls(names, np.diag([sigmas[name] ** 2 for name in names]))

    @property
    def standard_deviations(self) -> dict[str, float]:
        """By name, as given: {"D": ..., "ln G": ...}."""
        return dict(zip(self.names, np.sqrt(np.diagonal(self.covariance)).tolist(), strict=True))

    @property
    def quantities(self) -> tuple[str, ...]:
        """What scatters: the names without "ln ", and G for "ln m(q)"."""
        plain = [name.removeprefix("ln ") for name in self.names]
        return tuple(n.removesuffix(HEIGHT) + "G" if n.endswith(HEIGHT) else n for n in plain)

    def check(self, x: Mechanism, ranges: Mapping[str, Sequence[float]]) -> None:
        """Refuse names that `x` lacks, and a scatter that leaves a domain within six deviations.

        What is truncated to its domain cannot leave it. `ranges` are those inside which a quantity
        varies otherwise.
        """
        names = quantity_names(x)
        for name, (label, sigma) in zip(
            self.quantities, self.standard_deviations.items(), strict=True
        ):
            if name not in names:
                near = did_you_mean(name, names)
                raise ValueError(f"tolerance names {label!r}; there are {', '.join(names)}{near}")
            for each in [] if is_traced(x) else _scattered_names(x, name):
                ends = ranges.get(each, ranges.get(name, (float(value_of(x, each)),)))
                low, high = min(ends), max(ends)
                if self._ends(x, each) is not None or _is_height(label):
                    pass
                elif name == label:
                    low, high = low - REACH * sigma, high + REACH * sigma
                else:
                    most = min(REACH * sigma, _largest(value_of(x, each).dtype))
                    low, high = low * math.exp(-most), high * math.exp(most)
                try:
                    for end in (low, high):
                        replaced(x, {each: end})
                except ValueError as error:
                    raise ValueError(
                        f"tolerance of {label} leaves its domain within {REACH:g} deviations: "
                        f"{error}"
                    ) from None
        require_independent(x, self.quantities)
        if len(self.names) > 6:  # nodes double with each
            raise ValueError(f"tolerance takes at most 6 quantities, got {len(self.names)}")

    def shifts(self, deviates: np.ndarray) -> np.ndarray:
        """Shifts (n, k) of quantities, or of their logarithms, from normal `deviates` (n, k).

        The deviates have variance 1; they are correlated by the Cholesky factor of the correlation
        matrix, which may be singular.
        """
        C = np.asarray(self.covariance, float)
        sigma = np.sqrt(np.diagonal(C))
        unit = np.where(sigma > 0, sigma, 1)
        correlation = C / np.outer(unit, unit)
        np.fill_diagonal(correlation, 1 + 1e-14)
        return deviates @ np.linalg.cholesky(correlation).T * sigma

    def base(self, x: Mechanism) -> dict[str, Float[Array, ""]]:
        """The quantities of `x` that scatter, by name: of every joint by itself."""
        return {
            each: jnp.asarray(value_of(x, each))
            for name in self.quantities
            for each in _scattered_names(x, name)
        }

    def scattered(self, x: Mechanism, values: Mapping[str, Any], shift: Any) -> dict[str, Any]:
        """The quantities at `values` by name, shifted by (k,), or by (k, n) for values (n,).

        `values` holds a plain name, "D", where it stands for all joints at once.
        """
        values_at, heights = {}, []
        shifts = self._truncate(x, values, shift)
        for name, label, by in zip(self.quantities, self.names, shifts, strict=True):
            if _is_height(label):
                heights.append((name, by))
                continue
            for each, value in _values(x, name, values).items():
                if name == label:
                    values_at[each] = value + by
                else:
                    most = _largest(jnp.result_type(value))
                    values_at[each] = value * jnp.exp(jnp.clip(by, -most, most))
        for name, by in heights:
            for each, G in _values(x, name, values).items():
                dimension = f"{each[:-1]}D"
                D = self._value(x, values, dimension)
                scattered = values_at.get(dimension, D)
                scattered, values_at[each] = _with_height(D, G, scattered, by, self.q)
                if dimension in values_at:
                    values_at[dimension] = scattered
        return values_at

    def _value(self, x: Mechanism, values: Mapping[str, Any], name: str) -> Any:
        """The value of a quantity of `x`, of those at `values` if it is among them."""
        plain = name.rpartition(".")[2]
        stored = x.stored_quantities()[name].value
        return values.get(name, values.get(plain, stored))

    def _ends(self, x: Mechanism, name: str, values: Mapping[str, Any] = {}) -> Any:
        """The ends to which a quantity is truncated, or None."""
        joint = name.rpartition(".")[0]
        prefix = f"{joint}." if joint else ""
        return ends_of(x, name, lambda plain: self._value(x, values, prefix + plain))

    def _truncate(self, x: Mechanism, values: Mapping[str, Any], shift: Any) -> list[Any]:
        """The shifts with those that have ends truncated, and of all that is correlated.

        A second one is truncated by itself: it does not shift the first.
        """
        shifts, fixed = [*shift], set()
        for i, (name, label) in enumerate(zip(self.quantities, self.names, strict=True)):
            low, high = -math.inf, math.inf  # all joints shift by the same amount
            for each, value in _values(x, name, values).items():
                if _is_height(label) or (ends := self._ends(x, each, values)) is None:
                    continue
                below, above = (
                    end - value if name == label else jnp.log(end / value) for end in ends
                )
                low, high = jnp.maximum(low, below), jnp.minimum(high, above)
            if isinstance(low, float):
                continue
            variance = self.covariance[i, i]
            more = truncated(shifts[i], jnp.sqrt(variance), low, high) - shifts[i]
            share = self.covariance[i] / jnp.where(variance > 0, variance, 1)
            fixed.add(i)
            for j in range(len(shifts)):
                if j == i or j not in fixed:
                    shifts[j] = shifts[j] + (more if j == i else share[j] * more)
        return shifts


def _is_height(label: str) -> bool:
    """True if a label is "ln m(q)", of all joints or of one."""
    return label.startswith("ln ") and label.removeprefix("ln ").rpartition(".")[2] == HEIGHT


def _with_height(D: Any, G: Any, scattered: Any, by: Any, q: Any) -> tuple[Any, Any]:
    """D and G of a surface whose D is `scattered` and whose ln m(q) is shifted `by`.

    With f = q/(2 pi), ln m(q) = 2 (D - 2) (ln G + ln f) - 2 ln f - ln 2. Where G would leave the
    range of its precision, D comes no closer to 2: the height is kept.
    """
    log_f = jnp.log(q / (2 * math.pi))
    slope = 2 * (D - 2) * (jnp.log(G) + log_f) + by
    most = -math.log(float(jnp.finfo(jnp.result_type(G)).tiny)) - jnp.abs(log_f) - 2
    D = 2 + jnp.maximum(scattered - 2, jnp.abs(slope) / (2 * most))
    return D, jnp.exp(slope / (2 * (D - 2)) - log_f)


def _values(x: Mechanism, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of all quantities that a name stands for."""
    return {each: values[name if name in values else each] for each in _scattered_names(x, name)}


def _largest(dtype) -> float:
    """The largest shift of a logarithm: no error makes a number infinite or 0."""
    return 0.5 * math.log(float(jnp.finfo(dtype).max))


def _scattered_names(x: Mechanism, name: str) -> list[str]:
    """The name itself; for a structure the names in all joints that a plain name stands for."""
    return [name] if name in x.derived_quantities() else sorted(target_quantities(x, name))


def nodes(dimensions: int, count: int = 55, widening: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal deviates (n, dimensions) and their weights (n,), which sum to 1.

    There are `count` in one and two dimensions, a Fibonacci number, whose lattice is the best of
    its size; every further dimension doubles them. They are drawn from a distribution wider by
    the factor `widening`.
    """
    from scipy.special import ndtri

    z = ndtri(low_discrepancy(count * 2 ** max(dimensions - 2, 0), dimensions))
    # Zero mean and unit covariance exactly.
    z = z - z.mean(axis=0)
    z = np.linalg.solve(np.linalg.cholesky(z.T @ z / len(z)), z.T).T
    weights = np.exp(-(z**2).sum(axis=1) * (widening**2 - 1) / 2)
    return z * widening, weights / weights.sum()


def quantile(values: Float[Array, "n ..."], weights: Float[Array, " n"], level) -> Array:
    """The weighted `level`-quantile of values (n, ...) with weights (n,).

    The mean of the quantile function over level +- (1 - level)/2: continuous in the values, with a
    derivative that mixes those of several nodes.
    """
    half = (1 - level) / 2
    order = jnp.argsort(values, axis=0)
    below = jnp.cumsum(weights[order], axis=0)
    below = below / below[-1:]  # 1 exactly at the end, whatever the rounding of the weights
    reached = jnp.clip((below - level + half) / (2 * half), 0, 1)
    share = jnp.diff(reached, axis=0, prepend=jnp.zeros_like(reached[:1]))
    return jnp.sum(share * jnp.take_along_axis(values, order, axis=0), axis=0)


class Scatter(eqx.Module):
    """The quadrature over a tolerance, and the quantile that counts."""

    tolerance: Tolerance
    base: dict[str, Float[Array, ""]]  # what the quantities are where nothing moves them
    shifts: Float[Array, "n k"]
    weights: Float[Array, " n"]
    level: Float[Array, ""]


# --- probability of squeal ----------------------------------------------------------------


class SquealProbability(NamedTuple):
    """The share of draws that squeal, and its standard error, which is never 0.

    Draws without a sliding equilibrium, whose growth rate is NaN, are neither: they are counted by
    themselves, so that the probability lies between `value` and `value + undetermined`.
    """

    value: float
    standard_error: float
    undetermined: float = 0.0  # share of draws without a growth rate


@eqx.filter_jit
def _growth_rates(x, names, values, friction_slope):
    def one(row):
        return growth_rate(substituted(x, dict(zip(names, row, strict=True))), friction_slope)

    return jax.vmap(one)(values)


@eqx.filter_jit
def _joints(x, names, values):
    def one(row):
        varied = substituted(x, dict(zip(names, row, strict=True)))
        return jnp.stack([*stiffness(varied), growth_rate(varied)])

    return jax.vmap(one)(values)


def scattered_joint(
    scene: Scene, scatter: Any, *, samples: int = 256, seed: int = 0
) -> dict[str, tuple[float, float, float]]:
    """K_n, K_t [N/m] and growth rate [1/s] of a scene, and the middle 68 % of each over a scatter.

    By name: as it is, and the quantiles .16 and .84 of `samples` draws.
    """
    tolerance = Tolerance.of(scatter)
    tolerance.check(scene, {})
    shifts = tolerance.shifts(
        np.random.default_rng(seed).standard_normal((samples - 1, len(tolerance.names)))
    )
    base = tolerance.base(scene)
    scattered = tolerance.scattered(scene, base, shifts.T)
    rows = np.stack(
        [np.append(base[n], np.broadcast_to(v, samples - 1)) for n, v in scattered.items()], axis=1
    )
    values = np.asarray(_joints(scene, tuple(scattered), rows))
    low, high = np.nanquantile(values[1:], [0.16, 0.84], axis=0)
    names = ("K_n", "K_t", "growth rate")
    return {
        name: (float(values[0, i]), float(low[i]), float(high[i])) for i, name in enumerate(names)
    }


def squeal_probability(
    x: Mechanism,
    tolerance: Any,
    envelope: Envelope | Mapping[str, Any] | None = None,
    *,
    friction_slope: bool = True,
    samples: int | None = None,
    seed: int = 0,
) -> SquealProbability:
    """The probability that `x` as machined or identified squeals: growth rate > 0.

    Draws whose growth rate is NaN, as where a preloaded joint has no closed equilibrium, are
    `undetermined`.

    **Arguments:**

    - `x`: a scene or structure of scalars.
    - `tolerance`: an `Identification`, a `SurfaceScatter`, a `Tolerance` or a mapping of standard
      deviations. A name
      without a joint, "D", of a structure moves all joints that have one by the same amount.
    - `envelope`: an `Envelope` or a mapping; every draw is at a condition drawn evenly from it. By
      default there is none.
    - `friction_slope`: False leaves the slope of friction out of growth rates.
    - `samples`: number of draws, 100,000 by default, fewer, down to 1000, of a structure of more
      than 17 degrees of freedom.
    - `seed`: of the draws, 0 by default.

    **Returns:** a `SquealProbability`.

    **Raises:** `ValueError` for quantities that `x` lacks, or scattered beyond their domain; D is
    truncated to its own instead (see `Tolerance`).
    """
    tolerance, values = Tolerance.of(tolerance), {}
    if samples is None:
        # Eigenvalues take a time that grows with the cube of their number.
        samples = int(np.clip(4e9 / (2 * x.n) ** 3, 1000, 100_000))
    if envelope is not None:
        envelope = Envelope.of(envelope)
        envelope.check(x, ())
        drawn = envelope.values(envelope.drawn(samples, seed))
        values = dict(zip(envelope.names, drawn.T, strict=True))
    tolerance.check(x, {name: (column.min(), column.max()) for name, column in values.items()})
    x = with_optional(x, (*values, *tolerance.quantities))
    random = np.random.default_rng([seed, 0])
    shifts = tolerance.shifts(random.standard_normal((samples, len(tolerance.names))))
    scattered = tolerance.scattered(x, tolerance.base(x) | values, shifts.T)
    values |= {name: np.broadcast_to(column, samples) for name, column in scattered.items()}
    dtype = jax.tree.leaves(x)[0].dtype
    rows = np.stack([np.asarray(column, dtype) for column in values.values()], axis=1)
    batch = max(64, 32_768 // x.n**2)  # about as much memory for all sizes
    growth = in_batches(
        lambda rows: _growth_rates(x, tuple(values), rows, friction_slope),
        min(batch, samples),
        rows,
    )
    probability = proportion(int((growth > 0).sum()), samples)
    return probability._replace(undetermined=float(np.isnan(growth).mean()))


def proportion(hits: int, count: int) -> SquealProbability:
    """A proportion and its standard error, which is never zero."""
    smoothed = (hits + 1) / (count + 2)
    return SquealProbability(hits / count, math.sqrt(smoothed * (1 - smoothed) / count))
