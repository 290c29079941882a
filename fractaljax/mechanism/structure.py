"""A mechanism of many degrees of freedom, given by its matrices, with joints attached to it."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..base.parts import Part, Record, number, quantities, quantity, rebuild, require_scalar
from ..base.scene_file import read, read_bounded, write_together
from .damping import modal_damping, rayleigh_damping
from .friction import Friction
from .matrices import fitting, mass_matrix, square
from .scene import JOINT_LAWS, Scene, friction_for
from .structure_file import npz_of, parse_structure, render_structure


class Joint(Part):
    """A contact with friction between two bodies of a structure, or a body and the ground.

    `tangential` and `normal` each name a degree of freedom, by its index or its name, or a pair
    (i, j), whose relative displacement x_i - x_j counts. Positive `normal` displacement compresses
    the joint; friction pushes towards positive `tangential`, as the belt does in Eq. 39. `V` is the
    sliding velocity, which a law without slope can do without.

    **Raises:** `TypeError` for a part of the wrong kind; `ValueError` unless V > 0, if a degree of
    freedom stands twice, and where `Scene` refuses the friction.
    """

    contact: Any  # a Contact; which one decides what else it has
    friction: Friction
    tangential: tuple[int | str, ...] = eqx.field(static=True)
    normal: tuple[int | str, ...] = eqx.field(static=True)
    V: jax.Array | None = quantity("m/s", "sliding velocity")

    def __init__(self, contact, friction, tangential, normal, V=None):
        friction = friction_for(contact, friction)
        if V is None and friction.velocity_dependent:
            raise ValueError("V must be given for friction that depends on the sliding velocity")
        self.contact = contact
        self.friction = friction
        self.tangential = _direction("tangential", tangential)
        self.normal = _direction("normal", normal)
        if self.tangential == self.normal:
            raise ValueError(f"tangential and normal must differ, both are {tangential!r}")
        self.V = None if V is None else number("V", V, above=0)

    def stiffness(self) -> tuple[jax.Array, jax.Array]:
        """(K_n, K_t) [N/m], scalars: Eqs. 30 and 36, or as given."""
        return self.contact.stiffness(self.friction.mu_s, self.friction.mu_m)

    def coefficient(self) -> jax.Array:
        """mu at the joint's sliding velocity, a scalar."""
        law = self.friction
        return law.coefficient(self.V) if law.velocity_dependent else law.mu_s


def _direction(name: str, value) -> tuple[int | str, ...]:
    """One degree of freedom or a pair of different ones, as a tuple."""
    dofs = tuple(value) if isinstance(value, (list, tuple)) else (value,)
    dofs = tuple(int(dof) if isinstance(dof, np.integer) else dof for dof in dofs)
    plain = all(isinstance(dof, (int, str)) and not isinstance(dof, bool) for dof in dofs)
    if not plain or len(dofs) not in (1, 2) or len(set(dofs)) != len(dofs):
        raise ValueError(
            f"{name} must be a degree of freedom or a pair of two, by index or name, got {value!r}"
        )
    return dofs


class Structure(Record):
    """M x'' + C x' + K x = F with joints: a reduced finite-element model of n degrees of freedom.

    `M` (n, n) [kg] symmetric and positive definite, `K` (n, n) [N/m] and `C` (n, n) [N s/m] of any
    kind, zero where None; SciPy's sparse matrices will do. Rotations have their own units. `joints`
    is one `Joint`, a sequence of them (named joint_1, joint_2, ...) or a mapping from names. `F`
    (n,) [N], or a mapping from degrees of freedom to forces, presses the joints together: the slope
    of a friction law acts through the static equilibrium under it. `names` of the degrees of
    freedom are optional.

    **Raises:** `ValueError` or `TypeError` saying which matrix does not fit, is not finite or not
    positive definite, which degree of freedom is unknown, or which joint is none.
    """

    M: jax.Array
    C: jax.Array
    K: jax.Array
    F: jax.Array | None
    joints: tuple[Joint, ...]
    joint_names: tuple[str, ...] = eqx.field(static=True)
    names: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(self, M, C, K, joints, F=None, names=None):
        M = square("M", M)
        n = M.shape[0]
        self.M = mass_matrix(M)
        self.K = fitting("K", K, (n, n))
        self.C = jnp.zeros_like(self.K) if C is None else fitting("C", C, (n, n))
        self.names = _names(names, n)
        self.joints, self.joint_names = _joints(joints)
        self._check_joints()
        if isinstance(F, Mapping):
            given, F, named = F, np.zeros(n), {}
            for dof, force in given.items():
                at, dof = self.index(dof), dof if isinstance(dof, str) else int(dof)
                if at in named:
                    raise ValueError(
                        f"F gives one degree of freedom twice, as {named[at]!r} and as {dof!r}"
                    )
                named[at] = dof
                F[at] = number(f"F at {dof}", force)
        self.F = None if F is None else fitting("F", F, (n,))

    @classmethod
    def from_scene(cls, scene: Scene) -> "Structure":
        """The mass on a belt (Eq. 39) as a structure of two degrees of freedom, x1 and x2."""
        oscillator = scene.oscillator
        m, f = oscillator.m, oscillator.F / jnp.sqrt(2.0)
        omega = jnp.stack([oscillator.omega_1, oscillator.omega_2])
        xi = jnp.stack([oscillator.xi_1, oscillator.xi_2])
        return cls(
            M=m * jnp.eye(2, dtype=m.dtype),
            C=jnp.diag(2 * xi * omega * m),
            K=jnp.diag(m * omega**2),
            joints=Joint(scene.contact, scene.friction, "x1", "x2", oscillator.V),
            F=jnp.stack([f, -f]),
            names=("x1", "x2"),
        )

    @property
    def n(self) -> int:
        """The number of degrees of freedom."""
        return self.M.shape[-1]

    def index(self, dof: int | str) -> int:
        """The index of a degree of freedom given by index or name.

        **Raises:** `ValueError` if there is none; `TypeError` for anything else.
        """
        if isinstance(dof, str):
            if self.names is None:
                raise ValueError(
                    f"unknown degree of freedom {dof!r}: the structure has {self.n} without names"
                )
            if dof not in self.names:
                raise ValueError(
                    f"unknown degree of freedom {dof!r}; the structure has {_some(self.names)}"
                )
            return self.names.index(dof)
        if not isinstance(dof, (int, np.integer)) or isinstance(dof, bool):
            raise TypeError(f"a degree of freedom must be an index or a name, got {dof!r}")
        if not 0 <= dof < self.n:
            raise ValueError(f"unknown degree of freedom {dof}: they are 0 to {self.n - 1}")
        return int(dof)

    def direction(self, dofs: tuple[int | str, ...]) -> np.ndarray:
        """The vector d (n,) of 1, -1 and 0 for which d.x is the displacement that `dofs` names."""
        d = np.zeros(self.n, self.M.dtype)
        for dof, sign in zip(dofs, (1, -1), strict=False):
            d[self.index(dof)] = sign
        return d

    def replace(self, **changes: Any) -> "Structure":
        """A structure with M, C, K, F or quantities of its joints changed.

        `replace(D=2.5)` changes every joint that has a D, `replace(**{"left.D": 2.5})` the one
        named left; where both are given, the latter counts there. A quantity given beside the part
        that holds it is changed in the new part.

        **Raises:** `ValueError` for a name the structure does not have then, listing those it has,
        and for values outside their domain.
        """
        own = {name: getattr(self, name) for name in ("M", "C", "K", "F")}
        known, joints = list(own), []
        for name, joint in zip(self.joint_names, self.joints, strict=True):
            here = f"{name}."
            own_changes = {
                key[len(here) :]: changes[key] for key in changes if key.startswith(here)
            }
            joints.append(rebuild(joint, changes | own_changes))
            plain = list(quantities(joints[-1]))
            known += plain + [f"{here}{quantity}" for quantity in plain]
        known = list(dict.fromkeys(known))
        for name in changes:
            if name not in known:
                raise ValueError(f"structure has no quantity {name!r}; it has {', '.join(known)}")
        if changes.keys() & own.keys():
            own |= {name: changes[name] for name in own if name in changes}
            named = dict(zip(self.joint_names, joints, strict=True))
            return Structure(**own, joints=named, names=self.names)
        # The matrices are as they were: nothing to check anew, nor to factorise.
        changed = eqx.tree_at(lambda s: s.joints, self, tuple(joints))
        changed._check_joints()
        return changed

    def _check_joints(self):
        for name, joint in zip(self.joint_names, self.joints, strict=True):
            directions = []
            for dofs in (joint.tangential, joint.normal):
                try:
                    indices = {self.index(dof) for dof in dofs}
                except ValueError as error:
                    raise ValueError(f"joint {name}: {error}") from None
                if len(indices) != len(dofs):
                    raise ValueError(f"joint {name}: {dofs!r} is one degree of freedom twice")
                directions.append(indices)
            if directions[0] == directions[1]:
                raise ValueError(
                    f"joint {name}: tangential {joint.tangential!r} and normal {joint.normal!r} "
                    "are one direction"
                )

    def _shown(self):
        yield f"n={self.n}"
        yield from (f"{name}={j!r}" for name, j in zip(self.joint_names, self.joints, strict=True))

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Structure":
        """Read a structure from a TOML file that names its matrices' files, as docs/model.md says.

        **Raises:** `OSError` if a file cannot be read; `ValueError` naming the file and the key
        for anything unknown, missing, not fitting or outside its domain.
        """
        try:
            return _from_document(read(read_bounded(path)), Path(path).parent)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {error}") from None

    def save(self, path: str | os.PathLike) -> None:
        """Write a TOML file, and beside it the matrices as a .npz file of the same name.

        Both or neither: an error leaves the files of an earlier structure as they were.

        **Raises:** `OSError` if a file cannot be written; `ValueError` if the structure holds a
        batch, if `path` itself ends in .npz, and if there is a .npz file of that name which the
        TOML file at `path` does not name.
        """
        path = Path(path)
        matrices = path.with_suffix(".npz")
        if matrices == path:
            raise ValueError(f"path must be that of the TOML file, got {str(path)!r}")
        require_single(self)
        text = render_structure(self, matrices.name, JOINT_LAWS).encode()
        if matrices.exists() and not _names_matrices(path, matrices.name):
            raise ValueError(
                f"{matrices} is not of a structure saved as {path.name}: save under another name,"
                " or remove it"
            )
        # The TOML file comes last, so that it never names matrices of another structure.
        write_together({matrices: npz_of(self), path: text})


def _names_matrices(path: Path, matrices: str) -> bool:
    """Whether there is a structure's TOML file that has its matrices in the file `matrices`."""
    try:
        table = read(path.read_bytes()).get("structure")
    except (OSError, ValueError):
        return False
    return isinstance(table, dict) and table.get("matrices") == matrices


def load(path: str | os.PathLike) -> Scene | Structure:
    """What a TOML file holds: a structure if it has a table of that name, else a scene.

    **Raises:** as `Scene.load` and `Structure.load`.
    """
    try:
        content = read_bounded(path)  # once: a pipe holds it no longer
        document = read(content)
        if "structure" in document:
            return _from_document(document, Path(path).parent)
        return Scene.from_toml(content.decode())
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _from_document(document, folder) -> Structure:
    given = parse_structure(document, folder, JOINT_LAWS)
    joints = {}
    for name, joint in given.pop("joints").items():
        try:
            joints[name] = Joint(**joint)
        except (ValueError, TypeError) as error:
            raise ValueError(f"[joints.{name}] {error}") from None
    C, damping = given.pop("C"), given.pop("damping")
    bare = Structure(**given, C=C, joints=joints)
    if "rayleigh" in damping:
        C = rayleigh_damping(bare.M, bare.K, *damping["rayleigh"])
    if "damping_ratio" in damping:
        C = modal_damping(bare.M, bare.K, damping["damping_ratio"])
    return bare.replace(C=C) if damping else bare


def require_single(structure: Structure) -> None:
    """Refuse a structure that holds a batch: `jax.vmap` takes many."""
    if structure.M.ndim != 2 or (structure.F is not None and structure.F.ndim != 1):
        raise ValueError(
            f"M must have two dimensions, got shape {structure.M.shape}; "
            "use jax.vmap for many structures"
        )
    for joint in structure.joints:
        require_scalar(joint)


def _names(names, n: int) -> tuple[str, ...] | None:
    if names is None:
        return None
    if isinstance(names, (set, frozenset, Mapping)):
        raise TypeError(f"names must be in an order, got {names!r}")
    names = (names,) if isinstance(names, str) else tuple(names)
    if not all(isinstance(name, str) and name and name.isprintable() for name in names):
        raise ValueError(f"names must be printable strings, got {_some(map(repr, names))}")
    if len(names) != n:
        raise ValueError(f"names must be {n}, one a degree of freedom, got {len(names)}")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"names must differ, got {name!r} more than once")
    return names


def _joints(joints) -> tuple[tuple[Joint, ...], tuple[str, ...]]:
    if isinstance(joints, Joint):
        joints = [joints]
    if isinstance(joints, Sequence) and not isinstance(joints, str):
        joints = {f"joint_{i}": joint for i, joint in enumerate(joints, start=1)}
    if not isinstance(joints, Mapping):
        raise TypeError(f"joints must be a Joint, several or a mapping of them, got {joints!r}")
    for name, joint in joints.items():
        if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z0-9_-]+", name)):
            raise ValueError(f"a joint's name must be of letters, digits, _ and -, got {name!r}")
        if not isinstance(joint, Joint):
            raise TypeError(f"joint {name} must be a Joint, got {joint!r}")
    return tuple(joints.values()), tuple(joints)


def _some(names) -> str:
    names = list(names)
    return ", ".join(names[:10]) + (f", ... ({len(names)} in all)" if len(names) > 10 else "")
