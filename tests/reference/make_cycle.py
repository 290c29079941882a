"""Tabulate stick-slip limit cycles of the source's form and their derivatives, for the tests.

A row of cycle.json holds the numbers of a mechanism, a start, the kind of motion that it leads to
and, for a cycle, its numbers with derivatives in SI units. To add a mechanism, append a row with
its group and quantities only; rows without a "kind" are computed with `tests/hybrid_truth.py`, and
written as soon as they are. (The rows of the group "random" have K_n in 1.6e8..6e8 N/m, K_t/K_n in
0.3..0.75, V in 0.05..0.3 m/s, mu_s in 0.3..0.55, mu_m/mu_s in 0.5..0.9, v_m in 0.3..0.8 m/s and F
in 1..50 N, each uniform.)

The rows with "difference_step" were made by an older solver, for this form alone: it closed a
return map of (x1, x2, w2) by Broyden's method, and knew no linearised flow. The tests compare both
solvers by them.

    python tests/reference/make_cycle.py
"""

import json
import pathlib
from itertools import pairwise

import make_mechanisms
import numpy as np
from make_mechanisms import Mechanism, hybrid_truth
from numpy.polynomial import chebyshev

from mechanisms import PLAIN, source_form

TABLE = pathlib.Path(__file__).resolve().parent / "cycle.json"
LISTS = ("amplitude", "velocity_min", "velocity_max")
OF = ("period", "amplitude_1", "amplitude_2", "stick_fraction_1", "stick_fraction_2")
VALUES = [0, 1, 2, 3, 5]  # of these in `make_mechanisms.numbers`
ABOUT = (
    "Stick-slip limit cycles by event-driven DOP853, SI units. Rows with difference_step are of an "
    "older solver for this form alone, others by make_cycle.py with hybrid_truth. start and "
    "state are [x1, x2, x1', x2']; itinerary is [sign 1, sign 2, duration] with 0 for stick; "
    "multipliers are [real, imaginary], without the trivial 1; value_error is the relative change "
    "of period, amplitude and stick fraction with a finer step; margins: graze is the smallest "
    "extremum of what ends a phase, shortest the share of the shortest phase in the period, "
    "decision the distance from the friction limit where a slip ended (older rows); repeatable is "
    "false where a finer transient leads elsewhere; not periodic means no period of up to 4 maxima "
    "of x1 within 5000 of them; derivatives are [value, estimated error] by K_n "
    "(K_t held), K_t, mu_s (mu_m held, or moved along where equal) and V, null where no interval "
    "of one itinerary was wide enough; difference_step is the widest relative step used, of "
    "K_n / 8 where K_t is 0."
)


def start_of(row):
    """At rest, a length V/omega beside steady sliding."""
    problem = source_form(**row)
    (joint,) = Mechanism.of(problem).joints
    mu, K_n, K_t = joint.mu(joint.V), joint.K_n, joint.K_t
    K = np.add(problem["K"], [[K_t, -mu * K_n], [mu * K_t, K_n]])
    x_1, x_2 = np.linalg.solve(K, problem["F"])
    return [float(x_1 + joint.V * np.sqrt(row["m"] / K_n)), float(x_2), 0.0, 0.0]


def time_below_zero(trip, row):
    """How long row.[1, z] is negative in a trip."""
    total = 0.0
    for t, end, used, dense in (step for p in trip for step in p.steps):
        c = hybrid_truth.FIT @ (row[0] + row[1:] @ dense(t + (end - t) * hybrid_truth.NODES))
        roots = (1 + chebyshev.chebroots(chebyshev.chebtrim(c, 1e-15 * abs(c).max()))) / 2
        share = (used - t) / (end - t)
        inside = sorted(x.real for x in roots if abs(x.imag) < 1e-9 and 0 < x.real < share)
        for a, b in pairwise([0.0, *inside, share]):
            total += (end - t) * (b - a) * (hybrid_truth.at((a + b) / 2, c) < 0)
    return float(total)


def derivatives(row, cycle, known):
    """By the quantities of the table, of `OF`."""
    problem, found = source_form(**row), {}
    for name in ("K_n", "K_t", "mu_s", "V"):
        place = "mu" if row["mu_m"] == row["mu_s"] else "mu_s"
        path = f"joints.0.friction.{place}" if name == "mu_s" else f"joints.0.{name}"
        pair = make_mechanisms.derivative(problem, cycle, known, path, row["K_n"] / 8)
        columns = np.transpose(pair)[VALUES].tolist() if pair else len(OF) * [None]
        found[name] = dict(zip(OF, columns, strict=True))
    return found


def make_row(group, numbers):
    """One row of the table."""
    mechanism, start = Mechanism.of(source_form(**numbers)), start_of(numbers)
    cycle, again = (
        hybrid_truth.cycle(mechanism, start, coarse=coarse, most=5000, returns=4)
        for coarse in (1e-8, 1e-10)
    )
    row = {"group": group, **numbers, "start": start, "kind": cycle.kind}
    same = cycle.kind == again.kind
    if cycle.kind != "cycle":
        return row | {"repeatable": same}
    same = same and np.allclose(cycle.state / mechanism.units, again.state / mechanism.units, 1e-6)
    known, finer = (
        make_mechanisms.numbers(mechanism, cycle.state, cycle.period, cycle.flow, rtol)
        for rtol in (1e-12, 1e-13)
    )
    core, T = mechanism.scaled, cycle.period * mechanism.omega
    trip = list(hybrid_truth.phases(core, cycle.state / mechanism.units, 1e-12, T))
    others = np.delete(cycle.multipliers, abs(cycle.multipliers - 1).argmin())
    scale = np.where(abs(known[2]) > 1e-12, abs(known[2]), np.inf)
    return {
        **row,
        "repeatable": bool(same),
        "returns": cycle.maxima,
        "period": float(cycle.period),
        **{key: getattr(cycle, key).tolist() for key in LISTS},
        "stick_fraction": [float(cycle.stick_fraction[0]), float(cycle.second_stick_fraction[0])],
        "state": cycle.state.tolist(),
        "tension_fraction": time_below_zero(trip, core.normal(0)) / T,
        "itinerary": [[*mode, float(duration)] for mode, duration in cycle.itinerary],
        "multipliers": [[float(x.real), float(x.imag)] for x in others],
        "margins": {k: float(v) if np.isfinite(v) else None for k, v in cycle.margins.items()},
        "value_error": float((abs(finer[2] - known[2]) / scale).max()),
        "derivatives": derivatives(numbers, cycle, known),
    }


def main():
    rows = json.loads(TABLE.read_text(encoding="utf-8"))["rows"]
    for i, row in enumerate(rows):
        if "kind" not in row:
            rows[i] = make_row(row["group"], {name: row[name] for name in PLAIN})
            lines = ",\n".join(map(json.dumps, rows))
            text = f'{{"about": {json.dumps(ABOUT)},\n"rows": [\n{lines}\n]}}\n'
            TABLE.write_text(text, encoding="utf-8")
            print(i, rows[i]["kind"], flush=True)


if __name__ == "__main__":
    main()
