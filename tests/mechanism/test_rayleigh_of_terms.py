"""Rayleigh damping in a file whose matrices are sums with coefficients of parameters."""

from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from structures import matrices

M, _, K = matrices(3)


@pytest.mark.parametrize("coefficient", ["1 + kr", "1 - kr", "kr / 2 + 0.25", "kr", "-kr + 3"])
def test_damping_is_that_of_the_sums(tmp_path, coefficient):
    """alpha M + beta K at every value of the parameter, whatever the formula."""
    np.savez(tmp_path / "two.npz", M=M, K=K, N=0.1 * K)
    path = tmp_path / "x.toml"
    path.write_text(
        '[structure]\nmatrices = "two.npz"\nrayleigh = [2.0, 3e-6]\n'
        'M = [{coefficient = "2 - kr", matrix = "M"}]\n'
        f'K = [{{matrix = "K"}}, {{coefficient = "{coefficient}", matrix = "N"}}]\n'
        "[parameters]\nkr = 0.5\n[joints]\n"
    )
    x: Any = fj.load(path)
    for kr in (0.5, 0.8):
        at = x.replace(kr=kr)
        mass, stiffness = (2 - kr) * M, K + eval(coefficient, {"kr": kr}) * 0.1 * K
        np.testing.assert_allclose(at.K, stiffness, rtol=1e-13)
        np.testing.assert_allclose(at.C, 2.0 * mass + 3e-6 * stiffness, rtol=1e-13)
