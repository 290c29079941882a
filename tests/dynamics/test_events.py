"""First zeros of cubics against polynomial roots, the coarse step against another integrator."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Polynomial

from fractaljax._dynamics.events import Cubic, first_root, step, without_start
from fractaljax._dynamics.guard import NONE, SECTION
from fractaljax._dynamics.hybrid import HybridSystem
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.transition import first_contact_state
from hybrid_truth import Mechanism, phases
from mechanisms import PLAIN, source_form
from tools import reference_scene

EPS = np.finfo(float).eps
KINDS = pytest.mark.parametrize("kind", ["any", "guards"])
equilibrium, field = jax.jit(HybridSystem.equilibrium), jax.jit(HybridSystem.field)
contact_state = jax.jit(first_contact_state)
found_root = jax.jit(lambda *ends: first_root(Cubic.through(*ends)))


def cubics(kind, n=2000):
    """Random (g_0, g_1, d_0, d_1), (4, n)."""
    rng = np.random.default_rng(len(kind))
    if kind == "any":
        return rng.normal(size=(4, n))
    # What guards are made of: two oscillations below the frequency 1 over a step of 1/4 or 1/2.
    h = rng.choice([0.25, 0.5], n)
    rate, phase = rng.uniform(0.3, 1, (2, n)), rng.uniform(0, 2 * np.pi, (2, n))
    size, level = rng.normal(size=(2, n)), rng.normal(size=n)
    ends = [level + (size * np.cos(rate * t + phase)).sum(axis=0) for t in (0, h)]
    slopes = [-h * (size * rate * np.sin(rate * t + phase)).sum(axis=0) for t in (0, h)]
    return np.array([*ends, *slopes])


def coefficients(ends):
    """k_0 ... k_3 of the cubics with these (g_0, g_1, d_0, d_1), by solving for them."""
    return np.linalg.solve([[1, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 0], [0, 1, 2, 3]], ends)


def ends_of(k):
    """(g_0, g_1, d_0, d_1) of cubics with coefficients k (4, n)."""
    return np.array([k[0], k.sum(axis=0), k[1], np.arange(4) @ k])


def with_roots(roots, start):
    """k_0 ... k_3 of the cubic with these roots and this value at 0."""
    k = np.asarray(Polynomial.fromroots(roots).coef)
    return k * start / k[0]


def first_fall(k):
    """The first root in (0, 1] at which the polynomial falls, or 2: from all its roots."""
    curve = Polynomial(np.trim_zeros(k, "b"))
    roots: Any = curve.roots()
    inside = roots[(abs(roots.imag) < 1e-9) & (roots.real > 0) & (roots.real <= 1)].real
    return min((x for x in inside if curve.deriv()(x) < 0), default=2.0)


def clear(k):
    """Whether its roots are simple and none is at an end, so that rounding decides nothing."""
    curve = Polynomial(np.trim_zeros(k, "b"))
    extrema = curve.deriv().roots()
    extrema = extrema[(abs(extrema.imag) < 1e-9) & (abs(extrema.real - 0.5) < 0.6)].real
    return min(abs(curve(np.array([1.0, *extrema])))) > 1e-6 * abs(k).max()


def has_minimum(k):
    """Whether the slope of the polynomial rises through zero strictly between 0 and 1."""
    slope = Polynomial(k).deriv()
    if abs(k[3]) < 1e-9:  # nearly a parabola, whose other extremum no root finder gives
        return slope(0.0) < 0 < slope(1.0)
    extrema: Any = slope.roots()
    extrema = extrema[extrema.imag == 0].real
    return any(0 < x < 1 and slope.deriv()(x) > 0 for x in extrema)


def test_cubic():
    """Values and slopes, elementwise; and the cubic divided by x where it starts at zero."""
    ends = cubics("any", 100)
    ends[0, ::2], ends[2, ::2] = 0, abs(ends[2, ::2])
    k, cubic = coefficients(ends), Cubic.through(*ends)
    x = np.linspace(0.1, 1, 100)
    whole = (k * x ** np.arange(4)[:, None]).sum(axis=0)
    np.testing.assert_allclose(cubic(x), whole, rtol=0, atol=50 * EPS)
    slope = (k[1:] * np.arange(1, 4)[:, None] * x ** np.arange(3)[:, None]).sum(axis=0)
    np.testing.assert_allclose(cubic.slope(x), slope, rtol=0, atol=100 * EPS)
    divided = without_start(cubic, ends[0] == 0)(x)
    np.testing.assert_allclose(divided, np.where(ends[0] == 0, whole / x, whole), atol=100 * EPS)


def test_minimum():
    """The local minimum strictly inside, if there is one, of cubics, parabolas and lines."""
    k = coefficients(cubics("any", 1000))
    k[3, 400:600] = 0
    k[2:, 600:700] = 0
    k[3, 700:900] *= 1e-13
    minimum = jax.jit(lambda k: Cubic(*k).minimum())
    at, inside = map(np.asarray, minimum(k))
    np.testing.assert_array_equal(inside, [has_minimum(column) for column in k.T])
    assert 200 < inside.sum() < 800
    np.testing.assert_array_equal(at[~inside], 0)
    for column, x in zip(k.T[inside], at[inside], strict=True):
        slope = Polynomial(column).deriv()
        assert 0 < x < 1 and abs(slope(x)) < 1e-12 and slope.deriv()(x) > 0
    # One that starts level, to the last digits.
    rise = np.resize([0.0, 1e-18, 1e-12, 1e-6], 1000)
    at, inside = map(np.asarray, minimum(np.stack([0 * rise, rise, 0 * rise - 1, 0 * rise + 1])))
    np.testing.assert_allclose(at, (1 + np.sqrt(1 - 3 * rise)) / 3, rtol=1e-14)


@KINDS
@pytest.mark.parametrize("fresh", [False, True])
def test_first_root(kind, fresh):
    """Whether a cubic falls below zero, and where; `fresh`: it starts at a root."""
    x = cubics(kind)
    if fresh:
        x[1] -= x[0]
        x[0] = 0
        x *= np.sign(x[2])
    x = x[:, x[0] >= 0]
    k = coefficients(x)
    chosen = np.array([clear(column[int(fresh) :]) for column in k.T])
    x, k = x[:, chosen], k[:, chosen]
    found, truth = np.asarray(found_root(*x)), np.array([first_fall(column) for column in k.T])
    assert 0.02 * len(truth) < (truth < 2).sum() < 0.9 * len(truth)
    np.testing.assert_array_equal(found == 2, truth == 2)
    error = abs(found - truth)[truth < 2]
    assert ((found >= 0) & (found <= 2)).all()
    # Three steps are not enough for all cubics; guards are simpler.
    assert error.max() < 1e-4 if kind == "guards" else np.quantile(error, 0.6) < 1e-4
    assert fresh or np.quantile(error, 0.9 if kind == "guards" else 0.5) < 1e-8


def test_root_near_the_start():
    """A guard that leaves zero, or nearly zero, comes down at its next root, however near."""
    far = np.array([1.5, 4.0, 50.0])
    for root in (0.3, 1e-2, 1e-3, 1e-5):
        # x (root - x)(1 - x/far), which starts at exactly zero.
        k = np.array([0 * far, 0 * far + root, -1 - root / far, 1 / far])
        ends = ends_of(k)
        ends[0] = 0
        np.testing.assert_allclose(found_root(*ends), root, rtol=1e-4)
    for height in (1e-16, 1e-12, 1e-8, 1e-5):
        roots = [0.1, 0.4, 0.8]
        pairs = zip(roots, far, strict=True)
        k = np.array([with_roots([-height, r, f], height * r) for r, f in pairs]).T
        np.testing.assert_allclose(found_root(*ends_of(k)), roots, rtol=1e-4)
    # It rises, or is level, before it falls far: the secant's root is too early.
    high = np.array([0.0, 1e-3, 1.0, 50.0])
    for slope in (0.0, 1.0, 10.0):
        k = np.array([high, 0 * high + slope, 0 * high + 1e3, 0 * high - 1e4])
        truth = [first_fall(column) for column in k.T]
        np.testing.assert_allclose(found_root(*ends_of(k)), truth, atol=0.03)
    late = cubics("any")
    late[0] = -abs(late[0]) * np.logspace(-16, 0, late.shape[1])
    np.testing.assert_array_equal(found_root(*late), 0)


@pytest.mark.parametrize("depth", [1e-2, 1e-4, 1e-6, 1e-9])
def test_shallow_dip(depth):
    """Above zero at both ends and below it between: found, near, and before the bottom."""
    rng = np.random.default_rng(5)
    bottom, bend = rng.uniform(0.2, 0.8, 500), rng.uniform(0.5, 1, 500)
    skew = 0.1 * rng.normal(size=500)
    for sign in (-1, 1):
        g = [bend * (x - bottom) ** 2 + skew * (x - bottom) ** 3 + sign * depth for x in (0.0, 1.0)]
        d = [2 * bend * (x - bottom) + 3 * skew * (x - bottom) ** 2 for x in (0.0, 1.0)]
        x = np.array([*g, *d])[:, (g[0] > 0) & (g[1] > 0)]
        found = np.asarray(found_root(*x))
        if sign > 0:
            np.testing.assert_array_equal(found, 2)  # only just not
            continue
        truth = np.array([first_fall(column) for column in coefficients(x).T])
        cubic = Cubic.through(*x)
        assert (truth < 2).all() and (found <= np.asarray(cubic.minimum()[0])).all()
        np.testing.assert_allclose(found, truth, rtol=0, atol=0.15)
        assert (abs(cubic(found)) < 0.05 * x[0]).all()


@jax.jit
def _stepped(system, y, h):
    def body(carry, _):
        y, s, last, t = carry
        y, s_new, dt, guard, *_ = step(system, y, s, last, h)
        return (y, s_new, guard, t + dt), (y, s_new, t + dt, dt, guard)

    start = y, first_contact_state(system, y), jnp.array(NONE), jnp.zeros(())
    return jax.lax.scan(body, start, length=1600)[1]


def stepped(system, y, h):
    """States, contact states, times, lengths and guards of 1600 steps."""
    return tuple(map(np.asarray, _stepped(system, y, h)))


@functools.cache
def reference():
    """Switches and returns of the reference from its start up to 95/omega: times, signs after."""
    system = jax.jit(hybrid_system)(reference_scene())
    start = np.asarray(equilibrium(system)) + np.eye(4)[0]
    truth = Mechanism.of(source_form(**PLAIN))
    share = float(system.omega) / truth.omega  # its own unit of time
    y = start * np.asarray(system.units) / truth.units
    run = list(phases(truth.scaled, y, 1e-12, 95 / share, maxima=True))
    times = np.array([p.t1 * share for p in run[:-1]])
    signs = np.array([following.mode for _, following in itertools.pairwise(run)])
    return (
        system,
        jnp.asarray(start),
        times,
        signs,
        np.array([p.event[0] == "maximum" for p in run[:-1]]),
    )


def test_steps_follow_the_motion():
    """Ten returns with stick and reversals: the same itinerary, times to fourth order in h."""
    system, start, times, signs, maxima = reference()
    assert {(0, 1), (-1, 1), (1, -1)} <= set(map(tuple, signs.tolist())) and maxima.sum() >= 10
    worst = []
    for h in (0.25, 0.125, 0.0625):
        _, contact, t, dt, guard = stepped(system, start, h)
        ends = np.flatnonzero(guard != NONE)[: len(times)]
        np.testing.assert_array_equal(contact[ends], signs)
        np.testing.assert_array_equal(guard[ends] == SECTION, maxima)
        assert (dt[guard == NONE] == h).all() and (dt <= h).all() and (dt > 0).all()
        worst.append(abs(t[ends] - times).max())
    assert worst[0] < 2e-3 and worst[1] < 1e-4, worst
    assert (-np.diff(np.log2(worst)) > 3.5).all(), worst


def test_end_of_a_step_and_steps_of_a_batch():
    """After a switch the velocity is the belt's to the last bit, after a return nearly zero."""
    system, start, *_ = reference()
    y, s, _, _, guard = stepped(system, start, 0.25)
    before = np.vstack([contact_state(system, start), s[:-1]])
    for i in (0, 1):
        ended = (guard - 1) // 2 == i
        assert ended.sum() > 20
        np.testing.assert_array_equal(y[ended, 2 + i], 1)
        np.testing.assert_array_equal(ended, s[:, i] != before[:, i])
        slipping = s[:, i] != 0
        assert (s[slipping, i] * (1 - y[slipping, 2 + i]) >= -1e-9).all()
        np.testing.assert_array_equal(y[~slipping, 2 + i], 1)
    # A return is a maximum of x1: the velocity falls through zero.
    at = guard == SECTION
    assert abs(y[at, 2]).max() < 1e-3
    assert (field(system, y[at].T, s[at].T)[2] < 0).all()
    # Many motions side by side take the same steps as one by one.
    y, s = (jnp.asarray(x[:60].T) for x in (y, s))
    one, last = jax.jit(step), np.full(60, NONE)
    together = one(system, y, s, last, 0.25)
    for k in range(0, 60, 7):
        alone = one(system, y[:, k], s[:, k], last[k], 0.25)
        for batched, single in zip(together[:4], alone[:4], strict=True):
            np.testing.assert_allclose(batched[..., k], single, rtol=0, atol=1e-13)
