"""The merit that gradient descent lowers: its slope is that of its own differences."""

from types import SimpleNamespace

import numpy as np

from fractaljax._design.descent import _merit

LIMITED = np.array([False, True, True, True])
SCALE, PENALTY = 0.7, 10.0


def functions(u):
    """Objective and three residuals at two conditions (2, 4), met and unmet, and their slopes."""
    rng = np.random.default_rng(4)
    a, B, C = rng.standard_normal((2, 4)), *rng.standard_normal((2, 2, 4, 3))
    return a + B @ u + C @ u**2, B + 2 * C * u


def test_slope_of_the_merit_of_two_designs():
    evaluator = SimpleNamespace(average=lambda row, slope: (row, slope))

    def merit(us):
        rows, slopes = (np.concatenate(x) for x in zip(*map(functions, us), strict=True))
        return _merit(evaluator, rows, slopes, len(us), LIMITED, SCALE, PENALTY)

    us, h = np.array([[0.2, 0.5, 0.9], [0.7, 0.1, 0.4]]), 1e-6
    residuals = np.stack([functions(u)[0][:, 1:] for u in us])
    assert (residuals > 0.1).any() and (residuals < -0.1).any()
    _, gradient = merit(us)
    for step in h * np.eye(3):
        slope = (merit(us + step)[0] - merit(us - step)[0]) / (2 * h)
        np.testing.assert_allclose(gradient @ step / h, slope, rtol=1e-7, atol=1e-8)
