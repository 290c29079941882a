"""Distinct motions from many starts."""

import numpy as np
import pytest

import fractaljax as fj
from tools import reference_scene


@pytest.mark.slow
def test_coexisting_attractors():
    """At K_n = 6e8 the starts end in several distinct cycles, each of them attracting."""
    scene = reference_scene().replace(K_n=6e8, K_t=3e8)
    found = fj.attractors(scene)
    cycles = [cycle for cycle in found if np.isfinite(cycle.period)]
    assert len(cycles) >= 2
    periods = sorted(float(cycle.period) for cycle in cycles)
    assert min(np.diff(periods)) > 1e-6
    assert all(abs(cycle.multipliers[1]) < 1 for cycle in cycles)


def test_bad_starts_of_attractors():
    with pytest.raises(ValueError, match=r"starts must have shape \(k, 4\), got \(4,\)"):
        fj.attractors(reference_scene(), [0.0, 0.0, 0.0, 0.0])
