"""A scene: a contact, a friction law and an oscillator."""

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float

from .._base.files import write_whole
from .._base.parts import Numbers, quantities, rebuild, require_kind, require_scalar
from .._base.toml import part_table, read_part, read_toml, write_toml
from .._contact.contact import Contact
from .._contact.fractal import FractalContact
from .._contact.material import Material
from .._friction import Friction, Stribeck
from .._surface.surface import Surface
from .joint import (
    JOINT_LAWS,
    PRELOAD_NOTE,
    follows_load_curve,
    friction_for,
    preload_form,
    require_load,
)
from .mechanism import Mechanism
from .oscillator import Oscillator


class Scene(Mechanism):
    """A mass on a belt, with its contact and friction, as one frozen pytree.

    The friction along the belt acts on the normal force N = K_n x_2, the source's form. With
    `preload`, x = 0 is the state of rest under the load P of the contact, where N = P: N(x_2) is
    the load curve of the contact law, dN/dx_2 = K_n(N), or P + K_n x_2 for a law without a load
    curve and with `preload="linear"`.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` if the contact is fractal
    and the smallest friction exceeds 0.9, the limit of Eq. 19, and for preload without a P.
    """

    contact: Any  # a Contact; its other attributes depend on its class
    friction: Friction  # friction law at the belt
    oscillator: Oscillator  # the mass, its springs and the belt
    preload: bool | str = eqx.field(static=True, metadata={"note": PRELOAD_NOTE})

    def __init__(
        self,
        contact: Contact,
        friction: Friction,
        oscillator: Oscillator,
        preload: bool | str = False,
    ):
        self.friction = friction_for(contact, friction)
        require_kind("oscillator", oscillator, Oscillator)
        self.contact = contact
        self.oscillator = oscillator
        self.preload = preload_form(preload)
        if self.preload:
            require_load(contact, "preload")

    @property
    def normal_load(self) -> Numbers | None:
        """P [N], if the friction's normal force includes it; None in the source's form."""
        return self.contact.P if self.preload else None

    @property
    def follows_load_curve(self) -> bool:
        """True if the normal force is the load curve of the contact law."""
        return follows_load_curve(self)

    def _rebuilt(self, changes):
        return rebuild(self, changes)

    def _quantity_names(self):
        return list(quantities(self))

    @classmethod
    def _from_document(cls, document, folder):
        return read_part(cls, document, JOINT_LAWS)

    @classmethod
    def from_toml(cls, text: str) -> "Scene":
        """The scene whose `to_toml` is `text`; errors as in `load`, without the file name."""
        return cls._from_document(read_toml(text.encode()), Path())

    def to_toml(self) -> str:
        """The text of the scene's TOML file, with the unit and the meaning of each number.

        **Raises:** `ValueError` if the scene holds arrays.
        """
        require_scalar(self)
        return write_toml("A fractaljax scene, in SI units.", part_table(self, JOINT_LAWS))

    def save(self, path: str | os.PathLike) -> None:
        """Write the scene to a TOML file at `path`, whole or not at all.

        **Raises:** `OSError` if the file cannot be written; `ValueError` as in `to_toml`.
        """
        write_whole(path, self.to_toml().encode())


@jax.jit
def stiffness(scene: Scene) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Normal and tangential stiffness (K_n, K_t) [N/m] of the contact, by its law.

    **Arguments:**

    - `scene`: a `Scene` of scalars, whose friction law gives mu_s and mu_m: Eqs. 30 and 36 for a
      fractal contact.

    **Raises:** `TypeError` for what is not a scene; `ValueError` if it holds arrays: use
    `jax.vmap`.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    return scene.contact.stiffness(scene.friction.mu_s, scene.friction.mu_m)


def brake_scene() -> Scene:
    """The reference brake of the source's sections 3.2.1 and 3.3, with the G that gives its K_n.

    D = 2.4, G = 1.342e-10 m and P = 1907.3 N give K_n = 4.026e8 and K_t = 1.917e8 N/m. It squeals.
    """
    return Scene(
        FractalContact(
            Surface(D=2.4, G=1.342e-10, gamma=1.5),
            Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8),
            P=1907.3,
        ),
        Stribeck(mu_s=0.4, mu_m=0.25, v_m=0.5),
        Oscillator(
            m=1.0,
            omega_1=6283.185307179586,  # 1000 Hz
            omega_2=5026.548245743669,  # 800 Hz
            xi_1=0.001,
            xi_2=0.007,
            F=5.0,
            V=0.15,
        ),
    )
