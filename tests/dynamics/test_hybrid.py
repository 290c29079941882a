"""The scaled Filippov system against Eq. 39 as printed, in SI units and with a sign at a time."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._dynamics import step_length as step_lengths, transition
from fractaljax._dynamics.guard import NONE, SECTION
from fractaljax._dynamics.hybrid import HybridSystem
from fractaljax._dynamics.scaled import check_rtol, hybrid_system, start_state
from tools import both_modes, primitives, reference_scene

STATES = list(itertools.product((1, 0, -1), repeat=2))
SEEDS = range(8)
NAMES = ("m", "omega_1", "omega_2", "xi_1", "xi_2", "F", "V", "K_n", "K_t", "mu_s", "mu_m", "v_m")

field = jax.jit(HybridSystem.field)
guards = jax.jit(HybridSystem.guards)
switch = jax.jit(transition.switch)
first_state = jax.jit(transition.first_contact_state)
step_length = jax.jit(step_lengths.step_length)
closures = jax.jit(HybridSystem.closures)
equilibrium = jax.jit(HybridSystem.equilibrium)
scaled = jax.jit(hybrid_system)
equal = np.testing.assert_array_equal


def close(found, truth, atol):
    np.testing.assert_allclose(found, truth, rtol=0, atol=atol)


# --- the model, in SI units ---------------------------------------------------------------


@functools.cache
def numbers(seed):
    """A random mechanism: the reference's, every number times up to two; the first has K_t = 0."""
    rng = np.random.default_rng(seed)
    usual = (1.0, 6283.2, 5026.5, 0.02, 0.05, 3000.0, 0.15, 4e8, 2e8, 0.4, 0.25, 0.5)
    x = dict(zip(NAMES, np.array(usual) * rng.uniform(0.5, 2, len(usual)), strict=True))
    x["mu_m"] = x["mu_s"] * rng.uniform(0.3, 0.95)
    x["F"] *= rng.choice([-1, 1])
    x["K_t"] *= seed > 0
    return {name: float(value) for name, value in x.items()}


def scene_of(x) -> fj.Scene:
    return fj.Scene(
        fj.FixedContact(x["K_n"], x["K_t"]),
        fj.Stribeck(x["mu_s"], x["mu_m"], x["v_m"]),
        fj.Oscillator(**{name: x[name] for name in NAMES[:7]}),
    )


def acceleration(x, state, signs):
    """Eq. 39 solved for x1'', x2'', with sgn v_i = signs[i]; state [x1, x2, x1', x2'] (4, ...)."""
    x_1, x_2, v_1, v_2 = state
    drop, f = x["mu_s"] - x["mu_m"], x["F"] / np.sqrt(2)

    def mu(v, sign):
        return x["mu_s"] * sign - 3 * drop / (2 * x["v_m"]) * v + drop / (2 * x["v_m"] ** 3) * v**3

    K_1, K_2 = x["m"] * x["omega_1"] ** 2, x["m"] * x["omega_2"] ** 2
    C_1, C_2 = 2 * x["xi_1"] * x["omega_1"] * x["m"], 2 * x["xi_2"] * x["omega_2"] * x["m"]
    force_1 = f + mu(x["V"] - v_1, signs[0]) * x["K_n"] * x_2 - C_1 * v_1 - (K_1 + x["K_t"]) * x_1
    force_2 = -f - mu(x["V"] - v_2, signs[1]) * x["K_t"] * x_1 - C_2 * v_2 - (K_2 + x["K_n"]) * x_2
    return np.array([force_1, force_2]) / x["m"]


def scale(x):
    """(omega, factors from a scaled state to SI)."""
    omega = np.sqrt(x["omega_1"] ** 2 + x["omega_2"] ** 2 + (x["K_n"] + x["K_t"]) / x["m"])
    return omega, x["V"] * np.array([1 / omega, 1 / omega, 1, 1])[:, None]


def sides(x, y):
    """Scaled du_i/dt on the forward and on the backward side of u_i = 1, (2, n) each."""
    omega, factors = scale(x)
    return [acceleration(x, y * factors, (s, s)) / (omega * x["V"]) for s in (1, -1)]


def states(s, seed=0):
    """200 random scaled states (4, n) and the contact state s (2, n), which they obey."""
    y = np.random.default_rng(seed + 100).normal(size=(4, 200))
    s = np.repeat(np.array(s, float)[:, None], 200, axis=1)
    y[2:] = np.where(s == 0, 1, 1 - s * abs(y[2:]))
    return y, s


# --- field --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "x", [*map(numbers, SEEDS), numbers(1) | {"K_n": 0.0, "K_t": 0.0}], ids=lambda _: "x"
)
def test_field(x):
    """Eq. 39 in all nine contact states; what sticks moves with the belt, unaccelerated."""
    system, (omega, factors) = scaled(scene_of(x)), scale(x)
    np.testing.assert_allclose(system.omega, omega, rtol=1e-14)
    np.testing.assert_allclose(system.units, factors[:, 0], rtol=1e-14)
    for s in STATES:
        y, contact = states(s)
        slips = np.array(s)[:, None] != 0
        rate = np.vstack([y[2:] * x["V"], np.where(slips, acceleration(x, y * factors, s), 0)])
        truth = rate / factors / omega
        found = field(system, y, contact)
        close(found, truth, 1e-13 * abs(truth).max())
        equal(found[:2], y[2:])
        equal(found[2:][np.array(s) == 0], 0)


def test_equilibrium_and_coulomb():
    """Steady sliding at V > 0 is where the field vanishes, and Eq. 40's."""
    for seed, V in itertools.product(SEEDS, (0.05, 0.15, 1.3)):
        x = numbers(seed) | {"V": V}
        scene, (_, factors) = scene_of(x), scale(x)
        y = np.asarray(equilibrium(scaled(scene)))[:, None]
        equal(y[2:], 0)
        here = field(scaled(scene), np.tile(y, 200), np.ones((2, 200)))
        close(here, 0, 1e-15 * float(abs(y).max() + 1))
        force = acceleration(x, y * factors, (1, 1))[:, 0] * x["m"]
        close(force, 0, 1e-11 * abs(x["F"]))
    # Constant friction: no cubic is traced, the field is affine, and friction has no slope.
    stribeck = reference_scene()
    coulomb = stribeck.replace(friction=fj.Coulomb(0.4))
    y, s = states((1, 1))

    def program(scene):
        system = hybrid_system(scene)
        return primitives(jax.make_jaxpr(lambda y: system.field(y, s))(y).jaxpr)

    assert program(coulomb).total() < program(stribeck).total()
    assert "pow" not in str(program(coulomb)) and "pow" in str(program(stribeck))
    system, flat = scaled(coulomb), scaled(stribeck.replace(mu_m=0.4))
    ends, middle = np.asarray(field(system, y, s)), (y + y[:, ::-1]) / 2
    close(field(system, middle, s), (ends + ends[:, ::-1]) / 2, 1e-14)
    close(ends, field(flat, y, s), 1e-15)
    equal(step_length(system, y, s, field(system, y, s), *np.full((2, 200), 0.3)), 0.3)


def test_steps_are_bounded_by_the_slope_of_friction():
    """The larger slope of what friction does to u_i by u_i, in units of omega."""
    for seed in SEEDS:
        x, (omega, factors) = numbers(seed), scale(numbers(seed))
        y, _ = states((1, -1), seed)
        y[2:] *= 3  # also beyond v_m, where friction rises
        slopes = []
        for i in (0, 1):
            step = 1e-6 * np.eye(4)[2 + i][:, None]
            ends = [
                acceleration(x | {"xi_1": 0.0, "xi_2": 0.0}, moved * factors, (1, -1))[i]
                for moved in (y + step, y - step)
            ]
            slopes.append((ends[0] - ends[1]) / 2e-6 / (omega * x["V"]))
        system, s, longest = scaled(scene_of(x)), np.array([[1.0], [-1.0]]), np.full(200, 1e-3)
        s = np.broadcast_to(s, (2, 200))
        # In so short a step only the slope here counts.
        step = step_length(system, y, s, field(system, y, s), longest, 1e-6 * longest)
        assert (step < longest).all()
        found = np.maximum(5e-10 / np.asarray(step) - 5e-7, 0)
        np.testing.assert_allclose(found, abs(np.array(slopes)).max(axis=0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("v_0", [1.0, 1e-1, 1e-3, 1e-5])
def test_no_step_reaches_a_slope_too_steep_for_it(v_0):
    """Whatever w a face has and however that changes: friction that falls within v_0 of V."""
    V, h = 0.15, 0.3
    scene = reference_scene().replace(friction=fj.ExponentialStribeck(0.4, 0.25, v_0 * V))
    system = scaled(scene)
    rng = np.random.default_rng(5)
    y, s = states((1, 1))
    y[2] = 1 - np.geomspace(1e-3 * v_0, 3, 200)
    rate = np.concatenate([y[2:], rng.normal(size=(2, 200)) * 10 ** rng.uniform(-6, 1, (2, 200))])
    step = np.asarray(step_length(system, y, s, rate, *np.full((2, 200), h)))
    assert (step > 0).all() and (step <= h).all()
    loads = abs(np.asarray(jax.jit(HybridSystem.loads)(system, y[:2])))
    for face in (0, 1):
        w = abs(1 - y[2 + face])
        inside = w - np.linspace(-1, 1, 501)[:, None] * abs(rate[2 + face]) * step
        slope = 0.15 / v_0 * np.exp(-np.maximum(inside, 0) / v_0) * loads[face]
        assert (2 * step * slope.max(axis=0) <= h * (1 + 1e-9)).all()
    # None is shorter than the steepest slope of all asks for.
    assert (step >= 0.99 * np.minimum(h, h / (2 * 0.15 / v_0 * loads.max(axis=0)))).all()


def test_laws_go_on_below_zero_and_are_bounded():
    """Each by its own formula just below w = 0, and between 0 and 2 mu_s however far below."""

    class Root(fj.Friction):  # without a value below -1e-3 m/s
        mu_s: jax.Array = fj.quantity("-", "static friction coefficient")

        def mu(self, speed):
            return self.mu_s * (1.5 - jnp.sqrt(speed + 1e-3) / jnp.sqrt(1e-3) / 2)

    class Cubed(fj.Friction):  # flat at 0, without a bound below
        mu_s: jax.Array = fj.quantity("-", "static friction coefficient")

        def mu(self, speed):
            return self.mu_s * jnp.exp(-((speed / 1e-3) ** 3))

    laws = [
        fj.ExponentialStribeck(0.4, 0.2, 1e-6),
        fj.ExponentialStribeck(0.4, 0.2, 1e-2, 0.3),
        fj.HyperbolicStribeck(0.4, 1e4),
        fj.Stribeck(0.4, 0.1, 1e-3),
        Root(jnp.asarray(0.4)),
        Cubed(jnp.asarray(0.4)),
    ]
    signs = jnp.ones((2, 1))
    for law in laws:
        system = hybrid_system(reference_scene().replace(friction=law))
        assert system.scales is not None and float(system.scales.below[0]) > 0
        far = [
            float(system.friction(jnp.full((2, 1), w), signs, signs)[0, 0])
            for w in (-1e-12, -1e-3, -1.0, -1e3)
        ]
        assert min(far) >= 0 and max(far) <= 0.8 * (1 + 1e-12), law
        assert far[2] == far[3]
        # As smooth as the law.
        steps = 1e-3 * float(system.scales.below[0]) * jnp.arange(-2, 3)
        values = [float(system.friction(jnp.full((2, 1), w), signs, signs)[0, 0]) for w in steps]
        known = law.mu(float(system.speed) * steps)
        np.testing.assert_allclose(values, known, rtol=1e-12)


def test_derivatives():
    """By every quantity of the scene, forward and reverse: those of Eq. 39, scaled by hand."""
    y, contact = (x[:, :1] for x in states((1, -1)))

    def truth(values):
        x = dict(zip(NAMES, values, strict=True))
        omega, factors = scale(x)
        return acceleration(x, y * factors, (1, -1))[:, 0] / (omega * x["V"])

    def found(values):
        scene = scene_of(dict(zip(NAMES, values, strict=True)))
        return hybrid_system(scene).field(y, contact)[2:, 0]

    values = np.array([numbers(7)[name] for name in NAMES])
    steps = [(truth(values + d) - truth(values - d)) / 2e-5 for d in np.diag(1e-5 * values)]
    _, *slopes = jax.jit(lambda x: both_modes(found, x))(jnp.asarray(values))
    for slope in slopes:
        close(np.asarray(slope) * values, np.array(steps).T, 1e-9)


# --- guards -------------------------------------------------------------------------------


@pytest.mark.parametrize("s", STATES)
def test_guards(s):
    """In slip the velocity's own sign; in stick both sides push back; the section is u1."""
    x = numbers(4)
    system, (y, contact) = scaled(scene_of(x)), states(s)
    found = np.asarray(guards(system, y, contact))
    forward, backward = sides(x, np.vstack([y[:2], np.ones((2, 200))]))
    for i in (0, 1):
        if s[i]:
            close(found[2 * i + 1], s[i] * (1 - y[2 + i]), 1e-15)
            equal(found[2 * i + 2], 1)
        else:
            close(found[2 * i + 1], forward[i], 1e-12)
            close(found[2 * i + 2], -backward[i], 1e-12)
            held = (forward[i] > 0) & (backward[i] < 0)
            equal((found[2 * i + 1 : 2 * i + 3] > 0).all(axis=0), held)
    equal(found[SECTION], y[2])


# --- switches -----------------------------------------------------------------------------


@pytest.mark.parametrize("i", [0, 1])
@pytest.mark.parametrize("arriving", [1, -1])
def test_slip_that_ends(i, arriving):
    """It reverses where the far side leads on and sticks where both lead back.

    Decided from Eq. 39 on both sides of v = 0. Where the load is negative it never sticks.
    """
    seen = {"reversal": 0, "stick": 0, "reversal under tension": 0}
    for seed in SEEDS:
        x, other = numbers(seed), (1, -1, 0)[seed % 3]
        y, contact = states((arriving, other) if i == 0 else (other, arriving), seed)
        y[2 + i] = 1
        own, far = sides(x, y)[:: int(arriving)]
        arrives, reverses = arriving * own[i] > 0, arriving * far[i] > 0
        after, s = map(np.asarray, switch(scaled(scene_of(x)), y, contact, 2 * i + 1))
        equal(s[i][arrives], np.where(reverses, -arriving, 0)[arrives])
        equal(after, y)
        equal(s[1 - i], contact[1 - i])
        load = y[1] * x["K_n"] if i == 0 else -y[0] * x["K_t"]
        assert (s[i][arrives & (load < 0)] == -arriving).all()
        assert (load[(s[i] == 0) & arrives] > 0).all() or (i == 1 and x["K_t"] == 0)
        seen["reversal"] += (arrives & reverses).sum()
        seen["stick"] += (arrives & ~reverses).sum()
        seen["reversal under tension"] += (arrives & (load < 0)).sum()
    assert min(seen.values()) > 50, seen


@pytest.mark.parametrize("i", [0, 1])
@pytest.mark.parametrize("to", [1, -1])
def test_stick_that_ends(i, to):
    """The guard that reaches zero names the side, and that side's own field leaves the belt."""
    for seed in SEEDS:
        x, other = numbers(seed), (1, -1, 0)[seed % 3]
        y, contact = states((0, other) if i == 0 else (other, 0), seed)
        guard, system = 2 * i + (1 if to == 1 else 2), scaled(scene_of(x))
        # Moved along x_i until the guard is just below zero, under a positive load.
        y[1 - i] = abs(y[1 - i]) if i == 0 else -abs(y[1 - i])
        value = np.asarray(guards(system, y, contact))[guard]
        along = np.tile(np.eye(4)[i][:, None], 200)
        slope = np.asarray(guards(system, y + along, contact))[guard] - value
        y[i] -= (value + 1e-9) / slope
        after, s = map(np.asarray, switch(system, y, contact, guard))
        equal(s[i], to)
        equal(s[1 - i], contact[1 - i])
        equal(after, y)
        own = sides(x, y)[0 if to == 1 else 1][i]
        assert (to * own < 0).all() and (abs(own) < 1e-8).all()


def test_each_guard():
    """An end puts u_i to one; no guard touches anything else.

    A guard a column: each acts on its own column only.
    """
    system = scaled(scene_of(numbers(5)))
    for s in STATES:
        y, contact = states(s)
        every = (NONE, SECTION, 1, 2, 3, 4)
        columns = np.resize(every, 200)
        together = switch(system, y, contact, columns)
        for guard in every:
            after, new = map(np.asarray, switch(system, y, contact, guard))
            expected, untouched = y.copy(), [0, 1]
            if guard > 0:
                expected[2 + (guard - 1) // 2] = 1
                untouched.remove((guard - 1) // 2)
            equal(after, expected)
            equal(new[untouched], contact[untouched])
            for found, alone in zip(together, (after, new), strict=True):
                equal(np.asarray(found)[:, columns == guard], alone[:, columns == guard])


def test_first_contact_state_and_start():
    """Off the belt's velocity its sign; on it, the side that leaves (or forward), else stick."""
    seen = np.zeros(4, int)
    for seed in SEEDS:
        x, rng = numbers(seed), np.random.default_rng(seed)
        y = rng.normal(size=(4, 300))
        y[2:] = np.where(rng.uniform(size=(2, 300)) < 0.7, 1, y[2:] + 1)
        found = np.asarray(first_state(scaled(scene_of(x)), y))
        forward, backward = sides(x, y)
        for i, (u, s) in enumerate(zip(y[2:], found, strict=True)):
            leaves = forward[i] < 0, backward[i] > 0
            expected = np.where(u == 1, np.select(leaves, [1, -1], 0), np.sign(1 - u))
            equal(s, expected)
            seen += np.bincount((2 * leaves[0] + leaves[1])[u == 1], minlength=4)
    assert (seen > 50).all(), seen
    # Lists, whole numbers and arrays become one array of floats.
    for start in ([1, 2, 3, 4], np.arange(1, 5), jnp.arange(1.0, 5)):
        found = start_state(start, 2)
        assert found.dtype == np.float64
        equal(found, [1, 2, 3, 4])


# --- arguments ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rtol", "dtype", "outcome"),
    [
        (None, "float64", 1e-9),
        (None, "float32", 4096 * 2**-23),
        (0.1, "float64", 0.1),
        (9.1e-13, "float64", 9.1e-13),
        (0.00049, "float32", 0.00049),
        (np.float64(1e-6), "float64", 1e-6),
        (jnp.float32(0.5) ** 8, "float64", 2**-8),
        (0, "float64", "rtol must be above 0 and at most 0.1, got 0"),
        (0.2, "float64", "rtol must be above 0 and at most 0.1, got 0.2"),
        (np.nan, "float64", "rtol must be above 0 and at most 0.1, got nan"),
        (1e-14, "float64", "rtol must be at least 9.1e-13 in float64, got 1e-14"),
        (1e-9, "float32", "rtol must be at least 0.00049 in float32, got 1e-09"),
        (True, "float64", "rtol must be a number, got True"),
        ("1e-9", "float64", "rtol must be a number, got '1e-9'"),
        ((1e-9, 1e-6), "float64", "rtol must be a number, got (1e-09, 1e-06)"),
    ],
)
def test_rtol(rtol, dtype, outcome):
    """It follows the precision; what that cannot hold, and what is no number, is refused."""
    if not isinstance(outcome, str):
        assert check_rtol(rtol, dtype) == outcome
        return
    with pytest.raises((ValueError, TypeError)) as caught:
        check_rtol(rtol, dtype)
    assert str(caught.value) == outcome


def test_guards_of_joints_of_which_some_open():
    """Each opening has its own guard, which moves its own joint; no other number moves anything."""
    law, contact = fj.Coulomb(0.4), fj.FixedContact(2.0, 0.5, P=1.5)
    closed = fj.Joint(fj.FixedContact(1.0, 0.3), law, 0, 1, V=1.0)
    opening = [fj.Joint(contact, law, t, n, V=0.7, preload=True) for t, n in ((2, 3), (4, 5))]
    sliding = fj.Joint(contact, law, 1, V=0.5)
    rng = np.random.default_rng(4)
    A = rng.standard_normal((6, 6))
    M, K = np.eye(6) + 0.1 * A @ A.T, 3 * np.eye(6) + 0.2 * A @ A.T
    structure = fj.Structure(M, 0.1 * K, K, (opening[0], closed, opening[1], sliding))
    system = scaled(structure)
    faces = {0: [0, 1], 2: [4, 5]}  # of the joints that open
    y = 0.1 * rng.standard_normal(12)
    s = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    for k, joint in enumerate(faces):
        number = 1 + 2 * len(s) + k
        assert guards(system, y, s)[number] == closures(system, y[:6])[joint]
        after, states = map(np.asarray, switch(system, y, s, number))
        changed = np.flatnonzero(states != s)
        assert list(changed) == faces[joint] and (states[faces[joint]] == 2).all()
        # To rounding it opens without load, and the velocity and the other joint keep theirs.
        assert abs(closures(system, after[:6])[joint]) < 1e-14
        np.testing.assert_array_equal(after[6:], y[6:])
        assert guards(system, after, states)[number] == -closures(system, after[:6])[joint]
    for number in (NONE, SECTION):
        after, states = switch(system, y, s, number)
        np.testing.assert_array_equal(after, y)
        np.testing.assert_array_equal(states, s)
