"""A contact law of the user's own: the example of `Contact` itself, and laws that are refused."""

import re
import textwrap
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._mechanism.quantities import replaced, require_quantity
from tools import both_gradients, refusals

BRAKE = fj.brake_scene()
NUMBERS = dict(k=4e8, P_0=1900, stiffness_ratio=np.float32(0.5), P=np.array(1900.0))
COULOMB = fj.Scene(BRAKE.contact, fj.Coulomb(0.4), BRAKE.oscillator)


def example() -> Any:
    """The class in the docstring of `Contact`, run as it stands there."""
    (code,) = re.findall(
        r"( +class Hertz.*?stiffness_ratio \* K_n\n)", str(fj.Contact.__doc__), re.S
    )
    assert len(code.splitlines()) <= 10
    names = {"fj": fj, "jax": jax, "__name__": __name__}
    exec(textwrap.dedent(code), names)
    return names["Hertz"]


@pytest.fixture(autouse=True)
def forgotten():
    """The example's name is gone from files after each test."""
    yield
    fj.Contact.named.pop("hertz", None)


@pytest.fixture
def Hertz():
    return example()


class Softened(fj.Contact):
    """Its stiffness falls with friction, and is below 0 beyond mu_s = 1."""

    K: Any = fj.quantity("N/m", "normal stiffness without friction", log=True)
    P: Any = fj.quantity("N", "normal load", log=True)

    def stiffness(self, mu_s, mu_m):
        return self.K * (1 - mu_s), self.K / 2


class Steep(fj.Contact):
    """Without units, and with a load below 0 allowed by its form alone."""

    P: Any
    form: str = "cubic"
    on: bool = True

    def stiffness(self, mu_s, mu_m):
        return 1e5 * self.P**2, 1e8 if self.on else 0.0


class Alone(fj.Contact):
    P: Any

    def stiffness(self, mu_s, mu_m) -> Any:
        return self.P


class Complex(Alone):
    def stiffness(self, mu_s, mu_m):
        return self.P * 1j, self.P


def test_numbers_become_arrays_and_the_rest_stays(Hertz):
    law = Hertz(**NUMBERS)
    assert [x.dtype for x in jax.tree.leaves(law)] == ["float64", "float64", "float32", "float64"]
    K_n, K_t = law.stiffness(0.4, 0.25)
    assert (float(K_n), float(K_t)) == (4e8, 2e8)
    assert repr(law) == "Hertz(k=400000000.0, P_0=1900.0, stiffness_ratio=0.5, P=1900.0)"
    steep = Steep(30)
    assert isinstance(steep.P, jax.Array) and steep.form == "cubic" and steep.on is True
    assert not law.depends_on_friction and not steep.depends_on_friction
    assert Softened(1e8, 1e3).depends_on_friction


def test_the_example_does_what_a_joint_of_that_stiffness_does(Hertz):
    """Growth rate, stability, critical friction, sweep, limit cycle, a structure."""
    law = Hertz(**NUMBERS)
    scene, fixed = (COULOMB.replace(contact=c) for c in (law, fj.FixedContact(4e8, 2e8, 1900.0)))
    for measure in (fj.growth_rate, fj.critical_friction, lambda x: fj.stability(x).eigenvalues):
        np.testing.assert_allclose(measure(scene), measure(fixed), rtol=1e-12)
    loads = np.array([500.0, 1900.0, 4000.0])
    swept = fj.sweep(fj.growth_rate, scene, progress=False, P=loads)
    stiff = 4e8 * np.cbrt(loads / 1900)
    rates = [fj.growth_rate(fixed.replace(K_n=K, K_t=K / 2)) for K in stiff]
    np.testing.assert_allclose(swept.values, rates, rtol=1e-10)
    replaced_scene = replaced(scene, {"K_t/K_n": 0.4})
    assert float(replaced_scene.contact.stiffness_ratio) == pytest.approx(0.4)


def test_with_an_opening_exponent_it_has_its_load_curve(Hertz):
    """Hertz's, N = P (1 + 2 K_n u/(3 P))^(3/2), 0 where it is open."""
    law = type("Opening", (Hertz,), {"opening_exponent": 1 / 3})(**NUMBERS)
    u = np.array([-1e-5, -5e-6, 0.0, 2e-6])
    expected = 1900 * np.maximum(0, 1 + 2 * 4e8 * u / (3 * 1900)) ** 1.5
    np.testing.assert_allclose(law.load(u), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="load needs a contact law with a load curve, got Hertz"):
        Hertz(**NUMBERS).load(u)


@pytest.mark.slow
def test_its_limit_cycle_is_that_of_a_joint_of_that_stiffness(Hertz):
    scene = BRAKE.replace(contact=Hertz(**NUMBERS))
    computed = fj.limit_cycle(scene)
    expected = fj.limit_cycle(BRAKE.replace(contact=fj.FixedContact(4e8, 2e8)))
    assert computed.result == fj.CycleResult.converged
    np.testing.assert_allclose(computed.amplitude, expected.amplitude, rtol=1e-8)


def test_designed_over_its_load(Hertz):
    """The load found has the growth rate asked for, of the joint of that stiffness."""
    scene = COULOMB.replace(contact=Hertz(**NUMBERS | {"stiffness_ratio": 0.3}))
    best = fj.design(scene, {"P": (100.0, 40000.0)}, target=-1.8, progress=False)
    assert best.result == fj.DesignResult.found and "P [N]" in repr(best)
    P = float(best.scene.contact.P)
    K = 4e8 * np.cbrt(P / 1900)
    there = fj.growth_rate(COULOMB.replace(contact=fj.FixedContact(K, 0.3 * K)))
    assert float(there) == pytest.approx(best.growth_rate, rel=1e-9)
    assert best.growth_rate == pytest.approx(best.target, rel=1e-4) and P != 1900


def test_derivatives_in_both_modes_under_jit_and_vmap(Hertz):
    """dK_n/dP = K_n/(3 P); growth rates by the chain rule through a fixed joint."""
    numbers = {name: jnp.asarray(x, float) for name, x in NUMBERS.items()}

    def rate(x):
        return fj.growth_rate(COULOMB.replace(contact=Hertz(**x)))

    def fixed(K):
        return fj.growth_rate(COULOMB.replace(contact=fj.FixedContact(K[0], K[1])))

    by_K = jax.grad(fixed)(jnp.array([4e8, 2e8]))
    expected = {"k": by_K[0] + by_K[1] / 2, "stiffness_ratio": by_K[1] * 4e8}
    expected |= {"P": expected["k"] * 4e8 / 5700, "P_0": -expected["k"] * 4e8 / 5700}
    for computed in both_gradients(rate, numbers):
        for name in expected:
            assert float(computed[name]) == pytest.approx(float(expected[name]), rel=1e-9)
    loads = jnp.array([500.0, 1900.0, -1.0])
    many = jax.jit(jax.vmap(lambda P: rate(numbers | {"P": P})))(loads)
    np.testing.assert_allclose(many[:2], [rate(numbers | {"P": P}) for P in loads[:2]], rtol=1e-12)
    assert np.isnan(many[2])


def test_files_hold_it(Hertz, tmp_path):
    """Scenes and structures to the last bit, with unit and meaning; not without a name."""
    scene = BRAKE.replace(contact=Hertz(**NUMBERS | {"stiffness_ratio": 0.5}))
    text = scene.to_toml()
    assert 'law = "hertz"  # or "asperity"' in text
    assert "P_0 = 1900.0  # N: load at which it is k" in text
    joint = fj.Structure(
        np.eye(2), None, 2 * np.eye(2), fj.Joint(scene.contact, scene.friction, 0, 1, 0.2)
    )
    joint.save(tmp_path / "joint.toml")
    pairs = [(fj.Scene.from_toml(text), scene), (fj.Structure.load(tmp_path / "joint.toml"), joint)]
    for computed, expected in pairs:
        assert jax.tree.structure(computed) == jax.tree.structure(expected)
        assert all(map(np.array_equal, jax.tree.leaves(computed), jax.tree.leaves(expected)))
    with pytest.raises(ValueError, match=r"\[contact\] P of Hertz must be above 0, got -5"):
        fj.Scene.from_toml(text.replace("P = 1900.0", "P = -5.0"))
    with pytest.raises(ValueError, match=r"a file holds as contact one of Asperity.*got Softened"):
        BRAKE.replace(contact=Softened(1e8, 1e3)).to_toml()


def test_names_of_laws(Hertz):
    """Those of the package are taken, whichever of its modules is imported; the class is anew."""
    for name in ("fractal", "measured"):
        kind = fj.Contact.by_name()[name]
        with pytest.raises(ValueError, match=f"the law '{name}' is {kind.__name__} already"):
            type("Other", (fj.Contact,), {}, law=name)
    assert fj.Contact.named["fractal"] is fj.FractalContact
    again = example()
    assert again is not Hertz and fj.Contact.named["hertz"] is again


def test_a_traced_law_is_not_a_number_where_it_is_wrong(Hertz):
    """Also one member of a batch, alone, and one that is wrong under its friction."""
    made = jax.jit(lambda k: Hertz(**NUMBERS | {"k": k}))
    assert all(np.isnan(x) for x in jax.tree.leaves(made(-1.0)))
    assert not any(np.isnan(x) for x in jax.tree.leaves(made(1.0)))
    batch = jax.jit(lambda P: Hertz(**NUMBERS | {"P": P}))(jnp.array([1.0, -1.0]))
    np.testing.assert_array_equal(np.isnan(batch.stiffness(1, 1)[0]), [False, True])
    soft = BRAKE.replace(contact=Softened(1e9, 1900.0))
    rate = jax.jit(lambda mu_s: fj.growth_rate(soft.replace(mu_s=mu_s)))
    assert np.isnan(rate(1.5)) and np.isfinite(rate(0.5))


def test_a_batch_is_checked_one_by_one(Hertz):
    assert Hertz(**NUMBERS | {"k": np.array([1.0, 2.0])}).k.shape == (2,)
    with pytest.raises(ValueError, match=r"K_n of Hertz\(.* must be at least 0, got -2\.0"):
        Hertz(**NUMBERS | {"k": np.array([1.0, -2.0]), "stiffness_ratio": 0.5})


def test_critical_friction_follows_a_stiffness_that_friction_changes():
    """At the friction that is found the joint of that stiffness begins to squeal."""
    scene = COULOMB.replace(contact=Softened(8e8, 1900.0))
    mu = float(fj.critical_friction(scene))
    fixed = COULOMB.replace(contact=fj.FixedContact(8e8 * (1 - mu), 4e8))
    assert mu == pytest.approx(float(fj.critical_friction(fixed)), rel=1e-9)


test_refusals = refusals(
    [
        (
            lambda: example()(**NUMBERS | {"P": -1900}),
            r"^P of Hertz must be above 0, got -1900\.0$",
        ),
        (lambda: example()(**NUMBERS | {"P_0": -1}), r"^K_n of Hertz\(.*\) must be .* 0, got nan$"),
        (
            lambda: example()(**NUMBERS | {"stiffness_ratio": -0.5}),
            r"^K_t of Hertz\(.*\) must be at least 0, got -200000000\.0$",
        ),
        (lambda: example()(**NUMBERS | {"k": np.inf}), "^k must be finite, got inf$"),
        (lambda: example()(**NUMBERS | {"k": "4"}), "^k must be a number, got '4'$"),
        (lambda: example()(**NUMBERS | {"k": True}), "^k must be a number, got True$"),
        (lambda: Steep(-3.0), r"^P of Steep must be above 0, got -3\.0$"),
        (lambda: Alone(1.0), r"^stiffness of Alone must give \(K_n, K_t\), got Array\(1\."),
        (
            lambda: Complex(1.0),
            r"^K_n of Complex\(P=1\.0\) must be a real number, got Array\(0\.\+1",
        ),
        (
            lambda: BRAKE.replace(contact=Softened(1e8, 1e3), mu_s=1.5),
            r"^K_n of Softened\(.*\) must be at least 0, got -50000000\.0$",
        ),
        (
            lambda: fj.Joint(Softened(1e8, 1e3), fj.Coulomb(2.0), 0, 1),
            r"^K_n of Softened\(.*\) must be at least 0, got -100000000\.0$",
        ),
        (
            lambda: require_quantity(BRAKE.replace(contact=Steep(30.0)), "K_t/K_n"),
            "^scene has no quantity 'K_t/K_n'; it has mu_s",
        ),
    ],
    kind=(ValueError, TypeError),
)
