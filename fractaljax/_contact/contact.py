"""What every contact law gives, and what a joint asks of it."""

import abc
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float, ScalarLike

from .._base.parts import Part, Record

MU_M_MAX = 0.9  # Eq. 19, of the fractal law, ends there


class Contact(Part):
    """A contact law: the stiffness of a joint.

    A law is a pytree of named quantities, with `stiffness`. It is differentiable and works under
    `jit` and `vmap` if its `stiffness` does.
    """

    fractal: ClassVar[bool] = False  # has a surface and a material: there is a `ContactState`

    @abc.abstractmethod
    def stiffness(
        self, mu_s: ScalarLike, mu_m: ScalarLike
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """(K_n, K_t) [N/m] at the given static and smallest friction coefficient."""


class Regime(eqx.Enumeration):
    """The regime of a joint: an outcome, never an error."""

    fully_plastic = "fully plastic: every contact is below the critical area, K_n = K_t = 0"
    elastic_plastic = "elastic-plastic"
    gross_slip = "gross slip: the tangential load reaches mu_s P, K_t = 0"


class ContactState(Record):
    """A fractal joint under its load, as `contact_state` returns it; SI units."""

    K_n: Float[Array, ""]  # normal stiffness [N/m], 0 when fully plastic
    K_t: Float[Array, ""]  # tangential stiffness [N/m], 0 when fully plastic or in gross slip
    a_l: Float[Array, ""]  # largest contact area [m^2]
    a_e: Float[Array, ""]  # critical area: elastic above, plastic below [m^2]
    A_r: Float[Array, ""]  # real contact area [m^2]
    Q_e: Float[Array, ""] | None  # tangential load carried by the elastic contacts [N]
    plastic_share: Float[Array, ""]  # share of the load on plastic contacts, 1 when fully plastic
    log_area_ratio: Float[Array, ""]  # ln(a_l/a_e), at most 0 when fully plastic
    slip_ratio: Float[Array, ""] | None  # Q_e/(mu_s P), at least 1 in gross slip
    regime: Regime  # a member of Regime
