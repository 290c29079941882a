"""One row of the table: errors, numbers that are not finite and times over many drawn inputs."""

import dataclasses
import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from tqdm import tqdm

from .. import truths
from ..timing import seconds
from . import points, programs

PARTS = 10  # of all points, timed apart
REPEATS = 5
BEYOND = 1e37  # where a derivative leaves the range of a float32, or a step towards it does


@dataclasses.dataclass(frozen=True)
class Family:
    """Quantities that come from the same inputs."""

    name: str
    columns: int
    rows: Callable[[np.ndarray], np.ndarray]
    program: Callable[[jax.Array], dict[str, jax.Array]]
    truth: truths.Truth
    quantities: dict[str, str]  # and beside what their error is taken: themselves, or another
    moved: tuple[int, ...]  # columns by which derivatives are compared
    sorted_by: tuple[int, str]  # column whose value orders the timed parts
    single: Callable[[np.ndarray], np.ndarray] = points.single


def as_single(x: np.ndarray) -> np.ndarray:
    """Mechanisms rounded to float32; mu_m never above mu_s."""
    x = x.astype(np.float32)
    x[:, 9] = np.maximum(x[:, 9], x[:, 10])
    return x


FAMILIES = [
    Family(
        "joint",
        points.JOINT_COLUMNS,
        points.joints,
        programs.state,
        truths.joint,
        {"a_l": "a_l", "K_n": "K_n", "K_t": "K_t", "Q_e": "load", "plastic_share": "1"},
        (0, 1, 7),
        (0, "D"),
    ),
    Family(
        "load of an area",
        points.JOINT_COLUMNS,
        points.joints,
        programs.load_there_and_back,
        truths.joint,
        {"P": "P"},
        (),
        (0, "D"),
    ),
    Family(
        "mechanism",
        points.MECHANISM_COLUMNS,
        points.mechanisms,
        programs.squeal,
        truths.mechanism,
        {"growth_rate": "modulus", "real": "modulus", "margin": "1"},
        (7, 8, 9),
        (7, "K_n"),
        as_single,
    ),
    Family(
        "equilibrium",
        points.MECHANISM_COLUMNS,
        points.mechanisms,
        programs.rest,
        truths.mechanism,
        {"x_0": "x_0"},
        (),
        (7, "K_n"),
        as_single,
    ),
    Family(
        "critical friction",
        points.MECHANISM_COLUMNS,
        points.mechanisms,
        programs.critical_friction,
        truths.mechanism,
        {"mu_c": "mu_c"},
        (1, 7, 8),
        (7, "K_n"),
        as_single,
    ),
    Family(
        "roughness",
        points.ROUGHNESS_COLUMNS,
        points.areas,
        programs.roughness,
        truths.roughness,
        {"Sq": "Sq", "Sdq": "Sdq"},
        (0, 1),
        (0, "D"),
    ),
]


def family_rows(family: Family, count: int, exact: int, gradients: int) -> list[dict[str, Any]]:
    """A row for each quantity of the family: both precisions side by side."""
    x = family.rows(points.places(np.random.default_rng(3), count, family.columns))
    x = x[np.argsort(x[:, family.sorted_by[0]], kind="stable")]
    chosen = np.linspace(0, count - 1, exact).astype(int)
    rows: dict[str, dict[str, Any]] = {
        name: {"family": family.name, "quantity": name} for name in family.quantities
    }
    double: dict[str, np.ndarray] = {}
    for bits, inputs in ((64, x), (32, family.single(x))):
        value, forward, _ = programs.of_rows(family.program)
        found, by_forward = value(inputs), forward(inputs)
        by_reverse = one_by_one(family, inputs)
        if bits == 64:
            double = {name: np.asarray(by_forward[name]) for name in family.quantities}
            timed = times(value, inputs, family)
            for row in rows.values():
                row |= timed
        sampled = tqdm(inputs[chosen].astype(float).tolist(), desc=f"{family.name}, {bits}")
        exact_rows = [family.truth(*point) for point in sampled]
        for name, beside in family.quantities.items():
            off, conditioned = errors(
                np.asarray(found[name])[chosen],
                [row[name] for row in exact_rows],
                [scale(row, beside) for row in exact_rows],
                np.asarray(double[name])[chosen] * x[chosen][at_end(double[name])],
                float(jnp.finfo(inputs.dtype).eps),
            )
            rows[name][f"float{bits}"] = {
                "points": count,
                "exact_points": exact,
                "worst": max(off),
                "median": statistics.median(off),
                "worst_beside_rounding": max(conditioned),
                "gradient": gradient_error(family, name, inputs, by_reverse, gradients),
            } | not_finite(name, found, by_forward, by_reverse, double)
    return list(rows.values())


def at_end(derivative: np.ndarray) -> tuple:
    """Index that lays columns (n, k) along the last axis of derivatives (n, ..., k)."""
    return (slice(None), *(None,) * (derivative.ndim - 2), slice(None))


def one_by_one(family: Family, inputs: np.ndarray) -> dict[str, np.ndarray]:
    """Reverse derivatives, each quantity alone: an infinite one must not spoil the others."""

    def alone(name):
        return jax.jit(jax.vmap(jax.jacrev(lambda x: family.program(x)[name])))

    return {name: np.asarray(alone(name)(inputs)) for name in family.quantities}


def scale(row: dict[str, Any], beside: str) -> Any:
    """What an error is taken beside, from the truth of a row."""
    if beside == "1":
        return 1.0
    found = row[beside]
    return max(abs(value) for value in found) if isinstance(found, list) else abs(found)


def errors(found, truth, scales, moved, eps) -> tuple[list[float], list[float]]:
    """Errors beside the scale, and beside what rounding of the inputs alone would make of it."""
    off, conditioned = [], []
    for value, exact, size, slope in zip(found, truth, scales, moved, strict=True):
        exact = exact if isinstance(exact, list) else [exact]
        wide = mpmath.mpf(size) if size else mpmath.mpf(1)
        if not mpmath.isfinite(wide) or not np.isfinite(value).all():  # counted elsewhere
            continue
        lost = max(
            abs(mpmath.mpf(float(v)) - e) / wide
            for v, e in zip(np.ravel(value), exact, strict=True)
        )
        condition = np.abs(slope).reshape(len(exact), -1).sum(axis=1).max()
        off.append(float(lost))
        if np.isfinite(condition):
            conditioned.append(float(lost / (eps * (1 + mpmath.mpf(float(condition)) / wide))))
    return off, conditioned


def gradient_error(family, name, inputs, reverse, count) -> float | None:
    """Worst error of the derivative by ln x, beside the largest compared or the value's scale."""
    if not family.moved or reverse[name].ndim != 2 or name in ("Q_e", "plastic_share"):
        return None
    worst = 0.0
    for i in np.linspace(0, len(inputs) - 1, count).astype(int):
        row = inputs[i].astype(float).tolist()
        truth = [float(v) for v in truths.slopes(family.truth, name, row, family.moved)]
        weights = np.abs(inputs[i].astype(float)[list(family.moved)])
        found = reverse[name][i].astype(float)[list(family.moved)]
        size = np.abs(np.array(truth) * weights).max()
        size = max(size, float(scale(family.truth(*row), family.quantities[name])))
        if size > 0 and np.isfinite(size) and np.isfinite(found).all():
            worst = max(worst, float((np.abs(found - truth) * weights).max() / size))
    return worst


def not_finite(name, found, forward, reverse, double) -> dict[str, int]:
    """How many points have one in the value, in a derivative; and of these how many must."""

    def rows(bad):
        return bad.reshape(len(bad), -1).any(axis=1)

    bad = ~np.isfinite(np.asarray(forward[name])) | ~np.isfinite(reverse[name])
    must = bad & ~(np.abs(double[name]) < BEYOND)
    return {
        "not_finite": int(rows(~np.isfinite(np.asarray(found[name]))).sum()),
        "not_finite_gradient": int(rows(bad).sum()),
        "beyond_range": int(rows(must).sum()),
    }


def times(program, inputs: np.ndarray, family: Family) -> dict[str, Any]:
    """Time of a point, and the slowest tenth of the points in order of one column."""
    size = len(inputs) // PARTS
    chunks = [jnp.asarray(inputs[i * size : (i + 1) * size]) for i in range(PARTS)]
    jax.block_until_ready(program(chunks[0]))
    taken = np.array(
        [[seconds(program, chunk)[0] / size for chunk in chunks] for _ in range(REPEATS)]
    )
    ratios = np.median(taken / np.median(taken, axis=1, keepdims=True), axis=0)
    slowest = int(ratios.argmax())
    column, label = family.sorted_by
    ends = inputs[slowest * size, column], inputs[(slowest + 1) * size - 1, column]
    return {
        "seconds": float(np.median(taken)),
        "slowest": f"{label} from {ends[0]:.7g} to {ends[1]:.7g}",
        "slowest_ratio": float(ratios[slowest]),
    }
