"""Programs compiled quickly where JAX allows it."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
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


def inside(f):
    return lambda x: jax.jit(jax.vmap(f))(x)


@pytest.mark.parametrize(
    ("transformed", "outermost"),
    [
        (jax.vmap, True),
        (lambda f: jax.vmap(jax.jacfwd(f)), True),
        (lambda f: lambda x: jax.jvp(jax.vmap(f), (x,), (x,)), True),
        (inside, False),
        (lambda f: lambda x: jax.lax.map(f, x), False),
        (lambda f: jax.vmap(jax.grad(f)), False),
        (lambda f: jax.vmap(jax.hessian(f)), False),
        (lambda f: jax.vmap(jax.jacrev(jax.jacfwd(f))), False),
        (lambda f: jax.vmap(jax.checkpoint(f)), False),
        (lambda f: lambda x: jax.jit(jax.vjp(jax.vmap(f), x)[1])(x), False),
        (lambda f: lambda x: jax.jit(jax.linearize(jax.vmap(f), x)[1])(x), False),
    ],
)
def test_a_transformed_program_is_outermost_where_it_is_compiled_at_once(
    transformed, outermost, monkeypatch
):
    """With an option that XLA does not know, it is seen where JAX is given the options."""
    x = jnp.arange(3.0)
    expected = transformed(lambda x: x**2)(x)
    monkeypatch.setattr(quick, "_OWN", {"xla_no_such_option": True})
    monkeypatch.setattr(quick, "_available", lambda: True)
    found = transformed(quick.quick_jit(lambda x: x**2))
    if outermost:
        with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such_option"):
            found(x)
    else:
        jax.tree.map(np.testing.assert_array_equal, found(x), expected)
