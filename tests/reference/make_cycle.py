"""Tabulate stick-slip limit cycles and their derivatives, as truth for the tests.

A row of cycle.json holds a mechanism, a start, the kind of motion that it leads to and, for a
cycle, its numbers with derivatives, all by `tests/filippov.py` in SI units. Derivatives are
Richardson extrapolations of central differences over the converged cycle, with an estimate of
their error. To add a mechanism, append a row with its group and quantities only; rows without a
"kind" are computed, and written as soon as they are. (The rows of the group "random" have K_n in
1.6e8..6e8 N/m, K_t/K_n in 0.3..0.75, V in 0.05..0.3 m/s, mu_s in 0.3..0.55, mu_m/mu_s in 0.5..0.9,
v_m in 0.3..0.8 m/s and F in 1..50 N, each uniform.)

    python tests/reference/make_cycle.py [--anew]
"""

import argparse
import json
import math
import pathlib
import sys
from dataclasses import asdict, fields, replace

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import filippov  # noqa: E402
from filippov import Mechanism  # noqa: E402

TABLE = HERE / "cycle.json"
STEP = 8e-3  # relative; the widest of the differences
LEVELS = 6  # each half as wide as the one before
NARROWEST = 1e-7
NOISE = 4e-15  # relative rounding of a value
SAFETY = 10.0  # the smallest of the estimates is a lucky one
BY = ("K_n", "K_t", "mu_s", "V")
OF = ("period", "amplitude_1", "amplitude_2", "stick_fraction_1", "stick_fraction_2")
ABOUT = (
    "Stick-slip limit cycles by event-driven DOP853, SI units; made by make_cycle.py. start and "
    "state are [x1, x2, x1', x2']; itinerary is [sign 1, sign 2, duration] with 0 for stick; "
    "multipliers are [real, imaginary]; value_error is the relative change of period, amplitude "
    "and stick fraction with a finer step; margins as in filippov.measure; repeatable is false "
    "where a finer transient leads elsewhere; not periodic means no period of up to 4 maxima of x1 "
    "within 5000 of them; derivatives are [value, estimated error] by K_n "
    "(K_t held), K_t, mu_s (mu_m held, or moved along where equal) and V, null where no interval "
    "of one itinerary was wide enough; difference_step is the widest relative step used, of "
    "K_n / 8 where K_t is 0."
)


def numbers(cycle):
    """The values that have derivatives."""
    return np.array([cycle.period, *cycle.amplitude, *cycle.stick_fraction])


def follow(mechanism, cycle, rtol=1e-12):
    """The cycle of a mechanism near by."""
    z = mechanism.scaled(cycle.state)[[0, 1, 3]]
    z = filippov.close(mechanism, z, cycle.returns, rtol, cycle.slopes)
    return filippov.measure(mechanism, z, cycle.returns, rtol)


def difference(mechanism, cycle, name, h):
    """Central difference over 2 h, or None where the itinerary is another on either side."""
    ends = []
    for side in (h, -h):
        moved = replace(mechanism, **{name: getattr(mechanism, name) + side})
        if name == "mu_s" and mechanism.mu_m == mechanism.mu_s:
            moved = replace(moved, mu_m=moved.mu_s)  # Coulomb friction it stays
        try:
            end = follow(moved, cycle)
        except (ArithmeticError, np.linalg.LinAlgError):
            return None
        if [v[0] for v in end.itinerary] != [v[0] for v in cycle.itinerary]:
            return None
        ends.append(numbers(end))
    return (ends[0] - ends[1]) / (2 * h)


def derivative(mechanism, cycle, name):
    """Derivatives of `numbers`, their estimated errors, and the widest relative step."""
    unit = getattr(mechanism, name) or mechanism.K_n / 8
    step, widest, tables = STEP, None, []
    best, error = np.full(len(OF), np.nan), np.full(len(OF), np.inf)
    while len(tables) < LEVELS and step > NARROWEST:
        row = difference(mechanism, cycle, name, step * unit)
        if row is None:
            tables, widest, error[:] = [], None, np.inf
            step /= 4
            continue
        table, widest = [row], widest or step
        for j, above in enumerate(tables[-1] if tables else []):
            table.append(table[-1] + (table[-1] - above) / (4 ** (j + 1) - 1))
            guess = np.maximum(abs(table[-1] - table[-2]), abs(table[-1] - above))
            guess += NOISE * abs(numbers(cycle)) / (step * unit)
            best = np.where(guess < error, table[-1], best)
            error = np.minimum(guess, error)
        tables.append(table)
        step /= 2
    return best, SAFETY * error, widest


def make_row(group, mechanism):
    """One row of the table."""
    start = mechanism.si(mechanism.equilibrium + np.eye(4)[0])
    start[2:] = 0
    start = [float(x) for x in start]
    cycle, again = (filippov.cycle(mechanism, start, coarse=c) for c in (1e-8, 1e-10))
    same = cycle.kind == again.kind
    row = {"group": group, **asdict(mechanism), "start": start, "kind": cycle.kind}
    if cycle.kind != "cycle":
        return {**row, "repeatable": same}
    finer, value = numbers(follow(mechanism, cycle, 1e-13)), numbers(cycle)
    scale = np.where(abs(value) > 1e-12, abs(value), np.inf)
    slopes = {name: derivative(mechanism, cycle, name) for name in BY}
    same = same and np.allclose(cycle.state, again.state, rtol=1e-6, atol=1e-9 * mechanism.V)
    lists = ("amplitude", "velocity_min", "velocity_max", "stick_fraction", "state")
    return {
        **row,
        "repeatable": bool(same),
        "returns": cycle.returns,
        "period": float(cycle.period),
        **{key: getattr(cycle, key).tolist() for key in lists},
        "tension_fraction": float(cycle.tension_fraction),
        "itinerary": [[*signs, float(duration)] for signs, duration in cycle.itinerary],
        "multipliers": [[float(x.real), float(x.imag)] for x in cycle.multipliers],
        "margins": {
            name: float(x) if math.isfinite(x) else None for name, x in cycle.margins.items()
        },
        "value_error": float((abs(finer - value) / scale).max()),
        "derivatives": {
            name: {
                key: [float(x), float(e)] if math.isfinite(e) else None
                for key, x, e in zip(OF, best, error, strict=True)
            }
            for name, (best, error, _) in slopes.items()
        },
        "difference_step": {name: widest for name, (_, _, widest) in slopes.items()},
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--anew", action="store_true", help="compute all rows")
    anew = parser.parse_args().anew
    rows = json.loads(TABLE.read_text(encoding="utf-8"))["rows"]
    names = [field.name for field in fields(Mechanism)]
    for i, row in enumerate(rows):
        if anew or "kind" not in row:
            rows[i] = make_row(row["group"], Mechanism(*(row[name] for name in names)))
            lines = ",\n".join(map(json.dumps, rows))
            text = f'{{"about": {json.dumps(ABOUT)},\n"rows": [\n{lines}\n]}}\n'
            TABLE.write_text(text, encoding="utf-8")
            print(i, rows[i]["kind"], flush=True)


if __name__ == "__main__":
    main()
