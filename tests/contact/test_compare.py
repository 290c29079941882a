"""Contact laws side by side: each as it gives by itself, and boundary elements over seeds."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erfinv

import fractaljax as fj
from tools import assert_whole, refusals

pytestmark = pytest.mark.optimised

BRAKE = fj.brake_scene().contact
SURFACE, MATERIAL = BRAKE.surface, BRAKE.material
SIZES: dict[str, Any] = {"area": 4e-4, "L": 1e-2, "L_s": 1e-3}
LOADS = np.array([600.0, 1907.3, 6000.0])
MEASURED = fj.MeasuredContact((100.0, 1e4), (1e8, 1e10), 1.0, 0.7)


@pytest.fixture(scope="module")
def compared():
    options: dict[str, Any] = {"n": 64, "seeds": 3, "key": jax.random.key(5), "progress": False}
    laws = {"measured": MEASURED}
    return fj.compare_laws(SURFACE, MATERIAL, LOADS, **SIZES, laws=laws, **options)


@pytest.mark.slow
def test_every_law_is_as_by_itself_and_over_the_seeds(compared):
    names = ["fractal", "asperity", "Persson", "measured", "boundary elements"]
    assert list(compared.curves) == names
    for i, P in enumerate(LOADS):
        state = fj.contact_state(SURFACE, MATERIAL, P, mu_s=0.4, mu_m=0.25)
        curve = compared.curves["fractal"]
        for name, alone in (("K_n", state.K_n), ("K_t", state.K_t), ("real_area", state.A_r)):
            assert float(getattr(curve, name)[i]) == pytest.approx(float(alone), rel=1e-12)
        law = fj.PerssonContact(SURFACE, MATERIAL, P, 4e-4, 1e-2, 1e-3)
        curve = compared.curves["Persson"]
        for stiffness, alone in zip((curve.K_n, curve.K_t), law.stiffness(0.4, 0.25), strict=True):
            assert float(stiffness[i]) == pytest.approx(float(alone), rel=1e-12)
        assert float(curve.real_area[i]) == pytest.approx(float(law.real_area(0.25)), rel=1e-12)
    h = 1e-5
    low, high = (
        fj.compare_laws(SURFACE, MATERIAL, LOADS * x, **SIZES, seeds=0, progress=False).curves
        for x in (np.exp(-h), np.exp(h))
    )
    for name in ("fractal", "asperity", "Persson"):
        slope = np.log(high[name].K_n / low[name].K_n) / (2 * h)
        np.testing.assert_allclose(compared.curves[name].alpha, slope, rtol=1e-8)
    np.testing.assert_allclose(compared.curves["measured"].alpha, 1.0, rtol=1e-12)
    assert compared.curves["measured"].real_area is None
    # Four surfaces side by side on four times the area, each under a quarter of the load.
    stiff, touching = [], []
    for key in jax.random.split(jax.random.key(5), 3):
        z = fj.topography(SURFACE, 1e-2, 64, key=key, L_s=1e-3, periodic=True)
        pressed = [fj.boundary_element(z, 1e-2 / 64, MATERIAL, P / 4) for P in LOADS]
        stiff.append([float(4 * one.K_n) for one in pressed])
        touching.append([float(4 * one.area) for one in pressed])
    curve = compared.curves["boundary elements"]
    np.testing.assert_allclose(curve.K_n, np.exp(np.log(stiff).mean(0)), rtol=1e-12)
    np.testing.assert_allclose(curve.scatter, np.log(stiff).std(0, ddof=1), rtol=1e-10)
    np.testing.assert_allclose(curve.real_area, np.mean(touching, 0), rtol=1e-12)
    slope = np.log(curve.K_n[2] / curve.K_n[1]) / np.log(LOADS[2] / LOADS[1])
    assert float(curve.alpha[2]) == pytest.approx(slope, rel=1e-12)
    assert curve.K_t is None


@pytest.mark.slow
def test_table_and_picture(compared):
    lines = repr(compared).splitlines()
    assert len(lines) == 1 + 3 * 5
    assert lines[0].split("  ")[0] == "P [N]"
    assert lines[1].startswith("600") and lines[2].startswith("  ")
    assert "boundary elements" in lines[5] and "%" in lines[5]
    titles, rows = compared.rows()
    assert len(titles) == len(rows[0]) == 7
    loads = [100.0, 600.0, 6000.0]
    plastic = fj.compare_laws(SURFACE, MATERIAL, loads, **SIZES, seeds=0, progress=False)
    assert plastic.rows()[1][0][2:6] == ["0", "-", "-", "-"]
    figure = fj.plot.laws(compared)
    assert_whole(figure)
    alpha: Any
    _, alpha, ratio, _ = figure.axes
    laws = ["fractal", "asperity", "Persson", "measured"]
    assert [line.get_label() for line in ratio.get_lines()] == laws
    assert any("Pastewka" in text.get_text() for text in alpha.get_legend().get_texts())
    assert {ax.get_xlabel() for ax in figure.axes} == {"normal load P [N]"}
    with pytest.raises(ValueError, match="show must be one of K_n, alpha, ratio, share, got 'P'"):
        fj.plot.law_curves(compared, show="P")


def test_full_contact_is_infinitely_stiff():
    smooth, loads = fj.Surface(2.9, 1e-12), [4e6, 4e7, 4e8]
    comparison = fj.compare_laws(smooth, MATERIAL, loads, **SIZES, n=64, seeds=3, progress=False)
    judge: Any = comparison.curves["boundary elements"]
    assert np.isinf(judge.K_n).all() and np.isnan(judge.alpha).all()
    assert np.isnan(judge.scatter).all()
    np.testing.assert_allclose(judge.real_area, 4e-4, rtol=1e-12)
    assert comparison.rows()[1][3][2:6] == ["inf", "-", "-", "-"]


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("D, waves", [(2.1, 16), (2.1, 64), (2.5, 16), (2.9, 64)])
def test_persson_s_law_is_near_boundary_elements(D, waves):
    """Within 35 % below half contact, within a factor of 2 to nearly full; area and roughness."""
    n, side = 256, 5e-3
    loads = np.geomspace(1.0, 3e4, 10)
    one = float(fj.roughness(fj.Surface(D, side), side, side / waves).Sq)
    surface = fj.Surface(D, side * (0.5e-6 / one) ** (1 / (D - 2)))
    curves = fj.compare_laws(
        surface, MATERIAL, loads, area=side**2, L_s=side / waves, n=n, seeds=6, progress=False
    ).curves
    judge = curves["boundary elements"]
    share = np.asarray(judge.real_area) / side**2
    ratio = np.asarray(curves["Persson"].K_n / judge.K_n)
    # Below twice a shortest wavelength squared a single summit carries, as Hertz has it.
    touching = share * waves**2 > 2
    low, high = touching & (share < 0.5), touching & (share >= 0.5) & (share < 0.95)
    assert low.sum() >= 4
    assert np.abs(np.log(ratio[low])).max() < np.log(1.35)
    assert np.abs(np.log(ratio[high])).max(initial=0) < np.log(2)


def random_phases(seed, D, sides, waves, n):
    """Heights (n, n) of unit rms over a period of so many sides, with waves from the side down."""
    noise = np.fft.fft2(np.random.default_rng(seed).normal(size=(n, n)))
    f = np.fft.fftfreq(n) * n / sides
    q = np.hypot(f[:, None], f)
    inside = (q > 1 - 1e-9) & (q < waves + 1e-9)
    size = np.where(inside, np.where(inside, q, 1) ** (D - 4), 0)  # H = 3 - D
    z = np.fft.ifft2(noise / np.abs(noise) * size).real
    return z / z.std()


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("D", [2.1, 2.55, 2.9])
def test_persson_s_law_is_near_boundary_elements_on_surfaces_of_another_program(D):
    """Three loads on two areas, mean over seeds: 35 % below half contact, a factor of 2 beyond."""
    n, side, waves = 256, 5e-3, 32
    one = float(fj.roughness(fj.Surface(D, side), side, side / waves).Sq)
    surface = fj.Surface(D, side * (0.5e-6 / one) ** (1 / (D - 2)))
    rough = fj.roughness(surface, side, side / waves)
    shares = []
    for sides in (1, 2):
        area, dx = (sides * side) ** 2, sides * side / n
        for touching in (0.02, 0.2, 0.9):
            P = float(MATERIAL.E * rough.Sdq * area * erfinv(touching) / np.sqrt(2))
            law = fj.PerssonContact(surface, MATERIAL, P, area, side, side / waves)
            pressed = [
                fj.boundary_element(
                    float(rough.Sq) * random_phases(seed, D, sides, waves, n), dx, MATERIAL, P
                )
                for seed in range(8)
            ]
            share = np.mean([float(one.area) for one in pressed]) / area
            off = np.log(float(law.stiffness(0.4, 0.25)[0]))
            off -= np.mean([np.log(float(one.K_n)) for one in pressed])
            assert abs(off) < np.log(1.35 if share < 0.5 else 2.0)
            shares.append(share)
    assert min(shares) < 0.04 and 0.85 < max(shares) < 0.98


GROUND = fj.SelfAffine(1e-6, 0.8, 2.5e-4, 1e-4)


@pytest.mark.parametrize("measured", [False, True])
def test_another_spectrum_has_the_laws_that_take_it(measured):
    """Persson's law as by itself, and boundary elements on its topographies."""
    surface: fj.Spectrum = GROUND
    if measured:
        q = np.geomspace(2 * np.pi / 1e-3, 2 * np.pi / 1e-4 * 0.999, 12)
        surface = fj.MeasuredSpectrum(q, np.asarray(GROUND.C(q)))
    options: dict[str, Any] = {"area": 4e-6, "L": 1e-3, "n": 32, "progress": False}
    compared = fj.compare_laws(
        surface, MATERIAL, LOADS, seeds=2, laws={"measured": MEASURED}, **options
    )
    assert list(compared.curves) == ["Persson", "measured", "boundary elements"]
    curve: Any = compared.curves["Persson"]
    for i, P in enumerate(LOADS):
        law = fj.PerssonContact(surface, MATERIAL, P, 4e-6)
        for stiffness, alone in zip((curve.K_n, curve.K_t), law.stiffness(0.4, 0.25), strict=True):
            assert float(stiffness[i]) == pytest.approx(float(alone), rel=1e-12)
    stiff = []
    for key in jax.random.split(jax.random.key(0), 2):
        z = fj.topography(surface, 1e-3, 32, key=key, periodic=True)
        pressed = [fj.boundary_element(z, 1e-3 / 32, MATERIAL, P / 4) for P in LOADS]
        stiff.append([float(4 * one.K_n) for one in pressed])
    found: Any = compared.curves["boundary elements"].K_n
    np.testing.assert_allclose(found, np.exp(np.log(stiff).mean(0)), rtol=1e-9)
    kind = type(surface).__name__
    last = f"left out: fractal and asperity, which need the D and G of a Surface, not a {kind}"
    lines = repr(compared).splitlines()
    assert lines[-1] == last and len(lines) == 1 + 3 * 3 + 1
    assert_whole(fj.plot.laws(compared))
    assert fj.compare_laws(SURFACE, MATERIAL, [1e3], area=1e-4, seeds=0).left_out == ()


def test_waves_that_are_too_long_for_boundary_elements():
    """By default four points of the shortest wave; a warning where much of Sq is beyond."""
    few: dict[str, Any] = {"area": 1e-4, "seeds": 1, "progress": False}
    above = [(x**-1.6 - 2.5**-1.6) / 1.6 for x in (1.25, 1.0)]  # of L and of the roll-off
    held = np.sqrt(above[0] / (above[1] + (1 - (2.5e-4 / 1e-2) ** 2) / 2))
    with pytest.warns(UserWarning, match=rf"L = 0.0002 m hold {held:.0%} of Sq: the longer waves"):
        compared = fj.compare_laws(GROUND, MATERIAL, [1e3], n=8, **few)
    assert float(compared.L) == pytest.approx(8 * 1e-4 / 4) and float(compared.L_s) == 1e-4


test_refuses = refusals(
    [
        ({"loads": [2.0, 1.0]}, "loads must be a row of rising numbers, got [2. 1.]"),
        ({"loads": [[1.0, 2.0]]}, "loads must be a row of rising numbers"),
        ({"loads": [0.0, 1.0]}, "loads must be above 0, got 0.0"),
        ({"area": 0.0}, "area must be above 0, got 0.0"),
        ({"L_s": 1e-6}, "L_s must be at least 2 L/n"),
        ({"L_s": 1.0}, "L must be at least L_s = 1.0, got 0.01"),
        ({"n": 7}, "n must be a whole number of at least 8, got 7"),
        ({"seeds": -1}, "seeds must be a whole number of at least 0, got -1"),
        ({"mu_m": 0.5}, "mu_s must be at least mu_m = 0.5, got 0.4"),
    ],
    lambda wrong: fj.compare_laws(
        SURFACE, MATERIAL, **{"loads": [1.0], "area": 1e-4, "progress": False} | wrong
    ),
    plain=True,
)


def test_refuses_lengths_of_another_spectrum():
    few: dict[str, Any] = {"loads": [1.0], "area": 1e-4, "progress": False}
    with pytest.raises(ValueError, match="L_s is for a Surface; a SelfAffine has a shortest wave"):
        fj.compare_laws(GROUND, MATERIAL, L_s=1e-5, **few)
    with pytest.raises(ValueError, match="L_s must be at least 2 L/n"):
        fj.compare_laws(GROUND, MATERIAL, L=1e-2, n=64, **few)
    with pytest.raises(ValueError, match="L must be at least L_s"):
        fj.compare_laws(GROUND, MATERIAL, L=1e-5, **few)
    with pytest.raises(TypeError, match="surface must be a Spectrum, got 3"):
        wrong: Any = 3
        fj.compare_laws(wrong, MATERIAL, **few)


def test_refuses_what_is_no_law():
    with pytest.raises(TypeError, match=r"laws\['mine'\] must be a Contact, got 3"):
        laws: Any = {"mine": 3}
        fj.compare_laws(SURFACE, MATERIAL, [1.0], area=1e-4, laws=laws, progress=False)


def test_a_law_of_its_own_scene_is_differentiable():
    """alpha comes from the law's derivative, also of a law of the user's."""

    class Hertz(fj.Contact):
        P: jax.Array

        def stiffness(self, mu_s, mu_m):
            return 1e7 * jnp.cbrt(self.P), 5e6 * jnp.cbrt(self.P)

    laws = {"Hertz": Hertz(jnp.array(1.0))}
    comparison = fj.compare_laws(
        SURFACE, MATERIAL, LOADS, area=1e-4, laws=laws, seeds=0, progress=False
    )
    np.testing.assert_allclose(comparison.curves["Hertz"].alpha, 1 / 3, rtol=1e-12)
