"""Normal scatter of a fractal dimension, which has to stay above 2 and below 3.

Where six standard deviations stay inside, nothing is changed. Elsewhere the normal distribution is
cut off at the ends and scaled up to a total of 1, as a measured D is known with nothing else known
but 2 < D < 3: a wide one tends to an even distribution. Draws are mapped by their quantiles, so
that they follow the design continuously. The mass beyond six deviations, 1e-9, is left aside.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array

from .._mechanism.mechanism import Mechanism
from .._surface.surface import Surface

REACH = 6.0  # standard deviations that must stay inside the domain of a quantity


def is_fractal_dimension(x: Mechanism, name: str) -> bool:
    """True if a quantity is the D of a surface, of all joints or of one."""
    quantities = x.stored_quantities()
    fields = {field.name: field for field in dataclasses.fields(Surface)}
    return name in quantities and quantities[name].meaning == fields["D"].metadata["meaning"]


def truncated(shift: Any, sigma: Array, low: Any, high: Any) -> Array:
    """Normal shifts of a standard deviation, as those of the normal cut off at `low` and `high`.

    low < 0 < high. The shift of a quantile becomes that of the same quantile.
    """
    scale = jnp.where(sigma > 0, sigma, 1)
    # The lower half by itself, and the upper half as its mirror image: small tails stay exact.
    up = shift > 0
    lost = [jnp.maximum(ndtr(end / scale) - ndtr(-REACH), 0) for end in (low, -high)]
    here, there = jnp.where(up, lost[1], lost[0]), jnp.where(up, lost[0], lost[1])
    below = here + ndtr(-jnp.abs(shift) / scale) * (1 - here - there)
    closest = 1e-6  # that a draw comes to an end: single precision tells it from 2
    shifted = jnp.clip(jnp.where(up, -1, 1) * scale * ndtri(below), low + closest, high - closest)
    return jnp.where((here + there > 0) & (sigma > 0), shifted, shift)
