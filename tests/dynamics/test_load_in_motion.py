"""Motions whose normal force follows the load curve of the contact law.

The law of the tests is K_n ~ N^alpha, Hertz's for alpha = 1/3. Its load curve, which an
event-driven integration by SciPy has written down, is N = P (1 + (1 - alpha) e)^(1/(1 - alpha)),
e = K_n u/P.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fractaljax as fj
from fractaljax._dynamics.scaled import hybrid_system
from tools import both_modes

P, K_N, MU = 3000.0, 2.0e8, 0.4
COUPLING = 1.7e7  # of the two directions [N/m]
OSCILLATOR = fj.Oscillator(
    m=1.0, omega_1=5000.0, omega_2=4000.0, xi_1=0.01, xi_2=0.01, F=50.0, V=0.15
)


def power_law(alpha, ratio=0.0):
    """K_n = K_N at the load P, and as N^alpha."""
    loads = np.array([P / 10, 10 * P])
    return fj.MeasuredContact(loads, K_N * (loads / P) ** alpha, P, ratio)


FRICTION = fj.ExponentialStribeck(MU, 0.2, 0.1)


def hertz(**changes):
    scene = fj.Scene(power_law(1 / 3), FRICTION, OSCILLATOR, preload=True)
    return scene.replace(**changes) if changes else scene


def coupled(contact=None, preload=True):
    """As `hertz`, with springs that couple the two directions."""
    o = OSCILLATOR
    K = np.diag([o.m * o.omega_1**2, o.m * o.omega_2**2]) + COUPLING * np.array([[0, 1], [1, 0]])
    C = 2 * o.m * np.diag([o.xi_1 * o.omega_1, o.xi_2 * o.omega_2])
    contact = power_law(1 / 3) if contact is None else contact
    joint = fj.Joint(contact, FRICTION, 0, 1, o.V, preload)
    return fj.Structure(np.eye(2), C, K, {"pad": joint}, F=o.F / np.sqrt(2) * np.array([1, -1]))


def normal_force(u, alpha=1 / 3):
    """N [N] at the approach u [m]."""
    closed = np.maximum(1 + (1 - alpha) * K_N * u / P, 0)
    return P * closed ** (1 / (1 - alpha))


class Truth:
    """`hertz` or `coupled` by SciPy's DOP853 from event to event: K_t = 0, so one face slides."""

    def __init__(self, coupling=0.0):
        o = OSCILLATOR
        self.V = float(o.V)
        self.K = np.diag([o.omega_1**2, o.omega_2**2]) + coupling * np.array([[0, 1], [1, 0]])
        self.C = 2 * np.diag([o.xi_1 * o.omega_1, o.xi_2 * o.omega_2])
        self.F = float(o.F) / np.sqrt(2) * np.array([1, -1])
        self.mu = lambda w: 0.2 + (MU - 0.2) * np.exp(-w / 0.1)
        self.opening = -1.5 * P / K_N

    def rates(self, y, state):
        x, v = y[:2], y[2:]
        force = self.F - self.K @ x - self.C @ v
        N = 0.0 if state == 2 else normal_force(x[1])
        force[1] += P - N
        if abs(state) == 1:
            force[0] += state * self.mu(state * (self.V - v[0])) * N
        if state == 0:
            force[0] = 0.0
        return np.concatenate([v, force])

    def held(self, y):
        """What friction must bear in stick."""
        return self.K[0] @ y[:2] + self.C[0] @ y[2:] - self.F[0]

    def events(self, state):
        """Functions that fall through 0, with the state that follows."""
        lifts = (lambda t, y: y[1] - self.opening), 2
        if state == 2:
            return [((lambda t, y: self.opening - y[1]), None)]
        if state == 0:
            limit = lambda y: MU * normal_force(y[1])  # noqa: E731
            return [
                lifts,
                ((lambda t, y: limit(y) - self.held(y)), 1),
                ((lambda t, y: limit(y) + self.held(y)), -1),
            ]
        return [lifts, ((lambda t, y: state * (self.V - y[2])), 0)]

    def run(self, y, end):
        """States at the ends of the phases, and what begins there."""
        y, t = np.asarray(y, float), 0.0
        state = 2 if y[1] < self.opening else 1 if y[2] < self.V else -1
        log, self.seen = [(t, y, state)], []
        while t < end:
            events = []
            for function, _ in self.events(state):
                function.terminal, function.direction = True, -1.0
                events.append(function)
            found = solve_ivp(
                lambda t, y, state=state: self.rates(y, state), (t, end), y, "DOP853",
                events=events, rtol=1e-12, atol=1e-16, max_step=1e-5, dense_output=True,
            )  # fmt: skip
            self.seen.append(found.sol(np.linspace(found.t[0], found.t[-1], 2000)))
            t, y = found.t[-1], found.y[:, -1].copy()
            hit = next((i for i, at in enumerate(found.t_events) if len(at)), None)
            if hit is None:
                break
            after = self.events(state)[hit][1]
            if after is None:
                after = 1 if y[2] < self.V else -1
            if after == 0:
                y[2] = self.V
                if abs(self.held(y)) > MU * normal_force(y[1]):
                    after = -state
            state = after
            log.append((t, y, state))
        return log, y


STARTS = {
    "slip": ([4e-5, 2e-6, 0.0, 0.0], {1}),
    "stick": ([2e-5, 0.0, 0.3, 0.1], {1, 0, -1}),
    "lift off": ([0.0, -2e-5, 0.0, 0.4], {1, 0, 2}),
}


@functools.cache
def truth(name):
    return Truth().run(STARTS[name][0], 2e-3)


@pytest.mark.parametrize("name", STARTS)
def test_motion(name):
    """Every switch and the end, in slip, stick and flight."""
    start, states = STARTS[name]
    log, end = truth(name)
    found = fj.simulate(hertz(), start, 2e-3)
    switches = found.switches()
    times = [t for t, _, _ in log[1:]]
    faces = [switch for switch in switches if switch[1] == 1]
    assert len(faces) == len(times)
    np.testing.assert_allclose([switch[0] for switch in faces], times, rtol=1e-9)
    assert [switch[3] for switch in faces] == [state for *_, state in log[1:]]
    assert {state for *_, state in log} == states
    scale = np.abs(np.asarray(found.states)).max(axis=0)
    np.testing.assert_allclose(found.end / scale, end / scale, atol=1e-8)


@functools.cache
def cycle():
    return fj.limit_cycle(coupled())


@pytest.mark.slow
def test_cycle():
    """A cycle that sticks and lifts off closes in the other solver, with its forces and shares."""
    found, exact = cycle(), Truth(COUPLING)
    log, end = exact.run(np.asarray(found.state), float(found.period))
    size = np.repeat([float(found.amplitude.max()), float(OSCILLATOR.V)], 2)
    np.testing.assert_allclose(end / size, found.state / size, atol=1e-9)
    times, states = np.array([t for t, *_ in log]), [state for *_, state in log]
    assert {0, 1, 2} <= set(states)
    lengths = np.diff(np.append(times, float(found.period)))
    for share, state in ((found.stick_fraction, 0), (found.open_fraction, 2)):
        wanted = sum(t for t, s in zip(lengths, states, strict=True) if s == state)
        np.testing.assert_allclose(share[0], wanted / found.period, rtol=1e-7)
    motion = np.hstack(exact.seen)
    highest = normal_force(motion[1].max())
    np.testing.assert_allclose(found.normal_force[0], [0, highest], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(found.amplitude, np.ptp(motion[:2], axis=1), rtol=1e-6)


@pytest.mark.slow
def test_cycle_by_quantities():
    """Derivatives of the period by load, friction and V, in both modes, against differences."""
    names = ("P", "mu_s", "V")
    base = coupled()
    values = jnp.array([float(P), MU, OSCILLATOR.V])

    def period(values):
        x = base.replace(**{f"pad.{n}": v for n, v in zip(names, values, strict=True)})
        return fj.limit_cycle(x, cycle().state, segments=512, throw=False).period[None]

    program = jax.jit(lambda values: both_modes(period, values))
    _, forward, reverse = program(values)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    for i, step in enumerate(1e-5 * values):
        ends = [program(values.at[i].add(sign * step))[0][0] for sign in (1, -1)]
        wanted = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(forward[0, i], wanted, rtol=1e-5)


@pytest.mark.slow
def test_end_by_quantities():
    """Derivatives of a motion with lift-off by load and start, in both modes."""
    start = jnp.array(STARTS["lift off"][0])

    def end(values):
        scene = hertz(P=values[0])
        return fj.simulate(scene, start.at[1].set(values[1]), 4e-4).end

    values = jnp.array([float(P), start[1]])
    program = jax.jit(lambda values: both_modes(end, values))
    _, forward, reverse = program(values)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    for i, step in enumerate((0.1, 1e-10)):
        ends = [program(values.at[i].add(sign * step))[0] for sign in (1, -1)]
        wanted = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(forward[:, i], wanted, rtol=1e-4, atol=1e-6 * abs(wanted).max())


@pytest.mark.slow
def test_constant_stiffness_is_the_linear_spring_without_a_curve():
    """alpha = 0: the load curve of a law whose stiffness does not depend on the load."""
    contact = power_law(0.0, ratio=0.3)
    start = [4e-5, -1e-5, 0.0, 0.3]
    ends = [
        fj.simulate(fj.Scene(law, FRICTION, OSCILLATOR, form), start, 1e-3).states[-1]
        for law, form in (
            (contact, True),
            (contact, "linear"),
            (fj.FixedContact(K_N, 0.3 * K_N, P), True),
        )
    ]
    size = np.repeat([1e-5, 0.1], 2)
    for end in ends[1:]:
        np.testing.assert_allclose(ends[0] / size, end / size, atol=1e-9)
    # Linear springs have no table: structure decides it.
    for law, form, tabled in (
        (power_law(1 / 3), True, True),
        (power_law(1 / 3), "linear", False),
        (power_law(1.5), True, False),
        (fj.FixedContact(K_N, 0.0, P), True, False),
    ):
        scene = fj.Scene(law, FRICTION, OSCILLATOR, form)
        assert scene.follows_load_curve == tabled
        system = hybrid_system(scene)
        ones = jnp.ones((4, 3)), jnp.ones((2, 3))
        assert ("gather" in str(jax.make_jaxpr(system.field)(*ones))) == tabled


@pytest.mark.slow
def test_many_scenes_side_by_side():
    """vmap over scenes gives each its own table."""
    loads = jnp.array([2000.0, 3000.0, 4500.0])

    def end(P):
        return fj.simulate(hertz(P=P), STARTS["lift off"][0], 4e-4).end

    one = [end(P) for P in loads]
    size = np.repeat([1e-5, 0.1], 2)
    np.testing.assert_allclose(
        np.asarray(jax.vmap(end)(loads)) / size, np.stack(one) / size, atol=1e-8
    )


@pytest.mark.slow
def test_many_cycles_side_by_side():
    base, loads = coupled(), jnp.array([2900.0, 3000.0])

    def period(P):
        x = base.replace(P=P)
        return fj.limit_cycle(x, cycle().state, segments=512, throw=False).period

    one = [period(P) for P in loads]
    assert np.isfinite(one).all()
    np.testing.assert_allclose(jax.vmap(period)(loads), one, rtol=1e-8)


@pytest.mark.slow
def test_regularised_law_basin_and_branch():
    """tanh(v/eps) in place of the sign: its cycle approaches the exact one."""
    eps = 1e-3 * OSCILLATOR.V
    found = fj.limit_cycle(coupled(), cycle().state, regularisation=eps, throw=False)
    assert found.result in (fj.CycleResult.converged, fj.CycleResult.depends_on_eps)
    np.testing.assert_allclose(found.period, cycle().period, rtol=2e-3)
    np.testing.assert_allclose(found.normal_force, cycle().normal_force, rtol=2e-2, atol=1e-6)
    np.testing.assert_allclose(found.open_fraction, cycle().open_fraction, rtol=2e-2)
    # Both take the curve: the same cycle from all around it, and over the load.
    x = coupled()
    branch = fj.continue_cycle(x, "P", (2980.0, 3020.0), start=cycle())
    inside = np.argmin(abs(branch.parameter - 3000.0))
    x_there = x.replace(P=float(branch.parameter[inside]))
    again = fj.limit_cycle(x_there, cycle().state)
    np.testing.assert_allclose(branch.period[inside], again.period, rtol=1e-6)
    basin = fj.basin(x, starts=4, radius=0.5)
    assert set(basin.outcomes) >= {"cycle 1"}
    assert basin.cycles[0].period == pytest.approx(float(cycle().period), rel=1e-6)
