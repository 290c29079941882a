"""Parts: checked numbers, frozen pytrees, named quantities and how they are changed."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._base.parts import (
    Part,
    brief,
    concrete,
    flag,
    leaf,
    nan_where,
    number,
    ordered,
    quantities,
    quantity,
    rebuild,
    refused,
    require_kind,
    require_scalar,
    scalar,
    substitute,
    whole,
)
from tools import refusals

SURFACE = fj.Surface(2.4, 1.342e-10)
MATERIAL = fj.Material(1.154e11, 0.3, 3.55e8, 9.94e8)
CONTACT = fj.FractalContact(SURFACE, MATERIAL, 1907.3)
PARTS = [
    CONTACT,
    fj.FractalContact(SURFACE, MATERIAL, 1907.3, 0.5),
    fj.FixedContact(4e8, 2e8),
    fj.Coulomb(0.4),
    fj.Stribeck(0.4, 0.25, 0.5),
    fj.brake_scene(),
    fj.brake_scene().oscillator,
]
STATE = fj.contact_state(SURFACE, MATERIAL, 1907.3, mu_s=0.4, mu_m=0.25)


def same(a, b):
    """Two trees of one structure with equal leaves of equal types."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        (2, np.float64),
        (np.int32(2), np.float64),
        (np.float32(2), np.float32),
        (jnp.bfloat16(2), jnp.bfloat16),
        (np.array([1, 2]), np.float64),
        (np.ones((2, 3), np.float32), np.float32),
    ],
)
def test_number_keeps_floats_and_converts_integers(value, dtype):
    """A float array keeps its dtype and shape; all else becomes the default float, never weak."""
    array = number("x", value)
    assert (array.dtype, array.shape) == (dtype, np.shape(value))
    assert not jnp.zeros_like(array).weak_type
    np.testing.assert_array_equal(array, value)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_number_is_the_identity_to_derivatives(mode):
    """Also at a bound of its domain."""
    for f in (mode(lambda x: number("x", x, at_least=0)), jax.jit(mode(lambda x: number("x", x)))):
        assert f(0.0) == f(0.7) == 1.0


NO_NUMBERS: list[Any] = ["1", None, True, np.False_, 1j, [1.0], {}, object, 10**400]
NO_NUMBERS += [np.array("a"), np.ma.masked]
ONE, TWO = jnp.array(1.0), jnp.array([1.0, 2.0])
BELOW = jax.jit(lambda x: number("x", x, below=1))


test_refusals = refusals(
    [
        (lambda: number("x", 1.0, above=1), r"^x must be above 1, got 1\.0$"),
        (lambda: number("x", 1.0, at_least=1.5), r"^x must be at least 1\.5, got 1\.0$"),
        (lambda: number("x", TWO, above=0, at_most=1), r"^x .* above 0 and at most 1, got 2\.0$"),
        *((lambda x=x: number("x", x), f"^x must be finite, got {x!r}$") for x in (np.nan, np.inf)),
        *((lambda x=x: number("x", x), "^x must be a") for x in NO_NUMBERS),
        (lambda: scalar("x", TWO), r"^x must be a single number, got shape \(2,\)$"),
        (lambda: ordered("a", ONE, "b", TWO), r"^a must be at least b = 2\.0, got 1\.0$"),
        *(
            (lambda x=x: flag("f", x), "^f must be True or")
            for x in ("no", 0, None, jnp.array(True))
        ),
        *(
            (lambda x=x: whole("n", x, 1), "^n must be a whole number of at least 1, got")
            for x in (0, 1.5, np.nan, True, "4", [4], None)
        ),
        (lambda: whole("n", 10**30, 1, 5), "^n must be a whole number of at most 5, got 1000"),
        (lambda: require_kind("o", 3, fj.Oscillator), "^o must be an Oscillator, got 3$"),
        (lambda: rebuild(CONTACT, {"D": 3.5}), r"^D must be above 2 and below 3, got 3\.5$"),
        (lambda: rebuild(CONTACT, {"surface": 2.4}), "^surface must be a Surface"),
        (lambda: substitute(CONTACT, {"nonsense": ONE}), "nonsense"),
        (lambda: require_scalar(rebuild(CONTACT, {"G": TWO})), r"^G must be a scalar.*jax\.vmap"),
    ],
    kind=(ValueError, TypeError, KeyError),
)


def test_what_is_traced_becomes_nan_and_is_found():
    """Each number by itself, with its derivative, and nothing else in the batch."""
    half, nan = jnp.array([0.5, 1.0]), np.nan
    np.testing.assert_array_equal(BELOW(half), [0.5, nan])
    np.testing.assert_array_equal(jax.vmap(BELOW)(half), [0.5, nan])
    np.testing.assert_array_equal([BELOW(x) for x in (nan, jnp.inf, -0.5)], [nan, nan, -0.5])
    slope = jax.vmap(jax.grad(lambda x: BELOW(x) ** 2))
    np.testing.assert_array_equal(slope(half), [1.0, nan])
    above = jax.jit(lambda x, other: ordered("a", x, "b", other))
    np.testing.assert_array_equal(above(TWO, jnp.array([1.5, 1.5])), [nan, 2.0])
    np.testing.assert_array_equal([above(ONE, TWO), above(ONE, TWO / 2)], [nan, 1.0])
    integers = {"whole": jnp.array([1, 2]), "real": ONE, "none": None}
    found = nan_where(True, integers)
    assert found["whole"] is integers["whole"] and np.isnan(found["real"])
    assert nan_where(False, jnp.float32(3)).dtype == np.float32
    unbounded = jnp.array([complex(1, np.inf), 1j])
    np.testing.assert_array_equal(nan_where(False, unbounded), unbounded)
    assert np.isnan(nan_where(jnp.array([True, True]), unbounded).imag).all()
    # Among traced numbers alone: those that are known were checked at once.
    assert refused((SURFACE, 1.0)) is None
    found = jax.jit(lambda x, k: refused((x, k, SURFACE)))
    assert found(jnp.array([1.0, np.nan]), 1) and not found(TWO, 1)


def test_what_is_accepted():
    assert number("x", 1.0, at_least=1, at_most=1) == 1.0
    assert ordered("a", TWO, "b", ONE) is TWO
    assert flag("f", np.True_) is True
    assert [whole("n", x, 1) for x in (3, 3.0, np.int8(3), jnp.array(3))] == [3] * 4
    assert brief([1] * 1000) == f"[{'1, ' * 25}1..." and brief(10**5000) == "a very large integer"
    for part in PARTS:
        require_scalar(part)
    jax.vmap(lambda G: require_scalar(rebuild(CONTACT, {"G": G})))(TWO)


def test_what_is_known_stays_known_at_trace_time():
    """Quantities that are no argument of a program have values, and are refused at once."""
    known = []

    @jax.jit
    def look(D):
        surface = fj.Surface(D, 1e-10, gamma=1.4)
        known.extend(concrete(x) for x in (surface.D, surface.G, surface.gamma))
        with pytest.raises(ValueError, match=r"G must be above 0, got -1\.0"):
            fj.Surface(D, -1.0)
        return surface.gamma

    assert look(2.4) == 1.4 and known == [None, 1e-10, 1.4]
    jax.grad(lambda x: (known.append(concrete(x)), x)[1])(3.0)
    assert known[-1] == 3.0  # inside an eager gradient


@pytest.mark.parametrize("part", [*PARTS, STATE], ids=lambda part: type(part).__name__)
def test_frozen_pytree(part):
    """Flatten, jit and vmap give back the same part; equal structures compile once."""
    leaves, structure = jax.tree.flatten(part)
    assert all(isinstance(x, jax.Array) for x in leaves)
    same(jax.tree.unflatten(structure, leaves), part)
    traces = []
    identity = jax.jit(lambda x: (traces.append(0), jax.tree.map(lambda y: y, x))[1])
    same(identity(identity(part)), part)
    assert len(traces) == 1  # no weak types, no other dtypes
    stack = jax.tree.map(lambda x: jnp.stack([x, x]), part)
    same(jax.vmap(lambda x: x)(stack), stack)
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(part, dataclasses.fields(part)[0].name, 1.0)


def test_repr_shows_numbers():
    """What a notebook prints is the call that builds the part; traced, there are types."""
    assert repr(SURFACE) == "Surface(D=2.4, G=1.342e-10, gamma=1.5)"
    assert repr(CONTACT) == (
        f"FractalContact(surface={SURFACE!r}, material={MATERIAL!r}, P=1907.3, "
        "stiffness_ratio=None)"
    )
    assert repr(fj.Coulomb(jnp.array([0.25, 0.5]))) == "Coulomb(mu=array([0.25, 0.5 ]))"
    assert "K_n=402628934.268" in repr(STATE) and "elastic-plastic" in repr(STATE)
    shown = []
    jax.jit(lambda x: shown.append(repr(x)))(SURFACE)
    assert shown[0].startswith("Surface(D=") and "float64[]" in shown[0]


def test_every_quantity_says_what_it_is():
    for part in [SURFACE, MATERIAL, *PARTS]:
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            if isinstance(value, bool):
                assert field.metadata["note"], field.name
            elif not isinstance(value, Part):
                assert field.metadata["unit"] and field.metadata["meaning"], field.name
    scales = {
        field.name
        for part in (SURFACE, MATERIAL, CONTACT, PARTS[2])
        for field in dataclasses.fields(part)
        if field.metadata.get("log")
    }
    assert scales == {"G", "E", "sigma_y", "H", "P", "K_n", "K_t"}


class Table(Part):
    """A part of parts."""

    surface: fj.Surface
    height: jax.Array = quantity("m", "height", log=True)

    def __init__(self, surface, height):
        self.surface = surface
        self.height = number("height", height)


def test_quantities_are_listed_replaced_and_substituted():
    """Every name below a part, sub-parts included, with the path that leads to it."""
    table = Table(SURFACE, 1.0)
    assert quantities(table) == {
        "surface": ("surface",),
        "D": ("surface", "D"),
        "G": ("surface", "G"),
        "gamma": ("surface", "gamma"),
        "height": ("height",),
    }
    assert leaf(table, ("surface", "D")) == 2.4 and leaf(table, ()) is table
    assert [f.metadata.get("log") for f in dataclasses.fields(table)] == [None, True]
    for part in PARTS:  # names are unambiguous
        paths = list(quantities(part).values())
        assert len({path[-1] for path in paths}) == len(paths)
    changed = rebuild(CONTACT, {"D": 2.5, "P": 100.0})
    assert (changed.surface.D, changed.surface.G, changed.P) == (2.5, 1.342e-10, 100.0)
    assert changed.material is MATERIAL and rebuild(CONTACT, {}) is CONTACT
    scene: Any = rebuild(fj.brake_scene(), {"friction": fj.Coulomb(0.3), "mu": 0.2})
    assert scene.friction.mu_s == 0.2
    changes = {"D": jnp.array(2.5), "P": jnp.array(100.0)}
    same(substitute(CONTACT, changes), rebuild(CONTACT, changes))
    assert substitute(CONTACT, {"D": jnp.array(3.5)}).surface.D == 3.5


@pytest.mark.parametrize("change", [rebuild, substitute])
def test_changes_are_differentiable(change):
    """d(height gamma)/d(both) through a change of a quantity two levels deep."""

    def area(gamma, height):
        table = change(Table(SURFACE, 1.0), {"gamma": gamma, "height": height})
        return table.surface.gamma * table.height

    assert eqx.filter_jit(jax.grad(area, argnums=(0, 1)))(ONE * 2, ONE * 3) == (3.0, 2.0)
