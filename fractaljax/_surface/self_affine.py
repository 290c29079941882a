"""A self-affine surface with a roll-off, the usual spectrum of ground, turned and blasted metal."""

import math
from typing import final

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import Numbers, number, ordered, quantity
from .._base.singular import boxcox
from .spectrum import Pieces, Spectrum, through_gradients


@final
class SelfAffine(Spectrum, law="self-affine"):
    """A self-affine surface: flat power spectrum above the roll-off wavelength, H below it.

    With q_r = 2 pi/rolloff, q_L = 2 pi/longest and q_s = 2 pi/shortest,

        m(q) = m_r (q/q_r)^2 below q_r,    m_r (q/q_r)^(-2H) above,
        m_r = Sq^2/([1 - (q_L/q_r)^2]/2 + [1 - (q_s/q_r)^(-2H)]/(2H)).

    With a `lay` along x, q is sqrt((lay q_x)^2 + q_y^2) in these: wavelengths along x are `lay`
    times those across.

    **Arguments:**

    - `Sq`: root mean square height [m].
    - `H`: Hurst exponent, above 0 and at most 1; smaller is finer. In files, `replace`, sweeps and
      bounds it is `hurst`, since H is the hardness.
    - `rolloff`: wavelength [m], across the lay, above which the power spectrum is flat.
    - `shortest`: wavelength [m] at which the spectrum ends.
    - `longest`: wavelength [m] at which it begins; None (default) for a flat spectrum without end.
    - `lay`: ratio of the correlation lengths along and across the lay; None (default) is 1, for a
      surface without lay, at less work.

    **Raises:** `ValueError` unless Sq > 0, 0 < H <= 1, 0 < shortest <= rolloff <= longest, lay > 0.
    """

    Sq: Numbers = quantity("m", "root mean square height", log=True)
    # The hardness of the material is the H of a scene.
    H: Numbers = quantity(
        "-", "Hurst exponent, above 0 and at most 1; smaller is finer", name="hurst", argument="H"
    )
    rolloff: Numbers = quantity("m", "roll-off wavelength", log=True)
    shortest: Numbers = quantity("m", "shortest wavelength", log=True)
    longest: Numbers | None = quantity("m", "longest wavelength, if the spectrum has one", log=True)
    lay: Numbers | None = quantity(
        "-", "correlation length along the lay over that across", log=True
    )

    def __init__(
        self,
        Sq: ArrayLike,
        H: ArrayLike,
        rolloff: ArrayLike,
        shortest: ArrayLike,
        longest: ArrayLike | None = None,
        lay: ArrayLike | None = None,
    ):
        self.Sq = number("Sq", Sq, above=0)
        self.H = number("H (hurst)", H, above=0, at_most=1)
        self.shortest = number("shortest", shortest, above=0)
        rolloff = number("rolloff", rolloff, above=0)
        self.rolloff = ordered("rolloff", rolloff, "shortest", self.shortest)
        if longest is not None:
            longest = number("longest", longest, above=0)
            longest = ordered("longest", longest, "rolloff", self.rolloff)
        self.longest = longest
        self.lay = None if lay is None else number("lay", lay, above=0)

    @property
    def _peak(self) -> Numbers:
        """m_r [m^2]."""
        below = 0.5 if self.longest is None else (1 - (self.rolloff / self.longest) ** 2) / 2
        return self.Sq**2 / (below + boxcox(jnp.log(self.rolloff / self.shortest), -2 * self.H))

    def m(self, q):
        q = jnp.asarray(q)
        if self.lay is None:
            return self._isotropic(q)
        stretch = self._stretches(self.lay).reshape((1,) * q.ndim + (-1,))
        return jnp.mean(self.lay / stretch**2 * self._isotropic(q[..., None] * stretch), axis=-1)

    def C_at(self, q_x, q_y):
        lay = 1 if self.lay is None else self.lay
        q = jnp.hypot(lay * jnp.asarray(q_x), jnp.asarray(q_y))
        return lay * 2 * math.pi * self._isotropic(q) / q**2

    def _isotropic(self, q):
        """m(q) without lay."""
        x = jnp.log(q * self.rolloff / (2 * math.pi))
        m = self._peak * jnp.exp(jnp.where(x < 0, 2 * x, -2 * self.H * x))
        inside = q <= 2 * math.pi / self.shortest * (1 + 1e-9)  # rounding leaves the ends inside
        if self.longest is not None:
            inside &= q >= 2 * math.pi / self.longest * (1 - 1e-9)
        return jnp.where(inside, m, 0)

    def _stretches(self, lay: Numbers, count: int = 64):
        """q'/q = sqrt((lay cos a)^2 + sin^2 a) in directions a of a quarter turn.

        Since d2q = d2q'/lay, C(q) = lay C'(q') keeps the mean square height.
        """
        angles = (np.arange(count) + 0.5) / count * math.pi / 2
        along, across = jnp.asarray(np.cos(angles)), jnp.asarray(np.sin(angles))
        return jnp.sqrt((lay * along) ** 2 + across**2)

    def moments(self):
        waves = self._two_pieces(None)
        heights, gradients, curvatures = self.Sq**2, waves.moment(2), waves.moment(4)
        if self.lay is None:
            return heights, gradients, curvatures
        a = self.lay**-2
        # The means over directions of lay/s^4 and of lay/s^6.
        return heights, gradients * (1 + a) / 2, curvatures * (3 + 2 * a + 3 * a**2) / 8

    def roll_off(self):
        """The geometric mean of the roll-off wavelengths along and across the lay, and H."""
        along = 1 if self.lay is None else self.lay
        return self.rolloff * jnp.sqrt(along), self.H

    def pieces(self, longest=None, count=64):
        waves = self._two_pieces(longest)
        if self.lay is None:
            return waves
        # Waves of one direction, up to q: those without lay up to q' = q s, times lay/s^4.
        # Beyond the waves of all directions, so that without a lay no edge is at their very end.
        low = waves.q[0] / jnp.maximum(self.lay, 1) * (1 - 1e-6)
        high = waves.q[-1] / jnp.minimum(self.lay, 1) * (1 + 1e-6)
        q = low * jnp.exp(jnp.arange(count + 1) * jnp.log(high / low) / count)
        stretch = self._stretches(self.lay)
        below = waves.gradient(q[:, None] * stretch[None])
        total = jnp.mean((self.lay / stretch**4)[None] * below, axis=1)
        return through_gradients(q, jnp.diff(total))

    def _two_pieces(self, longest) -> Pieces:
        """The spectrum without lay, below and above its roll-off."""
        q_r, q_s = 2 * math.pi / self.rolloff, 2 * math.pi / self.shortest
        # Beyond 2^26 roll-off lengths the waves have no height above rounding.
        q_L = q_r * 2.0**-26 if self.longest is None else 2 * math.pi / self.longest
        if longest is not None:
            q_L = jnp.minimum(jnp.maximum(q_L, 2 * math.pi / longest), q_s)
        middle = jnp.maximum(q_r, q_L)
        m = self._peak * jnp.stack([(q_L / q_r) ** 2, (middle / q_r) ** (-2 * self.H)])
        r = jnp.stack([jnp.full_like(self.H, 4.0), 2 - 2 * self.H])
        return Pieces(jnp.stack([q_L, middle, q_s]), m, r)
