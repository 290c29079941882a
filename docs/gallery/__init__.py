"""Published results beside ours. Each module holds the cases of one subject."""

import jax

jax.config.update("jax_enable_x64", True)  # before modules make their materials

from . import (  # noqa: E402
    belts,
    coupling,
    damper,
    disc,
    finite_elements,
    follower,
    rough,
    smooth,
    source,
    two_blocks,
)
from .case import Case  # noqa: E402

_MODULES = (
    *(source, coupling, disc, follower, belts, two_blocks, damper, rough, smooth, finite_elements),
)
CASES: dict[str, Case] = {case.name: case for module in _MODULES for case in module.CASES}
