"""Materials of the joint."""

from jaxtyping import ArrayLike

from .._base.parts import Numbers, Part, number, ordered, quantity


class Material(Part):
    """The two bodies of a joint as one equivalent material.

    `E` is the equivalent modulus of Eq. 2; `sigma_y` and `H` belong to the softer body.

    **Raises:** `ValueError` unless E > 0, 0 <= nu <= 0.5, sigma_y > 0 and H >= sigma_y.
    """

    E: Numbers = quantity("Pa", "equivalent elastic modulus (Eq. 2)", log=True)
    nu: Numbers = quantity("-", "Poisson's ratio")
    sigma_y: Numbers = quantity("Pa", "yield strength of the softer body", log=True)
    H: Numbers = quantity("Pa", "hardness of the softer body, at least sigma_y", log=True)

    def __init__(self, E: ArrayLike, nu: ArrayLike, sigma_y: ArrayLike, H: ArrayLike):
        self.E = number("E", E, above=0)
        # Below rubber's, which is some MPa.
        self.nu = number("nu", nu, at_least=0, at_most=0.5)
        self.sigma_y = number("sigma_y", sigma_y, above=0)
        self.H = ordered("H", number("H", H, above=0), "sigma_y", self.sigma_y)

    @classmethod
    def pair(
        cls,
        E1: ArrayLike,
        nu1: ArrayLike,
        E2: ArrayLike,
        nu2: ArrayLike,
        sigma_y: ArrayLike,
        H: ArrayLike,
    ) -> "Material":
        """Two different bodies: E by Eq. 2, 1/E = (1 - nu1^2)/E1 + (1 - nu2^2)/E2 [Pa].

        nu is the mean of nu1 and nu2: the source has one nu for both bodies.

        **Arguments:**

        - `E1`, `E2`: elastic modulus of each body [Pa].
        - `nu1`, `nu2`: Poisson's ratio of each body [-].
        - `sigma_y`, `H`: yield strength and hardness of the softer body [Pa].

        **Raises:** `ValueError` as the constructor, for each body's own E and nu.
        """
        E1, E2 = number("E1", E1, above=0), number("E2", E2, above=0)
        nu1 = number("nu1", nu1, at_least=0, at_most=0.5)
        nu2 = number("nu2", nu2, at_least=0, at_most=0.5)
        return cls(1 / ((1 - nu1**2) / E1 + (1 - nu2**2) / E2), (nu1 + nu2) / 2, sigma_y, H)


def mindlin_ratio(nu: Numbers) -> Numbers:
    """K_t/K_n = (2 - 2 nu)/(2 - nu) of a contact without slip."""
    return (2 - 2 * nu) / (2 - nu)
