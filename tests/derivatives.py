"""Derivatives by every argument at once, in both modes, against differences."""

import jax
import jax.numpy as jnp
import numpy as np

from tools import both_modes


def check_slopes(function, rows, names, rtol: float = 1e-7, atol: float = 1e-8, h: float = 3e-5):
    """Both Jacobians of function(row) (m,) at each row are its differences of fourth order.

    All by the logarithms of the arguments. One program serves values and both modes.
    """

    @jax.jit
    def program(row, u):
        value, *modes = both_modes(lambda u: function(row * jnp.exp(u)), u)
        return jnp.atleast_1d(value), *map(jnp.atleast_2d, modes)

    for row in np.asarray(rows, float):
        assert len(row) == len(names)
        _, *modes = program(row, np.zeros(len(row)))
        for i, name in enumerate(names):
            unit = h * np.eye(len(row))[i]
            far, near, *others = (np.asarray(program(row, k * unit)[0]) for k in (-2, -1, 1, 2))
            slope = (far - 8 * near + 8 * others[0] - others[1]) / (12 * h)
            assert np.isfinite(slope).all(), name
            for mode in modes:
                np.testing.assert_allclose(mode[:, i], slope, rtol, atol, err_msg=name)
