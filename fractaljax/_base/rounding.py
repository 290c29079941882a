"""Rounding error of computed numbers."""

from typing import Any

import jax.numpy as jnp


def rounding_error(dtype: Any) -> float:
    """Bound on the relative rounding error of a sum of n products, or of a closed form: 16 eps.

    The worst case grows as n eps, but errors of either sign mostly cancel.
    """
    return 16 * float(jnp.finfo(dtype).eps)
