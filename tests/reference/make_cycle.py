"""Tabulate stick-slip limit cycles and their derivatives, as truth for the tests.

Every row holds one mechanism, a start, the kind of motion that it leads to and, for a cycle, what
there is to measure of it with derivatives, all from `tests/filippov.py`, in SI units. Derivatives
are Richardson extrapolations of central differences over the converged cycle, with an estimate of
their error. Rows are written as they are made, and those already in the file are kept.

    python tests/reference/make_cycle.py [--minutes M] [--out FILE]
"""

import argparse
import json
import math
import pathlib
import random
import sys
import time
from dataclasses import asdict, replace

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import filippov  # noqa: E402
from filippov import PLAIN  # noqa: E402

SEED = 1
RANDOM = 60
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


def scenes():
    """(group, mechanism) of all rows."""
    found = [
        ("paper", replace(PLAIN, K_n=K_n, K_t=K_n / 2)) for K_n in (4e8, 3e8, 5e8, 6e8, 7e8, 9e8)
    ]
    rng = random.Random(SEED)
    for _ in range(RANDOM):
        K_n, kappa, V = rng.uniform(1.6e8, 6e8), rng.uniform(0.3, 0.75), rng.uniform(0.05, 0.3)
        mu_s = rng.uniform(0.3, 0.55)
        mu_m, v_m, F = mu_s * rng.uniform(0.5, 0.9), rng.uniform(0.3, 0.8), rng.uniform(1, 50)
        mechanism = replace(
            PLAIN, K_n=K_n, K_t=kappa * K_n, V=V, mu_s=mu_s, mu_m=mu_m, v_m=v_m, F=F
        )
        found.append(("random", mechanism))
    special = {
        "pure slip": [
            {"K_t": 0.0, "V": 0.27, "v_m": 0.3, "F": -200.0},
            {"K_t": 2e7, "V": 0.27, "v_m": 0.3, "F": -200.0},
            {"K_t": 2e7, "V": 0.27, "v_m": 0.3, "F": -400.0},
            {"K_t": 4e7, "V": 0.28, "v_m": 0.3, "F": -400.0},
            {"K_t": 8e7, "V": 0.28, "v_m": 0.3, "F": -1000.0},
        ],
        "stick in both": [
            (2.604e8, 1.48e8, 0.0929, 0.312, 0.239, 0.38, -2476.0),
            (1.938e8, 1.181e8, 0.059, 0.402, 0.225, 0.624, -2305.0),
            (5.35e8, 2.768e8, 0.0672, 0.321, 0.275, 0.589, -2860.0),
            (4.778e8, 3.461e8, 0.2349, 0.473, 0.24, 0.635, -1876.0),
            (2.686e8, 1.921e8, 0.0863, 0.47, 0.284, 0.546, -321.6),
            (4.912e8, 2.23e8, 0.088, 0.392, 0.346, 0.318, -2010.0),
            (4.512e8, 2.651e8, 0.0626, 0.535, 0.437, 0.666, 16.75),
            (4.931e8, 3.095e8, 0.0503, 0.536, 0.335, 0.727, -29.7),
            (4e8, 2e8, 0.02, 0.4, 0.25, 0.5, -20000.0),
            (4e8, 2e8, 0.005, 0.4, 0.25, 0.5, -20000.0),
        ],
        "stick in 2": [
            (4.034e8, 2.784e8, 0.1177, 0.549, 0.317, 0.593, 5.843),
            (3.625e8, 2.336e8, 0.2529, 0.511, 0.42, 0.783, 2.456),
        ],
        "Coulomb": [
            (4e8, 2e8, 0.15, 0.4, 0.4, 0.5, 5.0),
            (2e8, 0.8e8, 0.1, 0.45, 0.45, 0.5, 1.0),
            (5e8, 2.25e8, 0.15, 0.45, 0.45, 0.5, 20.0),
            (3e8, 1.5e8, 0.15, 0.4, 0.4, 0.5, -2000.0),
            (5e8, 3.5e8, 0.3, 0.3, 0.3, 0.5, 10.0),
            (4e8, 2e8, 0.15, 0.25, 0.25, 0.5, -20.0),
        ],
        "one direction": [
            *({"K_t": 0.0, "F": F} for F in (-20.0, -100.0, -300.0, -1000.0, -5000.0)),
            {"K_t": 0.0, "F": -300.0, "mu_m": 0.4},
            {"K_t": 0.0, "F": -2000.0, "V": 0.05, "mu_s": 0.5, "K_n": 2e8},
        ],
        "other": [
            {"K_t": 8e7, "V": 0.28, "v_m": 0.3, "F": -3000.0},
            {"K_t": 8e7, "V": 0.28, "v_m": 0.3, "F": -5000.0},
            {"K_t": 1.2e8, "V": 0.28, "v_m": 0.3, "F": -3000.0},
            {"K_t": 1e8, "V": 0.25, "v_m": 0.3, "F": -3000.0},
            {"K_t": 1.2e8, "mu_s": 0.3, "mu_m": 0.2},
            {"K_t": 1.2e8, "mu_s": 0.3, "mu_m": 0.2, "V": 0.25},
        ],
    }
    names = ("K_n", "K_t", "V", "mu_s", "mu_m", "v_m", "F")
    for group, changes in special.items():
        for change in changes:
            pairs = change if isinstance(change, dict) else zip(names, change, strict=True)
            found.append((group, replace(PLAIN, **dict(pairs))))
    return found


def numbers(cycle):
    """The values that have derivatives."""
    return np.array([cycle.period, *cycle.amplitude, *cycle.stick_fraction])


def follow(mechanism, cycle, rtol=1e-12):
    """The cycle of a mechanism near by."""
    z = mechanism.scaled(cycle.state)[[0, 1, 3]]
    z = filippov.close(mechanism, z, cycle.turns, rtol, cycle.slopes)
    return filippov.measure(mechanism, z, cycle.turns, rtol)


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
    cycle = filippov.cycle(mechanism, start)
    again = filippov.cycle(mechanism, start, coarse=1e-10)
    same = cycle.kind == again.kind
    row = {"group": group, **asdict(mechanism), "start": start, "kind": cycle.kind}
    if cycle.kind != "cycle":
        return {**row, "repeatable": same}
    finer = numbers(follow(mechanism, cycle, 1e-13))
    value = numbers(cycle)
    scale = np.where(abs(value) > 1e-12, abs(value), np.inf)
    slopes = {name: derivative(mechanism, cycle, name) for name in BY}
    same = same and np.allclose(cycle.state, again.state, rtol=1e-6, atol=1e-9 * mechanism.V)
    return {
        **row,
        "repeatable": bool(same),
        "turns": cycle.turns,
        "period": float(cycle.period),
        **{
            key: getattr(cycle, key).tolist()
            for key in ("amplitude", "velocity_min", "velocity_max", "stick_fraction")
        },
        "tension_fraction": float(cycle.tension_fraction),
        "itinerary": [[*signs, float(duration)] for signs, duration in cycle.itinerary],
        "state": cycle.state.tolist(),
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


def write(path, rows):
    """The table, one row a line."""
    lines = ",\n".join(json.dumps(row) for row in rows)
    text = f'{{"about": {json.dumps(ABOUT)},\n"rows": [\n{lines}\n]}}\n'
    path.write_text(text, encoding="utf-8")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop here, to go on later")
    parser.add_argument("--out", type=pathlib.Path, default=HERE / "cycle.json")
    options = parser.parse_args()
    began = time.monotonic()
    known = (
        json.loads(options.out.read_text(encoding="utf-8"))["rows"] if options.out.exists() else []
    )
    rows, wanted = [], scenes()
    for group, mechanism in wanted:
        inputs = asdict(mechanism)
        row = next((r for r in known if all(r[k] == x for k, x in inputs.items())), None)
        if row is None:
            if time.monotonic() - began > 60 * options.minutes:
                print(f"{len(rows)} of {len(wanted)}")
                return
            t0 = time.monotonic()
            row = make_row(group, mechanism)
            print(len(rows), group, row["kind"], f"{time.monotonic() - t0:.1f} s", flush=True)
        rows.append({**row, "group": group})
        write(options.out, rows)
    print("complete")


if __name__ == "__main__":
    main()
