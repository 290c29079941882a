"""Materials: Eq. 2, what they accept, and what they refuse and how they say it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import fractaljax as fj
from fractaljax.mechanism.materials import equivalent_modulus

GOOD = {"E": 1.154e11, "nu": 0.3, "sigma_y": 3.55e8, "H": 9.94e8}
PAIR = {"E1": 2.1e11, "nu1": 0.27, "E2": 9e10, "nu2": 0.35, "sigma_y": 3.55e8, "H": 9.94e8}
LAST = np.nextafter(0.5, 1)


def test_pair_follows_equation_2():
    """1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2, against 40 digits; nu is the mean."""
    with mp.workdps(40):
        E1, nu1, E2, nu2 = (mpf(PAIR[name]) for name in ("E1", "nu1", "E2", "nu2"))
        truth = 1 / ((1 - nu1**2) / E1 + (1 - nu2**2) / E2)
    material = fj.Material.pair(**PAIR)
    assert float(abs(mpf(float(material.E)) / truth - 1)) < 4e-16
    assert material.nu == (0.27 + 0.35) / 2
    assert (material.sigma_y, material.H) == (3.55e8, 9.94e8)


def test_pair_of_equals_and_of_a_rigid_body():
    """Equal bodies halve E/(1 - nu^2); beside a far stiffer one the other counts alone."""
    np.testing.assert_allclose(equivalent_modulus(2e11, 0.3, 2e11, 0.3), 1e11 / 0.91, rtol=4e-16)
    np.testing.assert_allclose(equivalent_modulus(2e11, 0.3, 2e99, 0.1), 2e11 / 0.91, rtol=4e-16)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_pair_derivatives(mode):
    """dE/dE1 = (1 - nu1^2)(E/E1)^2 and dE/dnu1 = 2 nu1 E^2/E1, in both modes."""
    E1, nu1, E2, nu2 = (PAIR[name] for name in ("E1", "nu1", "E2", "nu2"))
    E = float(equivalent_modulus(E1, nu1, E2, nu2))
    found = mode(equivalent_modulus, argnums=(0, 1, 2, 3))(E1, nu1, E2, nu2)
    truth = [
        (1 - nu1**2) * (E / E1) ** 2,
        2 * nu1 * E**2 / E1,
        (1 - nu2**2) * (E / E2) ** 2,
        2 * nu2 * E**2 / E2,
    ]
    np.testing.assert_allclose(found, truth, rtol=2e-15)


def test_the_closed_ends():
    """nu = 0, nu = 0.5 and H = sigma_y belong to the domain."""
    for nu in (0.0, 0.5):
        material = fj.Material(**GOOD | {"nu": nu, "H": GOOD["sigma_y"]})
        assert (material.nu, material.H) == (nu, material.sigma_y)


@pytest.mark.parametrize(
    ("name", "bad", "bound"),
    [
        *(("E", x, "above 0") for x in (0, -1, np.nan, np.inf)),
        *(("nu", x, "at least 0 and at most 0.5") for x in (-0.1, LAST, 0.6, np.nan, np.inf)),
        *(("sigma_y", x, "above 0") for x in (0, -1, np.nan, np.inf)),
        *(("H", x, "above 0") for x in (0, -1, np.nan, np.inf)),
        *(("H", x, "at least sigma_y = 355000000.0") for x in (1.0, np.nextafter(3.55e8, 0))),
    ],
)
def test_refusals(name, bad, bound):
    """The message holds the argument, the bound and the value."""
    with pytest.raises(ValueError, match=f"^{name} must be {bound}, got {float(bad)!r}$"):
        fj.Material(**GOOD | {name: bad})


@pytest.mark.parametrize(
    ("name", "bad"),
    [("E1", 0), ("E2", -1), ("nu1", 0.6), ("nu2", -0.1), ("sigma_y", 0), ("H", 1), ("E1", np.nan)],
)
def test_pair_refuses_each_body(name, bad):
    """Each body's own numbers are checked under their own names."""
    with pytest.raises(ValueError, match=f"^{name} must be at? ?[a-z]+ .*got {float(bad)!r}$"):
        fj.Material.pair(**PAIR | {name: bad})


@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("bad", ["1", None, True, 1j])
def test_not_a_number(name, bad):
    """Anything but a real number is a TypeError that names the argument."""
    with pytest.raises(TypeError, match=f"^{name} must be a"):
        fj.Material(**GOOD | {name: bad})


@pytest.mark.parametrize(
    ("name", "bad", "message"),
    [
        ("E", 0.0, "E must be above 0"),
        ("nu", 0.6, "nu must be at least 0 and at most 0.5"),
        ("sigma_y", -1.0, "sigma_y must be above 0"),
        ("H", 1.0, "H must be at least sigma_y"),
    ],
)
def test_traced_refusal(name, bad, message):
    """Under jit the compiled program raises, with the argument and the bound."""

    @eqx.filter_jit
    def build(x):
        return fj.Material(**GOOD | {name: x})

    build(jnp.array(GOOD[name]))
    with pytest.raises((RuntimeError, ValueError), match=message):
        jax.block_until_ready(build(jnp.array(bad)))


def test_the_softest_of_many_is_named():
    """Of arrays, the message shows the first H below its own sigma_y."""
    with pytest.raises(ValueError, match=r"^H must be at least sigma_y = 3\.0, got 2\.5$"):
        fj.Material(1e11, 0.3, jnp.array([1.0, 3.0]), jnp.array([2.5, 2.5]))


def test_eager_gradient_refuses_with_the_value():
    """Inside an eager jax.grad the value is known, and is shown."""
    with pytest.raises(ValueError, match=r"^nu must be at least 0 and at most 0\.5, got 0\.75"):
        jax.grad(lambda nu: fj.Material(**GOOD | {"nu": nu}).nu)(0.75)
    with pytest.raises(ValueError, match=r"^H must be at least sigma_y = 355000000\.0, got 1\.0"):
        jax.grad(lambda H: fj.Material(**GOOD | {"H": H}).H)(1.0)
