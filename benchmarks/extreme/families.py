"""Errors, numbers that are not finite and times of one family of quantities over drawn inputs."""

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
Row = dict[str, Any]


def mechanism_in_single(x: np.ndarray) -> np.ndarray:
    """Mechanisms rounded to float32; mu_m never above mu_s."""
    x = x.astype(np.float32)
    x[:, 9] = np.maximum(x[:, 9], x[:, 10])
    return x


@dataclasses.dataclass(frozen=True)
class Kind:
    """Inputs of one kind: how many columns, rows from places, the same in float32, exact values."""

    columns: int
    rows: Callable[[np.ndarray], np.ndarray]
    single: Callable[[np.ndarray], np.ndarray]
    truth: truths.Truth
    sorted_by: tuple[int, str]  # column whose value orders the timed parts


JOINT = Kind(points.JOINT_COLUMNS, points.joints, points.single, truths.joint, (0, "D"))
MECHANISM = Kind(
    points.MECHANISM_COLUMNS,
    points.mechanisms,
    mechanism_in_single,
    truths.mechanism,
    (7, "K_n"),
)
AREA = Kind(points.ROUGHNESS_COLUMNS, points.areas, points.single, truths.roughness, (0, "D"))


@dataclasses.dataclass(frozen=True)
class Family:
    """Quantities that come from the same inputs."""

    name: str
    kind: Kind
    program: Callable[[jax.Array], dict[str, jax.Array]]
    quantities: dict[str, str]  # and beside what their error is taken: themselves, or another
    moved: tuple[int, ...] = ()  # columns by which derivatives are compared


CONTACT = {"a_l": "a_l", "K_n": "K_n", "K_t": "K_t", "Q_e": "load", "plastic_share": "1"}
MODES = {"growth_rate": "modulus", "real": "modulus", "margin": "1"}
HEIGHTS = {"Sq": "Sq", "Sdq": "Sdq"}
FAMILIES = [
    Family("joint", JOINT, programs.state, CONTACT, (0, 1, 7)),
    Family("load of an area", JOINT, programs.load_there_and_back, {"P": "P"}),
    Family("mechanism", MECHANISM, programs.squeal, MODES, (7, 8, 9)),
    Family("equilibrium", MECHANISM, programs.rest, {"x_0": "x_0"}),
    Family("critical friction", MECHANISM, programs.critical_friction, {"mu_c": "mu_c"}, (1, 7, 8)),
    Family("roughness", AREA, programs.roughness, HEIGHTS, (0, 1)),
]


def family_rows(family: Family, count: int, exact: int, gradients: int) -> list[Row]:
    """A row for each quantity of the family: both precisions side by side."""
    kind = family.kind
    x = kind.rows(points.places(np.random.default_rng(3), count, kind.columns))
    x = x[np.argsort(x[:, kind.sorted_by[0]], kind="stable")]
    chosen = np.linspace(0, count - 1, exact).astype(int)
    rows: dict[str, Row] = {n: {"family": family.name, "quantity": n} for n in family.quantities}
    double: dict[str, np.ndarray] = {}  # forward derivatives
    for inputs in (x, kind.single(x)):
        bits = 8 * inputs.itemsize
        value, forward, _ = programs.of_rows(family.program)
        found, by_forward = value(inputs), forward(inputs)
        if not double:
            double = {name: np.asarray(by_forward[name]) for name in rows}
            timed = times(value, inputs, kind)
        sampled = tqdm(inputs[chosen].astype(float).tolist(), desc=f"{family.name}, {bits}")
        truth = [kind.truth(*point) for point in sampled]
        for name, beside in family.quantities.items():
            # Alone: an infinite derivative must not spoil those of the other quantities.
            alone = jax.jacrev(lambda x, name=name: family.program(x)[name])
            reverse = np.asarray(jax.jit(jax.vmap(alone))(inputs))
            columns = x[chosen].reshape(exact, *[1] * (double[name].ndim - 2), -1)
            off, conditioned = errors(
                np.asarray(found[name])[chosen],
                [row[name] for row in truth],
                [scale(row, beside) for row in truth],
                double[name][chosen] * columns,
                float(jnp.finfo(inputs.dtype).eps),
            )
            rows[name] |= timed
            rows[name][f"float{bits}"] = {
                "points": count,
                "exact_points": exact,
                "worst": max(off),
                "median": statistics.median(off),
                "worst_beside_rounding": max(conditioned),
                "gradient": gradient_error(family, name, inputs, reverse, gradients),
            } | not_finite(found[name], np.asarray(by_forward[name]), reverse, double[name])
    return list(rows.values())


def scale(row: Row, beside: str) -> Any:
    """What an error is taken beside, from the truth of a row."""
    if beside == "1":
        return 1.0
    return max(map(abs, row[beside])) if isinstance(row[beside], list) else abs(row[beside])


def errors(found, truth, scales, moved, eps) -> tuple[list[float], list[float]]:
    """Errors beside the scale, and beside what rounding of the inputs alone would make of it."""
    off, conditioned = [], []
    for value, exact, size, slope in zip(found, truth, scales, moved, strict=True):
        exact = exact if isinstance(exact, list) else [exact]
        wide = mpmath.mpf(size) if size else mpmath.mpf(1)
        if not mpmath.isfinite(wide) or not np.isfinite(value).all():  # counted elsewhere
            continue
        pairs = zip(np.ravel(value).tolist(), exact, strict=True)
        lost = max(abs(mpmath.mpf(v) - e) / wide for v, e in pairs)
        condition = np.abs(slope).reshape(len(exact), -1).sum(axis=1).max()
        off.append(float(lost))
        if np.isfinite(condition):
            conditioned.append(float(lost / (eps * (1 + mpmath.mpf(float(condition)) / wide))))
    return off, conditioned


def gradient_error(family, name, inputs, reverse, count) -> float | None:
    """Worst error of the derivative by ln x, beside the largest compared or the value's scale."""
    if not family.moved or reverse.ndim != 2 or name in ("Q_e", "plastic_share"):
        return None
    worst, moved = 0.0, list(family.moved)
    for i in np.linspace(0, len(inputs) - 1, count).astype(int):
        row = inputs[i].astype(float)
        truth = truths.slopes(family.kind.truth, name, row.tolist(), family.moved)
        weights, truth = np.abs(row[moved]), np.array(truth, float)
        found = reverse[i].astype(float)[moved]
        size = float(scale(family.kind.truth(*row.tolist()), family.quantities[name]))
        size = max(np.abs(truth * weights).max(), size)
        if size > 0 and np.isfinite(size) and np.isfinite(found).all():
            worst = max(worst, float((np.abs(found - truth) * weights).max() / size))
    return worst


def not_finite(value, forward, reverse, double) -> dict[str, int]:
    """How many points have one in the value, in a derivative; and of these how many must."""

    def rows(bad):
        return int(bad.reshape(len(bad), -1).any(axis=1).sum())

    bad = ~np.isfinite(forward) | ~np.isfinite(reverse)
    return {
        "not_finite": rows(~np.isfinite(np.asarray(value))),
        "not_finite_gradient": rows(bad),
        "beyond_range": rows(bad & ~(np.abs(double) < BEYOND)),
    }


def times(program, inputs: np.ndarray, kind: Kind) -> Row:
    """Time of a point, and the slowest tenth of the points in order of one column."""
    size = len(inputs) // PARTS
    chunks = [jnp.asarray(inputs[i * size : (i + 1) * size]) for i in range(PARTS)]
    jax.block_until_ready(program(chunks[0]))
    taken = [[seconds(program, chunk)[0] / size for chunk in chunks] for _ in range(REPEATS)]
    ratios = np.median(taken / np.median(taken, axis=1, keepdims=True), axis=0)
    slowest, (column, label) = int(ratios.argmax()), kind.sorted_by
    ends = inputs[slowest * size, column], inputs[(slowest + 1) * size - 1, column]
    return {
        "seconds": float(np.median(taken)),
        "slowest": f"{label} from {ends[0]:.7g} to {ends[1]:.7g}",
        "slowest_ratio": float(ratios[slowest]),
    }
