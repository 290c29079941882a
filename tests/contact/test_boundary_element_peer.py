"""Boundary elements beside Tamaas and ContactMechanics."""

import numpy as np
import pytest

import fractaljax as fj
from benchmarks import half_spaces
from synthetic import rough

MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)
DX, E, H = 1e-5, 1.154e11, 9.94e8
CASES = [((64, 64), 1e6), ((64, 48), 1e7), ((48, 64), 1e8), ((32, 64), 3e8)]


def import_or_skip(package: str) -> None:
    pytest.importorskip(package, reason=f"{package} has wheels for few platforms")


def pressed(name, *case) -> tuple[np.ndarray, np.ndarray]:
    """Pressure [Pa] and gap [m], 0 in the mean of the contact."""
    pressure, gap = half_spaces.PEERS[name][1](*case)
    return pressure, gap - gap[pressure > 0].mean()


@pytest.mark.parametrize(("name", "tolerance"), [("Tamaas", 1e-14), ("ContactMechanics", 1e-11)])
@pytest.mark.parametrize(("shape", "mean"), CASES)
def test_the_same_contact(shape, mean, name, tolerance):
    """Pressure, gap, area, mean gap, and K_n, the peer's by differences within one outline."""
    import_or_skip(half_spaces.PEERS[name][0])
    heights, total = rough(shape), shape[0] * shape[1] * DX**2
    ours = fj.boundary_element(heights, DX, MATERIAL, mean * total, rtol=1e-12)
    pressure, gap = pressed(name, heights, DX, E, mean, tolerance)
    np.testing.assert_allclose(ours.pressure, pressure, rtol=0, atol=1e-9 * pressure.max())
    np.testing.assert_allclose(ours.gap, gap, rtol=0, atol=1e-9 * heights.std())
    assert float(ours.mean_gap) == pytest.approx(gap.mean(), rel=1e-9)
    assert float(ours.area) == pytest.approx((pressure > 0).mean() * total, rel=1e-12)
    step = 1e-6
    ends = [pressed(name, heights, DX, E, mean * (1 + s * step), tolerance) for s in (1, -1)]
    assert all(((p > 0) == (pressure > 0)).all() for p, _ in ends)
    K_n = 2 * step * mean * total / (ends[1][1].mean() - ends[0][1].mean())
    assert float(ours.K_n) == pytest.approx(K_n, rel=1e-6)


@pytest.mark.parametrize("shape", [(32, 48), (48, 64)])
@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.9])
def test_the_same_yielding_contact(shape, fraction):
    """Tamaas' own method for pressures up to a limit: pressure, area and mean gap."""
    import_or_skip("tamaas")
    heights, mean = rough(shape), fraction * H
    total = heights.size * DX**2
    ours = fj.boundary_element(heights, DX, MATERIAL, mean * total, plastic=True, rtol=1e-11)
    pressure, gap = half_spaces.tamaas_saturated(heights, DX, E, mean, 1e-12, H)
    yields, free = pressure > H * (1 - 1e-9), pressure > 0
    assert yields.any() and (free & ~yields).any()
    np.testing.assert_allclose(ours.pressure, pressure, rtol=0, atol=1e-8 * H)
    gap -= gap[free & ~yields].mean()
    np.testing.assert_allclose(ours.gap, np.maximum(gap, 0), rtol=0, atol=1e-8 * heights.std())
    assert float(ours.area) == pytest.approx(free.mean() * total, rel=1e-12)
    assert float(ours.mean_gap) == pytest.approx(np.maximum(gap, 0).mean(), rel=1e-7)
