"""What every contact law gives, and what a joint asks of it."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import Numbers, Part, Record, brief, number, substitute
from .load_curve import LoadCurve, load_curve

MU_M_MAX = 0.9  # Eq. 19 ends there


class Contact(Part):
    """A contact law: the stiffness of a joint.

    A law is a pytree of named quantities, with `stiffness`. It is differentiable and works under
    `jit` and `vmap` if its `stiffness` does.
    """

    has_surface: ClassVar[bool] = False  # its stiffness is that of a `Surface`
    fractal: ClassVar[bool] = False  # the source's law: there is a `ContactState`
    yields: ClassVar[bool] = False  # friction lowers its pressure at yield: Eq. 19, to mu_m = 0.9

    @property
    def depends_on_friction(self) -> bool:
        """Whether the stiffness does."""
        return self.yields

    @abc.abstractmethod
    def stiffness(
        self, mu_s: ScalarLike, mu_m: ScalarLike
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """(K_n, K_t) [N/m] at the given static and smallest friction coefficient."""

    @property
    def opening_exponent(self) -> Numbers | float | None:
        """alpha in K_n ~ P^alpha as the load vanishes, if the law has a load curve; else None.

        It is from 0 to below 1: a joint opens at a finite approach.
        """
        return None

    @property
    def load_borders(self) -> tuple[float, ...] | None:
        """The loads [N] between which K_n(P) is smooth; None where it is smooth everywhere."""
        return None

    def load_curve(self, mu_s: ScalarLike, mu_m: ScalarLike) -> LoadCurve | None:
        """N/P over K_n(P) u/P; None for a law that has no load curve."""
        return None if self.opening_exponent is None else _load_curve(self, mu_s, mu_m)

    def load(
        self, u: ArrayLike | Sequence[float], mu_s: ScalarLike = 0.0, mu_m: ScalarLike = 0.0
    ) -> Numbers:
        """Normal force N [N] at the approach u [m] from the pressed rest, of any shape.

        dN/du = K_n(N) with N(0) = P, and 0 where the joint is open. The friction coefficients
        matter where the stiffness depends on them.

        **Raises:** `ValueError` for a law without a load curve.
        """
        law: Any = self
        curve, u = law.load_curve(mu_s, mu_m), number("u", jnp.asarray(u))
        if curve is None:
            raise ValueError(f"load needs a contact law with a load curve, got {brief(law)}")
        e = law.stiffness(mu_s, mu_m)[0] / law.P * u
        return law.P * curve(e)

    def real_area(self, mu_m: ScalarLike) -> Float[Array, ""] | None:
        """Real contact area [m^2]; None where the law has none."""
        return None


@jax.jit
def _load_curve(law: Any, mu_s, mu_m) -> LoadCurve:
    def K_n(P):
        return substitute(law, {"P": P}).stiffness(mu_s, mu_m)[0]

    return load_curve(K_n, law.P, law.opening_exponent, law.load_borders)


def on_the_same_joint(law: Contact, contact: Contact) -> Contact:
    """`law` with the surface, the material and the load of `contact`, as far as both have them."""
    shared = [
        name
        for name in ("surface", "material", "P")
        if getattr(law, name, None) is not None and getattr(contact, name, None) is not None
    ]
    values = [getattr(contact, name) for name in shared]
    return eqx.tree_at(lambda law: [getattr(law, name) for name in shared], law, values)


def partial_slip(K_n: Callable[[Numbers], Numbers], P: Numbers, Q: Numbers, mu_s) -> Numbers:
    """K_t over the ratio at Q = 0: K_n(P - Q/mu_s) under a tangential load Q, 0 in gross slip.

    Slip reduces the stuck contacts to those of that load (Ciavarella, J. Appl. Mech. 65, 998, 1998,
    doi:10.1115/1.2791944; Jaeger, Arch. Appl. Mech. 68, 583, 1998).
    """
    stuck = P - Q / mu_s
    some = ~(stuck <= 0)  # NaN stays NaN
    return jnp.where(some, K_n(jnp.where(some, stuck, P)), 0)


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
