"""Tabulate the cycles of mechanisms and their derivatives, as truth for the tests.

All by `tests/hybrid_truth.py`. Derivatives are Richardson extrapolations of central differences
over the converged cycle, with an estimate of their error. To add a mechanism, append a row with its
name, note and problem.

    python tests/reference/make_mechanisms.py [NAME ...]

Without names it computes the rows that have no "kind".
"""

import copy
import json
import pathlib
import sys

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import hybrid_truth  # noqa: E402
from hybrid_truth import Mechanism  # noqa: E402
from mechanisms import PROBLEMS, TABLE  # noqa: E402

STEP = 4e-3  # relative; the widest of the differences
LEVELS = 3  # each half as wide as the one before
NARROWEST = 1e-5
NOISE = 2e-13  # relative error of a value
SAFETY = 10.0
ENOUGH = 1e-7  # relative error of a derivative by the logarithm of a quantity
LISTS = [
    "amplitude",
    "velocity_min",
    "velocity_max",
    "stick_fraction",
    "second_stick_fraction",
    "open_fraction",
    "normal_force",
    "state",
]
ABOUT = (
    "Mechanisms as tests/mechanisms.py says, and their periodic motions by event-driven DOP853, "
    "SI units; made by make_mechanisms.py. state is [x, x'] where t.x of the first joint is "
    "largest; itinerary is [signs of the faces, duration] from there on, with 0 for stick and 9 "
    "for open; multipliers are [real, imaginary] and hold the trivial 1; value_error is the "
    "relative change with a finer step; margins as in hybrid_truth.measure; derivatives by a "
    "quantity are [value, estimated error] of period, amplitude, stick_fraction and "
    "open_fraction, null where no interval of one itinerary was wide enough."
)


def place(problem, path):
    """The list or mapping and the key in it of a quantity such as joints.0.friction.mu_s."""
    *outer, last = (int(key) if key.isdigit() else key for key in path.split("."))
    for key in outer:
        problem = problem[key]
        problem = problem[1] if key == "friction" else problem
    return problem, last


def moved(problem, path, step):
    problem = copy.deepcopy(problem)
    where, key = place(problem, path)
    where[key] += step
    return Mechanism.of(problem)


def numbers(mechanism, state, T, flow=None, rtol=1e-12):
    """The cycle near by: its SI state and period, the values that have derivatives, its modes."""
    core, n = mechanism.scaled, len(mechanism.M)
    z, T = hybrid_truth.close(core, state / mechanism.units, T * mechanism.omega, rtol, flow)
    trip = list(hybrid_truth.phases(core, z, rtol, T))
    ends = hybrid_truth.extremes(mechanism, trip)[:n]
    stick, second, opened = hybrid_truth.shares(core, trip) / T
    period, amplitude = T / mechanism.omega, ends[:, 1] - ends[:, 0]
    values = np.concatenate([[period], amplitude, stick, opened, second])
    return z * mechanism.units, period, values, [p.mode for p in trip]


def differences(problem, cycle, known, path, step):
    """Extrapolated differences from this step on, and their estimated errors; or None."""
    table, ends = [], [(cycle.state, cycle.period)] * 2
    for _ in range(LEVELS):
        try:
            found = [
                numbers(moved(problem, path, side), state, T, cycle.flow)
                for side, (state, T) in zip((step, -step), ends, strict=True)
            ]
        except (ArithmeticError, np.linalg.LinAlgError):
            return None
        if any(f[3] != known[3] for f in found):
            return None
        row = [(found[0][2] - found[1][2]) / (2 * step)]
        for j, above in enumerate(table[-1] if table else []):
            row.append(row[-1] + (row[-1] - above) / (4 ** (j + 1) - 1))
        table.append(row)
        # The states of half the step, but for terms of third order.
        ends = []
        for side in (1, -1):
            odd = [side * (a - b) / 4 for a, b in zip(found[0][:2], found[1][:2], strict=True)]
            even = [
                (a + b - 2 * c) / 8
                for a, b, c in zip(*found[:2], (cycle.state, cycle.period), strict=False)
            ]
            ends.append((cycle.state + odd[0] + even[0], cycle.period + odd[1] + even[1]))
        step /= 2
    error = abs(row[-1] - table[-2][-1]) / 4 + abs(row[-1] - row[-2]) / 4
    return row[-1], SAFETY * (error + NOISE * np.maximum(abs(known[2]), 1e-3) / (2 * step))


def derivative(problem, cycle, known, path, unit=0.0):
    """Derivatives of the values, and their estimated errors; None where no step will do.

    Steps are relative, of `unit` where the quantity is 0.
    """
    where, key = place(problem, path)
    size = abs(where[key]) or unit
    best, error = np.zeros(len(known[2])), np.full(len(known[2]), np.inf)
    step = STEP
    while step > NARROWEST:
        found = differences(problem, cycle, known, path, step * size)
        if found:
            best = np.where(found[1] < error, found[0], best)
            error = np.minimum(found[1], error)
            relative = error * size / np.maximum(abs(known[2]), 1e-3)
            if relative.max() < ENOUGH:
                break
        step /= 4
    return (best, error) if np.isfinite(error).all() else None


def split(values, errors, n, m):
    pairs = [[float(v), float(e)] for v, e in zip(values, errors, strict=True)]
    return {
        "period": pairs[0],
        "amplitude": pairs[1 : n + 1],
        "stick_fraction": pairs[n + 1 : n + m + 1],
        "open_fraction": pairs[n + m + 1 : n + 2 * m + 1],
    }


def make_row(row):
    row = {name: row[name] for name in ("name", "note", "problem")}
    problem = PROBLEMS[row["name"]]
    mechanism = Mechanism.of(problem)
    n, m = len(mechanism.M), len(mechanism.joints)
    cycle = hybrid_truth.cycle(mechanism, problem["start"])
    row["kind"] = cycle.kind
    if cycle.kind != "cycle":
        return row
    known = numbers(mechanism, cycle.state, cycle.period, cycle.flow)
    finer = numbers(mechanism, cycle.state, cycle.period, cycle.flow, 1e-13)[2]
    scale = np.where(abs(known[2]) > 1e-12, abs(known[2]), np.inf)
    row |= {"period": float(cycle.period), "maxima": cycle.maxima}
    row |= {key: np.asarray(getattr(cycle, key)).tolist() for key in LISTS}
    row["multipliers"] = [[float(x.real), float(x.imag)] for x in cycle.multipliers]
    row["itinerary"] = [[list(mode), float(t)] for mode, t in cycle.itinerary]
    row["margins"] = {k: float(v) if np.isfinite(v) else None for k, v in cycle.margins.items()}
    row["value_error"] = float((abs(finer - known[2]) / scale).max())
    row["derivatives"] = {}
    for path in problem["by"]:
        found = derivative(problem, cycle, known, path)
        row["derivatives"][path] = None if found is None else split(*found, n, m)
    return row


def main():
    rows = json.loads(TABLE.read_text("utf-8"))["rows"]
    for i, row in enumerate(rows):
        if row["name"] not in sys.argv[1:] if sys.argv[1:] else "kind" in row:
            continue
        rows[i] = make_row(row)
        lines = ",\n".join(map(json.dumps, rows))
        TABLE.write_text(f'{{"about": {json.dumps(ABOUT)},\n"rows": [\n{lines}\n]}}\n', "utf-8")
        print(row["name"], rows[i]["kind"], rows[i].get("value_error"), flush=True)


if __name__ == "__main__":
    main()
