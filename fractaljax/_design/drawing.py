"""What a drawing says of a surface before a design and after it."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ScalarLike

from .._base.parts import Record
from .._base.table import table
from .._mechanism.mechanism import Mechanism
from .._stability.stability import growth_rate
from .._surface.areal_parameters import areal_parameters
from .._surface.profile_parameters import profile_parameters
from .._surface.spectrum import Spectrum
from .._surface.surface import Surface
from .growing_modes import needs_modes


class Drawing(Record):
    """Roughness parameters of the given and the designed surface; printed, it is a table."""

    Ra: tuple[float, float]  # arithmetic mean height [m], before and after
    Rz: tuple[float, float]  # maximum height [m], before and after
    Sq: tuple[float, float]  # root mean square height [m], before and after
    Sdq: tuple[float, float]  # root mean square gradient, before and after
    cutoff: float  # longest wavelength that the filters leave [m]
    shortest: float  # shortest wavelength that the filters leave [m]
    quiet_Ra: tuple[float, float] | None  # where the design stays quiet [m]; None if it is not

    def __repr__(self) -> str:
        rows = {"Ra [m]": self.Ra, "Rz [m]": self.Rz, "Sq [m]": self.Sq, "Sdq": self.Sdq}
        columns = [{name: f"{values[i]:.6g}" for name, values in rows.items()} for i in (0, 1)]
        filters = f"wavelengths from {self.cutoff:g} to {self.shortest:g} m"
        lines = [table(["before", "after"], columns), f"Ra to Sdq: behind filters, {filters}"]
        if self.quiet_Ra is not None:
            low, high = self.quiet_Ra
            lines.append(f"quiet for Ra from {low:.3g} to {high:.3g} m, all heights in proportion")
        return "\n".join(lines)


@functools.partial(jax.jit, static_argnames=("friction_slope", "joint"))
def _growth_rates(x: Mechanism, factors, friction_slope: bool, joint: str):
    """Growth rates [1/s] with the heights of a joint's surface times each of the factors."""
    parts = x.joints_by_name()

    def at(factor):
        surface = parts[joint].contact.surface.times(factor)
        changed = eqx.tree_at(lambda part: part.contact.surface, parts[joint], surface)
        return growth_rate(x.with_joints({**parts, joint: changed}), friction_slope)

    return jax.lax.map(at, factors) if needs_modes(x) else jax.vmap(at)(factors)


def quiet_factors(
    x: Mechanism, friction_slope: bool, joint: str = ""
) -> tuple[float, float] | None:
    """Between which factors of all heights of a joint, from 0.1 to 10, the mechanism stays quiet.

    None unless it is quiet as it is.
    """
    count = 33 if needs_modes(x) else 257  # eigenvalues of a structure take long
    logs = np.linspace(-np.log(10), np.log(10), count)
    rates = np.asarray(_growth_rates(x, jnp.exp(jnp.asarray(logs)), friction_slope, joint))
    middle, loud = len(logs) // 2, ~(rates < 0)
    if loud[middle]:
        return None
    ends = []
    for step in (-1, 1):
        side = slice(middle, None, step)
        at, rate, stop = logs[side], rates[side], loud[side]
        k = int(np.argmax(stop))
        if not stop.any():
            ends.append(at[-1])
        elif np.isnan(rate[k]):
            ends.append(at[k - 1])
        else:
            ends.append(np.interp(0.0, rate[k - 1 : k + 1], at[k - 1 : k + 1]))
    low, high = np.exp(ends)
    return float(low), float(high)


def compare_drawings(
    x: Mechanism,
    joint: str,
    before: Spectrum,
    after: Spectrum,
    cutoff: ScalarLike,
    shortest: ScalarLike,
    wavelengths: tuple[float, float],
    friction_slope: bool,
) -> Drawing:
    """What to expect of a joint's surfaces before and `after` the design x, behind the filters.

    A `Surface` has these wavelengths.
    """
    filters: dict[str, Any] = dict(cutoff=cutoff, shortest=shortest)
    if isinstance(before, Surface):
        filters |= dict(zip(("L", "L_s"), wavelengths, strict=True))
    profiles = [profile_parameters(surface, **filters) for surface in (before, after)]
    maps = [areal_parameters(surface, **filters) for surface in (before, after)]

    def both(pair, name) -> tuple[float, float]:
        return float(getattr(pair[0], name)), float(getattr(pair[1], name))

    Ra, factors = both(profiles, "Ra"), quiet_factors(x, friction_slope, joint)
    return Drawing(
        Ra,
        both(profiles, "Rz"),
        both(maps, "Sq"),
        both(maps, "Sdq"),
        float(jnp.asarray(cutoff)),
        float(jnp.asarray(shortest)),
        None if factors is None else (Ra[1] * factors[0], Ra[1] * factors[1]),
    )
