"""What a drawing says of a surface before a design and after it."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ScalarLike

from .._base.parts import Record
from .._base.table import table
from .._surface.areal_parameters import areal_parameters
from .._surface.profile_parameters import profile_parameters
from .._surface.spectrum import Spectrum
from .._surface.surface import Surface


class Drawing(Record):
    """Roughness parameters of the given and the designed surface; printed, it is a table."""

    Ra: tuple[float, float]  # arithmetic mean height [m], before and after
    Rz: tuple[float, float]  # maximum height [m], before and after
    Sq: tuple[float, float]  # root mean square height [m], before and after
    Sdq: tuple[float, float]  # root mean square gradient, before and after
    cutoff: float  # longest wavelength that the filters leave [m]
    shortest: float  # shortest wavelength that the filters leave [m]

    def __repr__(self) -> str:
        rows = {"Ra [m]": self.Ra, "Rz [m]": self.Rz, "Sq [m]": self.Sq, "Sdq": self.Sdq}
        columns = [{name: f"{values[i]:.6g}" for name, values in rows.items()} for i in (0, 1)]
        filters = f"wavelengths from {self.cutoff:g} to {self.shortest:g} m"
        return "\n".join(
            [table(["before", "after"], columns), f"Ra to Sdq: behind filters, {filters}"]
        )


def compare_drawings(
    before: Spectrum,
    after: Spectrum,
    cutoff: ScalarLike,
    shortest: ScalarLike,
    wavelengths: tuple[float, float],
) -> Drawing:
    """What to expect of two surfaces behind the filters; a `Surface` has these wavelengths."""
    filters: dict[str, Any] = dict(cutoff=cutoff, shortest=shortest)
    if isinstance(before, Surface):
        filters |= dict(zip(("L", "L_s"), wavelengths, strict=True))
    profiles = [profile_parameters(surface, **filters) for surface in (before, after)]
    maps = [areal_parameters(surface, **filters) for surface in (before, after)]

    def both(pair, name) -> tuple[float, float]:
        return float(getattr(pair[0], name)), float(getattr(pair[1], name))

    return Drawing(
        both(profiles, "Ra"),
        both(profiles, "Rz"),
        both(maps, "Sq"),
        both(maps, "Sdq"),
        float(jnp.asarray(cutoff)),
        float(jnp.asarray(shortest)),
    )
