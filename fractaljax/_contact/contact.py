"""The interface of contact laws, and the state of a joint that they share."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.laws import Law, refuse
from .._base.parts import Numbers, Record, brief, concrete, number, substitute
from .load_curve import LoadCurve, load_curve

MU_M_MAX = 0.9  # Eq. 19 ends there


class Contact(Law):
    """A contact law: the stiffness of a joint.

    A custom law declares its numbers as fields and defines a differentiable `stiffness`:

        class Hertz(fj.Contact, law="hertz"):
            k: jax.Array = fj.quantity("N/m", "normal stiffness under P_0", log=True)
            P_0: jax.Array = fj.quantity("N", "load at which it is k", log=True)
            stiffness_ratio: jax.Array = fj.quantity("-", "K_t/K_n")
            P: jax.Array = fj.quantity("N", "normal load", log=True)

            def stiffness(self, mu_s, mu_m):
                K_n = self.k * (self.P / self.P_0) ** (1 / 3)
                return K_n, self.stiffness_ratio * K_n

    `Hertz(k=4e8, P_0=1900, stiffness_ratio=0.5, P=1900)` is the contact of a scene or a joint like
    any other. `law` is its name in TOML files, without which it cannot be written to one;
    `fj.quantity` adds unit and meaning there and makes a number available to sweeps and designs.

    P is the normal load, which a preloaded joint needs. With `opening_exponent` beside it, 1/3
    here, the joint follows the load curve implied by `stiffness`. A field `stiffness_ratio`, or K_n
    and K_t, allows "K_t/K_n" to be set.

    **Raises:** `ValueError` unless P > 0, and K_n >= 0 and K_t >= 0 are finite, for a law that
    depends on friction once a `Scene` or a `Joint` has both; `TypeError` unless they are two real
    numbers; `ValueError` for a name that another law has. For a traced law every number is NaN
    instead.
    """

    has_surface: ClassVar[bool] = False  # its stiffness follows from a `Surface`
    fractal: ClassVar[bool] = False  # the source's law: there is a `ContactState`
    yields: ClassVar[bool] = False  # friction lowers its pressure at yield: Eq. 19, to mu_m = 0.9

    def check_as_defined(self):
        if (P := getattr(self, "P", None)) is not None:
            name = f"P of {type(self).__name__}"
            object.__setattr__(self, "P", number(name, P, above=0))
        if not self.depends_on_friction:
            bad = refused_stiffness(self, 1.0, 1.0)
            if bad is not None:
                refuse(self, bad)

    @property
    def depends_on_friction(self) -> bool:
        """True if the stiffness depends on friction."""
        if self.yields:
            return True
        both = jnp.ones(2)
        try:  # raises if the result follows a batch of friction
            alone = jax.vmap(lambda *friction: _map_stiffness(self, *friction), out_axes=None)
            jax.eval_shape(alone, both, both)
        except (ValueError, TypeError):
            return True
        return False

    @abc.abstractmethod
    def stiffness(
        self, mu_s: ScalarLike, mu_m: ScalarLike
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Normal and tangential stiffness (K_n, K_t) [N/m].

        **Arguments:**

        - `mu_s`, `mu_m`: static and smallest friction coefficient, scalars.
        """

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
        """N/P as a function of K_n(P) u/P; None for a law without a load curve.

        `mu_s` and `mu_m` are as in `stiffness`.
        """
        return None if self.opening_exponent is None else _load_curve(self, mu_s, mu_m)

    def load(
        self, u: ArrayLike | Sequence[float], mu_s: ScalarLike = 0.0, mu_m: ScalarLike = 0.0
    ) -> Numbers:
        """Normal force N [N] at an approach u from rest under the load P.

        dN/du = K_n(N) with N(0) = P, and 0 where the joint is open.

        **Arguments:**

        - `u`: approach of the two bodies [m], of any shape, which is that of the result.
        - `mu_s`, `mu_m`: friction coefficients, 0 by default; they matter where the stiffness
          depends on them.

        **Raises:** `ValueError` for a law without a load curve.
        """
        law: Any = self
        curve, u = law.load_curve(mu_s, mu_m), number("u", jnp.asarray(u))
        if curve is None:
            raise ValueError(f"load needs a contact law with a load curve, got {brief(law)}")
        e = law.stiffness(mu_s, mu_m)[0] / law.P * u
        return law.P * curve(e)

    def real_area(self, mu_m: ScalarLike) -> Float[Array, ""] | None:
        """Real contact area [m^2]; None where the law has none.

        `mu_m` is the smallest friction coefficient, as in `stiffness`.
        """
        return None


def refused_stiffness(law: Contact, mu_s: ArrayLike, mu_m: ArrayLike) -> Array | None:
    """True where a traced law has K_n or K_t negative or not finite; None for a concrete law.

    **Raises:** `TypeError` and `ValueError` as `Contact`.
    """
    pair = _map_stiffness(law, mu_s, mu_m)
    if not (isinstance(pair, (tuple, list)) and len(pair) == 2):
        raise TypeError(
            f"stiffness of {type(law).__name__} must give (K_n, K_t), got {brief(pair)}"
        )
    names = (f"{name} of {brief(law)}" for name in ("K_n", "K_t"))
    K_n, K_t = (number(name, K, at_least=0) for name, K in zip(names, pair, strict=True))
    bad = jnp.isnan(K_n) | jnp.isnan(K_t)
    return bad if concrete(bad) is None else None


def _map_stiffness(law: Contact, mu_s: ArrayLike, mu_m: ArrayLike) -> Any:
    """The `stiffness` of every member of a batch."""
    arrays, rest = eqx.partition(law, eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def one(mu_s, mu_m, *leaves):
        return eqx.combine(tree.unflatten(leaves), rest).stiffness(mu_s, mu_m)

    return jnp.vectorize(one)(mu_s, mu_m, *leaves)


@jax.jit
def _load_curve(law: Any, mu_s, mu_m) -> LoadCurve:
    def K_n(P):
        return substitute(law, {"P": P}).stiffness(mu_s, mu_m)[0]

    return load_curve(K_n, law.P, law.opening_exponent, law.load_borders)


def on_the_same_joint(law: Contact, contact: Contact) -> Contact:
    """`law` with the surface, the material and the load of `contact`, as far as both have them.

    **Raises:** `ValueError` if their surfaces are of two kinds.
    """
    surfaces = [getattr(x, "surface", None) for x in (law, contact)]
    kinds = [type(x).__name__ for x in surfaces if x is not None]
    if len(set(kinds)) == 2:
        raise ValueError(
            f"{type(law).__name__} has a {kinds[0]} and the joint a {kinds[1]}: laws are compared"
            " on the same kind of surface"
        )
    shared = [
        name
        for name in ("surface", "material", "P")
        if getattr(law, name, None) is not None and getattr(contact, name, None) is not None
    ]
    values = [getattr(contact, name) for name in shared]
    return eqx.tree_at(lambda law: [getattr(law, name) for name in shared], law, values)


def partial_slip(K_n: Callable[[Numbers], Numbers], P: Numbers, Q: Numbers, mu_s) -> Numbers:
    """K_t over K_t/K_n at Q = 0: K_n(P - Q/mu_s) under a tangential load Q, 0 in gross slip.

    The contacts that still stick are those of that load (Ciavarella, J. Appl. Mech. 65, 998, 1998,
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
