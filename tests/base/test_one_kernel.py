"""Functions as one kernel of XLA: the same numbers, whatever optimisation makes of arguments."""

import functools
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._base import one_kernel as module
from fractaljax._base.one_kernel import one_kernel
from mechanisms import PROBLEMS
from structures import of_problem

ROWS = jnp.zeros((2, 40))
STATE, RATES, UNUSED = jnp.array([1.0, 0.5]), {"a": 0.3, "b": 7}, jnp.array([True, False])
ON_A_CPU = jax.default_backend() == "cpu"


@pytest.fixture(autouse=True)
def optimised():
    """XLA as users have it: what it makes of an argument without a use is to be seen here."""
    jax.config.update("jax_disable_most_optimizations", False)  # the next test sets its own


def filled(rows, y, rates, _, wise=jnp.sin):
    """Rows of a motion step by step, with a branch, a reduction and an argument to no end."""
    never = jnp.where(jnp.zeros((), bool), rates["b"], 0)

    def step(k, carry):
        rows, y = carry
        move = jax.lax.cond(y[0] > 0, lambda y: -wise(y), jnp.cos, y)
        y = y + rates["a"] * (move - y) / (1 + jnp.max(jnp.abs(y))) + never
        return jax.lax.dynamic_update_index_in_dim(rows, y, k, 1), y

    return jax.lax.fori_loop(0, rows.shape[1], step, (rows, y))


def kernels(function, *given) -> int:
    """How many calls of an optimised program are to be one kernel."""
    compiled = jax.jit(lambda *x: function(*x)).lower(*given).compile()
    return (compiled.as_text() or "").count('inlineable="false"')


GIVEN = ROWS, STATE, RATES, UNUSED


def inside(*given, wise=jnp.sin):
    return one_kernel(functools.partial(filled, wise=wise), *given)


def end(function):
    return lambda y: function(ROWS, y, RATES, UNUSED)[1]


def test_the_same_numbers():
    for run in (jax.jit(inside), inside):
        for own, plain in zip(run(*GIVEN), filled(*GIVEN), strict=True):
            np.testing.assert_allclose(own, plain, rtol=1e-13)

    many = jnp.stack([STATE, 2 * STATE])
    for changed in (jax.vmap, lambda f: jax.vmap(jax.jacfwd(f)), lambda f: jax.vmap(jax.jacrev(f))):
        own, plain = (jax.jit(changed(end(f)))(many) for f in (inside, filled))
        np.testing.assert_allclose(own, plain, rtol=1e-13)


def test_one_kernel_where_xla_can():
    """Not of an operation of a library, nor by a version that nobody has looked at."""
    assert (kernels(inside, *GIVEN) > 0) == ON_A_CPU
    for slope in (jax.jacfwd(end(inside)), jax.value_and_grad(lambda y: end(inside)(y)[0])):
        assert (kernels(slope, STATE) > 0) == ON_A_CPU

    def much(y):
        return y * jnp.sum(jnp.sin(y[:, None] * jnp.arange(3000.0)[None]))

    def large(y):
        return y + jnp.max(jnp.arange(2**17) * y[0].astype(int))

    def told(y):
        jax.debug.callback(lambda _: None, y, ordered=True)
        return y

    for wise in (jnp.sort, much, large, told):
        assert kernels(functools.partial(inside, wise=wise), *GIVEN) == 0


def test_many_at_once_are_left_to_several_threads():
    def few(x):
        return one_kernel(lambda x: jnp.sin(x) * x, x, largest=8)

    assert (kernels(jax.vmap(few), jnp.ones(8)) > 0) == ON_A_CPU
    assert kernels(jax.vmap(few), jnp.ones(9)) == 0


def test_a_result_without_a_use():
    """XLA is asked of those that have one; what a kernel is for nothing else is not computed."""

    def both(x):
        return one_kernel(lambda x: (jnp.sin(x), jnp.cos(x)), x)[1]

    assert (kernels(both, STATE) > 0) == ON_A_CPU
    assert "sine" not in jax.jit(both).lower(STATE).as_text().replace("cosine", "")


def test_what_is_changed_in_a_part_is_not_copied():
    """In a loop around the kernel, as that of a run, which takes less time than a copy."""

    def run(rows, y, changed):
        def body(_, carry):
            return one_kernel(filled, *carry, RATES, UNUSED, changed=changed)

        return jax.lax.fori_loop(0, 5, body, (rows, y))

    def copies(changed):
        compiled = jax.jit(lambda rows, y: run(rows, y, changed)).lower(ROWS, STATE).compile()
        return len(re.findall(r"f64\[2,40\]\S* copy\(", compiled.as_text() or ""))

    if ON_A_CPU:
        assert copies(0) == copies(1) + 2
    assert (kernels(lambda rows, y: run(rows, y, 1), ROWS, STATE) > 0) == ON_A_CPU
    np.testing.assert_allclose(run(ROWS, STATE, 1)[0], run(ROWS, STATE, 0)[0], rtol=1e-13)

    def ending(y, changed):
        return one_kernel(filled, ROWS, y, RATES, UNUSED, changed=changed)[1]

    for slope in (jax.jacfwd, jax.jacrev):
        changed, plain = (jax.jit(slope(ending), static_argnums=1)(STATE, n) for n in (1, 0))
        np.testing.assert_allclose(changed, plain, rtol=1e-13)


def unused(x, a):
    return x * jnp.sin(x) + jnp.where(jnp.zeros((), bool), a, 0)


def sliced(x, a):
    return jax.lax.dynamic_slice(x * jnp.sin(x), (a.astype(int),), x.shape)


@pytest.mark.parametrize("function", [unused, sliced, lambda x, _: x * jnp.sin(x)])
def test_arguments_without_a_use(function):
    """XLA would end the process."""

    def run(x):
        return one_kernel(function, x, jnp.sum(x))

    def along(f):
        return lambda x: jax.jvp(f, (x,), (2 * x,))

    for changed in (lambda f: f, along, jax.jacfwd, jax.jacrev, jax.hessian):
        np.testing.assert_allclose(
            jax.jit(changed(run))(STATE), changed(lambda x: x * jnp.sin(x))(STATE), rtol=1e-13
        )


@pytest.mark.slow
def test_what_is_known_when_it_compiles():
    """XLA would put constants into the kernel, whose arguments lack a use then: it would end."""
    problem = PROBLEMS["released"]
    structure, start = of_problem(problem), jnp.asarray(problem["start"])

    def everything(x):
        changed = eqx.tree_at(lambda s: s.K, structure, structure.K * x)
        cycle = fj.limit_cycle(changed, start, segments=64, throw=False)
        return [x for x in jax.tree.leaves(cycle) if eqx.is_inexact_array(x)]

    for own, apart in zip(jax.jit(everything)(1.0), everything(1.0), strict=True):
        np.testing.assert_allclose(own, apart, rtol=1e-9, atol=1e-12)


def test_a_later_version_is_left_alone(monkeypatch):
    monkeypatch.setattr(module, "_BEYOND", module._FIRST)
    assert kernels(inside, *GIVEN) == 0


@pytest.mark.parametrize("empty", [jnp.zeros(0), ()])
def test_without_numbers(empty):
    found = one_kernel(lambda rows, y, _: rows + y[:, None], ROWS, STATE, empty)
    np.testing.assert_array_equal(found, ROWS + STATE[:, None])


@pytest.mark.slow
@pytest.mark.parametrize(("mechanism", "left"), [("scene", 0), ("second_face", 1)])
def test_a_limit_cycle_is_made_of_kernels(mechanism, left):
    """All that was meant to be one is, but a structure's eigenvalues, which are a library's."""
    mechanism = fj.brake_scene() if mechanism == "scene" else of_problem(PROBLEMS[mechanism])
    cycle = jax.jit(lambda x: fj.limit_cycle(x, throw=False))
    text = cycle.lower(mechanism).as_text()
    asked, all_calls = text.count('xla_cpu_small_call = "true"'), text.count("call @kernel")
    assert all_calls > 8
    assert asked == (all_calls - left if ON_A_CPU else 0)
