"""A scene: a contact, a friction law and an oscillator."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
from jaxtyping import Array, Float

from .._base.files import write_whole
from .._base.parts import Numbers, quantities, rebuild, require_kind, require_scalar, substitute
from .._base.toml import part_table, read_part, read_toml, write_toml
from .._contact.contact import Contact
from .._contact.fractal import FractalContact
from .._contact.material import Material
from .._friction import Friction, Stribeck
from .._surface.surface import Surface
from .joint import (
    PRELOAD_NOTE,
    AnyJoint,
    friction_for,
    preload_form,
    require_load,
)
from .mechanism import Derived, Mechanism
from .oscillator import Oscillator

if TYPE_CHECKING:
    from .structure import Structure

STIFFNESS_RATIO, FREQUENCY_RATIO, FRICTION = "K_t/K_n", "omega_1/omega_2", "mu"


class Scene(Mechanism, AnyJoint):
    """A mass on a belt, with its contact and friction, as one frozen pytree.

    The friction along the belt acts on the normal force N = K_n x_2, the source's form. With
    `preload`, x = 0 is the state of rest under the load P of the contact, where N = P: N(x_2) is
    the load curve of the contact law, dN/dx_2 = K_n(N), or P + K_n x_2 for a law without a load
    curve and with `preload="linear"`.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` if the contact is fractal
    and the smallest friction exceeds 0.9, the limit of Eq. 19, and for preload without a P.
    """

    kind: ClassVar[str] = "scene"
    names: ClassVar[tuple[str, ...]] = "x1", "x2"  # along the belt, and normal to it
    mesh: ClassVar[None] = None
    joint_names: ClassVar[tuple[str, ...]] = ("",)
    tangential: ClassVar[tuple[str]] = ("x1",)
    normal: ClassVar[tuple[str]] = ("x2",)

    contact: Any = eqx.field(metadata={"kind": Contact})  # its attributes depend on its class
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
    def n(self) -> int:
        """The number of degrees of freedom, 2."""
        return 2

    @property
    def uncoupled(self) -> bool:
        """True: the equations of the mass on a belt have closed forms."""
        return True

    @property
    def V(self) -> Numbers:
        """The belt velocity [m/s]."""
        return self.oscillator.V

    @property
    def F(self) -> Numbers:
        """The external force [N]."""
        return self.oscillator.F

    def stiffness(self) -> tuple[Numbers, Numbers]:
        """(K_n, K_t) [N/m], as the function `stiffness`."""
        return stiffness(self)

    def over_mass(self, forces):
        """M^-1 times forces (2, k)."""
        return forces / self.oscillator.m

    def require_one(self) -> None:
        """Refuse a scene that holds arrays: `jax.vmap` takes many."""
        require_scalar(self)

    def as_structure(self) -> "Structure":
        """As `Structure.from_scene`."""
        from .structure import Structure

        return Structure.from_scene(self)

    def joints_by_name(self) -> dict[str, AnyJoint]:
        """The scene, which is its own joint, by the name ""."""
        return {"": self}

    def with_joints(self, joints: Mapping[str, Any]) -> "Scene":
        """The only one of `joints`."""
        return joints[""]

    def substituted(self, changes: Mapping[str, Any]) -> "Scene":
        """Like `replace` for stored quantities that have a value, without checks."""
        changes = dict(changes)
        friction = changes.pop("friction", self.friction)  # perhaps another tree structure
        return substitute(eqx.tree_at(lambda scene: scene.friction, self, friction), changes)

    def derived_quantities(self) -> dict[str, Derived]:
        """K_t/K_n where a quantity of the contact sets it, omega_1/omega_2 and mu(V)."""
        names = self.contact.stored_quantities().keys()
        settable = hasattr(self.contact, "stiffness_ratio") or {"K_n", "K_t"} <= names
        return {name: _DERIVED[name] for name in _DERIVED if settable or name != STIFFNESS_RATIO}

    def _rebuilt(self, changes):
        return rebuild(self, changes)

    def _quantity_names(self):
        return list(quantities(self))

    def embedded(self, beside: Path) -> tuple[str, dict[Path, bytes]]:
        """The text of the scene, and no file."""
        return self.to_toml(), {}

    @classmethod
    def _from_document(cls, document, folder):
        return read_part(cls, document)

    @classmethod
    def from_toml(cls, text: str) -> "Scene":
        """The scene whose `to_toml` is `text`; errors as in `load`, without the file name."""
        return cls._from_document(read_toml(text.encode()), Path())

    def to_toml(self) -> str:
        """The text of the scene's TOML file, with the unit and the meaning of each number.

        **Raises:** `ValueError` if the scene holds arrays.
        """
        require_scalar(self)
        return write_toml("A fractaljax scene, in SI units.", part_table(self))

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


# --- derived quantities -------------------------------------------------------------------


def _stiffness_ratio(scene):
    K_n, K_t = stiffness(scene)
    return K_t / K_n


def _set_stiffness_ratio(scene, ratio):
    if hasattr(scene.contact, "stiffness_ratio"):
        return {"stiffness_ratio": ratio}
    return {"K_t": ratio * scene.contact.K_n}


def _set_friction(scene, mu):
    law = scene.friction
    scaled = law.times(mu / scene.coefficient())
    if not law.amplitudes:
        return {"friction": scaled}
    names = {path[-1]: name for name, path in quantities(law).items() if len(path) == 1}
    return {names[field]: getattr(scaled, field) for field in law.amplitudes}


_DERIVED = {
    STIFFNESS_RATIO: Derived(
        "stiffness ratio K_t/K_n", {"at_least": 0}, _stiffness_ratio, _set_stiffness_ratio
    ),
    FREQUENCY_RATIO: Derived(
        "ratio of natural frequencies ω₁/ω₂",
        {"above": 0},
        lambda scene: scene.oscillator.omega_1 / scene.oscillator.omega_2,
        lambda scene, ratio: {"omega_1": ratio * scene.oscillator.omega_2},
    ),
    FRICTION: Derived(
        "friction coefficient at the belt velocity µ",
        {"above": 0},
        AnyJoint.coefficient,
        _set_friction,
    ),
}


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
