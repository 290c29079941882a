"""Two measures have one key exactly where they are one program, in every process."""

import functools
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.experimental import io_callback

import fractaljax as fj
from fractaljax.sweeping.program import Program

jax.config.update("jax_enable_x64", True)  # another process imports this file too
SCENE = fj.brake_scene()
FIRST, SECOND = np.array([0.25, 0.5, 0.75]), np.array([0.25, 0.5, 0.75 + 1e-12])
FAR = np.array([0.75, 0.25, 0.125])  # where a measure takes whole numbers or words from the array
MEASURES: dict[str, Callable] = {}


def kind(build):
    MEASURES[build.__name__] = build
    return build


def D(scene):
    return scene.contact.surface.D


def weigh(a, x):
    return jnp.sum(jnp.cos(a * x))


class Weight(eqx.Module):
    a: jax.Array

    def __call__(self, scene):
        return weigh(self.a, D(scene))


class Plain:
    def __init__(self, a):
        self.a = np.array(a)

    def measure(self, scene):
        return weigh(self.a, D(scene))


@kind
def array(a):
    return lambda scene: weigh(a, D(scene))


@kind
def number(a):
    return lambda scene: float(a[2]) * D(scene)


@kind
def jitted(a):
    a = jnp.asarray(a)
    return jax.jit(lambda scene: weigh(a, D(scene)))


@kind
def jitted_within(a):
    inner = jax.jit(lambda x: weigh(jnp.asarray(a), x))
    middle = jax.jit(lambda x: 1 + inner(x))
    return jax.jit(lambda scene: middle(D(scene)))


@kind
def filter_jitted_scene(a):
    other = SCENE.replace(P=1e3 * float(a[2]))
    return eqx.filter_jit(lambda scene: fj.growth_rate(other) + D(scene))


@kind
def module(a):
    return eqx.filter_jit(Weight(jnp.asarray(a)))


@kind
def bound_method(a):
    return Plain(a).measure


@kind
def partial(a):
    return functools.partial(lambda a, scene: weigh(a, D(scene)), jnp.asarray(a))


@kind
def long_array(a):
    long = np.zeros(5000)
    long[2500] = a[2]
    return lambda scene: jnp.sum(long * D(scene))


@kind
def vmapped(a):
    return lambda scene: jax.vmap(lambda x: weigh(x, D(scene)))(jnp.asarray(a))


@kind
def scanned(a):
    def step(carry, x):
        return carry + weigh(jnp.asarray(a), x), None

    return lambda scene: lax.scan(step, D(scene), jnp.arange(3.0))[0]


@kind
def while_condition(a):
    return lambda scene: lax.while_loop(lambda x: x < 9 + a[2], lambda x: 1.5 * x, D(scene))


@kind
def branch(a):
    return lambda scene: lax.cond(
        D(scene) > 2.4, lambda x: weigh(jnp.asarray(a), x), lambda x: x, D(scene)
    )


@kind
def custom_jvp(a):
    @jax.custom_jvp
    def f(x):
        return weigh(jnp.asarray(a), x)

    f.defjvp(lambda x, t: (f(*x), t[0]))
    return lambda scene: f(D(scene))


@kind
def custom_vjp_rule(a):
    @jax.custom_vjp
    def f(x):
        return x

    f.defvjp(lambda x: (x, None), lambda _, g: (g * a[2],))
    return lambda scene: jax.grad(f)(D(scene))


@kind
def custom_vmap_rule(a):
    @jax.custom_batching.custom_vmap
    def f(x):
        return x

    @f.def_vmap
    def _(size, batched, x):
        return x * a[2], True

    return lambda scene: f(D(scene))


@kind
def checkpoint(a):
    return lambda scene: jax.checkpoint(lambda x: weigh(jnp.asarray(a), x))(D(scene))


@kind
def slope(a):
    return lambda scene: jax.grad(lambda x: weigh(jnp.asarray(a), x))(D(scene))


@kind
def checked(a):
    return lambda scene: fj.growth_rate(scene.replace(P=scene.contact.P * float(a[2])))


@kind
def random_key(a):
    key = jax.random.key(int(4 * a[0]))
    return jax.jit(lambda scene: jax.random.normal(key) * D(scene))


@kind
def static_argument(a):
    power = jax.jit(lambda x, n: x**n, static_argnums=1)
    return lambda scene: power(D(scene), int(4 * a[0]))


@kind
def word(a):
    name = ("sin", "cos", "tan")[int(4 * a[0]) - 1]
    return lambda scene: getattr(jnp, name)(D(scene))


@kind
def dtype(a):
    kind = jnp.float32 if a[0] < a[1] else jnp.float64
    return lambda scene: D(scene).astype(kind)


@kind
def direction(a):
    return lambda scene: lax.cumsum(jnp.arange(3.0) * D(scene), reverse=bool(a[0] < a[1]))


@kind
def reduction(a):
    operation = lax.add if a[0] < a[1] else lax.mul
    return lambda scene: lax.reduce(jnp.arange(1.0, 4.0) * D(scene), 1.0, operation, (0,))


@kind
def negative_zero(a):
    zero = 0.0 if a[0] < a[1] else -0.0
    return lambda scene: jnp.arctan2(zero, -D(scene))


WHOLE = (random_key, static_argument, word, dtype, direction, reduction, negative_zero)


def key(measure):
    return Program(measure, ("D",), SCENE, [np.array([2.4])]).key().hex()


def keys():
    return {name: key(build(FIRST)) for name, build in MEASURES.items()}


@pytest.mark.parametrize("name", MEASURES)
def test_what_a_measure_captures_is_in_its_key(name):
    build = MEASURES[name]
    other = FAR if build in WHOLE else SECOND
    first = key(build(FIRST))
    assert key(build(FIRST)) == first != key(build(other))
    assert key(build(FIRST)) == first  # whatever has been traced meanwhile


def test_keys_of_another_process():
    """With other seeds of hashing, other places in memory, and the measures in another order."""
    here = Path(__file__)
    program = "import json, test_program as t; t.MEASURES = dict(reversed(t.MEASURES.items()));"
    done = subprocess.run(
        [sys.executable, "-c", f"{program} print(json.dumps(t.keys()))"],
        env=os.environ | {"PYTHONHASHSEED": "7", "JAX_PLATFORMS": "cpu"},
        cwd=here.parent,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == keys()


def test_one_program_has_one_key_however_it_captures():
    found = keys()
    assert found["array"] == found["bound_method"] == found["partial"]
    assert len(set(found.values())) == len(found) - 2


def test_settings_of_jax_are_in_the_key():
    draw = jax.jit(lambda scene: jax.random.normal(jax.random.key(0), (3,)) * D(scene))
    plain = key(draw)
    found = set()
    for chosen in (True, False):
        with jax.threefry_partitionable(chosen):
            found.add(key(draw))
    assert len(found) == 2 and plain in found
    with jax.default_matmul_precision("float32"):
        assert key(draw) != plain


def python(x):
    return jax.pure_callback(lambda x: 2 * np.asarray(x), jax.ShapeDtypeStruct((), float), x)


@pytest.mark.parametrize(
    ("measure", "name"),
    [
        (lambda scene: python(D(scene)), "pure_callback"),
        (jax.jit(lambda scene: lax.cond(D(scene) > 3, python, jnp.sin, D(scene))), "pure_callback"),
        (
            lambda scene: io_callback(
                lambda x: np.asarray(x), jax.ShapeDtypeStruct((), float), D(scene)
            ),
            "io_callback",
        ),
    ],
)
def test_what_cannot_be_told_is_refused(tmp_path, measure, name):
    with pytest.raises(ValueError) as error:
        fj.sweep(measure, SCENE, progress=False, out=tmp_path / "out", D=[2.3, 2.4])
    assert str(error.value) == (
        f"out needs a measure that JAX traces as a whole: what its {name} does is not in the"
        " program"
    )
    assert not (tmp_path / "out").exists()


def test_rules_of_what_is_not_mapped_do_not_count(tmp_path):
    """The load is no axis: what it is given to is not mapped, and its rule not called."""
    for factor in (1.0, 2.0):
        f = jax.custom_batching.custom_vmap(lambda x: 3 * x)
        f.def_vmap(lambda size, batched, x, factor=factor: (factor * x, True))
        found = fj.sweep(
            lambda scene, f=f: f(scene.contact.P) + D(scene),
            SCENE,
            progress=False,
            out=tmp_path,
            D=[2.3, 2.4],
        )
        np.testing.assert_allclose(found, 3 * 1907.3 + np.array([2.3, 2.4]), rtol=1e-15)


def test_what_is_only_shown_is_not(tmp_path, capfd):
    def shown(scene):
        jax.debug.callback(lambda: None)
        return D(scene)

    found = fj.sweep(shown, SCENE, progress=False, out=tmp_path, D=[2.3, 2.4])
    np.testing.assert_array_equal(found, [2.3, 2.4])


def test_callbacks_are_told_apart_in_memory():
    """One program, two functions that it calls."""

    def calling(factor):
        def called(x):
            return factor * np.asarray(x)

        return lambda scene: jax.pure_callback(
            called, jax.ShapeDtypeStruct((), float), D(scene), vmap_method="sequential"
        )

    for factor in (2, 3):
        found = fj.sweep(calling(factor), SCENE, progress=False, D=[2.3, 2.4])
        np.testing.assert_allclose(found, factor * np.array([2.3, 2.4]), rtol=1e-15)
