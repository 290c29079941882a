"""A joint of known stiffness."""

from typing import final

from jaxtyping import ArrayLike

from .._base.parts import Numbers, number, quantity
from .contact import Contact


@final
class FixedContact(Contact):
    """A joint of known stiffness: no contact law is evaluated.

    **Raises:** `ValueError` unless K_n >= 0 and K_t >= 0.
    """

    K_n: Numbers = quantity("N/m", "normal contact stiffness", log=True)
    K_t: Numbers = quantity("N/m", "tangential contact stiffness", log=True)

    def __init__(self, K_n: ArrayLike, K_t: ArrayLike):
        self.K_n = number("K_n", K_n, at_least=0)
        self.K_t = number("K_t", K_t, at_least=0)

    def stiffness(self, mu_s, mu_m):
        return self.K_n, self.K_t
