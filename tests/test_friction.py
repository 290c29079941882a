"""Friction laws: shipped ones and a user's own, their slopes, scaling and files; refusals."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

import fractaljax as fj
from fractaljax._friction import Scaled
from fractaljax._mechanism.quantities import replaced, require_independent, substituted, value_of
from tools import both_modes, refusals

STRIBECK, COULOMB = fj.Stribeck(0.4, 0.25, 0.5), fj.Coulomb(0.4)
SPEEDS = np.array([1e-300, 1e-9, 0.01, 0.15, 0.3, 0.4999, 0.5, 0.75, 1.0, 3.0])
BOTH_WAYS = np.concatenate([-SPEEDS[::-1], [0.0], SPEEDS])


class Exponential(fj.Friction):
    """A law as a user writes one, with the names of the base's own numbers as plain fields."""

    mu_s: jax.Array
    mu_m: jax.Array
    v_0: jax.Array

    def mu(self, speed):
        return self.mu_m + (self.mu_s - self.mu_m) * jnp.exp(-jnp.asarray(speed) / self.v_0)


class Cubic(fj.Friction):
    """Stribeck's law in other words: nothing but `mu` tells what the fields mean."""

    high: Any = fj.quantity("-", "friction at rest")
    drop: Any = fj.quantity("-", "how far it falls")
    reach: Any = fj.quantity("m/s", "where it is least")

    def mu(self, speed):
        u = speed / self.reach
        return self.high + self.drop * u * (u**2 - 3) / 2


class Peaked(fj.Friction):
    """A law whose own mu_s is not its value at rest, but `share` of it."""

    mu_s: Any
    share: Any = 0.5

    def mu(self, speed):
        return self.mu_s / self.share * (1 - jnp.exp(-jnp.asarray(speed)) / 2)


WRONG: Any = None
ABSTRACT: Any = fj.Friction
EXPONENTIAL = Exponential(*map(jnp.array, (0.4, 0.25, 0.5)))
NUMBERS: Any = (0.4, 0.4 - 0.25, 0.5)  # Python's, as a user gives them
CUBIC = Cubic(*NUMBERS)


def equation_38(v, mu_s=mpf(0.4), mu_m=mpf(0.25), v_m=mpf(0.5)):  # noqa: B008
    """As printed, for v > 0, in working precision."""
    return mu_s - 3 * (mu_s - mu_m) / (2 * v_m) * v + (mu_s - mu_m) / (2 * v_m**3) * v**3


@pytest.mark.slow
def test_slope_in_both_precisions_and_nan_under_jit():
    """Against differences in 60 digits of Eq. 38; even in the velocity; its minimum; a constant."""
    with mp.workdps(60):
        h = mpf("1e-20")  # truncation h^2, rounding 1e-60/h
        pairs = [(equation_38(mpf(v) + h), equation_38(mpf(v) - h)) for v in SPEEDS]
        truth = np.array([float((up - down) / (2 * h)) for up, down in pairs])
        values = [float(equation_38(mpf(v))) for v in SPEEDS]
    np.testing.assert_allclose(STRIBECK.mu(SPEEDS), values, rtol=1e-15)
    by_mode = [jax.vmap(mode(STRIBECK.mu))(SPEEDS) for mode in (jax.jacfwd, jax.jacrev)]
    for found in (*by_mode, STRIBECK.slope(SPEEDS), STRIBECK.slope(-SPEEDS)):
        # Near the minimum two terms of the size of the slope at 0 cancel.
        np.testing.assert_allclose(found, truth, rtol=1e-15, atol=5e-16)
    assert STRIBECK.slope(0.5) == 0.0 and not COULOMB.velocity_dependent
    np.testing.assert_array_equal(COULOMB.mu(SPEEDS), 0.4)
    np.testing.assert_array_equal(COULOMB.slope(SPEEDS), 0)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), STRIBECK)
    v = SPEEDS[1:].astype(np.float32)
    assert single.mu(v).dtype == single.slope(v).dtype == np.float32
    np.testing.assert_allclose(single.mu(v), STRIBECK.mu(SPEEDS[1:]), rtol=1e-6)
    assert np.isnan(jax.jit(fj.Stribeck)(0.4, 0.5, 0.5).mu(0.1))
    cubic = jax.jit(lambda high: Cubic(high, 0.1, 0.5).mu(jnp.array(0.1)))
    np.testing.assert_allclose(cubic(0.4), Cubic(0.4, 0.1, 0.5).mu(jnp.array(0.1)), rtol=1e-15)
    peaked = jax.jit(lambda mu_s, share: Peaked(mu_s, share).mu(0.1))
    assert np.isnan(cubic(-0.4)) and np.isnan(peaked(0.5, 0.4)) and peaked(0.5, 0.6) > 0.4


def viscous(s, d, v, c, w):
    return d + (s - d) * mp.exp(-w / v) + c * w


def falling(s, d, v, w):
    return viscous(s, d, v, 0, w)


LAW_TABLE = {  # numbers, mu in working precision, its least value in closed form
    "stribeck": (fj.Stribeck, (0.4, 0.25, 0.5), lambda s, m, v, w: equation_38(w, s, m, v), 0.25),
    "cubic, a user's": (
        Cubic,
        (0.4, 0.15, 0.5),
        lambda s, d, v, w: s - 3 * d / (2 * v) * w + d / (2 * v**3) * w**3,
        0.25,
    ),
    "exponential": (fj.ExponentialStribeck, (0.5, 0.2, 0.07), falling, 0.2),
    "exponential, viscous": (
        fj.ExponentialStribeck,
        (0.5, 0.2, 0.07, 0.3),
        viscous,
        0.2 + 0.3 * 0.07 * (1 + np.log(0.3 / (0.3 * 0.07))),
    ),
    "exponential, rising": (fj.ExponentialStribeck, (0.5, 0.4, 0.1, 2.0), viscous, 0.5),
    "hyperbolic": (fj.HyperbolicStribeck, (0.45, 3.0), lambda s, d, w: s / (1 + d * w), 0.0),
    "coulomb": (fj.Coulomb, (0.4,), lambda s, w: s + 0 * w, 0.4),
}
EACH = pytest.mark.parametrize("name", LAW_TABLE)


def differences(function, numbers):
    """Derivatives of a function of numbers by each of them, in 60 digits."""
    with mp.workdps(60):
        h, at, found = mpf("1e-20"), [mpf(x) for x in numbers], []
        for i in range(len(at)):
            up, down = ([x + sign * h * (i == j) for j, x in enumerate(at)] for sign in (1, -1))
            found.append(float((function(*up) - function(*down)) / (2 * h)))
    return found


@jax.jit
def of_law(law, speeds):
    """Values, slopes at both signs, one by one, mu_s, mu_m and mu(0), and of twice the law."""
    twice = law.times(2.0)
    slopes = jnp.stack([law.slope(speeds), law.slope(-speeds)])
    ends, doubled = (law.mu_s, law.mu_m, law.mu(0.0)), (twice.mu_s, twice.mu_m)
    return law.mu(speeds), slopes, jax.vmap(law.mu)(speeds), ends, (twice.mu(speeds), doubled)


@EACH
def test_every_law(name):
    """Values, both derivatives in both modes against 60 digits, mu(0), the least value, scaling."""
    kind, numbers, exact, lowest = LAW_TABLE[name]
    law, speeds = kind(*numbers), [0.0, 1e-3, 0.03, 0.2, 0.9]
    by_all = jax.jit(jax.vmap(lambda x: both_modes(lambda x: kind(*x[:-1]).mu(x[-1]), x)[1:]))
    derivatives = by_all(np.array([[*numbers, w] for w in speeds]))
    values, slopes, each, (mu_s, mu_m, at_rest), (doubled, ends) = of_law(law, np.array(speeds))
    for i, w in enumerate(speeds):
        assert float(values[i]) == pytest.approx(float(exact(*map(mpf, (*numbers, w)))), rel=1e-14)
        wanted = differences(exact, (*numbers, w))
        for found in derivatives:
            np.testing.assert_allclose(found[i], wanted, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(slopes[:, i], wanted[-1], rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(each, values)
    assert float(law.mu_s) == float(mu_s) == numbers[0] == float(at_rest)
    assert float(mu_m) == pytest.approx(lowest, rel=1e-14)
    np.testing.assert_allclose(doubled, 2 * values, rtol=1e-15)
    np.testing.assert_allclose(ends, (2 * mu_s, 2 * mu_m), rtol=1e-14)
    leaves, structure = jax.tree.flatten(law)
    assert len(leaves) >= len(numbers) and type(jax.tree.unflatten(structure, leaves)) is kind
    assert {leaf.dtype for leaf in leaves} == {jnp.dtype(float)}


class Well(fj.Friction):
    """A law that says nothing of its least value, 0.1 + depth at^3 at the speed at^2."""

    depth: Any
    at: Any

    def mu(self, speed):
        return 0.1 + self.depth * (self.at**3 + (speed - self.at**2) ** 2)


def least(x):
    return Well(*x).mu_m


@jax.jit
def slopes_of_the_least(x):
    """First and second derivatives, in forward and in reverse mode each."""
    return both_modes(least, x)[1:], both_modes(jax.grad(least), x)[1:]


@pytest.mark.parametrize("place", ["inside", "at rest", "far"])
def test_derivatives_of_the_least_value(place):
    """In both modes; the second, by which the minimum moves, as well."""
    at = {"inside": 0.7, "at rest": 0.0, "far": 20.0}[place]
    first, second = slopes_of_the_least(jnp.array([0.3, at]))
    wanted = [at**3, 0.9 * at**2]
    if place == "far":  # beyond the fastest speed: still falling there
        wanted = [at**3 + (100 - at**2) ** 2, 0.3 * (3 * at**2 - 4 * at * (100 - at**2))]
    for found in first:
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=0 if place == "far" else 1e-15)
    if place == "inside":
        wanted = [[0, 3 * at**2], [3 * at**2, 1.8 * at]]
        for found in second:
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)


BRAKE = fj.brake_scene()


class Question(NamedTuple):
    scene: fj.Scene
    friction: Any


QUESTIONS = {"fixed": BRAKE.replace(contact=fj.FixedContact(4e8, 1.3e8)), "fractal": BRAKE}


@jax.jit
def answers(scene):
    """Growth rate, margin, critical friction and its gradient by the law: one program."""
    critical, gradient = jax.value_and_grad(fj.critical_friction)(scene)
    return (fj.growth_rate(scene), fj.margin(scene), critical), gradient.friction


@pytest.mark.parametrize("name", ["fixed", pytest.param("fractal", marks=pytest.mark.slow)])
def test_a_law_in_other_words_has_the_same_answers(name):
    """Stability, critical friction and its gradient: of Stribeck's law, restated by a user."""
    scene = QUESTIONS[name]
    (numbers, found), (own, wanted) = answers(scene.replace(friction=CUBIC)), answers(scene)
    np.testing.assert_allclose(numbers, own, rtol=1e-11)
    # high = mu_s at drop = mu_s - mu_m held.
    sums = [wanted.mu_s + wanted.mu_m, -wanted.mu_m, wanted.v_m]
    np.testing.assert_allclose([found.high, found.drop, found.reach], sums, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("place", [replaced, substituted])
def test_mu_of_a_users_law_is_set_by_scaling_it(place):
    scene = QUESTIONS["fractal"].replace(friction=CUBIC)
    moved = place(scene, {"mu": 0.3, "reach": 0.4, "D": 2.5})
    own = place(BRAKE, {"mu": 0.3, "v_m": 0.4, "D": 2.5})
    assert float(value_of(moved, "mu")) == pytest.approx(0.3, rel=1e-14)
    assert float(moved.friction.mu_s) == pytest.approx(float(own.friction.mu_s), rel=1e-13)
    assert float(fj.growth_rate(moved)) == pytest.approx(float(fj.growth_rate(own)), rel=1e-10)
    again = place(moved, {"mu": 0.2})
    assert isinstance(again.friction.of, Cubic) and float(value_of(again, "mu")) == pytest.approx(
        0.2
    )
    with pytest.raises(ValueError, match="quantities must be independent, got mu and high"):
        require_independent(scene, ("mu", "high"))
    require_independent(scene, ("mu", "reach"))


@pytest.fixture
def registered():
    """A user's law with a name in files; gone after the test."""

    class Named(Cubic, law="named"):
        pass

    yield Named
    del fj.Friction.named["named"]


def test_files_of_every_law(registered, tmp_path):
    """Scenes and structures, to the last bit; each number with its meaning."""
    laws = [kind(*numbers) for kind, numbers, *_ in LAW_TABLE.values() if kind is not Cubic]
    laws += [registered(*NUMBERS), Scaled(registered(*NUMBERS), 0.7)]
    for law in laws:
        scene = fj.Scene(fj.FixedContact(4e8, 2e8), law, BRAKE.oscillator)
        again = fj.Scene.from_toml(scene.to_toml())
        joint = fj.Structure(
            np.eye(2), None, 2 * np.eye(2), fj.Joint(scene.contact, law, 0, 1, 0.2)
        )
        joint.save(tmp_path / "joint.toml")
        for found, wanted in [(again, scene), (fj.Structure.load(tmp_path / "joint.toml"), joint)]:
            assert jax.tree.structure(found) == jax.tree.structure(wanted)
            assert all(map(np.array_equal, jax.tree.leaves(found), jax.tree.leaves(wanted)))
    text = fj.Scene(BRAKE.contact, registered(*NUMBERS), BRAKE.oscillator).to_toml()
    assert "high = 0.4  # -: friction at rest" in text and 'law = "named"' in text
    assert "mu = 0.4  # -: friction coefficient" in BRAKE.replace(friction=COULOMB).to_toml()
    assert repr(COULOMB) == "Coulomb(mu=0.4)"


def test_names_of_laws(registered):
    """One law a name; a class that is defined again, as a notebook does, takes its own."""
    with pytest.raises(ValueError, match=r"^the law 'stribeck' is Stribeck already$"):

        class Other(fj.Friction, law="stribeck"):
            pass

    assert fj.Friction.named["stribeck"] is fj.Stribeck

    def define():
        class Again(Cubic, law="again"):
            pass

        return Again

    define()
    second = define()
    assert fj.Friction.named.pop("again") is second
    with pytest.raises(ValueError, match=r"a file holds as friction one of Coulomb, .*got Cubic"):
        BRAKE.replace(friction=CUBIC).to_toml()


@pytest.mark.parametrize("law", [STRIBECK, COULOMB, EXPONENTIAL, CUBIC])
def test_branches(law):
    """One direction's law and slope, smooth through v = 0; a sign between smooths the jump."""
    for sign in (1.0, -1.0):
        assert law.branch(0.0, sign) == sign * 0.4
        own = sign * law.mu(sign * BOTH_WAYS)
        np.testing.assert_allclose(law.branch(BOTH_WAYS, sign), own, rtol=1e-15, atol=1e-16)
        near = jax.vmap(jax.grad(lambda v, sign=sign: law.branch(v, sign)))(BOTH_WAYS[9:12])
        np.testing.assert_allclose(near, law.slope(0.0), rtol=1e-14, atol=1e-15)
    smoothed = law.branch(SPEEDS, 0.25) - law.branch(SPEEDS, 1.0)
    np.testing.assert_allclose(smoothed, -0.75 * 0.4, rtol=1e-14)
    if law is STRIBECK:
        cubic = np.polynomial.Polynomial([0.4, -1.5 * 0.15 / 0.5, 0, 0.5 * 0.15 / 0.5**3])
        found = law.branch(BOTH_WAYS, 1.0)
        np.testing.assert_allclose(found, cubic(BOTH_WAYS), rtol=1e-15, atol=5e-16)


test_refusals = refusals(
    [
        (lambda: fj.Stribeck(0.0, 0.0, 0.5), r"^mu_s must be above 0, got 0\.0$"),
        (lambda: fj.Stribeck(0.4, -0.1, 0.5), r"^mu_m must be at least 0, got -0\.1$"),
        (lambda: fj.Stribeck(0.4, 0.5, 0.5), r"^mu_s must be at least mu_m = 0\.5, got 0\.4$"),
        (lambda: fj.Stribeck(0.4, 0.25, 0.0), r"^v_m must be above 0"),
        (lambda: fj.Coulomb(0), "^mu must be above 0, got 0"),
        (lambda: ABSTRACT(), "abstract"),
        (lambda: fj.ExponentialStribeck(0.4, 0.5, 0.1), r"^mu_s must be at least mu_d = 0\.5, got"),
        (lambda: fj.ExponentialStribeck(0.4, 0.2, 0.0), "^v_0 must be above 0, got 0"),
        (lambda: fj.ExponentialStribeck(0.4, 0.2, 0.1, -1.0), "^viscous must be at least 0, got"),
        (lambda: fj.HyperbolicStribeck(0.0, 0.1), "^mu_s must be above 0, got 0"),
        (lambda: fj.HyperbolicStribeck(0.4, -0.1), "^delta must be at least 0, got -0.1"),
        (lambda: Cubic(np.nan, 0.1, 0.5), "^high must be finite, got nan"),
        (lambda: Cubic(-0.4, 0.1, 0.5), r"^mu\(0\) must be above 0, got -0\.4"),
        (lambda: Scaled(WRONG), "^of must be a Friction, got None"),
        (lambda: Scaled(CUBIC, 0.0), r"^factor must be above 0, got 0\.0"),
        (lambda: Peaked(0.5, 0.25), r"^mu_s must be at least mu\(0\) = 1\.0, got 0\.5"),
        (lambda: fj.Coulomb(0.4, mu_s=0.3), r"^mu_s must be at least mu = 0\.4, got 0\.3"),
    ],
    kind=(ValueError, TypeError),
)
