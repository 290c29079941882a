"""One step of diffrax's tableaus: its order, derivatives, shapes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from diffrax import Dopri8, Tsit5

from fractaljax._dynamics.runge_kutta import runge_kutta

EPS = np.finfo(float).eps
START = np.array([0.6, -0.3])


def spiral(y):
    """With s the square of the radius, ds/dt = 2 s (1 - s), and the angle grows at the rate s."""
    x, y = y
    s = x**2 + y**2
    return jnp.stack([x * (1 - s) - s * y, y * (1 - s) + s * x])


@jax.jit
def exact(y, t):
    """The motion of the spiral from y, in closed form."""
    x, y = y
    s = x**2 + y**2
    growth = 1 + s * jnp.expm1(2 * t)
    radius, angle = jnp.exp(t) / jnp.sqrt(growth), 0.5 * jnp.log(growth)
    cos, sin = radius * jnp.cos(angle), radius * jnp.sin(angle)
    return jnp.stack([x * cos - y * sin, x * sin + y * cos])


rates = jax.jit(jax.jacfwd(exact, argnums=(0, 1)))


@functools.partial(jax.jit, static_argnames="order")
def stepped(y, h, *, order):
    tableau = {5: Tsit5, 8: Dopri8}[order].tableau
    return runge_kutta(tableau, spiral, y, h)


@pytest.mark.parametrize(("order", "counts"), [(8, (4, 5, 7)), (5, (10, 20, 40))])
def test_order(order, counts):
    """One step's error falls as h^(order + 1), that of many over a given time as h^order."""
    np.testing.assert_allclose(rates(START, 0.3)[1], spiral(exact(START, 0.3)), atol=8 * EPS)
    # From many starts: at one of them the leading term of the error may be small.
    start = 0.5 * jnp.stack([jnp.cos(jnp.arange(24.0)), jnp.sin(jnp.arange(24.0))])
    start = start * jnp.linspace(0.5, 1.3, 24)[None]
    one, many = [], []
    for n in counts:
        steps = [start]
        for _ in range(n):
            steps.append(stepped(steps[-1], 1 / n, order=order))
        one.append(np.abs(steps[1] - exact(start, 1 / n)).max())
        many.append(np.abs(steps[-1] - exact(start, 1.0)).max())
    for errors, expected in ((many, order), (one, order + 1)):
        measured = -np.diff(np.log(errors)) / np.diff(np.log(counts))
        assert (measured > expected - 0.3).all() and (measured < expected + 0.9).all(), measured


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(
    ("y_shape", "h_shape"), [((2,), ()), ((2, 5), (1, 5)), ((2, 1), (7,)), ((2, 3, 4), (3, 1))]
)
def test_shapes(y_shape, h_shape, dtype):
    """A step of its own for every element of h; h = 0 changes no bit."""
    rng = np.random.default_rng(2)
    y = jnp.asarray(rng.uniform(-0.7, 0.7, y_shape), dtype)
    h = jnp.asarray(rng.uniform(0.05, 0.3, h_shape), dtype)
    one, shape = stepped(y, h, order=5), np.broadcast_shapes(y_shape, h_shape)
    assert one.shape == shape and one.dtype == dtype
    y, h = np.broadcast_to(y, shape), np.broadcast_to(h, shape)[0]
    for index in [(0,) * len(shape[1:]), (-1,) * len(shape[1:])]:
        alone = stepped(jnp.asarray(y[:, *index]), jnp.asarray(h[index]), order=5)
        np.testing.assert_allclose(one[:, *index], alone, atol=8 * float(np.finfo(dtype).eps))
        nothing = stepped(jnp.asarray(y[:, *index]), jnp.zeros_like(h[index]), order=5)
        np.testing.assert_array_equal(nothing, y[:, *index])


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives(mode):
    """By y and by h: of the motion where the step is exact, of the step where it is coarse."""
    at = jnp.asarray(START), jnp.asarray(0.05)
    step = functools.partial(stepped, order=8)
    found = jax.jit(mode(step, argnums=(0, 1)))(*at)
    for slope, truth in zip(found, rates(*at), strict=True):
        np.testing.assert_allclose(slope, truth, rtol=0, atol=1e-12)
    y, h, d = jnp.asarray(START), jnp.asarray(0.8), 1e-5
    step = functools.partial(stepped, order=5)
    by_y, by_h = jax.jit(mode(step, argnums=(0, 1)))(y, h)
    assert np.abs(by_h - rates(y, h)[1]).max() > 1e-4
    np.testing.assert_allclose(by_h, (step(y, h + d) - step(y, h - d)) / (2 * d), atol=1e-9)
    columns = [(step(y + e, h) - step(y - e, h)) / (2 * d) for e in d * np.eye(2)]
    np.testing.assert_allclose(by_y, np.array(columns).T, atol=1e-9)
