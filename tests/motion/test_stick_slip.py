"""The scaled Filippov system against Eq. 39 as printed, in SI units and with a sign at a time."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.motion.stick_slip import (
    SECTION,
    StickSlip,
    check_rtol,
    rest,
    start_state,
    stick_slip,
    units,
)
from tools import reference_scene

MODES = list(itertools.product((1, 0, -1), repeat=2))
SEEDS = range(8)
NAMES = ("m", "omega_1", "omega_2", "xi_1", "xi_2", "F", "V", "K_n", "K_t", "mu_s", "mu_m", "v_m")

field = jax.jit(StickSlip.field)
guards = jax.jit(StickSlip.guards)
switch = jax.jit(StickSlip.switch)
first_mode = jax.jit(StickSlip.mode)
scaled = jax.jit(stick_slip)


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


def states(s, seed=0, n=200):
    """Random scaled states (4, n) and the mode s (2, n), which they obey."""
    rng = np.random.default_rng(seed + 100)
    y = rng.normal(size=(4, n))
    s = np.repeat(np.array(s, float)[:, None], n, axis=1)
    y[2:] = np.where(s == 0, 1, 1 - s * abs(y[2:]))
    return y, s


# --- field --------------------------------------------------------------------------------


@pytest.mark.parametrize("s", MODES)
def test_field(s):
    """In each of the nine modes it is Eq. 39; what sticks moves with the belt, unaccelerated."""
    for seed in SEEDS:
        x = numbers(seed)
        y, modes = states(s, seed)
        omega, factors = scale(x)
        slips = np.array(s)[:, None] != 0
        rate = np.vstack([y[2:] * x["V"], np.where(slips, acceleration(x, y * factors, s), 0)])
        truth = rate / factors / omega
        found = field(scaled(scene_of(x)), y, modes)
        np.testing.assert_allclose(found, truth, rtol=0, atol=1e-13 * abs(truth).max())
        np.testing.assert_array_equal(found[:2], y[2:])
        np.testing.assert_array_equal(found[2:][np.array(s) == 0], 0)


def test_scales():
    """`units` and omega are the documented ones, finite also without any contact stiffness."""
    for changes in ({}, {"K_t": 0.0}, {"K_n": 0.0, "K_t": 0.0}):
        x = numbers(1) | changes
        system = scaled(scene_of(x))
        omega, factors = scale(x)
        np.testing.assert_allclose(system.omega, omega, rtol=1e-14)
        np.testing.assert_allclose(units(system), factors[:, 0], rtol=1e-14)
        y, modes = states((1, -1), n=200)
        truth = acceleration(x, y * factors, (1, -1)) / (omega * x["V"])
        np.testing.assert_allclose(field(system, y, modes)[2:], truth, rtol=0, atol=1e-12)


@pytest.mark.parametrize("V", [0.05, 0.15, 1.3])
def test_rest(V):
    """Steady sliding at V > 0 is where the field vanishes, and Eq. 40's."""
    for seed in SEEDS:
        x = numbers(seed) | {"V": V}
        scene, (_, factors) = scene_of(x), scale(x)
        y = rest(scene, scaled(scene))
        np.testing.assert_array_equal(y[2:], 0)
        here = field(scaled(scene), y[:, None], np.ones((2, 1)))
        np.testing.assert_allclose(here, 0, rtol=0, atol=1e-15 * float(abs(y).max() + 1))
        at_rest = np.asarray(y)[:, None] * factors
        force = acceleration(x, at_rest, (1, 1))[:, 0] * x["m"]
        np.testing.assert_allclose(force, 0, rtol=0, atol=1e-11 * abs(x["F"]))


def test_coulomb():
    """Constant friction: no cubic is traced, and the field is affine where signs do not change."""
    stribeck = reference_scene()
    coulomb = stribeck.replace(friction=fj.Coulomb(0.4))
    y, s = states((1, 1))

    def program(scene):
        system = stick_slip(scene)
        return jax.make_jaxpr(lambda y: system.field(y, s))(y)

    lines, more = len(program(coulomb).eqns), len(program(stribeck).eqns)
    assert lines < more
    assert "pow" not in str(program(coulomb)) and "pow" in str(program(stribeck))
    middle = (y[:, :100] + y[:, 100:]) / 2
    for scene, affine in ((coulomb, True), (stribeck, False)):
        system = stick_slip(scene)
        ends = system.field(y, s)
        bent = system.field(middle, s[:, :100]) - (ends[:, :100] + ends[:, 100:]) / 2
        assert (abs(bent).max() < 1e-14) == affine
    flat = stribeck.replace(mu_m=0.4)
    np.testing.assert_allclose(
        stick_slip(coulomb).field(y, s), stick_slip(flat).field(y, s), rtol=0, atol=1e-15
    )


def test_stiffness():
    """The larger slope of what friction does to u_i by u_i, in units of omega; 0 for Coulomb."""
    for seed in SEEDS:
        x = numbers(seed)
        system = scaled(scene_of(x))
        y, _ = states((1, -1), seed)
        y[2:] *= 3  # also beyond v_m, where friction rises
        h = 1e-6
        slopes = []
        for i in (0, 1):
            ends = []
            for side in (h, -h):
                moved = y.copy()
                moved[2 + i] += side
                omega, factors = scale(x)
                free = {**x, "xi_1": 0.0, "xi_2": 0.0}
                ends.append(acceleration(free, moved * factors, (1, -1))[i] / (omega * x["V"]))
            slopes.append((ends[0] - ends[1]) / (2 * h))
        found = np.asarray(system.stiffness(y))
        assert found.shape == (200,)
        np.testing.assert_allclose(found, abs(np.array(slopes)).max(axis=0), rtol=1e-6, atol=1e-8)
    coulomb = stick_slip(reference_scene().replace(friction=fj.Coulomb(0.4)))
    np.testing.assert_array_equal(coulomb.stiffness(y), np.zeros(200))


# --- guards -------------------------------------------------------------------------------


@pytest.mark.parametrize("s", MODES)
def test_guards_are_affine(s):
    """Along any line in the space of states they are straight; `one` = 0 leaves the slope."""
    system = scaled(scene_of(numbers(2)))
    y, modes = states(s, n=200)
    z = np.roll(y, 1, axis=1)
    g, h = np.asarray(guards(system, y, modes)), np.asarray(guards(system, z, modes))
    for share in (0.3, -2.0):
        between = guards(system, share * y + (1 - share) * z, modes)
        np.testing.assert_allclose(between, share * g + (1 - share) * h, rtol=0, atol=1e-13)
    linear = guards(system, y - z, modes, 0.0)
    np.testing.assert_allclose(linear, g - h, rtol=0, atol=1e-13)


@pytest.mark.parametrize("s", MODES)
def test_guard_rates(s):
    """Their rates along the motion are the linear part at the field, in both modes of jax."""
    system = scaled(scene_of(numbers(3)))
    y, modes = states(s, n=200)
    rate = field(system, y, modes)
    tangent = jax.jvp(lambda y: guards(system, y, modes), (y,), (rate,))[1]
    np.testing.assert_allclose(guards(system, rate, modes, 0.0), tangent, rtol=0, atol=1e-13)


@pytest.mark.parametrize("s", MODES)
def test_guards_are_positive_while_the_mode_lasts(s):
    """In slip the velocity's own sign; in stick both sides push back; the section is u1."""
    x = numbers(4)
    y, modes = states(s, n=200)
    found = np.asarray(guards(scaled(scene_of(x)), y, modes))
    forward, backward = sides(x, np.vstack([y[:2], np.ones((2, y.shape[1]))]))
    for i in (0, 1):
        if s[i]:
            np.testing.assert_allclose(found[2 * i], s[i] * (1 - y[2 + i]), rtol=0, atol=1e-15)
            np.testing.assert_array_equal(found[2 * i + 1], 1)
        else:
            np.testing.assert_allclose(found[2 * i], forward[i], rtol=0, atol=1e-12)
            np.testing.assert_allclose(found[2 * i + 1], -backward[i], rtol=0, atol=1e-12)
            held = (forward[i] > 0) & (backward[i] < 0)
            np.testing.assert_array_equal((found[2 * i : 2 * i + 2] > 0).all(axis=0), held)
    np.testing.assert_array_equal(found[SECTION], y[2])


# --- switches -----------------------------------------------------------------------------


@pytest.mark.parametrize("i", [0, 1])
@pytest.mark.parametrize("arriving", [1, -1])
def test_slip_that_ends(i, arriving):
    """It crosses where the far side leads on and sticks where both lead back; no other way.

    Decided from Eq. 39 on both sides of v = 0. Where the load is negative it never sticks.
    """
    seen = {"cross": 0, "stick": 0, "cross under tension": 0}
    for seed in SEEDS:
        x = numbers(seed)
        other = (1, -1, 0)[seed % 3]
        y, modes = states((arriving, other) if i == 0 else (other, arriving), seed)
        y[2 + i] = 1
        own, far = sides(x, y)[:: int(arriving)]
        arrives = arriving * own[i] > 0
        crosses = arriving * far[i] > 0
        after, s = switch(scaled(scene_of(x)), y, modes, 2 * i)
        after, s = np.asarray(after), np.asarray(s)
        expected = np.where(crosses, -arriving, 0)
        np.testing.assert_array_equal(s[i][arrives], expected[arrives])
        np.testing.assert_array_equal(after, y)
        np.testing.assert_array_equal(s[1 - i], modes[1 - i])
        load = y[1] * x["K_n"] if i == 0 else -y[0] * x["K_t"]
        repelling = (sides(x, y)[0][i] < 0) & (sides(x, y)[1][i] > 0)
        assert not (arrives & repelling).any()
        assert (s[i][arrives & (load < 0)] == -arriving).all()
        seen["cross"] += (arrives & crosses).sum()
        seen["stick"] += (arrives & ~crosses).sum()
        seen["cross under tension"] += (arrives & (load < 0)).sum()
        if not (i == 1 and x["K_t"] == 0):
            sticks = s[i] == 0
            assert (load[sticks & arrives] > 0).all()
    assert min(seen.values()) > 50, seen


@pytest.mark.parametrize("i", [0, 1])
@pytest.mark.parametrize("to", [1, -1])
def test_stick_that_ends(i, to):
    """The guard that gives way names the side, and that side's own field leaves the belt."""
    left = 0
    for seed in SEEDS:
        x = numbers(seed)
        other = (1, -1, 0)[seed % 3]
        y, modes = states((0, other) if i == 0 else (other, 0), seed)
        guard = 2 * i if to == 1 else 2 * i + 1
        system = scaled(scene_of(x))
        # Beyond its limit by a little: the guard is moved there along x_i, under a positive load.
        y[1 - i] = abs(y[1 - i]) if i == 0 else -abs(y[1 - i])
        value = np.asarray(guards(system, y, modes))[guard]
        unit = np.eye(4)[i][:, None] * np.ones(y.shape)
        slope = np.asarray(guards(system, unit, modes, 0.0))[guard]
        y[i] -= (value + 1e-9) / slope
        after, s = switch(system, y, modes, guard)
        np.testing.assert_array_equal(np.asarray(s)[i], to)
        np.testing.assert_array_equal(np.asarray(s)[1 - i], modes[1 - i])
        np.testing.assert_array_equal(after, y)
        own = sides(x, y)[0 if to == 1 else 1][i]
        assert (to * own < 0).all()
        assert (abs(own) < 1e-8).all()
        left += y.shape[1]
    assert left == 200 * len(SEEDS)


def test_other_switches():
    """A turn puts u1 to zero, an end puts u_i to one; nothing else moves."""
    system = scaled(scene_of(numbers(5)))
    for s in MODES:
        y, modes = states(s)
        for guard in range(SECTION + 2):
            after, new = (np.asarray(x) for x in switch(system, y, modes, guard))
            expected, still = y.copy(), [0, 1]
            if guard == SECTION:
                expected[2] = 0
            elif guard < SECTION:
                expected[2 + guard // 2] = 1
                still.remove(guard // 2)
            np.testing.assert_array_equal(after, expected)
            np.testing.assert_array_equal(new[still], modes[still])
            assert after.dtype == new.dtype == np.float64


def test_one_guard_each():
    """Guards of different columns act on their own column only."""
    system = scaled(scene_of(numbers(6)))
    y, modes = states((1, -1), n=200)
    guard = np.arange(200) % (SECTION + 2)
    together = switch(system, y, modes, guard)
    for k in range(SECTION + 2):
        own = guard == k
        alone = switch(system, y, modes, k)
        for found, expected in zip(together, alone, strict=True):
            np.testing.assert_array_equal(np.asarray(found)[:, own], np.asarray(expected)[:, own])


def test_first_mode():
    """Off the belt's velocity its sign; on it, into the side that leaves, else stick.

    Where both sides leave (the sliding mode repels) the motion goes forward.
    """
    seen = np.zeros(4, int)
    for seed in SEEDS:
        x = numbers(seed)
        rng = np.random.default_rng(seed)
        y = rng.normal(size=(4, 300))
        y[2:] = np.where(rng.uniform(size=(2, 300)) < 0.7, 1, y[2:] + 1)
        found = np.asarray(first_mode(scaled(scene_of(x)), y))
        forward, backward = sides(x, y)
        for i in (0, 1):
            leaves = forward[i] < 0, backward[i] > 0
            at_rest = np.select([leaves[0], leaves[1]], [1, -1], 0)
            u = y[2 + i]
            np.testing.assert_array_equal(found[i], np.where(u == 1, at_rest, np.sign(1 - u)))
            kinds = 2 * leaves[0][u == 1] + leaves[1][u == 1]
            seen += np.bincount(kinds, minlength=4)
    assert (seen > 50).all(), seen


# --- derivatives and refusals -------------------------------------------------------------


def test_derivatives_of_the_system():
    """By every quantity of the scene, forward and reverse: those of Eq. 39, scaled by hand."""
    x = numbers(7)
    y, modes = states((1, -1), n=1)

    def truth(values):
        x = dict(zip(NAMES, values, strict=True))
        omega, factors = scale(x)
        return acceleration(x, y * factors, (1, -1))[:, 0] / (omega * x["V"])

    def found(values):
        scene = scene_of(dict(zip(NAMES, values, strict=True)))
        return stick_slip(scene).field(y, modes)[2:, 0]

    values = np.array([x[name] for name in NAMES])
    h = 1e-5 * values
    steps = [(truth(values + d) - truth(values - d)) / 2e-5 for d in np.diag(h)]
    for mode in (jax.jacfwd, jax.jacrev):
        by_log = np.asarray(jax.jit(mode(found))(values)) * values
        np.testing.assert_allclose(by_log, np.array(steps).T, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ([0.0, 0.0, 0.0], r"start must have shape \(4,\), got \(3,\); use jax.vmap for many"),
        (0.0, r"start must have shape \(4,\), got \(\); use jax.vmap for many"),
        (np.zeros((2, 4)), r"start must have shape \(4,\), got \(2, 4\); use jax.vmap for many"),
        ([0, 0, np.nan, 0], "start must be finite, got nan"),
        ([0, 0, 0, -np.inf], "start must be finite, got -inf"),
    ],
)
def test_start_refusals(bad, message):
    """The message holds the argument, what it must be, and what it was."""
    with pytest.raises(ValueError, match=f"^{message}$"):
        start_state(bad)


def test_start():
    """Lists, whole numbers and arrays are one (4,) array of floats."""
    for start in ([1, 2, 3, 4], (1.0, 2.0, 3.0, 4.0), np.arange(1, 5), jnp.arange(1.0, 5)):
        found = start_state(start)
        assert found.dtype == np.float64
        np.testing.assert_array_equal(found, [1, 2, 3, 4])


@pytest.mark.parametrize("bad", [0, 0.0, -1e-9, 0.2, np.nan, np.inf])
def test_rtol_refusals(bad):
    """The message holds the argument, both bounds and the value."""
    text = f"rtol must be above 0 and at most 0.1, got {bad!r}"
    with pytest.raises(ValueError) as caught:
        check_rtol(bad, jnp.float64)
    assert str(caught.value) == text
    for good in (0.1, 1e-3, 1e-12):
        assert check_rtol(good, jnp.float64) == good


@pytest.mark.parametrize("bad", [True, "1e-9", [1e-9], (1e-9, 1e-6)])
def test_rtol_is_a_number(bad):
    """Nothing else is taken for one."""
    with pytest.raises(TypeError) as caught:
        check_rtol(bad, jnp.float64)
    assert str(caught.value) == f"rtol must be a number, got {bad!r}"
    for good in (np.float64(1e-6), jnp.asarray(1e-6)):
        assert check_rtol(good, jnp.float64) == 1e-6


@pytest.mark.parametrize(
    ("dtype", "usual", "least", "bad"),
    [("float64", 1e-9, "9.1e-13", 1e-14), ("float32", 4096 * 2**-23, "0.00049", 1e-9)],
)
def test_rtol_follows_the_precision(dtype, usual, least, bad):
    """One that the precision cannot hold is refused; the default is one that it can."""
    assert check_rtol(None, dtype) == usual
    with pytest.raises(ValueError, match=f"^rtol must be at least {least} in {dtype}, got {bad}$"):
        check_rtol(bad, dtype)
    assert check_rtol(float(least), dtype) == float(least)
