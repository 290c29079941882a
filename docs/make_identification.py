"""Draw identification.png: a known surface, identified, `python docs/make_identification.py`."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

import fractaljax as fj

PICTURE = Path(__file__).with_name("identification.png")
L, POINTS, NOISE = 1e-3, 512, 2e-9  # m, a side, m
TIP = 2e-6  # m


def draw(path=PICTURE) -> fj.Identification:
    """The reference brake's surface as a map, with an instrument's noise."""
    surface = fj.brake_scene().contact.surface
    z = np.asarray(fj.topography(surface, L, POINTS, key=jax.random.key(4)))
    z = z + NOISE * np.random.default_rng(0).standard_normal(z.shape)
    found = fj.identify(z, L / POINTS, stylus_radius=TIP)
    figure: Any = fj.plot.identification(found).figure
    figure.savefig(path, dpi=110)
    return found


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(draw())
