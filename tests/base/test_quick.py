"""Programs compiled quickly where JAX allows it."""

import functools
import inspect

import jax
import jax.numpy as jnp
import pytest

from fractaljax._base import quick


@pytest.mark.parametrize("known", [True, False])
def test_options_are_for_the_outermost_program_only(known, monkeypatch):
    """JAX refuses them inside of another one, and XLA those that it does not know."""
    if not known:
        monkeypatch.setattr(quick, "_OPTIONS", {"xla_no_such_option": True})
    asked = functools.cache(inspect.unwrap(quick._available))  # conftest says no to all others
    monkeypatch.setattr(quick, "_available", asked)
    square = quick.quick_jit(lambda x: x**2)
    expected = known and jax.default_backend() == "cpu"
    assert quick._available() == expected
    assert quick.quick_compilation() == (quick._OPTIONS if expected else {})
    assert jax.jit(square, compiler_options=quick.quick_compilation())(3.0) == 9
    x = jnp.arange(3.0)
    assert float(square(3.0)) == 9
    assert (jax.vmap(square)(x) == x**2).all()
    assert (jax.jit(lambda x: square(x) + square(2.0))(x) == x**2 + 4).all()
    for gradient in (jax.grad(square), jax.jit(jax.grad(square)), jax.jacfwd(square)):
        assert float(gradient(3.0)) == 6
