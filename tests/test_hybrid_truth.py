"""The independent solver of hybrid_truth.py against closed forms and other solvers."""

import json
from math import atan2, cos, hypot, pi, sin, sqrt
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from hybrid_truth import OPEN, Impossible, Mechanism, cycle, monodromy, phases, simulate
from mechanisms import PLAIN, PROBLEMS, source_form

REFERENCE = Path(__file__).parent / "reference"
CYCLES, TABLE = (
    json.loads((REFERENCE / f"{name}.json").read_text("utf-8"))["rows"]
    for name in ("cycle", "mechanisms")
)


def coulomb(mu):
    return ("coulomb", {"mu": mu})


BELT = PROBLEMS["papangelo_2017"]
# Two joints, which stick together for a while, on three degrees of freedom.
PAIR = {
    "M": np.diag([1.0, 0.5, 0.8]),
    "C": 0.02 * np.eye(3),
    "K": [[2.0, -0.5, 0.2], [-0.5, 1.5, -0.3], [0.2, -0.3, 3.0]],
    "F": [0.0, 0.0, 0.0],
    "joints": [
        {
            **{"tangential": [1.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]},
            **{"V": 0.4, "P": 1.0, "K_n": 1.0},
            "friction": ("exponential", {"mu_s": 0.9, "mu_d": 0.4, "v_0": 0.3}),
        },
        {
            **{"tangential": [0.3, 1.0, 0.0], "V": 0.5, "P": 0.8},
            "friction": ("hyperbolic", {"mu_s": 0.8, "delta": 1.5}),
        },
    ],
}


def test_belt_is_that_of_a_plain_integration():
    """From the end of stick, x = mu(0) - 0.1, to the next stick by solve_ivp's own events."""
    found = cycle(Mechanism.of(BELT), [1.5, 0.0])

    def rates(_t, y):
        return [y[1], 0.5 + 0.5 * np.exp(-(1 - y[1]) / 0.5) - 0.1 * y[1] - y[0]]

    def top(_t, y):
        return y[1]

    def stuck(t, y):
        return 1 - y[1] if t > 1 else 1.0

    stuck.terminal = True
    watch = [top, stuck]
    far = solve_ivp(rates, (0, 10), [0.9, 1.0], "DOP853", events=watch, rtol=1e-13, atol=1e-14)
    (t,), (y,) = far.t_events[1], far.y_events[1]
    assert found.period == pytest.approx(t + 0.9 - y[0], abs=1e-10)
    extremes = sorted(y[0] for y in far.y_events[0])
    assert found.state[0] == pytest.approx(extremes[-1], abs=1e-10)
    assert found.amplitude[0] == pytest.approx(extremes[-1] - extremes[0], abs=1e-10)
    # And numbers that are known.
    assert found.period == pytest.approx(6.431382798208, abs=2e-12)
    assert found.stick_fraction[0] == pytest.approx(0.156589870473, abs=2e-12)
    high, low = found.state[0], found.state[0] - found.amplitude[0]
    # The known extremes are of samples, a little inside the true ones.
    assert 0 <= high - 1.788130629711 < 5e-9
    assert 0 <= -0.577428348365 - low < 5e-9


def agrees(row, start):
    """The motion from a start is that of a row of cycle.json, which another solver has made."""
    numbers = {name: row[name] for name in PLAIN}
    mechanism = Mechanism.of(source_form(**numbers))
    found = cycle(mechanism, row[start], most=5000, returns=4)
    assert found.kind == row["kind"]
    if row["kind"] != "cycle":
        return
    assert found.maxima == row["returns"]
    assert found.period == pytest.approx(row["period"], rel=1e-12)
    lengths, speeds = np.split(mechanism.units, 2)
    scales = {"amplitude": lengths, "velocity_min": speeds, "velocity_max": speeds}
    for name, unit in (scales | {"state": mechanism.units}).items():
        np.testing.assert_allclose(getattr(found, name) / unit, row[name] / unit, 1e-11, 1e-12)
    sticks = [found.stick_fraction[0], found.second_stick_fraction[0]]
    np.testing.assert_allclose(sticks, row["stick_fraction"], rtol=0, atol=1e-12)
    known = [abs(complex(*pair)) for pair in row["multipliers"]]
    others = np.delete(found.multipliers, abs(found.multipliers - 1).argmin())
    np.testing.assert_allclose(np.sort(abs(others)), np.sort(known), rtol=0, atol=3e-6)


# One of each group; a later one of the random group has two maxima of x1 in a period.
@pytest.mark.parametrize("row", [3, 25, 66, 72, 81, 83, 91])
def test_older_cycle(row):
    agrees(CYCLES[row], "state")


@pytest.mark.slow
@pytest.mark.parametrize("row", [0, 19, 75, 86])
def test_older_motion(row):
    """From the start: with the transient, also where it leads to no cycle."""
    agrees(CYCLES[row], "start")


@pytest.mark.slow
def test_older_cycles():
    for row in CYCLES[::6]:
        if row["kind"] == "cycle":
            agrees(row, "state")


def test_bouncing_on_a_spring():
    """A mass k0 = 1 thrown against a spring: two circular motions in turn, in closed form."""
    K_n, P, x0 = 3.0, 0.5, 2.0
    joint = {
        "tangential": [1.0, 0.0], "normal": [0.0, 1.0], "V": 1.0,
        "P": P, "K_n": K_n, "friction": coulomb(0.0),
    }  # fmt: skip
    problem = {
        "M": np.eye(2), "C": np.zeros((2, 2)), "K": np.eye(2), "F": [0, 0], "joints": [joint]
    }  # fmt: skip
    trip = simulate(Mechanism.of(problem), [0.0, -x0, 0.0, 0.0], 40.0)
    # Open: x'' + x = P about P. Closed: x'' + (1 + K_n) x = 0. They meet at x = -P/K_n.
    gap, omega = -P / K_n, sqrt(1 + K_n)
    radius = x0 + P
    angle = np.arccos((P - gap) / radius)
    speed = radius * sin(angle)
    inner = hypot(gap, speed / omega)
    closed = 2 * atan2(speed / omega, gap)
    closed = (2 * pi - closed if closed < 0 else closed) / omega
    period, t = 2 * angle + closed, angle
    switches = [p.t1 for p in trip if p.event and p.event[0] in ("open", "close")]
    expected = []
    while t < 40.0:
        expected += [t, t + closed]
        t += period
    np.testing.assert_allclose(switches, [t for t in expected if t < 40], atol=1e-10)
    assert max(p.dense(np.linspace(p.t0, p.t1, 400))[1].max() for p in trip) == pytest.approx(
        inner, rel=1e-4
    )
    last = trip[-1]
    phase = (40.0 - (expected[-2] - angle)) % period
    assert last.mode == (OPEN,) if phase < angle or phase > angle + closed else (1,)
    if last.mode == (OPEN,):
        since = phase if phase < angle else phase - period
        assert last.end[1] == pytest.approx(P - radius * cos(since), abs=1e-9)


def balance(mechanism, trip):
    """Rise of energy, less the work of dampers, presses and friction, over a trip in SI units."""
    M, C, K, F = mechanism.M, mechanism.C, mechanism.K, mechanism.F
    n = len(M)

    def energy(z):
        x, v = z[:n], z[n:]
        stored = v @ M @ v / 2 + x @ K @ x / 2 - F @ x
        for j in mechanism.joints:
            press, stretch = (0 if j.n is None else j.n @ x), j.t @ x
            if j.lifts:  # the force P - N along n has this potential; K_t acts in closed joints
                assert j.K_t == 0 or j.P + j.K_n * press > 0
                stored += max(0, j.P + j.K_n * press) ** 2 / (2 * j.K_n) - j.P * press
            else:
                stored += j.K_n * press**2 / 2
            stored += j.K_t * stretch**2 / 2
        return stored

    core, work = mechanism.scaled, 0.0
    s, V = mechanism.omega, mechanism.units[-1]
    for p in trip:
        field = core.field(p.mode)

        def power(t, p=p, field=field):
            z = p.dense(t)
            x, v = z[:n], z[n:]
            forces = field.forces(z / mechanism.units, t)
            total = field.multipliers @ forces if field.stuck else []
            out = -v @ C @ v
            for i, (f, sign) in enumerate(zip(mechanism.faces, p.mode, strict=True)):
                if abs(sign) == 1:
                    push = sign * f.mu(sign * (f.V - f.d @ v)) * (f.load + f.slope @ x)
                elif sign == 0:
                    push = total[field.stuck.index(i)] * V * s
                else:
                    continue
                out += push * (f.d @ v)
            return out

        work += quad(power, p.t0, p.t1, epsabs=1e-13, epsrel=1e-12, limit=200)[0]
    return energy(trip[-1].end) - energy(trip[0].start) - work


def test_energy_and_joints_that_stick_together():
    mechanism = Mechanism.of(PAIR)
    trip = simulate(mechanism, [0.5, 0.0, -1.8, 0.0, 0.38, 0.0], 20.0)
    assert {OPEN} & {p.mode[0] for p in trip}
    assert balance(mechanism, trip) == pytest.approx(0, abs=1e-10)
    trip = simulate(mechanism, [0.0, 0.0, 0.0, 0.4, 0.38, 0.0], 30.0)
    both = [p for p in trip if p.mode == (0, 0)]
    assert both
    for p in both:
        v = p.dense(np.linspace(p.t0, p.t1, 9))[3:]
        np.testing.assert_allclose(v[0], 0.4, atol=1e-12)
        np.testing.assert_allclose(0.3 * v[0] + v[1], 0.5, atol=1e-12)


@pytest.mark.parametrize("name", ["second_face", "source_second_face", "stick_together"])
def test_friction_feeds_what_the_dampers_take_in_a_period(name):
    row = next(row for row in TABLE if row["name"] == name)
    mechanism = Mechanism.of(PROBLEMS[name])
    trip = simulate(mechanism, row["state"], row["period"])
    assert balance(mechanism, trip) == pytest.approx(0, abs=1e-10)


def test_table_agrees_with_the_older_one():
    old, new = CYCLES[0], next(row for row in TABLE if row["name"] == "source_form")
    assert new["period"] == pytest.approx(old["period"], rel=1e-12)
    np.testing.assert_allclose(new["amplitude"], old["amplitude"], rtol=1e-11)
    for path in ("K_n", "K_t", "V"):
        known, found = old["derivatives"][path], new["derivatives"][f"joints.0.{path}"]
        value, error = found["period"]
        assert value == pytest.approx(known["period"][0], abs=error)
        for i, (value, error) in enumerate(found["amplitude"], 1):
            assert value == pytest.approx(known[f"amplitude_{i}"][0], abs=error)
        value, error = found["stick_fraction"][0]
        assert value == pytest.approx(known["stick_fraction_1"][0], abs=error)
    assert {row["kind"] for row in TABLE} == {"cycle"}
    assert source_form(**PLAIN).items() <= PROBLEMS["source_form"].items()


@pytest.mark.slow
def test_monodromy_is_the_difference_of_the_flow():
    mechanism = Mechanism.of(PAIR).scaled
    z, h = np.array([0.5, 0.0, -1.8, 0.0, 0.38, 0.0]) / Mechanism.of(PAIR).units, 1e-5

    def end(z):
        return list(phases(mechanism, z, 1e-13, 12.0))

    found = monodromy(mechanism, end(z))
    ends = [(end(z + d)[-1].end - end(z - d)[-1].end) / (2 * h) for d in h * np.eye(6)]
    np.testing.assert_allclose(found, np.array(ends).T, atol=1e-7 * abs(found).max())


def test_sticking_faces_of_one_direction_are_impossible():
    twice = {**BELT, "joints": BELT["joints"] * 2}
    with pytest.raises(Impossible):
        simulate(Mechanism.of(twice), [0.0, 1.0], 1.0)


@pytest.mark.parametrize("row", TABLE, ids=[row["name"] for row in TABLE])
def test_tabled_cycle_closes(row):
    """The tabled state comes back after the tabled period, through the tabled modes."""
    mechanism = Mechanism.of(PROBLEMS[row["name"]])
    state, T, durations = np.array(row["state"]), row["period"], {}
    trip = simulate(mechanism, state, T)
    np.testing.assert_allclose(
        trip[-1].end / mechanism.units, state / mechanism.units, rtol=1e-9, atol=1e-9
    )
    for mode, duration in [(p.mode, p.t1 - p.t0) for p in trip]:
        durations[mode] = durations.get(mode, 0.0) + duration
    for mode, duration in row["itinerary"]:
        durations[tuple(mode)] -= duration
    assert max(map(abs, durations.values())) < 1e-9 * T
