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
from fractaljax._sweep.program import Program

jax.config.update("jax_enable_x64", True)  # another process imports this file too
SCENE = fj.brake_scene()
FIRST, SECOND = np.array([0.25, 0.5, 0.75]), np.array([0.25, 0.5, 0.75 + 1e-12])
FAR = np.array([0.75, 0.25, 0.125])  # where a measure takes integers or words from the array
FLOAT = jax.ShapeDtypeStruct((), float)


def D(scene):
    return scene.contact.surface.D


def weigh(a, x):
    return jnp.sum(jnp.cos(jnp.asarray(a) * x))


class Weight(eqx.Module):
    a: jax.Array

    def __call__(self, scene):
        return weigh(self.a, D(scene))


class Plain:
    def __init__(self, a):
        self.a = np.array(a)

    def measure(self, scene):
        return weigh(self.a, D(scene))


def jitted_within(a):
    inner = jax.jit(lambda x: weigh(a, x))
    middle = jax.jit(lambda x: 1 + inner(x))
    return jax.jit(lambda scene: middle(D(scene)))


def filter_jitted_scene(a):
    other = SCENE.replace(P=1e3 * float(a[2]))
    return eqx.filter_jit(lambda scene: fj.growth_rate(other) + D(scene))


def long_array(a):
    long = np.zeros(5000)
    long[2500] = a[2]
    return lambda scene: jnp.sum(long * D(scene))


def scanned(a):
    def step(carry, x):
        return carry + weigh(a, x), None

    return lambda scene: lax.scan(step, D(scene), jnp.arange(3.0))[0]


def branch(a):
    return lambda scene: lax.cond(D(scene) > 2.4, lambda x: weigh(a, x), jnp.sin, D(scene))


def custom_jvp(a):
    f = jax.custom_jvp(lambda x: weigh(a, x))
    f.defjvp(lambda x, t: (f(*x), t[0]))
    return lambda scene: f(D(scene))


def custom_vjp_rule(a):
    f = jax.custom_vjp(lambda x: x)
    f.defvjp(lambda x: (x, None), lambda _, g: (g * a[2],))
    return lambda scene: jax.grad(f)(D(scene))


def custom_vmap_rule(a):
    f = jax.custom_batching.custom_vmap(lambda x: x)
    f.def_vmap(lambda size, batched, x: (x * a[2], True))
    return lambda scene: f(D(scene))


def random_key(a):
    key = jax.random.key(int(4 * a[0]))
    return jax.jit(lambda scene: jax.random.normal(key) * D(scene))


def static_argument(a):
    power = jax.jit(lambda x, n: x**n, static_argnums=1)
    return lambda scene: power(D(scene), int(4 * a[0]))


def word(a):
    name = ("sin", "cos", "tan")[int(4 * a[0]) - 1]
    return lambda scene: getattr(jnp, name)(D(scene))


def dtype(a):
    kind = jnp.float32 if a[0] < a[1] else jnp.float64
    return lambda scene: D(scene).astype(kind)


def reduction(a):
    operation = lax.add if a[0] < a[1] else lax.mul
    return lambda scene: lax.reduce(jnp.arange(1.0, 4.0) * D(scene), 1.0, operation, (0,))


def negative_zero(a):
    zero = 0.0 if a[0] < a[1] else -0.0
    return lambda scene: jnp.arctan2(zero, -D(scene))


MEASURES: dict[str, Callable] = {
    "array": lambda a: lambda scene: weigh(a, D(scene)),
    "bound method": lambda a: Plain(a).measure,
    "partial": lambda a: functools.partial(lambda a, scene: weigh(a, D(scene)), jnp.asarray(a)),
    "number": lambda a: lambda scene: float(a[2]) * D(scene),
    "jitted": lambda a: jax.jit(lambda scene: weigh(a, D(scene))),
    "module": lambda a: eqx.filter_jit(Weight(jnp.asarray(a))),
    "vmapped": lambda a: lambda scene: jax.vmap(lambda x: weigh(x, D(scene)))(jnp.asarray(a)),
    "while": lambda a: (
        lambda scene: lax.while_loop(lambda x: x < 9 + a[2], lambda x: 1.5 * x, D(scene))
    ),
    "checkpoint": lambda a: lambda scene: jax.checkpoint(lambda x: weigh(a, x))(D(scene)),
    "slope": lambda a: lambda scene: jax.grad(lambda x: weigh(a, x))(D(scene)),
    "checked": lambda a: lambda scene: fj.growth_rate(scene.replace(P=1e3 * float(a[2]))),
    **{
        build.__name__: build
        for build in (jitted_within, filter_jitted_scene, long_array, scanned, branch)
    },
    **{build.__name__: build for build in (custom_jvp, custom_vjp_rule, custom_vmap_rule)},
}
WORDS: dict[str, Callable] = {
    "direction": lambda a: (
        lambda scene: lax.cumsum(jnp.arange(3.0) * D(scene), reverse=bool(a[0] < a[1]))
    ),
    **{
        build.__name__: build
        for build in (random_key, static_argument, word, dtype, reduction, negative_zero)
    },
}


def key(measure):
    return Program(measure, ("D",), SCENE, [np.array([2.4])]).key().hex()


def keys():
    return {name: key(build(FIRST)) for name, build in (MEASURES | WORDS).items()}


@pytest.mark.parametrize("name", [*MEASURES, *WORDS])
def test_what_a_measure_captures_is_in_its_key(name):
    build = (MEASURES | WORDS)[name]
    first = key(build(FIRST))
    assert key(build(FIRST)) == first != key(build(SECOND if name in MEASURES else FAR))
    assert key(build(FIRST)) == first  # whatever has been traced meanwhile


@pytest.mark.slow  # starts Python
def test_keys_of_another_process():
    """With another hash seed, other addresses, and the measures in another order."""
    program = "import json, test_program as t; t.MEASURES = dict(reversed(t.MEASURES.items()));"
    done = subprocess.run(
        [sys.executable, "-c", f"{program} print(json.dumps(t.keys()))"],
        env=os.environ | {"PYTHONHASHSEED": "7", "JAX_PLATFORMS": "cpu"},
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = keys()
    assert json.loads(done.stdout) == found
    # One program has one key, however it captures.
    assert found["array"] == found["bound method"] == found["partial"]
    assert len(set(found.values())) == len(found) - 2


def test_settings_of_jax_are_in_the_key():
    draw = jax.jit(lambda scene: jax.random.normal(jax.random.key(0), (3,)) * D(scene))
    found = {key(draw)}
    for chosen in (True, False):
        with jax.threefry_partitionable(chosen):
            found.add(key(draw))
    assert len(found) == 2
    with jax.default_matmul_precision("float32"):
        assert key(draw) not in found


def python(x):
    return jax.pure_callback(lambda x: 2 * np.asarray(x), FLOAT, x)


@pytest.mark.parametrize(
    ("measure", "name"),
    [
        (lambda scene: python(D(scene)), "pure_callback"),
        (jax.jit(lambda scene: lax.cond(D(scene) > 3, python, jnp.sin, D(scene))), "pure_callback"),
        (lambda scene: io_callback(lambda x: np.asarray(x), FLOAT, D(scene)), "io_callback"),
    ],
)
def test_callbacks_are_refused_beside_a_store(tmp_path, measure, name):
    with pytest.raises(ValueError, match=f"what its {name} does is not in the program"):
        fj.sweep(measure, SCENE, progress=False, out=tmp_path / "out", D=[2.3, 2.4])
    assert not (tmp_path / "out").exists()


def test_rules_of_what_is_not_mapped_do_not_count(tmp_path):
    """The load is no axis: what takes it is not mapped, and its rule not called."""
    for factor in (1.0, 2.0):
        f = jax.custom_batching.custom_vmap(lambda x: 3 * x)
        f.def_vmap(lambda size, batched, x, factor=factor: (factor * x, True))

        def measure(scene, f=f):
            jax.debug.callback(lambda: None)  # gives no value
            return f(scene.contact.P) + D(scene)

        found = fj.sweep(measure, SCENE, progress=False, out=tmp_path, D=[2.3, 2.4])
        np.testing.assert_allclose(found, 3 * 1907.3 + np.array([2.3, 2.4]), rtol=1e-15)


def test_callbacks_are_told_apart_in_memory():
    """One program, two functions that it calls."""
    for factor in (2, 3):

        def called(x, factor=factor):
            return factor * np.asarray(x)

        def measure(scene, called=called):
            return jax.pure_callback(called, FLOAT, D(scene), vmap_method="sequential")

        found = fj.sweep(measure, SCENE, progress=False, D=[2.3, 2.4])
        np.testing.assert_allclose(found, factor * np.array([2.3, 2.4]), rtol=1e-15)
