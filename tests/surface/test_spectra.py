"""Spectra of surfaces: moments by quadrature, heights by their waves, one's own, files."""

import math
import re
import textwrap
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from tools import both_modes, refusals

PLAIN = {"Sq": 1e-6, "H": 0.8, "rolloff": 1e-4, "shortest": 1e-5}
MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)
KEY = jax.random.key(3)


def self_affine(**changes) -> fj.SelfAffine:
    return fj.SelfAffine(**(PLAIN | changes))


def table(surface: fj.SelfAffine, points=2001) -> fj.MeasuredSpectrum:
    q = np.geomspace(2 * math.pi / 1e-3, 2 * math.pi / 1e-5, points)
    return fj.MeasuredSpectrum(q, np.asarray(surface.C(q)))


def example() -> Any:
    """The class in the docstring of `Spectrum`, run as it stands there."""
    (code,) = re.findall(r"( +class Turned.*?2 / jnp.pi\)\n)", str(fj.Spectrum.__doc__), re.S)
    names = {"fj": fj, "jax": jax, "jnp": jnp, "__name__": __name__}
    exec(textwrap.dedent(code), names)
    return names["Turned"]


@pytest.fixture
def turned():
    yield example()(Sq=1e-6, feed=1e-4, longest=1e-3, shortest=1e-5)
    fj.Spectrum.named.pop("turned", None)


BOUNDED = [
    self_affine(longest=1e-3),
    self_affine(longest=1e-4),  # from the roll-off on
    self_affine(longest=1e-3, H=1.0),
    self_affine(longest=1e-3, lay=1.0),
    self_affine(longest=1e-3, lay=4.0),
    self_affine(longest=1e-3, lay=0.5),
    table(self_affine(longest=1e-3), 30),
]


def quadrature(surface, power, waves=(1e-2, 2e-6)):
    """The integral of m q^power over ln q, by the trapezoidal rule on every wave there is."""
    x = np.linspace(math.log(2 * math.pi / waves[0]), math.log(2 * math.pi / waves[1]), 40_001)
    m = np.asarray(jax.lax.map(surface.m, jnp.exp(x), batch_size=4001))
    return np.trapezoid(m * np.exp(power * x), x)


@pytest.mark.parametrize("surface", BOUNDED, ids=str)
def test_moments_are_integrals_of_m(surface):
    moments = fj.spectral_moments(surface)
    rough = fj.roughness(surface)
    # The ends of the waves lie between two points.
    expected = [quadrature(surface, power) for power in (0, 2, 4)]
    assert float(moments.m0) == pytest.approx(expected[0], rel=1e-3)
    assert float(moments.m2) == pytest.approx(expected[1] / 2, rel=1e-3)
    assert float(moments.m4) == pytest.approx(3 * expected[2] / 8, rel=2e-3)
    assert float(moments.alpha) == pytest.approx(
        float(moments.m0 * moments.m4 / moments.m2**2), rel=1e-12
    )
    assert float(rough.Sq) == pytest.approx(math.sqrt(moments.m0), rel=1e-14)
    assert float(rough.Sdq) == pytest.approx(math.sqrt(2 * moments.m2), rel=1e-14)
    assert float(surface.pieces().moment(2)) == pytest.approx(float(2 * moments.m2), rel=1e-6)
    q = 2e5
    assert float(surface.C(q)) == pytest.approx(2 * math.pi * float(surface.m(q)) / q**2)


def test_self_affine_has_its_height_and_a_flat_spectrum_above_its_roll_off():
    surface = self_affine()
    assert float(fj.roughness(surface).Sq) == 1e-6
    q = 2 * math.pi / np.array([1e-2, 2e-4, 1.0001e-4])
    np.testing.assert_allclose(surface.C(q), float(surface.C(q[0])), rtol=1e-12)
    q = 2 * math.pi / np.array([5e-5, 1.00001e-5, 0.9999e-5])
    C = np.asarray(surface.C(q))
    assert C[0] / C[1] == pytest.approx((q[1] / q[0]) ** 3.6) and C[2] == 0


def test_a_lay_is_a_spectrum_that_is_longer_along_it():
    surface = self_affine(lay=3.0, longest=1e-3)
    q, angles = 2e5, (np.arange(4000) + 0.5) * 2 * math.pi / 4000
    mean = np.mean(np.asarray(surface.C_at(q * np.cos(angles), q * np.sin(angles))))
    assert mean == pytest.approx(float(surface.C(q)), rel=0.02)  # 64 directions in the law
    alike = surface.C_at(jnp.array([1e5, 0.0]), jnp.array([0.0, 3e5]))
    assert float(alike[0]) == pytest.approx(float(alike[1]), rel=1e-12)


def test_fractal_surface_is_a_spectrum():
    """Many waves a decade: Sq of Eq. 13 and the integral of m, and its slope 2D - 6."""
    surface = fj.Surface(2.4, 1.342e-10, 1.005)
    rough = fj.roughness(surface, 1e-3, 1e-5)
    half_step = math.log(1.005) / 2
    x = np.linspace(
        math.log(2e3 * math.pi) - half_step, math.log(2e5 * math.pi) + half_step, 20_001
    )
    m = np.asarray(surface.m(np.exp(x)))
    # The last wave may be up to one step short of L_s.
    assert math.sqrt(np.trapezoid(m, x)) == pytest.approx(float(rough.Sq), rel=3e-5)
    gradient = math.sqrt(np.trapezoid(m * np.exp(2 * x), x))
    assert gradient == pytest.approx(float(rough.Sdq), rel=0.005)
    moments = fj.spectral_moments(surface, 1e-3, 1e-5)
    assert float(moments.m0) == pytest.approx(float(rough.Sq) ** 2, rel=1e-13)
    assert float(moments.m2) == pytest.approx(float(rough.Sdq) ** 2 / 2, rel=1e-13)


@jax.jit
def moments_of(x):
    def moments(x):
        found = fj.spectral_moments(fj.SelfAffine(*jnp.exp(x)))
        return jnp.log(jnp.stack([found.m0, found.m2, found.m4]))

    return both_modes(moments, x)


@pytest.mark.parametrize("lay", [1.0, 3.0])
def test_slopes_of_moments(lay):
    """By Sq, H, roll-off, shortest and longest wavelength and lay, against differences."""
    x = np.log([1e-6, 0.8, 1e-4, 1e-5, 1e-3, lay])
    _, forward, reverse = moments_of(jnp.asarray(x))
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-12)
    for i in range(6):
        ends = [moments_of(jnp.asarray(x + s * np.eye(6)[i]))[0] for s in (1e-5, -1e-5)]
        np.testing.assert_allclose(forward[:, i], (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-8)


def test_slopes_by_the_entries_of_a_table():
    q = np.geomspace(1e4, 1e6, 7)
    C = np.asarray(self_affine().C(q)) + 1e-30

    @jax.jit
    def heights(C):
        return both_modes(lambda C: jnp.stack([fj.roughness(fj.MeasuredSpectrum(q, C)).Sq]), C)

    _, forward, reverse = heights(jnp.asarray(C))
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    for i in range(7):
        step = 1e-5 * C[i] * np.eye(7)[i]
        up, down = (heights(jnp.asarray(C + s * step))[0] for s in (1, -1))
        assert forward[0, i] == pytest.approx(float(up[0] - down[0]) / (2e-5 * C[i]), rel=1e-6)


# --- heights ------------------------------------------------------------------------------------


@pytest.mark.parametrize("surface", [BOUNDED[0], BOUNDED[4], BOUNDED[6]], ids=str)
def test_topography_has_the_waves_of_its_spectrum(surface):
    """Each to rounding, also of the only phases that are real; a flat mean."""
    n, L = 64, 4e-4
    z = np.asarray(fj.topography(surface, L, n, key=KEY, periodic=True))
    q = 2 * math.pi * np.fft.fftfreq(n, L / n)
    q_x, q_y = np.meshgrid(q, q, indexing="ij")
    waves = np.abs(np.fft.fft2(z) / n**2) ** 2
    q_x[0, 0] = 1e9
    expected = np.asarray(surface.C_at(q_x, q_y)) / L**2
    np.testing.assert_allclose(waves, expected, rtol=1e-9, atol=1e-25 + 1e-12 * expected.max())
    half = np.asarray(fj.topography(surface, L, n, key=KEY))
    assert half.shape == (n, n) and abs(half[0] - half[-1]).std() > 0.1 * half.std()
    other = np.asarray(fj.topography(surface, L, n, key=jax.random.key(4), periodic=True))
    assert np.corrcoef(z.ravel(), other.ravel())[0, 1] < 0.5


# --- one's own, and files -------------------------------------------------------------------------


def test_a_spectrum_of_one_s_own(turned):
    """Has roughness, heights, a contact, quantities and files as the others do."""
    assert float(fj.roughness(turned).Sq) == pytest.approx(1e-6, rel=1e-5)
    assert float(turned.pieces().moment(2)) == pytest.approx(float(turned.moments()[1]), rel=1e-6)
    assert float(turned.roll_off()[0]) == pytest.approx(1e-4, rel=0.1)
    assert fj.topography(turned, 1e-3, 16, key=KEY).shape == (16, 16)
    law = fj.PerssonContact(turned, MATERIAL, 1907.3, 1e-4)
    scene = fj.brake_scene().replace(contact=law)
    rougher = scene.replace(Sq=2e-6)
    assert float(fj.stiffness(rougher)[0]) < float(fj.stiffness(scene)[0])
    back = fj.Scene.from_toml(scene.to_toml())
    assert back.to_toml() == scene.to_toml() and type(back.contact.surface) is type(turned)


@pytest.mark.parametrize("surface", [self_affine(), self_affine(lay=2.0), BOUNDED[6]], ids=str)
def test_spectra_in_files(surface):
    scene = fj.brake_scene().replace(contact=fj.PerssonContact(surface, MATERIAL, 1907.3, 1e-4))
    back = fj.Scene.from_toml(scene.to_toml())
    assert back.to_toml() == scene.to_toml()
    assert jax.tree.all(jax.tree.map(lambda x, y: bool(x == y), scene, back))


def test_a_file_without_the_name_of_its_surface_has_a_fractal_one():
    scene = fj.brake_scene()
    law = fj.PerssonContact(scene.contact.surface, MATERIAL, 1907.3, 1e-4, 1e-3, 1e-6)
    text = scene.replace(contact=law).to_toml()
    older = "\n".join(line for line in text.splitlines() if 'law = "fractal"' not in line)
    assert fj.Scene.from_toml(older).to_toml() == text
    with pytest.raises(TypeError, match=r"surface must be a Surface, got (a )?SelfAffine"):
        other = 'law = "self-affine"\nSq = 1e-6\nhurst = 0.8\nrolloff = 1e-4\nshortest = 1e-5\n'
        fj.Scene.from_toml(re.sub(r"D = .*\nG = .*\ngamma = .*\n", other, scene.to_toml()))


def test_hurst_exponent_is_not_the_hardness():
    law = fj.PerssonContact(self_affine(), MATERIAL, 1907.3, 1e-4)
    scene = fj.brake_scene().replace(contact=law)
    finer = scene.replace(hurst=0.5)
    assert float(finer.contact.surface.H) == 0.5 and float(finer.contact.material.H) == 9.94e8
    harder = scene.replace(H=2e9)
    assert float(harder.contact.surface.H) == 0.8 and float(harder.contact.material.H) == 2e9
    assert "H=0.8" in repr(scene.contact.surface)


SURFACE = fj.Surface(2.4, 1e-10)
test_refused = refusals(
    [
        (lambda: self_affine(Sq=0.0), r"^Sq must be above 0, got 0\.0$"),
        (lambda: self_affine(H=1.2), r"^H \(hurst\) must be above 0 and at most 1, got 1\.2$"),
        (lambda: self_affine(rolloff=1e-6), r"^rolloff must be at least shortest = 1e-05"),
        (lambda: self_affine(longest=5e-5), r"^longest must be at least rolloff = 0\.0001"),
        (lambda: self_affine(lay=0.0), r"^lay must be above 0, got 0\.0$"),
        (lambda: fj.MeasuredSpectrum([1e5], [1e-20]), r"^q and C must be two or more"),
        (lambda: fj.MeasuredSpectrum([2e5, 1e5], [1e-20, 1e-20]), r"^q must rise"),
        (lambda: fj.MeasuredSpectrum([1e5, 2e5], [1e-20, 0.0]), r"^C\[1\] must be above 0"),
        (lambda: fj.MeasuredSpectrum(1e5, [1e-20]), r"^q must have shape \(k,\)"),
        (lambda: fj.roughness(SURFACE), r"^a Surface needs L and L_s"),
        (lambda: fj.roughness(self_affine(), 1e-3, 1e-5), r"^L and L_s are for a Surface; a Self"),
        (lambda: fj.PerssonContact(SURFACE, MATERIAL, 1e3, 1e-4), r"^a Surface needs L and L_s"),
        (
            lambda: fj.PerssonContact(self_affine(), MATERIAL, 1e3, 1e-4, 1e-3, 1e-5),
            r"^L and L_s are for a Surface; a SelfAffine has wavelengths of its own$",
        ),
        (
            lambda: fj.topography(self_affine(), 1e-3, 8, key=KEY, L_s=1e-5),
            r"^L_s is for a Surface",
        ),
        (lambda: fj.roughness(self_affine(Sq=jnp.ones(2))), r"^Sq must be a scalar.*jax.vmap"),
    ]
)


def test_a_spectrum_without_ends_is_refused():
    class Endless(fj.Spectrum):
        Sq: Any = fj.quantity("m", "height", log=True)

        def m(self, q):
            return self.Sq**2 / q

    with pytest.raises(TypeError, match="Endless must have longest and shortest"):
        Endless(Sq=1e-6)
