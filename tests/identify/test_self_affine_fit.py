"""Roll-off, lay, H and Sq of synthetic surfaces, the errors stated for them, and their slopes."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import truncnorm

import fractaljax as fj
from fractaljax._identify.self_affine_fit import Cells, _Law
from synthetic import gaussian_map, gaussian_profile

N, DX = 192, 2e-6
SURFACES = {
    "isotropic": fj.SelfAffine(1e-6, 0.8, 4e-5, 1e-6),
    "rough": fj.SelfAffine(3e-7, 0.4, 3e-5, 1e-6),
    "lay": fj.SelfAffine(1e-6, 0.6, 2e-5, 1e-6, lay=3.0),
}


def standardised(surface, seeds):
    """Deviations of (ln Sq, H, ln rolloff, ln lay) in standard errors, a row a seed."""
    rows = []
    for seed in seeds:
        z = fj.topography(surface, N * DX, N, key=jax.random.key(seed))
        found = fj.identify(np.asarray(z), DX)
        fit = found.self_affine
        assert isinstance(found.surface, fj.SelfAffine) and fit.has_rolloff
        lay = 1.0 if surface.lay is None else float(surface.lay)
        assert (fit.lay != 1) == (lay != 1)
        # Sq of the waves that the map has.
        true = fj.SelfAffine(surface.Sq, surface.H, surface.rolloff, fit.shortest, lay=lay)
        ratio = float(surface._peak / true._peak)
        values = [fit.Sq**2, fit.H, fit.rolloff, fit.lay]
        expected = [float(surface.Sq) ** 2 * ratio, float(surface.H), float(surface.rolloff), lay]
        by = [
            math.log(a / b) if i != 1 else a - b
            for i, (a, b) in enumerate(zip(values, expected, strict=True))
        ]
        by[0] /= 2
        errors = np.sqrt(np.diagonal(fit.covariance))
        rows.append(np.array(by) / np.where(errors > 0, errors, 1))
    return np.array(rows)


@pytest.mark.parametrize("name", SURFACES)
def test_roll_off_and_lay_are_within_their_errors(name):
    rows = standardised(SURFACES[name], range(3))
    assert np.abs(rows).max() < 3.5 and np.sqrt((rows**2).mean()) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_errors_are_those_of_many_surfaces(name):
    rows = standardised(SURFACES[name], range(20))
    size = np.sqrt((rows**2).mean(axis=0))
    assert (size < 1.4).all() and (size[:3] > 0.4).all()


def test_a_lay_at_any_angle():
    """The transpose of a map has its lay at a right angle to that of the map."""
    z = np.asarray(fj.topography(SURFACES["lay"], N * DX, N, key=jax.random.key(5)))
    fits = [fj.identify(each, DX).self_affine for each in (z, z.T)]
    assert abs(fits[0].lay_direction) < 5 and abs(abs(fits[1].lay_direction) - 90) < 5
    assert fits[0].lay == pytest.approx(fits[1].lay, rel=0.02)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_lay_across_the_first_axis_is_seen_as_well_as_one_along_it(seed):
    """With the long waves along y the plateau reaches far into the band: it is no filter."""
    surface = fj.SelfAffine(2e-6, 0.8, 1e-4, 4e-6, lay=0.5)
    z = np.asarray(fj.topography(surface, 1.2e-3, 400, seed=seed))
    found, turned = (fj.identify(each, 3e-6) for each in (z, z.T))
    assert not any(line.startswith("roll-off") for line in found.warnings)
    fit, other = found.self_affine, turned.self_affine
    assert abs(fit.H - 0.8) < 0.05 and fit.lay == pytest.approx(2, rel=0.05)
    # Along the lay, 1e-4 m; across it half of that.
    assert fit.rolloff == pytest.approx(5e-5, rel=0.15) and fit.shortest < 1e-5
    assert abs(abs(fit.lay_direction) - 90) < 3 and abs(other.lay_direction) < 3
    for name in ("Sq", "H", "rolloff", "lay", "shortest"):
        assert getattr(fit, name) == pytest.approx(getattr(other, name), rel=5e-3)


def test_no_roll_off_is_invented():
    """A power law stays a `Surface`, with what it says beside it."""
    found = fj.identify(gaussian_map(np.random.default_rng(2), 2.4), 1e-6)
    assert isinstance(found.surface, fj.Surface) and not found.self_affine.has_rolloff
    assert "no roll-off up to" in repr(found)
    assert found.scatter.names == ("D", "ln m(q)")


@pytest.mark.parametrize("kind", ["map", "profile"])
def test_law_is_that_of_the_surface_with_its_slopes(kind):
    """Against `SelfAffine.C_at`, or the integral over the waves that a cut crosses."""
    f = np.geomspace(1e3, 2e5, 9)
    angle = np.linspace(0.1, 3.0, 9) if kind == "map" else None
    model = _Law(Cells(f, angle, f, f), 1e-6)
    s, psi = (math.log(3.0), 0.4) if kind == "map" else (0.0, 0.0)
    at = np.array([math.log(1e-6), 0.7, math.log(5e-5)])
    if kind == "map":
        at = np.append(at, [s * math.cos(2 * psi), s * math.sin(2 * psi)])
    value, slope = model(at)
    across = 5e-5 * math.exp(-s / 2)
    surface = fj.SelfAffine(1e-6, 0.7, across, 1e-6 * math.exp(-s / 2), lay=math.exp(s))
    if kind == "map":
        assert angle is not None
        q = 2 * np.pi * f
        C = surface.C_at(q * np.cos(angle - psi), q * np.sin(angle - psi))
        # The waves of the surface end at its shortest, those of the law do not.
        np.testing.assert_allclose(value, np.log(2 * np.pi * f**2 * np.asarray(C)), rtol=1e-12)
    else:
        wide = fj.SelfAffine(1e-6, 0.7, across, 1e-9)
        scale = float(fj.SelfAffine(1e-6, 0.7, across, 1e-6)._peak / wide._peak)

        def wave(t, f):
            k = f * math.cosh(t)
            return scale * float(wide.m(2 * math.pi * k)) / math.cosh(t)

        for i in (0, 4, 8):
            integral = quad(wave, 0, 6, (f[i],), points=[1.0], limit=200)[0]
            assert math.exp(value[i]) == pytest.approx(2 / math.pi * integral, rel=2e-3)
    for j in range(at.size):
        step = 1e-6 * np.eye(at.size)[j]
        difference = (model(at + step)[0] - model(at - step)[0]) / 2e-6
        np.testing.assert_allclose(slope[:, j], difference, rtol=1e-5, atol=1e-6)


def test_a_dimension_outside_is_refused_beyond_three_errors_only():
    """D is then the mean of the truncated normal, at the same height; else another surface."""
    found = fj.identify(gaussian_profile(np.random.default_rng(0)), 1e-6)
    for D, is_fractal in ((1.93, True), (2.0001, True), (1.8, False), (3.1, True), (3.3, False)):
        changed = dataclasses.replace(found, D=D, D_standard_error=0.05)
        scatter = changed.scatter
        assert isinstance(scatter.surface, fj.Surface) == is_fractal
        if is_fractal:
            surface: Any = scatter.surface
            mean = truncnorm.mean((2 - D) / 0.05, (3 - D) / 0.05, D, 0.05)
            assert float(surface.D) == pytest.approx(np.asarray(mean).item(), rel=1e-9)
            log_m = math.log(float(scatter.surface.m(changed.q)))
            assert log_m == pytest.approx(changed.log_height, rel=1e-9)
    few = dataclasses.replace(found, warnings=("too few levels: heights have only 4 levels",))
    with pytest.raises(
        ValueError, match=r"^too few levels: .*: measure with finer steps of height"
    ):
        few.scatter  # noqa: B018
