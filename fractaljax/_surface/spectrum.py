"""A surface as its height spectrum: the mean square height per ln q.

With C(q) the two-sided power spectrum of the heights [m^4], averaged over directions, and q the
wavenumber [rad/m],

    m(q) = q^2 C(q)/(2 pi),    <h^2> = int m dln q,    <|grad h|^2> = int m q^2 dln q

(Nayak, J. Lubr. Technol. 93, 398, 1971, doi:10.1115/1.3451608; Jacobs, Junge and Pastewka, Surf.
Topogr. 5, 013001, 2017, doi:10.1088/2051-672X/aa51f8).
"""

import abc
import math
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.laws import Law
from .._base.parts import Numbers, number, ordered
from .._base.singular import boxcox


class Pieces(NamedTuple):
    """A spectrum whose mean square gradient per ln q is a power of q between each two edges."""

    q: Float[Array, " k+1"]  # edges [rad/m]
    m: Float[Array, " k"]  # mean square height per ln q at the lower edge [m^2]
    r: Float[Array, " k"]  # the mean square gradient per ln q, m q^2, grows as q^r

    @property
    def widths(self) -> Float[Array, " k"]:
        """The widths of the pieces in ln q."""
        return jnp.log(self.q[1:] / self.q[:-1])

    def moment(self, power: float) -> Float[Array, ""]:
        """The integral of m q^power over ln q."""
        return jnp.sum(self.m * self.q[:-1] ** power * boxcox(self.widths, self.r + power - 2))

    def gradient(self, q: Numbers) -> Numbers:
        """The mean square gradient of the waves up to the wavenumbers q [rad/m]; any shape."""
        low, high, m, r = (
            x.reshape((1,) * q.ndim + (-1,)) for x in (self.q[:-1], self.q[1:], self.m, self.r)
        )
        x = jnp.log(jnp.clip(q[..., None] / low, 1, high / low))
        return jnp.sum(m * low**2 * boxcox(x, r), axis=-1)


class Spectrum(Law):
    """A surface by the mean square height m(q) of its waves per ln q.

    A custom spectrum declares its numbers as fields, `longest` and `shortest` among them, and
    defines a differentiable `m` for wavenumbers q [rad/m] of any shape:

        class Turned(fj.Spectrum, law="turned"):
            Sq: jax.Array = fj.quantity("m", "root mean square height", log=True)
            feed: jax.Array = fj.quantity("m", "wavelength of the feed marks", log=True)
            longest: jax.Array = fj.quantity("m", "longest wavelength", log=True)
            shortest: jax.Array = fj.quantity("m", "shortest wavelength", log=True)

            def m(self, q):
                x = jnp.log(q * self.feed / (2 * jnp.pi))
                return self.Sq**2 * jnp.exp(-2 * x**2) * jnp.sqrt(2 / jnp.pi)

    `Turned(Sq=1e-6, feed=1e-4, longest=1e-3, shortest=1e-5)` is then the surface of a
    `PerssonContact`, has `roughness` and `topography`, and its numbers can be swept and designed.
    `law` is its name in TOML files, without which it cannot be written to one.

    **Raises:** `ValueError` unless 0 < shortest <= longest, and for a name that another spectrum
    has; `TypeError` for what is not a number.
    """

    def check_as_defined(self):
        name = type(self).__name__
        try:
            longest, shortest = self._ends()
        except AttributeError:
            raise TypeError(
                f"{name} must have longest and shortest, the wavelengths of its ends"
            ) from None
        shortest = number(f"shortest of {name}", shortest, above=0)
        longest = number(f"longest of {name}", longest, above=0)
        object.__setattr__(self, "shortest", shortest)
        longest = ordered(f"longest of {name}", longest, "shortest", shortest)
        object.__setattr__(self, "longest", longest)

    @abc.abstractmethod
    def m(self, q: Float[ArrayLike, "..."]) -> Numbers:
        """Mean square height per ln q [m^2] at wavenumbers q [rad/m], the mean over directions."""

    def C(self, q: Float[ArrayLike, "..."]) -> Numbers:
        """Power spectrum of the heights [m^4] at wavenumbers q [rad/m], two-sided: 2 pi m/q^2."""
        q = jnp.asarray(q)
        return 2 * math.pi * self.m(q) / q**2

    def C_at(self, q_x: Float[ArrayLike, "..."], q_y: Float[ArrayLike, "..."]) -> Numbers:
        """Power spectrum [m^4] at wavevectors (q_x, q_y) [rad/m]; by default `C` of the length."""
        return self.C(jnp.hypot(jnp.asarray(q_x), jnp.asarray(q_y)))

    def times(self, factor: Numbers) -> Self:
        """The surface with all heights times `factor`, a number above 0; not checked.

        By default its Sq is multiplied.

        **Raises:** `ValueError` for a custom spectrum without a number Sq.
        """
        Sq: Any = getattr(self, "Sq", None)
        if Sq is None:
            raise ValueError(f"{type(self).__name__} must have a number Sq, or a method times")
        return eqx.tree_at(lambda x: x.Sq, self, factor * Sq)

    def _ends(self) -> tuple[Any, Any]:
        """The longest and the shortest wavelength of a custom spectrum [m]."""
        fields: Any = self
        return fields.longest, fields.shortest

    def pieces(self, longest: Numbers | None = None, count: int = 64) -> Pieces:
        """The spectrum in pieces, without waves longer than `longest` [m].

        By default there are `count` of equal width in ln q, each with its exact mean square
        gradient.
        """
        end, shortest = self._ends()
        if longest is not None:
            end = jnp.maximum(jnp.minimum(end, longest), shortest)
        low, width = 2 * math.pi / end, jnp.log(end / shortest) / count
        node, weight = np.polynomial.legendre.leggauss(4)
        at = jnp.asarray(np.arange(count)[:, None] + (node + 1) / 2)
        q = low * jnp.exp(at * width)
        gradients = width / 2 * jnp.sum(jnp.asarray(weight)[None] * self.m(q) * q**2, axis=1)
        return through_gradients(low * jnp.exp(jnp.arange(count + 1) * width), gradients)

    def moments(self) -> tuple[Numbers, Numbers, Numbers]:
        """The integrals of m, m q^2 and m q^4 over ln q [m^2, -, 1/m^2]."""
        x, weight = np.polynomial.legendre.leggauss(256)
        longest, shortest = self._ends()
        low, width = 2 * math.pi / longest, jnp.log(longest / shortest)
        q = low * jnp.exp(width * jnp.asarray((x + 1) / 2))
        waves = jnp.asarray(weight / 2) * width * self.m(q)
        return jnp.sum(waves), jnp.sum(waves * q**2), jnp.sum(waves * q**4)

    def roll_off(self) -> tuple[Numbers, Numbers]:
        """The wavelength [m] at which m is greatest, and the Hurst exponent of shorter waves.

        By default both are read off 64 points, the exponent as the slope of ln m weighted by m,
        from .01 to .99.
        """
        longest, shortest = self._ends()
        q = 2 * math.pi / longest * jnp.exp(jnp.linspace(0, 1, 64) * jnp.log(longest / shortest))
        return fit_roll_off(q, self.m(q))


def fit_roll_off(q: Float[Array, " k"], m: Float[Array, " k"]) -> tuple[Numbers, Numbers]:
    """The wavelength [m] where m is greatest; -1/2 of the slope of ln m beyond, .01 to .99."""
    peak = jnp.argmax(m)
    beyond = (jnp.arange(len(q)) > peak) & (m > 0)
    falls = jnp.log(jnp.where(beyond, m / m[peak], 1))
    distances = jnp.log(jnp.where(beyond, q / q[peak], 1))
    # By the waves that are high: the end of a table may fall off otherwise.
    weight = jnp.where(beyond, m / m[peak], 0)
    squares = jnp.sum(weight * distances**2)
    # With the greatest m at the last point there is no slope.
    H = -jnp.sum(weight * falls * distances) / jnp.where(squares > 0, squares, 1) / 2
    return 2 * math.pi / q[peak], jnp.clip(H, 0.01, 0.99)


def through_gradients(q: Float[Array, " k+1"], gradients: Float[Array, " k"]) -> Pieces:
    """Pieces of equal width in ln q with these mean square gradients.

    Each one's exponent is that between its neighbours, and at most 10.
    """
    width = jnp.log(q[1] / q[0])
    total = jnp.sum(gradients)
    log = jnp.log(jnp.maximum(gradients, total * jnp.finfo(total.dtype).eps))
    log = jnp.concatenate([2 * log[:1] - log[1:2], log, 2 * log[-1:] - log[-2:-1]])
    r = jnp.clip((log[2:] - log[:-2]) / (2 * width), -10, 10)
    return Pieces(q, gradients / (q[:-1] ** 2 * boxcox(width, r)), r)
