"""A joint of known stiffness."""

from typing import final

from jaxtyping import ArrayLike

from .._base.parts import Numbers, number, quantity
from .contact import Contact


@final
class FixedContact(Contact, law="fixed"):
    """A joint of known stiffness: no contact law is evaluated. A preloaded joint needs its load P.

    **Raises:** `ValueError` unless K_n >= 0, K_t >= 0 and P > 0.
    """

    K_n: Numbers = quantity("N/m", "normal contact stiffness", log=True)
    K_t: Numbers = quantity("N/m", "tangential contact stiffness", log=True)

    P: Numbers | None = quantity("N", "normal load, of a preloaded joint", log=True)

    def __init__(self, K_n: ArrayLike, K_t: ArrayLike, P: ArrayLike | None = None):
        self.K_n = number("K_n", K_n, at_least=0)
        self.K_t = number("K_t", K_t, at_least=0)
        self.P = None if P is None else number("P", P, above=0)

    def stiffness(self, mu_s, mu_m):
        return self.K_n, self.K_t
