"""The growth rate of a mechanism while the surfaces of its joints run in."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.parts import scalar
from .._contact.boundary_element import boundary_element
from .._contact.contact import Contact
from .._contact.run_in import run_in
from .._mechanism.mechanism import Mechanism
from .._stability.stability import growth_rate
from .._surface.spectrum import Spectrum
from .._surface.surface import Surface
from .._surface.topography import topography
from .joints import with_contacts


class Worn(Contact):
    """A contact law whose stiffness under every load has grown by one factor."""

    of: Contact
    factor: Float[Array, ""]

    @property
    def P(self) -> Any:
        """The load of the law [N]."""
        law: Any = self.of
        return law.P

    @property
    def opening_exponent(self):
        return self.of.opening_exponent

    def stiffness(self, mu_s, mu_m):
        K_n, K_t = self.of.stiffness(mu_s, mu_m)
        return self.factor * K_n, self.factor * K_t

    def load_curve(self, mu_s, mu_m):
        return self.of.load_curve(mu_s, mu_m)  # N/P over K_n u/P, in which the factor cancels


class WornGrowth(NamedTuple):
    """Growth rates over the depth of wear."""

    depths: np.ndarray  # (k,) mean height worn off, in units of Sq
    rates: np.ndarray  # (k,) [1/s]

    @property
    def onset(self) -> float | None:
        """The depth at which a quiet mechanism begins to squeal, or None if it never does."""
        crossed = np.flatnonzero((self.rates[:-1] < 0) & (self.rates[1:] >= 0))
        if not len(crossed):
            return None
        (a, b), (low, high) = (values[crossed[0] :][:2] for values in self)
        return float(a - low * (b - a) / (high - low))


def check_depths(depths: Any) -> tuple[float, float]:
    """The least and the greatest depth of wear in units of Sq.

    **Raises:** `ValueError` unless they are two rising numbers of at least 0.
    """
    if not isinstance(depths, Sequence) or isinstance(depths, str) or len(depths) != 2:
        raise ValueError(f"run_in must be (least, greatest) depth in units of Sq, got {depths!r}")
    low, high = (float(scalar("depth of run_in", depth, at_least=0)) for depth in depths)
    if not low < high:
        raise ValueError(f"run_in must be two rising depths in units of Sq, got {depths!r}")
    return low, high


def worn_growth(
    x: Mechanism,
    depths: tuple[float, float],
    area: Any,
    friction_slope: bool,
    seed: int,
    *,
    n: int = 256,
    maps: int = 2,
    points: int = 8,
) -> WornGrowth:
    """Growth rates while the joints with a spectrum wear, each by the same multiple of its Sq.

    Boundary elements say by what factor a worn map is stiffer under the load of the joint; the
    stiffness of its own law is multiplied by it under every load. The maps have `n` points a side:
    shorter waves are left out.
    """
    low, high = depths
    # The first wear stiffens most: it takes off the few summits that touch.
    coarse = np.unique([0.0, low, *np.geomspace(max(low, 1e-3 * high), high, points)])
    ends = coarse[coarse >= low]
    fine = np.interp(np.linspace(0, len(ends) - 1, 65), np.arange(len(ends)), ends)
    laws, logs = {}, {}
    for name, part in x.joints_by_name().items():
        contact = part.contact
        if not isinstance(getattr(contact, "surface", None), Spectrum):
            continue
        laws[name] = contact
        A = _nominal_area(name, contact, area)
        keys = jax.random.split(jax.random.key(seed), maps)
        stiffer = np.mean([_stiffening(contact, A, coarse, key, n) for key in keys], axis=0)
        logs[name] = np.interp(fine, coarse, stiffer)
    if not laws:
        raise ValueError("run_in needs a joint whose contact has a surface")

    @jax.jit
    def rates(logs):
        def at(logs):
            contacts = {name: Worn(law, jnp.exp(logs[name])) for name, law in laws.items()}
            return growth_rate(with_contacts(x, contacts), friction_slope)

        return jax.lax.map(at, logs)

    return WornGrowth(fine, np.asarray(rates({k: jnp.asarray(v) for k, v in logs.items()})))


def _nominal_area(name: str, contact: Any, area: Any) -> float:
    """The area of the law, or the one stated for the joint [m^2]."""
    stated = getattr(contact, "area", None)
    if stated is None:
        stated = area.get(name) if isinstance(area, Mapping) else area
    if stated is None:
        raise ValueError(f"run_in needs the nominal area of the joint {name}".rstrip())
    return float(scalar("area", stated, above=0))


def _stiffening(contact: Any, area: float, depths: np.ndarray, key, n: int) -> np.ndarray:
    """ln of the stiffness of a drawn map over that without wear, at each depth; rising from 0."""
    surface, side = contact.surface, area**0.5
    if isinstance(surface, Surface):
        longest = getattr(contact, "L", None)
    else:
        longest = 8 * surface.roll_off()[0]  # some cells, and points for the shorter waves
    L = side if longest is None else min(float(longest), side)
    heights = topography(surface, L, n, key=key, periodic=True)
    dx, pressure, Sq = L / n, float(contact.P) / area, float(jnp.std(heights))
    stiffness, before = [], 0.0
    for depth in depths:
        if depth > before:
            step = (depth - before) * Sq
            heights = run_in(heights, dx, contact.material, pressure, step, steps=4).heights
            before = depth
        stiffness.append(
            boundary_element(heights, dx, contact.material, pressure * float(L) ** 2).K_n
        )
    logs = np.log(np.asarray(stiffness))
    with np.errstate(invalid="ignore"):  # at full contact from the start there is no factor
        return logs - logs[0]
