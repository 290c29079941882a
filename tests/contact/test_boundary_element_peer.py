"""Boundary elements beside Tamaas (Frerot et al., J. Open Source Softw. 5, 2121, 2020)."""

from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from synthetic import rough

tamaas: Any = pytest.importorskip("tamaas", reason="Tamaas has wheels for Linux on x86-64 alone")

MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)
DX, E = 1e-5, 1.154e11


def peer(heights, mean):
    """Pressure [Pa] and gap [m] under a mean pressure [Pa], by Polonsky and Keer's method."""
    tamaas.set_log_level(tamaas.LogLevel.error)
    size = [n * DX for n in heights.shape]
    model = tamaas.ModelFactory.createModel(tamaas.model_type.basic_2d, size, list(heights.shape))
    model.E, model.nu = E, 0.0  # E is that of the pair
    kind = tamaas.PolonskyKeerRey.pressure
    solver = tamaas.PolonskyKeerRey(model, heights, 1e-14, kind, kind)
    solver.max_iter = 20_000
    solver.solve(mean)
    pressure, gap = np.array(model.traction), np.array(model.displacement) - heights
    return pressure, gap - gap[pressure > 0].mean()


@pytest.mark.parametrize(
    ("shape", "mean"), [((64, 64), 1e6), ((64, 48), 1e7), ((48, 64), 1e8), ((32, 64), 3e8)]
)
def test_the_same_contact(shape, mean):
    """Pressure, gap, area, mean gap, and K_n, of Tamaas by differences within one outline."""
    heights, total = rough(shape), shape[0] * shape[1] * DX**2
    found = fj.boundary_element(heights, DX, MATERIAL, mean * total, rtol=1e-12)
    pressure, gap = peer(heights, mean)
    np.testing.assert_allclose(found.pressure, pressure, rtol=0, atol=1e-9 * pressure.max())
    np.testing.assert_allclose(found.gap, gap, rtol=0, atol=1e-9 * heights.std())
    assert float(found.mean_gap) == pytest.approx(gap.mean(), rel=1e-9)
    assert float(found.area) == pytest.approx((pressure > 0).mean() * total, rel=1e-12)
    ends = [peer(heights, mean * (1 + sign * 1e-6)) for sign in (1, -1)]
    assert all(((p > 0) == (pressure > 0)).all() for p, _ in ends)
    K_n = 2e-6 * mean * total / (ends[1][1].mean() - ends[0][1].mean())
    assert float(found.K_n) == pytest.approx(K_n, rel=1e-6)
