"""A scene: a joint, a friction law and an oscillator, and its TOML file."""

import os
from typing import Any

import equinox as eqx
import jax

from ..base.parts import Part, brief, number, quantities, rebuild, require_scalar
from ..base.scene_file import parse, read_bounded, render, write_whole
from ..surface.surfaces import Surface
from .contact import MU_M_MAX, Contact, FixedContact, FractalContact
from .friction import Coulomb, Friction, Stribeck
from .materials import Material
from .oscillator import Oscillator

JOINT_LAWS: dict[str, dict[str, type[Part]]] = {
    "contact": {"fractal": FractalContact, "fixed": FixedContact},
    "friction": {"coulomb": Coulomb, "stribeck": Stribeck},
}


def friction_for(contact: Contact, friction: Friction) -> Friction:
    """The friction law of a joint, checked against its contact.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` if the contact is fractal
    and the smallest friction exceeds 0.9, where Eq. 19 ends.
    """
    require_kind("contact", contact, Contact)
    require_kind("friction", friction, Friction)
    if not contact.fractal:
        return friction
    checked = number(friction.lowest, friction.mu_m, at_most=MU_M_MAX)
    return eqx.tree_at(lambda f: getattr(f, f.lowest), friction, checked)


def require_kind(name: str, part: Any, kind: type[Part]) -> None:
    """Refuse what is not a part of this kind."""
    if not isinstance(part, kind):
        raise TypeError(f"{name} must be a {kind.__name__}, got {brief(part)}")


class Scene(Part):
    """Everything a question about stability needs, as one frozen pytree.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` if the contact is fractal
    and the smallest friction exceeds 0.9, where Eq. 19 ends.
    """

    contact: Any  # a Contact; which one decides what else it has
    friction: Friction
    oscillator: Oscillator

    def __init__(self, contact, friction, oscillator):
        self.friction = friction_for(contact, friction)
        require_kind("oscillator", oscillator, Oscillator)
        self.contact = contact
        self.oscillator = oscillator

    def replace(self, **changes: Any) -> "Scene":
        """A scene with named quantities changed wherever they live: `replace(D=2.5, mu_s=0.3)`.

        Whole parts have names as well: `replace(friction=Coulomb(0.4))`. A quantity given beside
        the part that holds it is changed in the new part.

        **Raises:** `ValueError` for a name the scene does not have then, listing those it has, and
        for values outside their domain.
        """
        scene = rebuild(self, changes)
        known = quantities(scene)
        for name in changes:
            if name not in known:
                raise ValueError(f"scene has no quantity {name!r}; it has {', '.join(known)}")
        return scene

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Scene":
        """Read a scene from a TOML file, as `save` or `fractaljax scene` writes it.

        **Raises:** `OSError` if the file cannot be read; `ValueError` naming the file and the key
        for anything unknown, missing or outside its domain.
        """
        try:
            return cls(**parse(read_bounded(path), _LAWS))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def from_toml(cls, text: str) -> "Scene":
        """The scene of which `to_toml` gives this text; errors as `load`, without a file."""
        return cls(**parse(text.encode(), _LAWS))

    def to_toml(self) -> str:
        """The text of the scene's file, with the unit and the meaning beside each number.

        **Raises:** `ValueError` if the scene holds arrays.
        """
        require_scalar(self)
        return render(self, _LAWS)

    def save(self, path: str | os.PathLike) -> None:
        """Write the scene to a TOML file, whole or not at all.

        **Raises:** `OSError` if the file cannot be written.
        """
        write_whole(path, self.to_toml().encode())


_LAWS = JOINT_LAWS | {"oscillator": {"two directions": Oscillator}}


@jax.jit
def stiffness(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """(K_n, K_t) of the joint [N/m], scalars: Eqs. 30 and 36, or as given.

    **Raises:** `ValueError` if the scene holds arrays: use `jax.vmap`.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    return scene.contact.stiffness(scene.friction.mu_s, scene.friction.mu_m)


def brake_scene() -> Scene:
    """The reference brake: the source's sections 3.2.1 and 3.3, with the G that gives its K_n.

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
