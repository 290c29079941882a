"""Normal scatter of what has to stay between two ends: D, a Hurst exponent, a roll-off wavelength.

Where six standard deviations stay inside, nothing is changed. Elsewhere the normal distribution is
cut off at the ends and scaled up to a total of 1, as a measured D is known with nothing else known
but 2 < D < 3: a wide one tends to an even distribution. Draws are mapped by their quantiles, so
that they follow the design continuously. The mass beyond six deviations, 1e-9, is left aside.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array

from .._mechanism.mechanism import Mechanism
from .._surface.self_affine import SelfAffine
from .._surface.surface import Surface

REACH = 6.0  # standard deviations that must stay inside the domain of a quantity


def ends_of(x: Mechanism, name: str, value_at: Callable[[str], Any]) -> tuple[Any, Any] | None:
    """The ends of a quantity that is truncated to them, of all joints or of one; None of others.

    `value_at` returns the value of another quantity of the same joint, by its plain name.
    """
    quantities = x.stored_quantities()
    if name not in quantities:
        return None
    for kind, field, ends in (
        (Surface, "D", lambda: (2.0, 3.0)),
        (SelfAffine, "H", lambda: (0.0, 1.0)),
        (SelfAffine, "rolloff", lambda: (value_at("shortest"), _longest(value_at("longest")))),
    ):
        meaning = {each.name: each for each in dataclasses.fields(kind)}[field].metadata["meaning"]
        if quantities[name].meaning == meaning:
            return ends()
    return None


def _longest(value: Any) -> Any:
    return math.inf if value is None else value


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
