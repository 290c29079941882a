"""Persson's law of spectra other than Eq. 13: quadrature, boundary elements, slopes, files."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mpf
from scipy.integrate import quad
from scipy.special import erf

import fractaljax as fj
from tools import both_modes

mp = mpmath
E = 1.154e11
MATERIAL = fj.Material(E=E, nu=0.3, sigma_y=3.55e8, H=9.94e8)
NAMES = ("Sq", "H", "rolloff", "shortest", "lay", "P", "area")


def K_n(surface, P, area):
    return fj.PerssonContact(surface, MATERIAL, P, area).stiffness(0.4, 0.25)[0]


def joined(middle, P, area, cell, H, Sq, root, exp, sqrt):
    """K_n from the compliance of the middle range, with the finite-size law and atoms."""
    cells = sqrt(area) / cell
    finite = 1.05 * exp(1.24 * (0.5 - H)) * cells * E * cell
    finite *= root(P / (cells * E * Sq * cell), 1 + H)
    compliance = middle / root(1 + (middle * finite) ** 2.4, 2.4)
    return 1 / (compliance + 3e-10 / (E * area))


def exact(Sq, H, rolloff, shortest, P, area):
    """K_n without a longest wavelength, by quadrature in 40 digits."""
    Sq, H, rolloff, shortest, P, area = map(mpf, (Sq, H, rolloff, shortest, P, area))
    q_r, q_s, q_L = (2 * mp.pi / x for x in (rolloff, shortest, mp.sqrt(area)))
    m_r = Sq**2 / (mpf(1) / 2 + (1 - (q_s / q_r) ** (-2 * H)) / (2 * H))

    def m(q):
        return m_r * ((q / q_r) ** 2 if q < q_r else (q / q_r) ** (-2 * H))

    def g2(q):
        below = m_r / q_r**2 * (min(q, q_r) ** 4 - q_L**4) / 4
        if q <= q_r:
            return below
        return below + m_r * q_r**2 * ((q / q_r) ** (2 - 2 * H) - 1) / (2 - 2 * H)

    def integrand(x):
        q = mp.exp(x)
        s = mp.sqrt(2) * P / (area * E * mp.sqrt(g2(q)))
        energy = mpf("0.45") + 3 * mpf("0.55") * mp.erf(s) ** 2
        return m(q) * q / mp.sqrt(g2(q)) * energy * mp.exp(-(s**2))

    low, peak, high = map(mp.log, (q_L, q_r, q_s))
    near = [low + (peak - low) * mpf(2) ** -k for k in range(60, 0, -2)]
    cuts = [
        low + (peak - low) * mpf(2) ** -62,
        *near,
        peak,
        (2 * peak + high) / 3,
        (peak + 2 * high) / 3,
        high,
    ]
    middle = mp.quad(integrand, cuts) / mp.sqrt(2 * mp.pi) / P
    middle *= 1 + mp.erf(mp.sqrt(2) * P / (area * E * mp.sqrt(g2(q_s)))) ** 4 / 2
    return joined(middle, P, area, rolloff, H, Sq, lambda x, n: x ** (1 / n), mp.exp, mp.sqrt)


@pytest.mark.parametrize(
    "row",
    [
        (1e-6, 0.8, 1e-4, 1e-5, 1e3, 1e-6),
        (1e-6, 0.8, 1e-4, 1e-6, 1e-3, 1e-4),  # a few hills
        (3e-7, 0.3, 2e-4, 1e-5, 3e4, 1e-6),  # nearly all of it
    ],
)
def test_stiffness_is_the_quadrature(row):
    with mpmath.workdps(30):
        expected = float(exact(*row))
    *surface, P, area = row
    assert float(K_n(fj.SelfAffine(*surface), P, area)) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("lay", [0.4, 1.0, 3.0, 10.0])
def test_stiffness_with_a_lay_is_the_quadrature(lay):
    """Of the mean over directions, with the gradient of all waves up to q in all directions."""
    Sq, H, rolloff, shortest, P, area = 1e-6, 0.8, 6e-5, 1e-5, 1e3, 1e-6
    surface = fj.SelfAffine(Sq, H, rolloff, shortest, lay=lay)
    angles = (np.arange(720) + 0.5) / 720 * math.pi / 2
    s = np.hypot(lay * np.cos(angles), np.sin(angles))
    q_r, q_s, q_L = (2 * math.pi / x for x in (rolloff, shortest, 1e-3))
    m_r = Sq**2 / (1 / 2 + (1 - (q_s / q_r) ** (-2 * H)) / (2 * H))

    def g2(q):
        stretched = np.clip(q * s, q_L, q_s)
        below = m_r / q_r**2 * (np.minimum(stretched, q_r) ** 4 - q_L**4) / 4
        above = np.maximum(stretched / q_r, 1) ** (2 - 2 * H) - 1
        return np.mean(lay / s**4 * (below + m_r * q_r**2 * above / (2 - 2 * H)))

    # The integral of m q/g [...] dln q is that of 2/q [...] dg.
    q = np.geomspace(q_L / max(lay, 1), q_s / min(lay, 1), 4001)
    g = np.sqrt([g2(each) for each in q])
    middles = np.sqrt(q[1:] * q[:-1])
    strain = math.sqrt(2) * P / (area * E * np.sqrt((g[1:] ** 2 + g[:-1] ** 2) / 2))
    kernel = (0.45 + 1.65 * erf(strain) ** 2) * np.exp(-(strain**2))
    middle = np.sum(2 / middles * kernel * np.diff(g)) / math.sqrt(2 * math.pi) / P
    middle *= 1 + erf(math.sqrt(2) * P / (area * E * g[-1])) ** 4 / 2
    cell = rolloff * math.sqrt(lay)
    expected = joined(middle, P, area, cell, H, Sq, lambda x, n: x ** (1 / n), math.exp, math.sqrt)
    assert float(K_n(surface, P, area)) == pytest.approx(expected, rel=2e-3)


def test_a_table_and_its_law_agree():
    surface = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5, longest=1e-3)
    q = 2 * math.pi / np.concatenate([np.geomspace(1e-3, 1e-4, 9), np.geomspace(1e-4, 1e-5, 9)[1:]])
    table = fj.MeasuredSpectrum(q, np.asarray(surface.C(q)))
    for P in (1.0, 1e3, 3e5):
        expected = float(K_n(surface, P, 1e-6))
        assert float(K_n(table, P, 1e-6)) == pytest.approx(expected, rel=2e-3)
    side = 3e-4  # longer waves are left out of both
    assert float(K_n(table, 100.0, side**2)) == pytest.approx(
        float(K_n(surface, 100.0, side**2)), rel=0.01
    )


TRUTH = json.loads((Path(__file__).parents[1] / "reference/self_affine_contacts.json").read_text())[
    "surfaces"
]


@pytest.mark.parametrize("row", TRUTH, ids=lambda row: str(row["surface"]))
def test_within_the_stated_errors_of_boundary_elements(row):
    """From 1e-3 to .5 of E Sdq, with roll-off and lay."""
    surface = fj.SelfAffine(**row["surface"])
    for pressure, expected in zip(row["pressures"], row["K_n_per_area"], strict=True):
        stiffness = float(K_n(surface, pressure * row["area"], row["area"]))
        assert 0.75 < stiffness / (expected * row["area"]) < 1.1


@jax.jit
def log_stiffness(x):
    def function(x):
        *surface, lay, P, area = jnp.exp(x)
        return jnp.log(K_n(fj.SelfAffine(*surface, lay=lay), P, area))[None]

    return both_modes(function, x)


@pytest.mark.parametrize("lay", [1.0, 4.0])
@pytest.mark.parametrize("P", [1e-2, 1e3, 1e5])
def test_slopes(P, lay):
    """By every number in both modes, against differences; without a kink at lay = 1."""
    x = np.log([1e-6, 0.8, 1e-4, 1e-5, lay, P, 1e-6])
    _, forward, reverse = log_stiffness(jnp.asarray(x))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-11)
    for i, _name in enumerate(NAMES):
        ends = [log_stiffness(jnp.asarray(x + s * np.eye(7)[i]))[0] for s in (1e-5, -1e-5)]
        expected = float((ends[0] - ends[1])[0]) / 2e-5
        assert float(forward[0, i]) == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_small_loads_follow_the_finite_size_law_and_the_load_curve_ends():
    surface = fj.SelfAffine(1e-6, 0.6, 1e-4, 1e-5)
    law = fj.PerssonContact(surface, MATERIAL, 1e3, 1e-6)
    assert float(law.opening_exponent) == pytest.approx(1 / 1.6)
    low, high = (float(K_n(surface, P, 1e-6)) for P in (1e-7, 2e-7))
    assert math.log2(high / low) == pytest.approx(1 / 1.6, abs=1e-3)
    opening = float(law.load(-1e-4, 0.4, 0.25))
    closed = float(law.load(1e-8, 0.4, 0.25))
    assert opening == 0 and closed > 1e3
    slope = (float(law.load(1e-12, 0.4, 0.25)) - 1e3) / 1e-12
    assert slope == pytest.approx(float(law.stiffness(0.4, 0.25)[0]), rel=1e-3)


def test_real_area_and_mean_gap():
    surface = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5)
    law = fj.PerssonContact(surface, MATERIAL, 1e3, 1e-6)
    Sdq = math.sqrt(float(surface.pieces(jnp.asarray(1e-3)).moment(2)))
    expected = erf(math.sqrt(2) * 1e3 / (1e-6 * E * Sdq))
    assert float(law.real_area(0.25)) / 1e-6 == pytest.approx(expected, rel=1e-10)
    loads = np.geomspace(1e3, 2e3, 41)
    compliance = [1 / float(K_n(surface, P, 1e-6)) - 3e-10 / (E * 1e-6) for P in loads]
    fall = float(law.mean_gap()) - float(fj.PerssonContact(surface, MATERIAL, 2e3, 1e-6).mean_gap())
    assert fall == pytest.approx(np.trapezoid(compliance, loads), rel=1e-3)


def test_float32():
    single = jax.tree.map(lambda x: x.astype(jnp.float32), fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5))
    law = fj.PerssonContact(single, MATERIAL, np.float32(1e3), np.float32(1e-6))
    law = jax.tree.map(lambda x: x.astype(jnp.float32), law)
    K = law.stiffness(jnp.float32(0.4), jnp.float32(0.25))[0]
    expected = float(K_n(fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5), 1e3, 1e-6))
    assert K.dtype == jnp.float32 and float(K) == pytest.approx(expected, rel=1e-4)


def test_without_waves_longer_than_the_roll_off():
    """The law has one power of q there: SciPy's adaptive quadrature."""
    surface = fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5, longest=1e-4)
    P, area = 2e3, 1e-6
    q_r, m_r = 2 * math.pi / 1e-4, float(surface.m(2 * math.pi / 1e-4))

    def integrand(x):
        g = math.sqrt(m_r * q_r**2 * math.expm1(0.4 * x) / 0.4)
        s = math.sqrt(2) * P / (area * E * g)
        m, q = m_r * math.exp(-1.6 * x), q_r * math.exp(x)
        return m * q / g * (0.45 + 1.65 * erf(s) ** 2) * math.exp(-(s**2))

    middle = quad(integrand, 1e-9, math.log(10), epsrel=1e-10, epsabs=0, limit=200)[0]
    middle *= 1 / math.sqrt(2 * math.pi) / P
    g = math.sqrt(m_r * q_r**2 * math.expm1(0.4 * math.log(10)) / 0.4)
    middle *= 1 + erf(math.sqrt(2) * P / (area * E * g)) ** 4 / 2
    expected = joined(
        middle, P, area, 1e-4, 0.8, 1e-6, lambda x, n: x ** (1 / n), math.exp, math.sqrt
    )
    assert float(K_n(surface, P, area)) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("lay", [None, 2.0])
def test_sweeps_over_each_number(lay):
    """Each value of a sweep is that of the replaced scene; what is outside the domain is named."""
    surface = fj.SelfAffine(1e-6, 0.8, 1e-4, 4e-6, longest=1e-3, lay=lay)
    contact = fj.PerssonContact(surface, MATERIAL, 400.0, 1e-5)
    scene = fj.brake_scene().replace(contact=contact)
    for name, values in {
        "Sq": [1e-7, 1e-6],
        "hurst": [0.6, 0.9],
        "rolloff": [5e-5, 2e-4],
        "shortest": [2e-6, 1e-5],
        "longest": [5e-4, 2e-3],
        **({} if lay is None else {"lay": [0.5, 3.0]}),
    }.items():
        axis: Any = {name: values}
        swept = fj.sweep(fj.growth_rate, scene, progress=False, **axis).values
        singly = [float(fj.growth_rate(scene.replace(**{name: value}))) for value in values]
        np.testing.assert_allclose(swept, singly, rtol=1e-9)
        assert singly[0] != singly[1]
    with pytest.raises(ValueError, match=r"H \(hurst\) must be above 0 and at most 1, got 1.2"):
        fj.sweep(fj.growth_rate, scene, progress=False, hurst=[0.5, 1.2])
    with pytest.raises(ValueError, match="rolloff must be at least shortest = 4e-06, got 1e-06"):
        fj.sweep(fj.growth_rate, scene, progress=False, rolloff=[1e-6, 1e-4], P=[300.0, 400.0])
    # `jax.vmap` takes many scenes; what takes one says so.
    many = scene.replace(Sq=np.array([1e-7, 1e-6]))
    with pytest.raises(ValueError, match=r"Sq must be a scalar, got shape \(2,\)"):
        fj.stiffness(many)
    with pytest.raises(ValueError, match=r"Sq must be a scalar, got shape \(2,\)"):
        fj.roughness(many.contact.surface)


@pytest.mark.slow
def test_boundaries_and_envelopes_over_its_numbers():
    """Growth rates vanish on the boundary; an envelope of H counts the worst."""
    contact = fj.PerssonContact(fj.SelfAffine(1e-6, 0.8, 1e-4, 4e-6), MATERIAL, 400.0, 1e-5)
    scene = fj.brake_scene().replace(contact=contact)
    found = fj.hopf_boundary(scene, ("Sq", 5e-7, 1e-5), ("P", 1.0, 100.0), lines=9)
    assert found.branches
    for branch in found.branches:
        for Sq, P in zip(branch.x[::9], branch.y[::9], strict=True):
            rate = float(fj.growth_rate(scene.replace(Sq=Sq, P=P)))
            assert abs(rate) < 1e-5
    at = scene.replace(Sq=float(found.branches[0].x[9]), P=float(found.branches[0].y[9]))
    alone, over, *ends = (
        fj.squeal_probability(x, {"ln Sq": 0.1}, envelope=envelope).value
        for x, envelope in (
            (at, None),
            (at, {"hurst": (0.7, 0.9)}),
            (at.replace(hurst=0.7), None),
            (at.replace(hurst=0.9), None),
        )
    )
    assert 0.2 < alone < 0.8 and min(ends) < over < max(ends) != min(ends)
