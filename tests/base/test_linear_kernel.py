"""Linear functions with parameters: derivatives of every kind are those of the plain function."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._base.linear_kernel import linear_kernel
from fractaljax._dynamics.orbit import orbit

GIVEN = {"a": jnp.array([0.3, -1.2, 0.8]), "k": jnp.array([2, 0, 1]), "on": jnp.array(True)}
VECTOR = jnp.array([0.5, -0.7, 1.1]), jnp.array(0.4)


def plain(given, vector):
    """By a loop, a choice and a function of the parameters alone."""
    a, k = given["a"], given["k"]
    v, shift = vector
    b = jnp.sin(a) * jnp.where(given["on"], a[k], 1) / (1 + jnp.max(a**2))

    def step(v, x):
        v = b * jnp.roll(v, 1) + x * v + shift * jnp.cos(x)
        return v, jnp.sum(v * a)

    return dict(zip("vs", jax.lax.scan(step, v, a), strict=True))


def own(given, vector):
    return linear_kernel(plain, given, vector)


def with_a(function, a, vector=VECTOR):
    return function(GIVEN | {"a": a}, vector)


def number(function, a, vector=VECTOR):
    found = with_a(function, a, vector)
    return jnp.sum(found["v"] ** 2) + jnp.sum(jnp.sin(found["s"]))


def products(function, a):
    """Many vectors at once, one part of them alone, and one of the results without a use."""
    v, shift = VECTOR
    by_v = jax.vmap(lambda v: function(GIVEN | {"a": a}, (v, shift))["s"])(
        jnp.outer(jnp.arange(3), v)
    )
    by_shift = jax.grad(lambda shift: number(function, a, (v, shift)))(shift)
    _, transposed = jax.vjp(lambda v: with_a(function, a, v), VECTOR)
    return by_v, by_shift, transposed({"v": v, "s": jnp.cos(v)})


CASES = {
    "value": with_a,
    "forward": lambda f, a: jax.jacfwd(functools.partial(with_a, f), argnums=(0, 1))(a, VECTOR),
    "reverse": lambda f, a: jax.jacrev(functools.partial(with_a, f), argnums=(0, 1))(a, VECTOR),
    "second": lambda f, a: jax.hessian(functools.partial(number, f), argnums=(0, 1))(a, VECTOR),
    "reverse twice": lambda f, a: jax.jacrev(jax.grad(functools.partial(number, f)))(a),
    "third": lambda f, a: jax.jacfwd(jax.hessian(functools.partial(number, f)))(a),
    "many": lambda f, a: jax.vmap(jax.grad(functools.partial(number, f)))(jnp.stack([a, 2 * a])),
    "products": products,
}


@pytest.mark.parametrize("case", CASES)
def test_the_same_numbers(case):
    expected = CASES[case](plain, GIVEN["a"])
    for run in (functools.partial(CASES[case], own), jax.jit(functools.partial(CASES[case], own))):
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=1e-12), run(GIVEN["a"]), expected
        )


def test_reverse_mode_is_one_more_function():
    """Nothing of it is computed ahead, and its transpose is of the same kind."""
    jaxpr = jax.make_jaxpr(jax.grad(lambda v: jnp.sum(with_a(own, GIVEN["a"], v)["v"])))(VECTOR)
    names = [equation.primitive.name for equation in jaxpr.eqns]
    assert names.count("linear_kernel") == 2
    assert not {"scan", "sin", "jit", "pjit"} & set(names)


@pytest.mark.slow
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels are of XLA on a CPU")
def test_the_derivative_of_an_orbit_is_one_kernel():
    """Which has no scatter, as the transpose of a look-up."""
    cycle = fj.limit_cycle(fj.brake_scene())

    def period(system):
        return jnp.sum(orbit(system, cycle._orbit.segments)[1])

    for slope in (jax.grad(period), lambda system: jax.jvp(period, (system,), (system,))):
        program = jax.jit(slope).lower(cycle._system).as_text()
        assert program.count('inlineable = "false"') == 1
