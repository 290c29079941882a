"""First zeros of cubics against polynomial roots, the coarse step against another integrator."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Polynomial

from filippov import Mechanism, phases
from fractaljax.motion.events import NONE, Cubic, first_root, step, without_start
from fractaljax.motion.stick_slip import SECTION, rest, stick_slip
from tools import reference_scene

PI = np.pi
EPS = np.finfo(float).eps
REFERENCE = Mechanism(1.0, 2000 * PI, 1600 * PI, 0.001, 0.007, 5.0, 0.15, 4e8, 2e8, 0.4, 0.25, 0.5)

found_root = jax.jit(first_root)


# --- cubics -------------------------------------------------------------------------------


def cubics(kind, n=2000):
    """Random (g_0, g_1, d_0, d_1), (4, n)."""
    rng = np.random.default_rng(len(kind))
    if kind == "any":
        return rng.normal(size=(4, n))
    # What guards are made of: two oscillations below the frequency 1 over a step of 1/4 or 1/2.
    h = rng.choice([0.25, 0.5], n)
    rate, phase = rng.uniform(0.3, 1, (2, n)), rng.uniform(0, 2 * PI, (2, n))
    size, level = rng.normal(size=(2, n)), rng.normal(size=n)
    ends = [level + (size * np.cos(rate * t + phase)).sum(axis=0) for t in (0, h)]
    slopes = [-h * (size * rate * np.sin(rate * t + phase)).sum(axis=0) for t in (0, h)]
    return np.array([*ends, *slopes])


def coefficients(g_0, g_1, d_0, d_1):
    """k_0 ... k_3 of the cubic, by solving for them."""
    conditions = [[1, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 0], [0, 1, 2, 3]]
    return np.linalg.solve(conditions, [g_0, g_1, d_0, d_1])


def first_fall(k):
    """The first root in (0, 1] at which the polynomial falls, or 2: from all its roots."""
    curve = Polynomial(np.trim_zeros(k, "b"))
    roots: Any = curve.roots()
    inside = roots[(abs(roots.imag) < 1e-9) & (roots.real > 0) & (roots.real <= 1)].real
    return min((x for x in inside if curve.deriv()(x) < 0), default=2.0)


def clear(k):
    """Whether its roots are simple and none is at an end, so that rounding decides nothing."""
    curve = Polynomial(np.trim_zeros(k, "b"))
    turns = curve.deriv().roots()
    turns = turns[(abs(turns.imag) < 1e-9) & (turns.real > -0.1) & (turns.real < 1.1)].real
    scale = abs(k).max()
    return min(abs(curve(np.array([1.0, *turns])))) > 1e-6 * scale


@pytest.mark.parametrize("shape", [(), (7,), (3, 5)])
def test_through(shape):
    """Values and slopes at both ends are those given, elementwise; `slope` is the derivative."""
    g_0, g_1, d_0, d_1 = np.random.default_rng(3).normal(size=(4, *shape))
    cubic = Cubic.through(g_0, g_1, d_0, d_1)
    for x, g, d in ((0.0, g_0, d_0), (1.0, g_1, d_1)):
        np.testing.assert_allclose(cubic(x), g, rtol=0, atol=20 * EPS)
        np.testing.assert_allclose(cubic.slope(x), d, rtol=0, atol=20 * EPS)
    k = coefficients(*(np.reshape(x, -1) for x in (g_0, g_1, d_0, d_1)))
    x = np.random.default_rng(4).uniform(size=shape)
    truth = sum(k[i] * np.reshape(x, -1) ** i for i in range(4))
    np.testing.assert_allclose(np.reshape(cubic(x), -1), truth, rtol=0, atol=30 * EPS)
    truth = sum(i * k[i] * np.reshape(x, -1) ** (i - 1) for i in range(1, 4))
    np.testing.assert_allclose(np.reshape(cubic.slope(x), -1), truth, rtol=0, atol=50 * EPS)


def has_minimum(k):
    """Whether the slope of the polynomial rises through zero strictly between 0 and 1."""
    slope = Polynomial(k).deriv()
    if abs(k[3]) < 1e-9:  # as good as a parabola, whose far turning point no root finder gives
        return slope(0.0) < 0 < slope(1.0)
    turns: Any = slope.roots()
    turns = turns[turns.imag == 0].real
    return any(0 < x < 1 and slope.deriv()(x) > 0 for x in turns)


def test_minimum():
    """The local minimum strictly inside, if there is one, of cubics, parabolas and lines."""
    k = coefficients(*cubics("any", 1000))
    k[3, 400:600] = 0
    k[2:, 600:700] = 0
    k[3, 700:900] *= 1e-13
    at, inside = (np.asarray(x) for x in jax.jit(lambda k: Cubic(*k).minimum())(k))
    np.testing.assert_array_equal(inside, [has_minimum(column) for column in k.T])
    assert 200 < inside.sum() < 800
    np.testing.assert_array_equal(at[~inside], 0)
    for column, x in zip(k.T[inside], at[inside], strict=True):
        slope = Polynomial(column).deriv()
        assert 0 < x < 1 and abs(slope(x)) < 1e-12 and slope.deriv()(x) > 0


@pytest.mark.parametrize("kind", ["any", "guards"])
def test_first_root(kind):
    """Of cubics that start above zero: whether they fall below it first, and for guards where."""
    x = cubics(kind)
    x = x[:, x[0] > 0]
    k = coefficients(*x)
    chosen = np.array([clear(column) for column in k.T])
    x, k = x[:, chosen], k[:, chosen]
    found = np.asarray(found_root(*x))
    truth = np.array([first_fall(column) for column in k.T])
    assert 0.02 * len(truth) < (truth < 2).sum() < 0.9 * len(truth)
    np.testing.assert_array_equal(found == 2, truth == 2)
    if kind == "guards":
        np.testing.assert_allclose(found, truth, rtol=0, atol=1e-4)
        assert np.quantile(abs(found - truth)[truth < 2], 0.9) < 1e-8
    else:
        # Three steps are not enough for all of these, which no guard comes near.
        assert ((found >= 0) & (found <= 2)).all()
        assert np.median(abs(found - truth)[truth < 2]) < 1e-8


@pytest.mark.parametrize("kind", ["any", "guards"])
def test_fresh_start(kind):
    """One that has just left zero: that root does not count, the next one does, however near."""
    x = cubics(kind)
    x[1] -= x[0]
    x[0] = 0
    x *= np.sign(x[2])
    k = coefficients(*x)
    chosen = np.array([clear(column[1:]) for column in k.T])
    x, k = x[:, chosen], k[:, chosen]
    found = np.asarray(found_root(*x))
    truth = np.array([first_fall(column) for column in k.T])
    assert 0.02 * len(truth) < (truth < 2).sum() < 0.9 * len(truth)
    np.testing.assert_array_equal(found == 2, truth == 2)
    error = abs(found - truth)[truth < 2]
    assert error.max() < 1e-4 if kind == "guards" else np.quantile(error, 0.6) < 1e-4


@pytest.mark.parametrize("duration", [0.3, 1e-2, 1e-3, 1e-5])
def test_short_excursion(duration):
    """A guard that leaves zero and is back after a small share of the step has that root."""
    root, far = duration, np.array([1.5, 4.0, 50.0])
    # x (root - x)(1 - x/far), which starts at exactly zero.
    d_0, d_1 = root * np.ones(3), root - 2 - (2 * root - 3) / far
    found = found_root(np.zeros(3), (root - 1) * (1 - 1 / far), d_0, d_1)
    np.testing.assert_allclose(found, root, rtol=1e-4)


@pytest.mark.parametrize("height", [1e-16, 1e-12, 1e-8, 1e-5])
def test_start_just_above_zero(height):
    """One that rises from there has its root where it comes down, not just behind its start."""
    root, far = np.array([0.1, 0.4, 0.8]), np.array([1.5, 4.0, 50.0])
    # (x + height)(root - x)(1 - x/far)
    k = [
        coefficients_of(np.array([-height, r, f]), height * r)
        for r, f in zip(root, far, strict=True)
    ]
    ends = np.array([[c[0], c.sum(), c[1], c @ np.arange(4)] for c in k]).T
    np.testing.assert_allclose(found_root(*ends), root, rtol=1e-4)


def coefficients_of(roots, start):
    """k_0 ... k_3 of the cubic with these roots and this value at 0."""
    k = np.asarray(Polynomial.fromroots(roots).coef)
    return k * start / k[0]


def test_minimum_behind_a_hill():
    """A cubic that starts level has its minimum where it has it, to the last digits."""
    for rise in (0.0, 1e-18, 1e-12, 1e-6):
        x, inside = Cubic(*(jnp.array(k) for k in (0.0, rise, -1.0, 1.0))).minimum()
        assert inside
        np.testing.assert_allclose(x, (1 + np.sqrt(1 - 3 * rise)) / 3, rtol=1e-14)


def test_late_start():
    """One that starts below zero is late: its root is at once, wherever it goes."""
    x = cubics("any")
    x[0] = -abs(x[0]) * np.logspace(-16, 0, x.shape[1])
    np.testing.assert_array_equal(found_root(*x), 0)


@pytest.mark.parametrize("depth", [1e-2, 1e-4, 1e-6, 1e-9])
def test_shallow_dip(depth):
    """Above zero at both ends and below it between: found, near, and before the bottom."""
    rng = np.random.default_rng(5)
    bottom, bend = rng.uniform(0.2, 0.8, 500), rng.uniform(0.5, 1, 500)
    skew = 0.1 * rng.normal(size=500)
    for sign in (-1, 1):
        ends = [
            bend * (x - bottom) ** 2 + skew * (x - bottom) ** 3 + sign * depth for x in (0.0, 1.0)
        ]
        slopes = [2 * bend * (x - bottom) + 3 * skew * (x - bottom) ** 2 for x in (0.0, 1.0)]
        x = np.array([*ends, *slopes])[:, (ends[0] > 0) & (ends[1] > 0)]
        found = np.asarray(found_root(*x))
        if sign > 0:
            np.testing.assert_array_equal(found, 2)  # only just not
            continue
        truth = np.array([first_fall(column) for column in coefficients(*x).T])
        low = np.asarray(Cubic.through(*x).minimum()[0])
        assert (truth < 2).all() and (found <= low).all()
        np.testing.assert_allclose(found, truth, rtol=0, atol=0.15)
        assert (abs(Cubic.through(*x)(found)) < 0.05 * x[0]).all()


def test_without_start():
    """Divided by x where fresh, else as it was."""
    k = coefficients(*cubics("any", 100))
    k[0, ::2], k[1, ::2] = 0, abs(k[1, ::2])
    x = np.linspace(0.1, 1, 100)
    divided = without_start(Cubic(*k), k[0] == 0)
    whole = Cubic(*k)(x)
    np.testing.assert_allclose(
        divided(x), np.where(k[0] == 0, whole / x, whole), rtol=0, atol=50 * EPS
    )


# --- steps --------------------------------------------------------------------------------


@jax.jit
def _stepped(system, y, h):

    def body(carry, _):
        y, s, t = carry
        y, s_new, dt, guard = step(system, y, s, h)
        return (y, s_new, t + dt), (y, s_new, t + dt, dt, guard)

    return jax.lax.scan(body, (y, system.mode(y), jnp.zeros(())), length=1600)[1]


def stepped(system, y, h):
    """States, modes, times, lengths and guards of 1600 steps."""
    return tuple(map(np.asarray, _stepped(system, y, h)))


@functools.cache
def reference():
    """Switches and turns of the reference from its start up to 95/omega: times, signs after."""
    system = stick_slip(reference_scene())
    share = float(system.omega) / REFERENCE.omega  # its own unit of time
    start = np.asarray(rest(reference_scene(), system).at[0].add(1.0))
    y = start * [1 / share, 1 / share, -1, -1] + [0, 0, 1, 1]
    run = list(phases(REFERENCE, y, 1e-12, 95 / share, turns=True))
    ended = [(p.t1 * share, following.signs) for p, following in itertools.pairwise(run)]
    turned = np.array([p.turned for p in run[:-1]])
    times, signs = np.array([t for t, _ in ended]), np.array([s for _, s in ended])
    return system, jnp.asarray(start), times, signs, turned


def test_steps_follow_the_motion():
    """Ten turns with stick and reversals: the same itinerary, times to fourth order in h."""
    system, start, times, signs, turned = reference()
    assert {(0, 1), (-1, 1), (1, -1)} <= set(map(tuple, signs.tolist())) and turned.sum() >= 10
    worst = []
    for h in (0.25, 0.125, 0.0625):
        _, modes, t, dt, guard = stepped(system, start, h)
        ends = np.flatnonzero(guard != NONE)[: len(times)]
        np.testing.assert_array_equal(modes[ends], signs)
        np.testing.assert_array_equal(guard[ends] == SECTION, turned)
        assert (dt[guard == NONE] == h).all() and (dt <= h).all() and (dt > 0).all()
        worst.append(abs(t[ends] - times).max())
    assert worst[0] < 2e-3 and worst[1] < 1e-4, worst
    order = -np.diff(np.log2(worst))
    assert (order > 3.5).all(), (worst, order)


def test_what_a_step_leaves():
    """After a switch its velocity is the belt's to the last bit, after a turn it is zero."""
    system, start, *_ = reference()
    y, s, _, _, guard = stepped(system, start, 0.25)
    before = np.vstack([np.asarray(system.mode(start)), s[:-1]])
    for i in (0, 1):
        ended = (guard // 2 == i) & (guard < SECTION)
        assert ended.sum() > 20
        np.testing.assert_array_equal(y[ended, 2 + i], 1)
        assert (s[ended, i] != before[ended, i]).all() and (s[~ended, i] == before[~ended, i]).all()
        slipping = s[:, i] != 0
        assert (s[slipping, i] * (1 - y[slipping, 2 + i]) >= -1e-9).all()
        np.testing.assert_array_equal(y[~slipping, 2 + i], 1)
    np.testing.assert_array_equal(y[guard == SECTION, 2], 0)
    assert (y[guard != SECTION, 2] != 0).all()
    # A turn is a maximum of x1: the velocity falls through zero.
    turns = guard == SECTION
    rate = system.field(jnp.asarray(y[turns].T), jnp.asarray(s[turns].T))[2]
    assert (rate < 0).all()


def test_steps_of_a_batch():
    """Many motions side by side take the same steps as one by one."""
    system, start, *_ = reference()
    y, s, _, _, _ = stepped(system, start, 0.25)
    y, s = jnp.asarray(y[:60].T), jnp.asarray(s[:60].T)
    together = jax.jit(step)(system, y, s, 0.25)
    one = jax.jit(step)
    for k in range(0, 60, 7):
        alone = one(system, y[:, k], s[:, k], 0.25)
        for batched, single in zip(together, alone, strict=True):
            np.testing.assert_allclose(batched[..., k], single, rtol=0, atol=1e-13)
