"""Materials of the joint."""

import jax

from ..base.parts import Part, number, ordered, quantity


class Material(Part):
    """The two bodies of a joint as one equivalent material.

    `E` is the equivalent modulus of Eq. 2, `sigma_y` and `H` belong to the softer body.

    **Raises:** `ValueError` unless E > 0, 0 <= nu <= 0.5, sigma_y > 0 and H >= sigma_y.
    """

    E: jax.Array = quantity("Pa", "equivalent elastic modulus (Eq. 2)")
    nu: jax.Array = quantity("-", "Poisson's ratio")
    sigma_y: jax.Array = quantity("Pa", "yield strength of the softer body")
    H: jax.Array = quantity("Pa", "hardness of the softer body, at least sigma_y")

    def __init__(self, E, nu, sigma_y, H):
        self.E = number("E", E, above=0)
        self.nu = number("nu", nu, at_least=0, at_most=0.5)
        self.sigma_y = number("sigma_y", sigma_y, above=0)
        self.H = ordered("H", number("H", H, above=0), "sigma_y", self.sigma_y)

    @classmethod
    def pair(cls, E1, nu1, E2, nu2, sigma_y, H) -> "Material":
        """Two different bodies: E by Eq. 2, nu the mean of the two.

        1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2 [Pa]. The source has one nu for both bodies; the
        mean is this package's reading where they differ.

        **Raises:** `ValueError` as the constructor, for each body's own E and nu.
        """
        E1, E2 = number("E1", E1, above=0), number("E2", E2, above=0)
        nu1 = number("nu1", nu1, at_least=0, at_most=0.5)
        nu2 = number("nu2", nu2, at_least=0, at_most=0.5)
        return cls(equivalent_modulus(E1, nu1, E2, nu2), (nu1 + nu2) / 2, sigma_y, H)


def equivalent_modulus(E1, nu1, E2, nu2) -> jax.Array:
    """Eq. 2: 1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2 [Pa]; any shape."""
    return 1 / ((1 - nu1**2) / E1 + (1 - nu2**2) / E2)
