"""Surfaces: what they accept, and what they refuse and how they say it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj

GOOD = {"D": 2.4, "G": 1e-10, "gamma": 1.5}


def test_fields():
    """A surface holds what it was given, as float64 arrays; gamma is 1.5 unless told."""
    surface = fj.Surface(2.4, 1e-10)
    assert (surface.D, surface.G, surface.gamma) == (2.4, 1e-10, 1.5)
    assert surface.D.dtype == np.float64


@pytest.mark.parametrize("D", [np.nextafter(2, 3), 2.5, np.nextafter(3, 2)])
def test_whole_open_interval_of_D(D):
    """2 < D < 3 up to the doubles next to its ends."""
    assert fj.Surface(D, 1e-10).D == D


@pytest.mark.parametrize(
    ("name", "bad", "bound"),
    [
        *(("D", x, "above 2 and below 3") for x in (2, 3, 1.9, 3.1, -2.5, np.nan, np.inf, -np.inf)),
        *(("G", x, "above 0") for x in (0, -1e-10, np.nan, np.inf)),
        *(("gamma", x, "above 1") for x in (1, 0.5, -2, np.nan, np.inf)),
    ],
)
def test_refusals(name, bad, bound):
    """The message holds the argument, the bound and the value."""
    with pytest.raises(ValueError, match=f"^{name} must be {bound}, got {float(bad)!r}$"):
        fj.Surface(**GOOD | {name: bad})


def test_the_bad_entry_of_an_array_is_named():
    """Of many values, the message shows the first that is outside."""
    with pytest.raises(ValueError, match=r"D must be above 2 and below 3, got 3\.5"):
        fj.Surface(jnp.array([2.5, 3.5, 4.5]), 1e-10)


@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("bad", ["2.4", b"2.4", None, True, np.True_, 2.4 + 0j, [2.4], {}])
def test_not_a_number(name, bad):
    """Anything but a real number is a TypeError that names the argument."""
    with pytest.raises(TypeError, match=f"^{name} must be a"):
        fj.Surface(**GOOD | {name: bad})


@pytest.mark.parametrize("name", GOOD)
def test_traced_refusal(name):
    """Under jit the compiled program raises, with the argument and the bound."""

    @eqx.filter_jit
    def build(x):
        return fj.Surface(**GOOD | {name: x})

    assert getattr(build(jnp.array(2.5)), name) == 2.5
    with pytest.raises((RuntimeError, ValueError), match=f"{name} must be above"):
        jax.block_until_ready(build(jnp.array(-1.0)))


def test_eager_gradient_refuses_with_the_value():
    """Inside an eager jax.grad the value is known, and is shown."""
    with pytest.raises(ValueError, match=r"^D must be above 2 and below 3, got 3\.25"):
        jax.grad(lambda D: fj.Surface(D, 1e-10).D)(3.25)
