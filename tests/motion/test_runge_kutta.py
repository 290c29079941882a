"""One step of diffrax's tableaus: its order, both ways to write it, derivatives, shapes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diffrax import Dopri8, Tsit5

from fractaljax.motion.runge_kutta import runge_kutta

EPS = np.finfo(float).eps
START = np.array([0.6, -0.3])
BOTH = pytest.mark.parametrize("written_out", [False, True])
MODES = pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])


def spiral(y):
    """With s the square of the radius, ds/dt = 2 s (1 - s), and the angle turns at the rate s."""
    x, y = y
    s = x**2 + y**2
    return jnp.stack([x * (1 - s) - s * y, y * (1 - s) + s * x])


def exact(y, t):
    """The motion of the spiral from y, in closed form."""
    x, y = y
    s = x**2 + y**2
    growth = 1 + s * jnp.expm1(2 * t)
    radius, angle = jnp.exp(t) / jnp.sqrt(growth), 0.5 * jnp.log(growth)
    cos, sin = radius * jnp.cos(angle), radius * jnp.sin(angle)
    return jnp.stack([x * cos - y * sin, x * sin + y * cos])


moved = jax.jit(exact)
rates = jax.jit(jax.jacfwd(exact, argnums=(0, 1)))


@functools.partial(jax.jit, static_argnames=("order", "written_out"))
def stepped(y, h, *, order, written_out=False):
    tableau = {5: Tsit5, 8: Dopri8}[order].tableau
    return runge_kutta(tableau, spiral, y, h, written_out=written_out)


def test_the_closed_form_is_one():
    """The truth of this file solves the differential equation, from its start."""
    for t in (0.0, 0.3, 1.5):
        rate = rates(START, t)[1]
        np.testing.assert_allclose(rate, spiral(moved(START, t)), rtol=0, atol=8 * EPS)
    np.testing.assert_array_equal(moved(START, 0.0), START)


@BOTH
@pytest.mark.parametrize(("order", "counts"), [(8, (4, 5, 7)), (5, (10, 20, 40))])
def test_order(order, counts, written_out):
    """One step's error falls as h^(order + 1), that of many over a given time as h^order."""
    # From many starts: at one of them the leading term of the error may be small.
    start = 0.5 * jnp.stack([jnp.cos(jnp.arange(24.0)), jnp.sin(jnp.arange(24.0))])
    start = start * jnp.linspace(0.5, 1.3, 24)[None]
    one, all_of_them = [], []
    for n in counts:
        steps = [start]
        for _ in range(n):
            steps.append(stepped(steps[-1], 1 / n, order=order, written_out=written_out))
        one.append(np.abs(steps[1] - moved(start, 1 / n)).max())
        all_of_them.append(np.abs(steps[-1] - moved(start, 1.0)).max())
    for errors, expected in ((all_of_them, order), (one, order + 1)):
        measured = -np.diff(np.log(errors)) / np.diff(np.log(counts))
        assert (measured > expected - 0.3).all() and (measured < expected + 0.9).all(), measured


@pytest.mark.parametrize("order", [5, 8])
def test_written_out(order):
    """Loop and written-out stages agree to rounding, also in float32, and keep the type."""
    y = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 50))
    h = np.linspace(0.01, 0.4, 50)[None]
    for dtype in (np.float64, np.float32):
        one, other = (
            stepped(jnp.asarray(y, dtype), jnp.asarray(h, dtype), order=order, written_out=out)
            for out in (False, True)
        )
        assert one.dtype == other.dtype == dtype
        np.testing.assert_allclose(one, other, rtol=0, atol=8 * float(np.finfo(dtype).eps))
        np.testing.assert_array_equal(one.shape, (2, 50))


@MODES
@BOTH
def test_derivatives(mode, written_out):
    """By y and by h they are those of the motion, as far as the method is exact."""
    at = jnp.asarray(START), jnp.asarray(0.05)
    step = functools.partial(stepped, order=8, written_out=written_out)
    found = jax.jit(mode(step, argnums=(0, 1)))(*at)
    truth = rates(*at)
    np.testing.assert_allclose(found[0], truth[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found[1], truth[1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[1], spiral(moved(*at)), rtol=0, atol=1e-12)


@BOTH
def test_derivatives_of_a_coarse_step(written_out):
    """Where the method is not exact they are those of the step taken: central differences."""
    y, h, d = jnp.asarray(START), jnp.asarray(0.8), 1e-5
    step = functools.partial(stepped, order=5, written_out=written_out)
    by_y, by_h = jax.jacfwd(step, argnums=(0, 1))(y, h)
    assert np.abs(by_h - rates(y, h)[1]).max() > 1e-4
    np.testing.assert_allclose(by_h, (step(y, h + d) - step(y, h - d)) / (2 * d), atol=1e-9)
    for i, e in enumerate(d * np.eye(2)):
        np.testing.assert_allclose(
            by_y[:, i], (step(y + e, h) - step(y - e, h)) / (2 * d), atol=1e-9
        )


@BOTH
@pytest.mark.parametrize(
    ("y_shape", "h_shape"),
    [
        ((2,), ()),
        ((2, 5), ()),
        ((2, 5), (5,)),
        ((2, 5), (1, 5)),
        ((2, 1), (7,)),
        ((2, 3, 4), (3, 1)),
    ],
)
def test_broadcast(y_shape, h_shape, written_out):
    """A step of its own for every element of h, with y repeated where it must be."""
    rng = np.random.default_rng(2)
    y, h = rng.uniform(-0.7, 0.7, y_shape), np.asarray(rng.uniform(0.05, 0.3, h_shape))
    found = stepped(jnp.asarray(y), jnp.asarray(h), order=5, written_out=written_out)
    shape = np.broadcast_shapes(y_shape, h_shape)
    y, h = np.broadcast_to(y, shape), np.broadcast_to(h, shape)[0]
    assert found.shape == shape
    for index in np.ndindex(shape[1:]):
        alone = stepped(jnp.asarray(y[:, *index]), jnp.asarray(h[index]), order=5)
        np.testing.assert_allclose(found[:, *index], alone, rtol=0, atol=8 * EPS)


def test_no_step():
    """h = 0 leaves the state as it is, to the last bit."""
    for written_out in (False, True):
        y = stepped(jnp.asarray(START), 0.0, order=8, written_out=written_out)
        np.testing.assert_array_equal(y, START)
