"""Parts: checked numbers, frozen pytrees, named quantities and how they are changed."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.base.parts import (
    Part,
    concrete,
    flag,
    leaf,
    number,
    ordered,
    quantities,
    quantity,
    rebuild,
    require_scalar,
    substitute,
)

SURFACE = fj.Surface(2.4, 1.342e-10)
MATERIAL = fj.Material(1.154e11, 0.3, 3.55e8, 9.94e8)
CONTACT = fj.FractalContact(SURFACE, MATERIAL, 1907.3)
PARTS = {
    "Surface": SURFACE,
    "Material": MATERIAL,
    "FractalContact": CONTACT,
    "FractalContact with ratio": fj.FractalContact(SURFACE, MATERIAL, 1907.3, 0.5),
    "FixedContact": fj.FixedContact(4e8, 2e8),
    "Coulomb": fj.Coulomb(0.4),
    "Stribeck": fj.Stribeck(0.4, 0.25, 0.5),
    "Oscillator": fj.Oscillator(1.0, 6283.0, 5026.0, 0.001, 0.007, 5.0, 0.15),
    "Scene": fj.brake_scene(),
    "ContactState": fj.contact_state(SURFACE, MATERIAL, 1907.3, mu_s=0.4, mu_m=0.25),
}
EVERY = pytest.mark.parametrize("part", PARTS.values(), ids=list(PARTS))


class Plate(Part):
    """The smallest part: one checked quantity."""

    width: jax.Array = quantity("m", "width")

    def __init__(self, width):
        self.width = number("width", width, above=0)


class Table(Part):
    """A part of parts."""

    plate: Plate
    height: jax.Array = quantity("m", "height")

    def __init__(self, plate, height):
        self.plate = plate
        self.height = number("height", height)


def same(a, b):
    """Two trees of one structure with equal leaves of equal types."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        np.testing.assert_array_equal(x, y)


# ---------------------------------------------------------------------------------------------
# number, ordered, concrete
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        (2, np.float64),
        (2.0, np.float64),
        (np.int32(2), np.float64),
        (np.float32(2), np.float32),
        (jnp.float32(2), np.float32),
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


def test_number_bounds():
    """`above` and `below` are strict, `at_least` and `at_most` are not."""
    assert number("x", 1.0, at_least=1, at_most=1) == 1.0
    for bound, message in [
        ({"above": 1}, "above 1"),
        ({"below": 1}, "below 1"),
        ({"at_least": 1.5}, "at least 1.5"),
        ({"at_most": 0.5}, "at most 0.5"),
        ({"above": 0, "at_most": 0.5}, "above 0 and at most 0.5"),
    ]:
        with pytest.raises(ValueError, match=rf"^x must be {message}, got 1\.0$"):
            number("x", 1.0, **bound)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_number_is_finite(bad):
    """NaN and infinity are refused even without bounds, concrete and traced."""
    with pytest.raises(ValueError, match=f"^x must be finite, got {bad!r}$"):
        number("x", bad)
    with pytest.raises((RuntimeError, ValueError), match="x must be finite"):
        jax.block_until_ready(eqx.filter_jit(lambda x: number("x", x))(jnp.array(bad)))


@pytest.mark.parametrize(
    "bad", ["1", b"1", None, True, np.False_, 1j, [1.0], (1.0,), {}, object, 10**400, np.array("a")]
)
def test_number_refuses_other_types(bad):
    """Anything but a real number or an array of them is a TypeError."""
    with pytest.raises(TypeError, match=r"^x must be a"):
        number("x", bad)


def test_number_under_vmap():
    """One bad entry of a mapped array stops the program."""
    checked = eqx.filter_jit(jax.vmap(lambda x: number("x", x, above=0)))
    np.testing.assert_array_equal(checked(jnp.array([1.0, 2.0])), [1, 2])
    with pytest.raises((RuntimeError, ValueError), match="x must be above 0"):
        jax.block_until_ready(checked(jnp.array([1.0, -2.0])))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_number_is_the_identity_to_derivatives(mode):
    """A checked number has derivative 1, also at a bound of its domain."""
    for x in (0.0, 0.7):
        assert mode(lambda x: number("x", x, at_least=0))(x) == 1.0
        assert jax.jit(mode(lambda x: number("x", x, at_least=0)))(x) == 1.0


def test_ordered():
    """`value` is returned as it is where it is at least `other`, and refused elsewhere."""
    one, two = jnp.array(1.0), jnp.array([1.0, 2.0])
    assert ordered("a", two, "b", one) is two
    with pytest.raises(ValueError, match=r"^a must be at least b = 2\.0, got 1\.0$"):
        ordered("a", one, "b", two)
    traced = eqx.filter_jit(lambda a, b: ordered("a", a, "b", b))
    assert traced(one, one) == 1.0
    with pytest.raises((RuntimeError, ValueError), match="a must be at least b"):
        jax.block_until_ready(traced(one, jnp.array(2.0)))


def test_concrete():
    """The values of an array, inside an eager jax.grad too; None while a program is traced."""
    seen = []

    def look(x):
        seen.append(concrete(x))
        return x

    jax.grad(look)(3.0)
    jax.jit(look)(3.0)
    assert seen == [3.0, None]


# ---------------------------------------------------------------------------------------------
# Pytrees
# ---------------------------------------------------------------------------------------------


@EVERY
def test_pytree(part):
    """Flatten and unflatten, tree_map, jit and vmap give back the same part."""
    leaves, structure = jax.tree.flatten(part)
    assert all(isinstance(x, jax.Array) for x in leaves)
    same(jax.tree.unflatten(structure, leaves), part)
    same(jax.tree.map(lambda x: x, part), part)
    same(jax.jit(lambda x: x)(part), part)
    stack = jax.tree.map(lambda x: jnp.stack([x, x]), part)
    same(jax.vmap(lambda x: x)(stack), stack)
    assert type(jax.vmap(lambda x: x)(stack)) is type(part)


@EVERY
def test_frozen(part):
    """No field can be assigned."""
    name = dataclasses.fields(part)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(part, name, 1.0)


@EVERY
def test_equal_structures_compile_once(part):
    """A part built anew does not compile the caller again: no weak types, no other dtypes."""
    count = 0

    @jax.jit
    def twice(x):
        nonlocal count
        count += 1
        return jax.tree.map(lambda y: y, x)

    twice(part)
    twice(twice(part))
    assert count == 1


def test_repr_shows_numbers():
    """What a notebook prints is the call that builds the part."""
    assert repr(SURFACE) == "Surface(D=2.4, G=1.342e-10, gamma=1.5)"
    assert (
        repr(MATERIAL) == "Material(E=115400000000.0, nu=0.3, sigma_y=355000000.0, H=994000000.0)"
    )
    assert repr(CONTACT) == (
        f"FractalContact(surface={SURFACE!r}, material={MATERIAL!r}, "
        "P=1907.3, stiffness_ratio=None)"
    )
    assert repr(fj.Coulomb(jnp.array([0.25, 0.5]))) == "Coulomb(mu=array([0.25, 0.5 ]))"
    state = repr(PARTS["ContactState"])
    assert "K_n=402628934.268" in state
    assert "elastic-plastic" in state


def test_repr_while_traced():
    """Inside a compiled program there are no numbers yet, and repr still works."""
    shown = []
    jax.jit(lambda x: shown.append(repr(x)))(SURFACE)
    assert shown[0].startswith("Surface(D=")
    assert "float64[]" in shown[0]


def test_fields_have_unit_and_meaning():
    """Every quantity of every part says what it is."""
    for part in PARTS.values():
        for field in dataclasses.fields(part):
            if isinstance(part, Part) and not isinstance(getattr(part, field.name), Part):
                assert field.metadata["unit"], field.name
                assert field.metadata["meaning"], field.name


# ---------------------------------------------------------------------------------------------
# Named quantities
# ---------------------------------------------------------------------------------------------


def test_quantities():
    """Every name below a part, sub-parts included, with the path that leads to it."""
    assert quantities(CONTACT) == {
        "surface": ("surface",),
        "D": ("surface", "D"),
        "G": ("surface", "G"),
        "gamma": ("surface", "gamma"),
        "material": ("material",),
        "E": ("material", "E"),
        "nu": ("material", "nu"),
        "sigma_y": ("material", "sigma_y"),
        "H": ("material", "H"),
        "P": ("P",),
        "stiffness_ratio": ("stiffness_ratio",),
    }


@EVERY
def test_names_are_unambiguous(part):
    """No two quantities of a part share a name, so that a change finds the one that is meant."""
    if isinstance(part, Part):
        paths = list(quantities(part).values())
        assert len({path[-1] for path in paths}) == len(paths)
        by_field = sum(
            len(dataclasses.fields(sub))
            for sub in jax.tree.leaves(part, is_leaf=lambda x: isinstance(x, (Part, jax.Array)))
            if isinstance(sub, Part)
        )
        assert by_field == len(dataclasses.fields(part))


def test_leaf():
    """The value at a path; the part itself at the empty one."""
    assert leaf(CONTACT, ("surface", "D")) == 2.4
    assert leaf(CONTACT, ("material",)) is MATERIAL
    assert leaf(CONTACT, ()) is CONTACT


def test_rebuild():
    """Quantities change wherever they live; parts that hold none of them are kept as they are."""
    changed = rebuild(CONTACT, {"D": 2.5, "P": 100.0})
    assert (changed.surface.D, changed.surface.G, changed.P) == (2.5, 1.342e-10, 100.0)
    assert changed.material is MATERIAL
    assert rebuild(CONTACT, {}) is CONTACT
    assert CONTACT.surface.D == 2.4


def test_rebuild_takes_whole_parts():
    """A sub-part has a name as well, and may be of another kind."""
    other = fj.Surface(2.6, 1e-11)
    assert rebuild(CONTACT, {"surface": other}).surface is other
    scene = rebuild(fj.brake_scene(), {"friction": fj.Coulomb(0.3)})
    assert scene.friction.mu == 0.3


def test_rebuild_checks():
    """The constructor runs again: what it refuses is refused, with the value."""
    with pytest.raises(ValueError, match=r"^D must be above 2 and below 3, got 3\.5$"):
        rebuild(CONTACT, {"D": 3.5})
    with pytest.raises(ValueError, match=r"^H must be at least sigma_y = 995000000\.0"):
        rebuild(CONTACT, {"sigma_y": 9.95e8})
    with pytest.raises(TypeError, match=r"^surface must be a Surface"):
        rebuild(CONTACT, {"surface": 2.4})


def test_substitute():
    """The same change without checks: equal results, and values outside the domain pass."""
    changes = {"D": jnp.array(2.5), "P": jnp.array(100.0)}
    same(substitute(CONTACT, changes), rebuild(CONTACT, changes))
    assert substitute(CONTACT, {"D": jnp.array(3.5)}).surface.D == 3.5
    assert substitute(CONTACT, {"surface": fj.Surface(2.6, 1e-11)}).surface.D == 2.6
    with pytest.raises(KeyError, match="nonsense"):
        substitute(CONTACT, {"nonsense": jnp.array(1.0)})


@pytest.mark.parametrize("change", [rebuild, substitute])
def test_changes_are_differentiable(change):
    """d(height width)/d(both) through a change of a quantity two levels deep."""

    def area(width, height):
        table = change(Table(Plate(1.0), 1.0), {"width": width, "height": height})
        return table.plate.width * table.height

    at = jnp.array(2.0), jnp.array(3.0)
    assert jax.jit(jax.grad(area, argnums=(0, 1)))(*at) == (3.0, 2.0)


def test_require_scalar():
    """A part that holds arrays is refused with the first such name and its shape."""
    for part in PARTS.values():
        if isinstance(part, Part):
            require_scalar(part)
    many = rebuild(CONTACT, {"G": jnp.array([1e-10, 1e-11])})
    message = r"^G must be a scalar, got shape \(2,\); use jax.vmap for many scenes"
    with pytest.raises(ValueError, match=message):
        require_scalar(many)
    with pytest.raises(ValueError, match=message):
        jax.jit(require_scalar)(many)
    jax.vmap(lambda G: require_scalar(rebuild(CONTACT, {"G": G})))(many.surface.G)


def test_what_is_known_stays_known_while_a_program_is_traced():
    """Quantities that are no argument of it have values, and are refused at once."""

    @jax.jit
    def look(D):
        surface = fj.Surface(D, 1e-10, gamma=1.4)
        again = fj.brake_scene().replace(D=D).contact.surface
        known.extend(concrete(x) for x in (surface.D, surface.G, surface.gamma, again.gamma))
        with pytest.raises(ValueError, match=r"G must be above 0, got -1\.0"):
            fj.Surface(D, -1.0)
        return surface.gamma

    known = []
    assert look(2.4) == 1.4 and known == [None, 1e-10, 1.4, 1.5]


def test_flags_are_true_or_false():
    for given in (True, np.True_):
        assert flag("friction_slope", given) is True
    for given in ("no", 0, 1, None, jnp.array(True), np.array([True])):
        with pytest.raises(TypeError, match="friction_slope must be True or False, got"):
            flag("friction_slope", given)
