"""A mechanism of many degrees of freedom, given by its matrices, with joints attached to it."""

import functools
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.files import read_bounded, write_together
from .._base.parts import (
    brief,
    concrete,
    nan_where,
    number,
    quantities,
    rebuild,
    require_kind,
    require_scalar,
    scalar,
)
from .._base.programs import exported_jit
from .._base.toml import naming, read_toml
from .joint import Direction, Dof, Joint, stored_direction
from .matrices import (
    MatrixLike,
    MatrixSum,
    fitting,
    fitting_or_sparse,
    is_sum,
    mass_matrix,
    matrix_sum,
    require_mass_matrix,
    square_or_sparse,
)
from .mechanism import Mechanism
from .mesh import Mesh
from .oscillator import Oscillator
from .scene import Scene
from .structure_file import npz_bytes, read_structure, structure_text


class Structure(Mechanism):
    """M x'' + C x' + K x = F with joints: a reduced finite-element model of n degrees of freedom.

    `M` (n, n) [kg] is symmetric and positive definite. `K` (n, n) [N/m] and `C` (n, n) [N s/m],
    zero where None, are of any kind. Sparse matrices of SciPy's are welcome; with more than 2000
    rows they stay sparse, for `reduce` to make a small structure of. Rotations have their own
    units. `joints` is one `Joint`, a sequence of them (named joint_1, joint_2, ...) or a mapping
    from names. `F` (n,) [N], or a mapping from degrees of freedom to forces, presses the joints
    together: the slope of a friction law acts through the static equilibrium under it. `names` of
    the degrees of freedom are optional, and so is a `Mesh` for pictures. `notes` say what was made
    of the files of the matrices, such as a mirrored triangle; `load` finds them.

    **Raises:** `ValueError` or `TypeError` saying which matrix does not fit, is not finite or not
    positive definite, which degree of freedom is unknown, or which joint is wrong.
    """

    sums: dict[str, MatrixSum]  # of "M", "C" and "K"
    parameters: dict[str, Float[Array, ""]]  # of the coefficients in them
    F: Float[Array, " n"] | None
    joints: tuple[Joint, ...]
    joint_names: tuple[str, ...] = eqx.field(static=True)
    names: tuple[str, ...] | None = eqx.field(static=True)
    mesh: Mesh | None = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        M: MatrixLike,
        C: MatrixLike | None,
        K: MatrixLike,
        joints: Joint | Sequence[Joint] | Mapping[str, Joint],
        F: ArrayLike | Sequence[float] | Mapping[Any, ArrayLike] | None = None,
        names: Iterable[str] | None = None,
        mesh: Mesh | None = None,
        notes: Iterable[str] = (),
    ):
        self._fill({"M": M, "C": C, "K": K}, {}, joints, F, names, mesh, notes)

    def _fill(self, given, parameters, joints, F, names, mesh, notes):
        self.parameters = parameters
        self.notes = tuple(notes)
        mass = matrix_sum("M", given["M"], parameters, square_or_sparse)
        # Each term symmetric to the last bit, if their sum is a mass matrix.
        if mass.sparse:
            require_mass_matrix(mass.at(parameters))
        elif len(mass.arrays) == 1 and mass.coefficients[0] is None:
            mass = eqx.tree_at(lambda x: x.arrays, mass, (mass_matrix(mass.arrays[0]),))
        else:
            whole = mass_matrix(mass.at(parameters))
            halves = tuple((X + X.T) / 2 for X in mass.arrays)
            if concrete(whole) is None:
                halves = nan_where(jnp.isnan(whole).any(), halves)
            mass = eqx.tree_at(lambda x: x.arrays, mass, halves)
        n = mass.shape[-1]
        fit = functools.partial(fitting_or_sparse, shape=(n, n))
        stiffness = matrix_sum("K", given["K"], parameters, fit)
        damping = given["C"]
        if damping is None:
            damping = 0 * abs(stiffness.at(parameters))
        self.sums = {"M": mass, "C": matrix_sum("C", damping, parameters, fit), "K": stiffness}
        self.names = _names(names, n)
        self.mesh = mesh
        if mesh is not None:
            require_kind("mesh", mesh, Mesh)
            mesh.require(self._full_n(n))
        self.joints, self.joint_names = _joints(joints)
        self._check_joints()
        F = self._forces(F) if isinstance(F, Mapping) else F
        self.F = None if F is None else fitting("F", F, (n,))

    def _full_n(self, n: int) -> int:
        """The degrees of freedom that its mesh has, of n itself."""
        return n

    @classmethod
    def from_scene(cls, scene: Scene) -> "Structure":
        """The mass on a belt (Eq. 39) as a structure of two degrees of freedom, x1 and x2."""
        M, C, K, F = _of_oscillator(scene.oscillator)
        return cls(
            M=M,
            C=C,
            K=K,
            joints=Joint(
                scene.contact, scene.friction, "x1", "x2", scene.oscillator.V, preload=scene.preload
            ),
            F=F,
            names=("x1", "x2"),
        )

    @property
    def n(self) -> int:
        """The number of degrees of freedom."""
        return self.sums["M"].shape[-1]

    @property
    def M(self) -> Float[Array, "n n"]:
        """The mass matrix [kg]. **Raises:** `ValueError` if it is large and sparse."""
        return self._matrix("M")

    @property
    def C(self) -> Float[Array, "n n"]:
        """The damping matrix without the joints [N s/m]; errors as of `M`."""
        return self._matrix("C")

    @property
    def K(self) -> Float[Array, "n n"]:
        """The stiffness matrix without the joints [N/m]; errors as of `M`."""
        return self._matrix("K")

    @property
    def band(self) -> tuple[float, float] | None:
        """Where eigenvalues are those of the structure, in |Im s| [rad/s]; None: everywhere."""
        return None

    @property
    def coarse(self) -> Any:
        """A space in which modes are known roughly, of a reduced structure; else None."""
        return None

    @property
    def is_sparse(self) -> bool:
        """Whether the matrices are large and sparse: then `reduce` comes first."""
        return any(held.sparse for held in self.sums.values())

    def _matrix(self, name: str) -> Float[Array, "n n"]:
        if self.sums[name].sparse:
            raise ValueError(too_large(self))
        return self.sums[name].at(self.parameters)

    @property
    def _dtype(self):
        arrays = self.sums["M"].arrays
        return arrays[0].dtype if arrays else jnp.result_type(float)

    def index(self, dof: Dof | np.integer) -> int:
        """The index of a degree of freedom given by index or name.

        **Raises:** `ValueError` if there is none; `TypeError` for anything else.
        """
        if isinstance(dof, bool) or not isinstance(dof, (int, str, np.integer)):
            raise TypeError(f"a degree of freedom must be an index or a name, got {dof!r}")
        known: list[Any] = list((self.names or ()) if isinstance(dof, str) else range(self.n))
        if dof not in known:
            has = _some(known) or "no names"
            raise ValueError(f"unknown degree of freedom {dof!r}; the structure has {has}")
        return known.index(dof)

    def direction(self, direction: Direction) -> np.ndarray:
        """The weights d (n,) for which d.x is the displacement in a direction, as `Joint` has it.

        **Raises:** `ValueError` for a direction that is zero or has another length, and as `index`.
        """
        stored = stored_direction("direction", direction)
        if isinstance(stored[0], float):
            if len(stored) != self.n:
                raise ValueError(f"a direction must have {self.n} weights, got {len(stored)}")
            return np.array(stored, self._dtype)
        pairs = stored if isinstance(stored[0], tuple) else zip(stored, (1.0, -1.0), strict=False)
        weights, d = {}, np.zeros(self.n, self._dtype)
        for dof, weight in pairs:
            place = self.index(dof)
            if place in weights:
                raise ValueError(f"{direction!r} is one degree of freedom twice")
            weights[place] = weight
        d[list(weights)] = list(weights.values())
        return d

    def _touched(self) -> np.ndarray | None:
        """How much the directions of each joint move each degree of freedom (m, n), where known."""
        moved = [np.abs(self._directions(joint)).sum(axis=0) for joint in self.joints]
        return np.array(moved).reshape(len(moved), self.n)

    def _directions(self, joint: Joint) -> list[np.ndarray]:
        """The tangential and, where there is one, the normal direction (n,) of a joint."""
        given = (joint.tangential, joint.normal)
        return [self.direction(each) for each in given if each is not None]

    def _check_joints(self) -> None:
        for name, joint in zip(self.joint_names, self.joints, strict=True):
            try:
                directions = self._directions(joint)
            except ValueError as error:
                raise ValueError(f"joint {name}: {error}") from None
            if len(directions) == 2 and _parallel(*directions):
                raise ValueError(
                    f"joint {name}: tangential {joint.tangential!r} and normal {joint.normal!r} "
                    "are one direction"
                )

    def _forces(self, given: Mapping[Any, ArrayLike]) -> Float[Array, " n"]:
        places = [self.index(dof) for dof in given]
        twice = [dof for dof, place in zip(given, places, strict=True) if places.count(place) > 1]
        if twice:
            raise ValueError(f"F gives one degree of freedom twice: {_some(map(repr, twice))}")
        forces = [number(f"F at {dof}", force) for dof, force in given.items()]
        return jnp.zeros(self.n).at[np.array(places, int)].set(jnp.array(forces, float))

    def _rebuilt(self, changes):
        joints = {}
        for name, joint in zip(self.joint_names, self.joints, strict=True):
            here = f"{name}."
            mine = {key.removeprefix(here): changes[key] for key in changes if key.startswith(here)}
            joints[name] = rebuild(joint, changes | mine)
        parameters = self.parameters | {
            name: number(name, changes[name]) for name in self.parameters if name in changes
        }
        if changes.keys() & {*self.sums, "F"}:
            own = {name: changes.get(name, self._terms(name)) for name in self.sums}
            own |= {"joints": joints, "F": changes.get("F", self.F), "names": self.names}
            own |= {"mesh": self._own_mesh(), "notes": self.notes}
            if not self.parameters:
                return Structure(**own)
            return ParametricStructure(**own, parameters=parameters)
        # The matrices are as they were: there is nothing to check or factorise again.
        new = eqx.tree_at(lambda structure: structure.joints, self, tuple(joints.values()))
        new._check_joints()
        if changes.keys() & parameters.keys():
            new = eqx.tree_at(lambda structure: structure.parameters, new, parameters)
            _check_coefficients(new)
        return new

    def _own_mesh(self) -> Mesh | None:
        """The mesh, if its degrees of freedom are those of the matrices."""
        return self.mesh

    def _terms(self, name: str) -> list[tuple[Any, Any]]:
        """The matrix of a name as it was given, less its numbers."""
        held = self.sums[name]
        return list(zip(held.coefficients, held.matrices, strict=True))

    def _known(self):
        known = ["M", "C", "K", "F", *self.parameters]
        for name, joint in zip(self.joint_names, self.joints, strict=True):
            known += [*quantities(joint), *(f"{name}.{plain}" for plain in quantities(joint))]
        return list(dict.fromkeys(known))

    def _shown(self):
        yield f"n={self.n}"
        yield from (f"{name}={value}" for name, value in self.parameters.items())
        yield from (f"{name}={j!r}" for name, j in zip(self.joint_names, self.joints, strict=True))
        yield from map(repr, self.notes)

    @classmethod
    def _from_document(cls, document, folder):
        given = read_structure(document, folder)
        if "reduced" in given:
            from .reduced import ReducedStructure

            return ReducedStructure.from_file(given)
        if "parameters" in given or any(is_sum(given[name]) for name in "MCK"):
            return ParametricStructure(**given)
        return Structure(**given)

    def _more_tables(self) -> dict[str, Any]:
        """Tables of its TOML file beyond those of every structure."""
        return {}

    def _more_arrays(self) -> dict[str, np.ndarray]:
        """Arrays of its .npz file beyond those of every structure."""
        return {}

    def save(self, path: str | os.PathLike) -> None:
        """Write a TOML file, and beside it the matrices as a .npz file of the same name.

        Both or neither: an error leaves the files of an earlier structure as they were.

        **Raises:** `OSError` if a file cannot be written; `ValueError` if the structure holds a
        batch, if `path` itself ends in .npz, and if there is a .npz file of that name which the
        TOML file at `path` does not name.
        """
        write_together(self._files(Path(path)))

    def _files(self, path: Path) -> dict[Path, bytes]:
        """What `save` writes to `path`, by file; errors as there."""
        matrices = path.with_suffix(".npz")
        if matrices == path:
            raise ValueError(f"path must be that of the TOML file, got {str(path)!r}")
        require_single(self)
        if matrices.exists() and not _names_matrices(path, matrices.name):
            raise ValueError(
                f"{matrices} is not of a structure saved as {path.name}: save under another name,"
                " or remove it"
            )
        text = structure_text(self, matrices.name).encode()
        # The TOML file comes last, so that it never names matrices of another structure.
        return {matrices: npz_bytes(self), path: text}


class ParametricStructure(Structure):
    """A structure whose matrices depend on named parameters: rotation, friction, temperature, ...

    `M`, `C` and `K` are a matrix or a list of (coefficient, matrix), of which the sum counts. A
    coefficient is a number, a function of the parameters, `lambda p: p["Omega"] ** 2 - 1`, or the
    same as text, "Omega**2 - 1", with + - * / **, pi, sqrt, exp, log, sin, cos and tan, which a
    file can hold. So gyroscopic terms are ("Omega", G) in C, circulatory ones ("mu", N) in K.
    `parameters` maps names to numbers. `replace(Omega=...)`, sweeps and designs know them by name,
    and derivatives go to each. All else is as in `Structure`.

    **Raises:** as `Structure`; `ValueError` for a coefficient that is not finite or asks for an
    unknown parameter, and for a parameter whose name another quantity has.
    """

    def __init__(
        self,
        M: Any,
        C: Any,
        K: Any,
        joints: Joint | Sequence[Joint] | Mapping[str, Joint] = (),
        parameters: Mapping[str, ArrayLike] | None = None,
        F: ArrayLike | Sequence[float] | Mapping[Any, ArrayLike] | None = None,
        names: Iterable[str] | None = None,
        mesh: Mesh | None = None,
        notes: Iterable[str] = (),
    ):
        if not isinstance(parameters or {}, Mapping):
            raise TypeError(f"parameters must be a mapping, got {brief(parameters)}")
        held = {name: number(str(name), value) for name, value in (parameters or {}).items()}
        self._fill({"M": M, "C": C, "K": K}, held, joints, F, names, mesh, notes)
        taken = {"M", "C", "K", "F", "pi"}.union(*map(quantities, self.joints))
        for name in held:
            if not (isinstance(name, str) and name.isidentifier()):
                raise ValueError(f"a parameter's name must be like Omega or k_1, got {name!r}")
            if name in taken:
                raise ValueError(f"the parameter {name} has the name of another quantity")


@exported_jit
def _of_oscillator(oscillator: Oscillator):
    """M, C, K and F of the mass on a belt."""
    m, f = oscillator.m, oscillator.F / jnp.sqrt(2.0)
    omega = jnp.stack([oscillator.omega_1, oscillator.omega_2])
    xi = jnp.stack([oscillator.xi_1, oscillator.xi_2])
    M, C = m * jnp.eye(2, dtype=m.dtype), jnp.diag(2 * xi * omega * m)
    return M, C, jnp.diag(m * omega**2), jnp.stack([f, -f])


def too_large(structure: Structure) -> str:
    """What is said where a structure must be reduced first."""
    return (
        f"the structure is sparse with {structure.n} degrees of freedom, too many for this: "
        "take reduce(structure, ...) in its place"
    )


def _check_coefficients(structure: Structure) -> None:
    """Refuse parameters, if they are known numbers, at which a coefficient is not finite."""
    known = {name: concrete(value) for name, value in structure.parameters.items()}
    if any(value is None or value.ndim for value in known.values()):
        return
    p = {name: jnp.asarray(value) for name, value in known.items()}
    for name, held in structure.sums.items():
        for coefficient in held.coefficients:
            if coefficient is not None:
                at = ", ".join(f"{key} = {value:g}" for key, value in p.items())
                scalar(f"a coefficient of {name} at {at}", coefficient(p))
    mass = structure.sums["M"]
    if not mass.sparse and any(mass.coefficients) and concrete(mass.arrays[0]) is not None:
        mass_matrix(mass.at(p))


def _names_matrices(path: Path, matrices: str) -> bool:
    """Whether `path` is a structure's TOML file that has its matrices in the file `matrices`."""
    try:
        table = read_toml(path.read_bytes()).get("structure")
    except (OSError, ValueError):
        return False
    return isinstance(table, dict) and table.get("matrices") == matrices


def load(path: str | os.PathLike) -> Scene | Structure:
    """What a TOML file holds: a structure if it has a table of that name, else a scene.

    **Raises:** as `Scene.load` and `Structure.load`.
    """
    with naming(path):
        document = read_toml(read_bounded(path))
        kind = Structure if "structure" in document else Scene
        return kind._from_document(document, Path(path).parent)


def require_single(structure: Structure) -> None:
    """Refuse a structure that holds a batch: `jax.vmap` takes many."""
    shape = structure.sums["M"].shape
    batch = len(shape) != 2 or any(value.ndim for value in structure.parameters.values())
    if batch or (structure.F is not None and structure.F.ndim != 1):
        raise ValueError(
            f"M must have two dimensions and parameters none, got shape {shape} of M; "
            "use jax.vmap for many structures"
        )
    for joint in structure.joints:
        require_scalar(joint)


def _parallel(t: np.ndarray, n: np.ndarray) -> bool:
    t, n = (d / np.abs(d).max() for d in (t.astype(float), n.astype(float)))
    return bool(np.abs(t * (n @ n) - n * (t @ n)).max() <= 1e-12 * (n @ n))


def _names(names: Iterable[str] | None, n: int) -> tuple[str, ...] | None:
    if names is None:
        return None
    if isinstance(names, (set, frozenset, Mapping)):
        raise TypeError(f"names must be in an order, got {names!r}")
    names = (names,) if isinstance(names, str) else tuple(names)
    printable = all(isinstance(name, str) and name and name.isprintable() for name in names)
    if not printable or len(names) != n:
        wanted = f"{n} printable strings, one a degree of freedom"
        raise ValueError(f"names must be {wanted}, got {len(names)}: {_some(map(repr, names))}")
    name, times = Counter(names).most_common(1)[0]
    if times > 1:
        raise ValueError(f"names must differ, got {name!r} more than once")
    return names


def _joints(
    joints: Joint | Sequence[Joint] | Mapping[str, Joint],
) -> tuple[tuple[Joint, ...], tuple[str, ...]]:
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


def _some(items: Iterable[Any]) -> str:
    texts = list(map(str, items))
    return ", ".join(texts[:10]) + (f", ... ({len(texts)} in all)" if len(texts) > 10 else "")
