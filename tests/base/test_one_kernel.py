"""Loops as one kernel of XLA: the same numbers, whatever optimisation makes of the arguments."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fractaljax._base import one_kernel as module
from fractaljax._base.one_kernel import one_kernel

ROWS = jnp.zeros((2, 40))
STATE, RATES, UNUSED = jnp.array([1.0, 0.5]), {"a": 0.3, "b": 7}, jnp.array([True, False])


def filled(rows, y, rates, _, wise=jnp.sin):
    """Rows of a motion step by step, with a branch, a reduction and an argument to no end."""
    never = jnp.where(jnp.zeros((), bool), rates["b"], 0)

    def step(k, carry):
        rows, y = carry
        move = jax.lax.cond(y[0] > 0, lambda y: -wise(y), jnp.cos, y)
        y = y + rates["a"] * (move - y) / (1 + jnp.max(jnp.abs(y))) + never
        return jax.lax.dynamic_update_index_in_dim(rows, y, k, 1), y

    return jax.lax.fori_loop(0, rows.shape[1], step, (rows, y))


def kernels(function, *arguments) -> int:
    """How many calls of an optimised program are to be one kernel."""
    compiled = jax.jit(lambda *given: one_kernel(function, *given)).lower(*arguments).compile()
    return (compiled.as_text() or "").count('inlineable="false"')


GIVEN = ROWS, STATE, RATES, UNUSED


def test_the_same_numbers():
    def inside(*given):
        return one_kernel(filled, *given)

    for run in (jax.jit(inside), inside):
        for own, plain in zip(run(*GIVEN), filled(*GIVEN), strict=True):
            np.testing.assert_allclose(own, plain, rtol=1e-13)

    def end(function):
        return lambda y: function(ROWS, y, RATES, UNUSED)[1]

    many = jnp.stack([STATE, 2 * STATE])
    for changed in (jax.vmap, lambda f: jax.vmap(jax.jacfwd(f)), lambda f: jax.vmap(jax.jacrev(f))):
        own, plain = (jax.jit(changed(end(f)))(many) for f in (inside, filled))
        np.testing.assert_allclose(own, plain, rtol=1e-13)


def test_one_kernel_where_xla_can():
    """Not of an operation of a library, nor by a version that nobody has looked at."""
    on_a_cpu = jax.default_backend() == "cpu"
    assert (kernels(filled, *GIVEN) > 0) == on_a_cpu

    def much(y):
        return y * jnp.sum(jnp.sin(y[:, None] * jnp.arange(1000.0)[None]))

    for wise in (jnp.sort, much):
        assert kernels(functools.partial(filled, wise=wise), *GIVEN) == 0


def test_a_later_version_is_left_alone(monkeypatch):
    monkeypatch.setattr(module, "_BEYOND", module._FIRST)
    assert kernels(filled, *GIVEN) == 0


@pytest.mark.parametrize("empty", [jnp.zeros(0), ()])
def test_without_numbers(empty):
    found = one_kernel(lambda rows, y, _: rows + y[:, None], ROWS, STATE, empty)
    np.testing.assert_array_equal(found, ROWS + STATE[:, None])
