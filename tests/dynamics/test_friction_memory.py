"""Friction with memory, against SciPy on equations written here once more, and closed forms."""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.integrate import solve_ivp

import fractaljax as fj
from fractaljax._mechanism.quantities import value_of
from tools import both_modes

SLOW = pytest.mark.slow
BRAKE = fj.brake_scene()
MPMATH: Any = mp
LAWS = {
    "lugre": fj.LuGre(0.4, 0.25, 0.1, 1e5, 10.0),
    "lugre, viscous": fj.LuGre(0.4, 0.25, 0.1, 1e5, 10.0, 0.02, exponent=2),
    "dahl": fj.Dahl(0.4, 1e5),
    "rate_and_state": fj.RateAndState(0.6, 0.01, 0.015, 1e-6, 1e-3),
    "jenkins": fj.Jenkins(0.4, 1e6, 1e-7),
    "iwan": fj.Iwan(0.4, 5, 1e6, 1e-7),
}


class Bristles(fj.Friction):
    """Dahl's law as a user writes it, on a state in m."""

    state_size = 1
    mu_s: jax.Array = fj.quantity("-", "friction coefficient")
    sigma: jax.Array = fj.quantity("1/m", "stiffness of the bristles per normal load")

    def mu(self, speed):
        return self.mu_s + 0 * jnp.asarray(speed)

    def rate(self, z, w, N):
        return w - self.sigma * jnp.abs(w) / self.mu_s * z

    def force(self, z, w, N):
        return self.sigma * z * N


def coefficient(law: Any, w):
    """Steady sliding as the papers have it, for w > 0."""
    if isinstance(law, fj.RateAndState):
        return law.mu_0 + (law.a - law.b) * np.log(w / law.v_ref)
    if isinstance(law, fj.LuGre):
        fall = np.exp(-((w / law.v_0) ** law.exponent))
        return law.mu_d + (law.mu_s - law.mu_d) * fall + law.viscous * w
    return law.mu_s + 0 * w


@pytest.mark.parametrize("name", LAWS)
def test_steady_sliding(name):
    """Either way; and whatever the start, the states come to it."""
    law, N = LAWS[name], jnp.array(7.0)
    for w in np.array([1e-3, 0.1, -0.1, 1.0]):
        z = law.steady(jnp.asarray(w), N)
        assert z.shape == (law.state_size,)
        unit = law.D_c if isinstance(law, fj.RateAndState) else 1.0
        np.testing.assert_allclose(law.rate(z, w, N), 0, atol=1e-10 * float(abs(w) / unit))
        expected = float(np.sign(w) * coefficient(law, abs(w)) * N)
        np.testing.assert_allclose(jnp.squeeze(law.force(z, w, N)), expected, rtol=1e-12)
        np.testing.assert_allclose(
            jnp.squeeze(law.mu(abs(w))), coefficient(law, abs(w)), rtol=1e-12
        )
    if isinstance(law, (fj.LuGre, fj.Dahl)):
        by_newton = fj.Friction.steady(law, jnp.array(0.1), N)
        np.testing.assert_allclose(by_newton, law.steady(jnp.array(0.1), N), rtol=1e-12, atol=1e-14)
    scene = fj.Scene(fj.FixedContact(4e8, 2e8), law, BRAKE.oscillator)
    assert fj.Scene.from_toml(scene.to_toml()) == scene
    twice = law.times(2.0)
    np.testing.assert_allclose(twice.mu(0.1), 2 * law.mu(0.1), rtol=1e-14)
    z = twice.steady(jnp.array(0.1), N)
    np.testing.assert_allclose(jnp.squeeze(twice.force(z, 0.1, N)), 2 * N * law.mu(0.1), rtol=1e-12)


def test_rate_and_state_at_rest():
    """The regularised logarithm against 40 digits, its slopes in both modes, also at w = 0."""
    law = LAWS["rate_and_state"]

    def force(x):
        return law.force(x[0], x[1], jnp.ones(()))

    slopes = jax.jit(lambda x: both_modes(force, x))
    for z, w in ((0.0, 0.0), (-30.0, 1e-3), (2.0, 1e-40), (2.0, -1e-3), (40.0, 3.0), (-60.0, 1.0)):
        with mp.workdps(40):
            at = mpf(w) / (2 * mpf(1e-3)) * mp.exp((mpf(0.6) + mpf(0.015) * z) / mpf(0.01))
            value = mpf(0.01) * mp.asinh(at)
            bend = 1 / mp.sqrt(1 + at**2)
            by_z = mpf(0.015) * at * bend
            by_w = mpf(0.01) * bend * mp.exp((mpf(0.6) + mpf(0.015) * z) / mpf(0.01)) / mpf(2e-3)
        found, forward, reverse = slopes(jnp.array([z, w]))
        np.testing.assert_allclose(found, float(value), rtol=1e-13)
        for slope in (forward, reverse):
            np.testing.assert_allclose(slope, [float(by_z), float(by_w)], rtol=1e-12)


@pytest.mark.parametrize("name", ["jenkins", "iwan"])
def test_hysteresis_loop(name):
    """The work of a cycle is 4 mu N (A - mu N/K_t) of each slider that slips."""
    law, N, amplitude, rate = LAWS[name], 20.0, 2e-5, 600.0
    n, period = law.state_size, 2 * np.pi / 600.0

    @jax.jit
    def field(t, y):
        w = amplitude * rate * jnp.cos(rate * t)
        z = y[:n]
        return jnp.append(law.rate(z, w, N), law.force(z, w, N) * w)

    options = {"method": "LSODA", "rtol": 1e-10, "atol": 1e-14, "max_step": period / 200}
    first = solve_ivp(field, (0, period / 4), np.zeros(n + 1), **options)
    loop = solve_ivp(field, (period / 4, 5 * period / 4), first.y[:, -1], **options)
    most = (2 * np.arange(n) + 1) / n**2 * 0.4 * N
    work = sum(4 * most * np.maximum(amplitude - most / (1e6 / n), 0))
    np.testing.assert_allclose(loop.y[-1, -1] - loop.y[-1, 0], work, rtol=1e-6)
    # The quasi-static stiffness of the reversal is K_t while nothing slips.
    z = loop.y[:n, -1]
    change = law.force(z - 1e-7 * np.sign(z), 0.0, N) - law.force(z, 0.0, N)
    np.testing.assert_allclose(change / -1e-7, 1e6, rtol=1e-2)


# --- stability ------------------------------------------------------------------------------------


def lugre_field(y, law, K_n, K_t, P=0.0, o=BRAKE.oscillator):
    """y' of Eq. 39 with bristles on both faces, P on the first: of NumPy or mpmath numbers."""
    number = type(y[0])
    m, w_1, w_2, xi_1, xi_2, F, V = (
        number(float(x)) for x in (o.m, o.omega_1, o.omega_2, o.xi_1, o.xi_2, o.F, o.V)
    )
    s, d, v_0, s_0, s_1 = (
        number(float(x)) for x in (law.mu_s, law.mu_d, law.v_0, law.sigma_0, law.sigma_1)
    )
    K_n, K_t, P = (number(float(x)) for x in (K_n, K_t, P))
    exp = mp.exp if number is mpf else np.exp
    forces, rates = [], []
    for u, z, N in ((y[2], y[4], K_n * y[1] + P), (y[3], y[5], -K_t * y[0])):
        w = V - u
        rate = w - s_0 * abs(w) * z / (d + (s - d) * exp(-abs(w) / v_0))
        forces.append(N * (s_0 * z + s_1 * rate))
        rates.append(rate)
    push = F / number(2) ** number(0.5)
    a_1 = (push + forces[0] - K_t * y[0]) / m - 2 * xi_1 * w_1 * y[2] - w_1**2 * y[0]
    a_2 = (-push + forces[1] - K_n * y[1]) / m - 2 * xi_2 * w_2 * y[3] - w_2**2 * y[1]
    return [y[2], y[3], a_1, a_2, *rates]


@pytest.mark.parametrize("preload", [False, True])
def test_eigenvalues(preload):
    """Those of a Jacobian by differences in 40 digits; of a scene, and of a structure."""
    law, P = fj.LuGre(0.4, 0.25, 0.3, 1e6, 1.0), 1907.3
    scene = fj.Scene(fj.FixedContact(4e8, 1.9e8, P), law, BRAKE.oscillator, preload)
    numbers = law, 4e8, 1.9e8, P if preload else 0.0
    with mp.workdps(40):
        z = mpf(float(law.mu(jnp.array(0.15)))) / mpf(1e6)

        def static(x, y):
            at = [x * mpf("1e-6"), y * mpf("1e-6"), mpf(0), mpf(0), z, z]
            return lugre_field(at, *numbers)[2:4]

        x, y = MPMATH.findroot(static, (mpf(1), mpf(1)))
        at = [x * mpf("1e-6"), y * mpf("1e-6"), mpf(0), mpf(0), z, z]
        h = [mpf("1e-20") * (mpf("1e-6") if i in (0, 1, 4, 5) else 1) for i in range(6)]
        J = mp.matrix(6, 6)
        for j in range(6):
            ends = [[*at[:j], at[j] + sign * h[j], *at[j + 1 :]] for sign in (1, -1)]
            up, down = (lugre_field(end, *numbers) for end in ends)
            for i in range(6):
                J[i, j] = (up[i] - down[i]) / (2 * h[j])
        truth: Any = np.array([complex(s) for s in MPMATH.eig(J, left=False, right=False)])
    x = fj.Structure.from_scene(scene) if preload else scene
    found, expected = fj.stability(x), truth[np.lexsort((-truth.imag, -truth.real))]
    np.testing.assert_allclose(found.eigenvalues, expected, rtol=1e-9)
    assert (abs(found.eigenvalues - expected) <= found.resolutions + 1e-14 * abs(truth)).all()
    ratio = (-expected.real / abs(expected)).min()
    for measure, value in ((fj.growth_rate, expected.real.max()), (fj.margin, ratio))[preload:]:
        np.testing.assert_allclose(measure(x), value, rtol=1e-8)


@SLOW
def test_stiff_bristles_are_dry_friction():
    """The growth rate nears that without memory as 1/sigma_0."""
    dry = float(fj.growth_rate(BRAKE.replace(friction=fj.ExponentialStribeck(0.4, 0.25, 0.3))))
    off = [
        float(fj.growth_rate(BRAKE.replace(friction=fj.LuGre(0.4, 0.25, 0.3, s, 0.0)))) - dry
        for s in (1e7, 1e8)
    ]
    assert 0 < off[0] < 1e-3
    np.testing.assert_allclose(off[0] / off[1], 10, rtol=0.1)


def test_derivatives_of_the_growth_rate():
    """By the law's numbers, D and G in both modes, with K_t beside the bristles; by K_t in series.

    In series, K_t of the contact has no part in steady sliding.
    """
    place = np.array([1e6, 1.0, 0.25, 2.4, np.log(1.342e-10)])

    @jax.jit
    def growth(x):
        law = fj.LuGre(0.4, x[2], 0.3, x[0], x[1])
        return fj.growth_rate(BRAKE.replace(friction=law, D=x[3], G=jnp.exp(x[4])))

    _, forward, reverse = jax.jit(lambda x: both_modes(growth, x))(place)
    steps = np.array([1e4, 1e-2, 1e-4, 1e-5, 1e-4])  # above the rounding of the growth rate
    for i, h in enumerate(steps):
        d = h * np.eye(5)[i]
        ends = [float(growth(place + k * d)) for k in (-2, -1, 1, 2)]
        slope = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * h)
        np.testing.assert_allclose([forward[i], reverse[i]], slope, rtol=1e-5)
    loaded = fj.Scene(BRAKE.contact, fj.Jenkins(0.4), BRAKE.oscillator, preload=True)
    K_n, _ = fj.stiffness(loaded)
    contact = fj.FixedContact(K_n, 0.0, 1907.3)
    free = fj.Scene(contact, fj.Coulomb(0.4), BRAKE.oscillator, preload=True)
    np.testing.assert_allclose(fj.growth_rate(loaded), fj.growth_rate(free), rtol=1e-10)


# --- motion ---------------------------------------------------------------------------------------


def block(law, V: Any = 1.0, **contact) -> fj.Structure:
    """x'' + 0.1 x' + x = the friction of a belt under a load of 1 N."""
    contact = fj.FixedContact(0.0, contact.get("K_t", 0.0), 1.0)
    joint = fj.Joint(contact, law, [1.0], V=V)
    return fj.Structure([[1.0]], [[0.1]], [[1.0]], (joint,))


def block_field(t, y, sigma_0=100.0, sigma_1=1.0):
    x, v, z = y
    w = 1 - v
    rate = w - sigma_0 * abs(w) * z / (0.5 + 0.5 * np.exp(-abs(w) / 0.5))
    return [v, -x - 0.1 * v + sigma_0 * z + sigma_1 * rate, rate]


def scipy_end(field, t1, y, *numbers):
    options = {"rtol": 1e-11, "atol": 1e-13, "args": numbers}
    return solve_ivp(field, (0, t1), y, "Radau", **options).y[:, -1]


@functools.cache
def block_cycle(sigma_0=100.0) -> fj.LimitCycle:
    return fj.limit_cycle(block(fj.LuGre(1.0, 0.5, 0.5, sigma_0, 1.0)), [1.5, 0.0])


def test_motion():
    """By the default and by an explicit solver, from sliding and from given states."""
    law, z = fj.LuGre(1.0, 0.5, 0.5, 100.0, 1.0), (0.5 + 0.5 * np.exp(-2)) / 100
    truth = scipy_end(block_field, 8.0, [1.5, 0.0, z])
    found = fj.simulate(block(law), [1.5, 0.0], 8.0)
    assert found.result == fj.SimulationResult.reached and found.internal is not None
    np.testing.assert_allclose([*found.end, found.internal[-1, 0]], truth, rtol=0, atol=2e-8)
    np.testing.assert_allclose(found.at([8.0])[0], found.end, rtol=0, atol=1e-12)
    start = [1.5, 0.0, 0.0]
    found = fj.simulate(block(law), start, 8.0, saveat=[4.0, 8.0], solver=diffrax.Tsit5())
    truth = scipy_end(block_field, 8.0, start)
    np.testing.assert_allclose(found.end, truth[:2], rtol=0, atol=2e-8)
    with pytest.raises(ValueError, match=r"shape \(2,\), or \(3,\) with the states of the laws"):
        fj.simulate(block(law), [1.5, 0.0, 0.0, 0.0], 8.0)


@SLOW
def test_cycle():
    """SciPy's motion from `state` is back after `period`; extremes are its own."""
    found = block_cycle()
    start = [*map(float, found.state), *np.asarray(found.internal)]
    options = {"rtol": 1e-11, "atol": 1e-13, "dense_output": True}
    motion = solve_ivp(block_field, (0, float(found.period)), start, "Radau", **options)
    np.testing.assert_allclose(motion.y[:, -1], start, rtol=0, atol=1e-8)
    x = motion.sol(np.linspace(0, float(found.period), 40_001))
    np.testing.assert_allclose(found.amplitude, np.ptp(x[0]), rtol=1e-6)
    np.testing.assert_allclose(found.velocity_max, x[1].max(), rtol=1e-5)
    assert found.multipliers.shape == (3,) and abs(found.multipliers[0] - 1) < 1e-4
    assert np.isnan(found.stick_fraction).all() and found.regularisation_error == 0


@SLOW
def test_stiff_bristles_come_to_the_exact_cycle():
    """The period nears that of dry friction, by less than 1/sigma_0 of a unit."""
    exact = fj.limit_cycle(block(fj.ExponentialStribeck(1.0, 0.5, 0.5)), [1.5, 0.0])
    off = [abs(float(block_cycle(s).period / exact.period) - 1) for s in (100.0, 1e3, 1e4)]
    assert off[0] > 2 * off[1] > 8 * off[2] and off[2] < 6e-4
    off = [abs(float(block_cycle(s).amplitude[0] / exact.amplitude[0]) - 1) for s in (1e3, 1e4)]
    assert off[0] > 4 * off[1]


@SLOW
def test_derivatives_of_the_cycle():
    """Period and amplitude by the law's numbers and V, in both modes, against differences."""
    place = np.array([100.0, 1.0, 0.5, 1.0])

    @jax.jit
    def numbers(x):
        mechanism = block(fj.LuGre(1.0, x[2], 0.5, x[0], x[1]), V=x[3])
        found = fj.limit_cycle(mechanism, [1.5, 0.0], solver=diffrax.Tsit5(), throw=False)
        return jnp.stack([found.period, found.amplitude[0]])

    _, forward, reverse = jax.jit(lambda x: both_modes(numbers, x))(place)
    np.testing.assert_allclose(forward, reverse, rtol=1e-6, atol=1e-9)
    for i in range(4):
        d = 1e-3 * place[i] * np.eye(4)[i]
        ends = [np.asarray(numbers(place + k * d)) for k in (-2, -1, 1, 2)]
        slope = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * d[i])
        np.testing.assert_allclose(forward[:, i], slope, rtol=1e-3, atol=1e-7)


@SLOW
def test_cycle_of_the_brake():
    """Two faces with bristles, against SciPy on the same equations."""
    law, P = fj.LuGre(0.4, 0.25, 0.3, 1e5, 3.0), 2e4  # pressed so that the joint stays closed
    scene = fj.Scene(fj.FixedContact(4e8, 2e8, P), law, BRAKE.oscillator, preload="linear")
    found = fj.limit_cycle(scene, max_steps=20_000)
    start = np.array([*found.state, *np.asarray(found.internal)])
    unit = np.array([1e-6, 1e-6, 0.1, 0.1, 1e-7, 1e-7])
    field = lambda t, y: np.array(lugre_field(list(y * unit), law, 4e8, 2e8, P)) / unit  # noqa: E731
    end = scipy_end(field, float(found.period), start / unit)
    np.testing.assert_allclose(end, start / unit, rtol=0, atol=2e-5)


def exact_jenkins(K_t, limit, t1, y):
    """The block of `block` on a belt with V = 1 by events: elastic, or slipping with w > 0."""
    slips = y[2] >= limit / K_t

    def elastic(t, y):
        return [y[1], -y[0] - 0.1 * y[1] + K_t * y[2], 1 - y[1]]

    def slipping(t, y):
        return [y[1], -y[0] - 0.1 * y[1] + limit, 0.0]

    def yields(t, y):
        return y[2] - limit / K_t

    def reverses(t, y):
        return 1 - y[1]

    yields.terminal, yields.direction = True, 1
    reverses.terminal, reverses.direction = True, -1
    t = 0.0
    while t < t1:
        field, event = (slipping, reverses) if slips else (elastic, yields)
        part = solve_ivp(field, (t, t1), y, rtol=1e-11, atol=1e-12, events=event)
        t, y, slips = part.t[-1], part.y[:, -1], slips != (part.status == 1)
    return y


def test_spring_in_series():
    """K_t of the contact carries the block until mu N, and is nowhere else."""
    law, start = fj.Jenkins(0.5, relaxation=1e-5), [-1.0, 0.0, 0.0]
    found = fj.simulate(block(law, K_t=4.0), start, 6.0, solver=diffrax.Kvaerno5(), rtol=1e-8)
    truth = exact_jenkins(4.0, 0.5, 6.0, start)
    np.testing.assert_allclose(found.end, truth[:2], rtol=0, atol=1e-6)


# --- refusals -------------------------------------------------------------------------------------


def test_a_users_law_is_the_shipped_one():
    """And what follows no states says what does."""
    mine = BRAKE.replace(friction=Bristles(jnp.array(0.4), jnp.array(1e6)))
    dahl = BRAKE.replace(friction=fj.Dahl(0.4, 1e6))
    np.testing.assert_allclose(fj.growth_rate(mine), fj.growth_rate(dahl), rtol=1e-9)
    np.testing.assert_allclose(value_of(dahl.replace(sigma_0=2e6), "sigma_0"), 2e6)
    memory = "friction must be without memory here.* limit_cycle alone, got Dahl"
    for call in (
        lambda: fj.basin(dahl, radius=1.0, starts=2, progress=False),
        lambda: fj.continue_cycle(dahl, "V", (0.1, 0.2), "hopf"),
    ):
        with pytest.raises(ValueError, match=memory):
            call()
    first, second = (fj.Joint(fj.FixedContact(1.0, 0.0, 1.0), law, i, V=1.0) for i, law in
                     enumerate((fj.Dahl(0.4, 1e3), fj.Coulomb(0.4))))  # fmt: skip
    mixed = fj.Structure(np.eye(2), 0.1 * np.eye(2), np.eye(2), (first, second))
    for call, message in (
        (
            lambda: fj.simulate(mixed, np.zeros(4), 1.0),
            "friction of joint joint_2 must have memory",
        ),
        (lambda: fj.growth_rate(dahl, friction_slope=False), "friction_slope must be True"),
        (
            lambda: fj.simulate(dahl, np.zeros(4), 1.0, regularisation=0.1),
            "friction with memory takes no regularisation",
        ),
        (lambda: fj.Jenkins(0.4).rate(0.0, 1.0, 1.0), "stiffness must be given"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
