"""A mechanism of many degrees of freedom, defined by its matrices and joints."""

import functools
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._base.files import read_bounded, write_together
from .._base.parts import (
    Numbers,
    Quantity,
    Record,
    brief,
    concrete,
    nan_where,
    number,
    quantities,
    rebuild,
    require_kind,
    require_scalar,
    scalar,
    substitute,
)
from .._base.programs import exported_jit
from .._base.toml import naming, read_toml
from .joint import Direction, Dof, Joint, stored_direction
from .matrices import (
    MatrixLike,
    MatrixSum,
    as_array,
    fitting,
    fitting_or_sparse,
    is_sum,
    mass_matrix,
    matrix_sum,
    merged,
    placed,
    require_mass_matrix,
    separated,
    square_or_sparse,
)
from .mechanism import Mechanism, some_of
from .mesh import Mesh
from .oscillator import Oscillator
from .scene import Scene
from .structure_file import npz_bytes, read_structure, structure_text


class Structure(Mechanism):
    """M x'' + C x' + K x = F with joints: a reduced finite-element model of n degrees of freedom.

    **Arguments:**

    - `M`: mass matrix (n, n) [kg], symmetric and positive definite. Sparse matrices of SciPy's are
      accepted; with more than 2000 rows they stay sparse, and `reduce` makes a small structure from
      them. Rotations have their own units.
    - `C`: damping matrix (n, n) [N s/m] without the joints, which need not be symmetric; zero if
      None.
    - `K`: stiffness matrix (n, n) [N/m] without the joints, which need not be symmetric. The
      imaginary part of a complex one is added to `K_loss`.
    - `joints`: one `Joint`, a sequence of them (named joint_1, joint_2, ...) or a mapping from
      names; none by default.
    - `F`: (n,) [N], or a mapping from degrees of freedom to forces, by default none. It presses the
      joints together: the slope of a friction law acts through the static equilibrium under it.
    - `names`: names of the n degrees of freedom, by default none.
    - `K_loss`: structural (hysteretic) damping (n, n) [N/m], such as the sum of loss factor times
      stiffness of all parts, by default none. An oscillation with Im s > 0 has s^2 M + s C + K +
      i K_loss, and its conjugate the conjugate; what does not oscillate has no hysteresis, so that
      static divergence is that of K. Motion in time needs `equivalent_viscous`.
    - `mesh`: a `Mesh` for pictures, by default none.
    - `notes`: changes made on reading the matrices' files, such as a mirrored triangle; `load` sets
      them.

    **Raises:** `ValueError` or `TypeError` saying which matrix does not fit, is not finite or not
    positive definite, which degree of freedom is unknown, or which joint is wrong.
    """

    kind: ClassVar[str] = "structure"
    sums: dict[str, MatrixSum]  # of "M", "C", "K", and "K_loss" if there is any
    parameters: dict[str, Float[Array, ""]]  # of the coefficients in them
    F: Float[Array, " n"] | None  # static force [N]
    joints: tuple[Joint, ...]  # in the order of their names
    joint_names: tuple[str, ...] = eqx.field(static=True)  # of the joints
    names: tuple[str, ...] | None = eqx.field(static=True)  # of the degrees of freedom
    mesh: Mesh | None = eqx.field(static=True)  # for pictures
    notes: tuple[str, ...] = eqx.field(static=True)  # of changes on reading

    def __init__(
        self,
        M: MatrixLike,
        C: MatrixLike | None,
        K: MatrixLike,
        joints: Joint | Sequence[Joint] | Mapping[str, Joint] = (),
        F: ArrayLike | Sequence[float] | Mapping[Any, ArrayLike] | None = None,
        names: Iterable[str] | None = None,
        K_loss: MatrixLike | None = None,
        mesh: Mesh | None = None,
        notes: Iterable[str] = (),
    ):
        matrices = {"M": M, "C": C, "K": K, "K_loss": K_loss}
        self._fill(matrices, {}, joints, F, names, mesh, notes)

    def _fill(self, matrices, parameters, joints, F, names, mesh, notes):
        self.parameters = parameters
        self.notes = tuple(notes)
        mass = matrix_sum("M", matrices["M"], parameters, square_or_sparse)
        # Each term is made symmetric to the last bit, if their sum is a mass matrix.
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
        K, K_loss = separated(matrices["K"], matrices["K_loss"])
        stiffness = matrix_sum("K", K, parameters, fit)
        damping = matrices["C"]
        if damping is None:
            damping = 0 * abs(stiffness.at(parameters))
        self.sums = {"M": mass, "C": matrix_sum("C", damping, parameters, fit), "K": stiffness}
        if K_loss is not None:
            self.sums["K_loss"] = matrix_sum("K_loss", K_loss, parameters, fit)
        self.names = _names(names, n)
        self.mesh = mesh
        if mesh is not None:
            require_kind("mesh", mesh, Mesh)
            mesh.require(self._full_n(n))
        self.joints, self.joint_names = _joints(joints)
        self._check_joints()
        F = self._forces(F) if isinstance(F, Mapping) else F
        self.F = None if F is None else fitting("F", F, (n,))

    def full(self, q: ArrayLike) -> Numbers:
        """Displacements of all degrees of freedom: `q` itself, but in a reduced structure."""
        return jnp.asarray(q)

    def over_mass(self, forces: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """M^-1 times forces."""
        return jnp.linalg.solve(self.M, forces)

    def _full_n(self, n: int) -> int:
        """The number of degrees of freedom of the mesh, for n of the structure."""
        return n

    @classmethod
    def from_scene(cls, scene: Scene) -> "Structure":
        """The mass on a belt (Eq. 39) of `scene` as a structure with the displacements x1, x2."""
        M, C, K, F = _oscillator_matrices(scene.oscillator)
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
        """The damping matrix without the joints [N s/m]; errors as for `M`."""
        return self._matrix("C")

    @property
    def K(self) -> Float[Array, "n n"]:
        """The stiffness matrix without the joints [N/m]; errors as for `M`."""
        return self._matrix("K")

    @property
    def K_loss(self) -> Float[Array, "n n"] | None:
        """The structural damping without the joints [N/m], None if none; errors as for `M`."""
        return self._matrix("K_loss") if "K_loss" in self.sums else None

    @property
    def complex_K(self) -> Any:
        """K + i K_loss (n, n) [N/m], or K without K_loss; errors as for `M`."""
        K_loss = self.K_loss
        return self.K if K_loss is None else self.K + 1j * K_loss

    @property
    def has_loss(self) -> bool:
        """True if the matrices or a joint have structural damping."""
        return "K_loss" in self.sums or any(j.loss_factor is not None for j in self.joints)

    def equivalent_viscous(self, frequency: ArrayLike) -> "Structure":
        """A copy with viscous damping in the place of structural damping, C + K_loss/(2 pi f).

        At the frequency f both take the same energy off an oscillation: s C = i K_loss at s =
        2 pi f i. Above it the viscous damping is larger, below it smaller. A joint with a loss
        factor gets dashpots beside its springs, loss_factor K_n/(2 pi f) along the normal and
        loss_factor K_t/(2 pi f) along the tangential direction, with its stiffness at its load;
        friction acts on the forces of the springs alone, and the dashpots remain where the joint
        opens. A reduced structure becomes a plain one.

        **Arguments:**

        - `frequency`: f [Hz], above 0, such as that of the mode in question.

        **Raises:** `ValueError` unless f is above 0.
        """
        omega = 2 * jnp.pi * number("frequency", frequency, above=0)
        if not self.has_loss:
            return self
        damping = self._terms("C")
        if "K_loss" in self.sums:
            scale = float(omega) if self.sums["K_loss"].sparse else omega
            damping += [(c, X * (1 / scale)) for c, X in self._terms("K_loss")]
        joints = {}
        for name, joint in self.joints_by_name().items():
            joints[name] = rebuild(joint, {"loss_factor": None})
            if joint.loss_factor is None:
                continue
            for d, k in zip(self._directions(joint), reversed(joint.stiffness()), strict=False):
                damping.append((None, joint.loss_factor * k / omega * np.outer(d, d)))
        return self._with_terms({"C": damping, "K_loss": None}, joints, self.F, self.parameters)

    def add(
        self,
        dofs: Sequence[Dof],
        K: MatrixLike | None = None,
        *,
        M: MatrixLike | None = None,
        C: MatrixLike | None = None,
        K_loss: MatrixLike | None = None,
    ) -> "Structure":
        """A copy with small matrices added at some degrees of freedom, as DMIG and K2PP cards do.

        A reduced structure becomes a plain one.

        **Arguments:**

        - `dofs`: the k degrees of freedom, by index or name, in the order of the matrices' rows.
        - `K`: (k, k) [N/m], added to the stiffness; the imaginary part of a complex one is added to
          K_loss. None adds nothing, by default, as for the others.
        - `M`, `C`, `K_loss`: (k, k), added to the matrix of that name.

        **Raises:** `ValueError` for an unknown degree of freedom, one that is given twice, and a
        matrix of another shape; as `Structure` for the sums.
        """
        places = [self.index(dof) for dof in ([dofs] if isinstance(dofs, (int, str)) else dofs)]
        if len(set(places)) < len(places):
            raise ValueError(f"dofs gives one degree of freedom twice: {some_of(map(repr, dofs))}")
        K, K_loss = separated(K, K_loss)
        added: dict[str, Any] = {}
        for name, X in {"M": M, "C": C, "K": K, "K_loss": K_loss}.items():
            if X is None:
                continue
            terms = self._terms(name) if name in self.sums else []
            for coefficient, small in X if is_sum(X) else [(None, X)]:
                small = as_array(name, small)
                if small.shape != (len(places), len(places)):
                    raise ValueError(
                        f"{name} must have shape {(len(places),) * 2}, one row for each of dofs, "
                        f"got {small.shape}"
                    )
                terms.append((coefficient, placed(small, places, self.n, self.is_sparse)))
            added[name] = terms
        return self._with_terms(added, self.joints_by_name(), self.F, self.parameters)

    def require_one(self) -> None:
        """Refuse a batch, and a large sparse structure, which must be reduced first."""
        require_single(self)
        if self.is_sparse:
            raise ValueError(too_large(self))

    def as_structure(self) -> "Structure":
        """The structure itself."""
        return self

    def joints_by_name(self) -> dict[str, Joint]:
        """The joints by their names."""
        return dict(zip(self.joint_names, self.joints, strict=True))

    def with_joints(self, joints: Mapping[str, Any]) -> Self:
        """A copy with other joints of the same names, not checked."""
        return eqx.tree_at(lambda structure: structure.joints, self, tuple(joints.values()))

    def stored_quantities(self) -> dict[str, Quantity]:
        """The numbers of the joints, "D" of the first that has one and "left.D", and parameters."""
        stored = {}
        for name, joint in self.joints_by_name().items():
            plain = joint.stored_quantities()
            stored = plain | stored | {f"{name}.{each}": plain[each] for each in plain}
        parameters = {
            name: Quantity(value, "-", "parameter", False)
            for name, value in self.parameters.items()
        }
        return parameters | stored

    def substituted(self, changes: Mapping[str, Any]) -> Self:
        """Like `replace` for stored quantities that have a value, without checks."""
        joints = {}
        for name, joint in self.joints_by_name().items():
            full_names = {f"{name}.{plain}": plain for plain in quantities(joint)}
            plain = {key: value for key, value in changes.items() if key in full_names.values()}
            full = {full_names[key]: value for key, value in changes.items() if key in full_names}
            joints[name] = substitute(joint, plain | full)
        new = self.with_joints(joints)
        parameters = {name: changes[name] for name in self.parameters if name in changes}
        if not parameters:
            return new
        return eqx.tree_at(lambda s: s.parameters, new, new.parameters | parameters)

    @property
    def is_sparse(self) -> bool:
        """True if the matrices are large and sparse, so that `reduce` must come first."""
        return any(held.sparse for held in self.sums.values())

    def _matrix(self, name: str) -> Float[Array, "n n"]:
        if self.sums[name].sparse:
            raise ValueError(too_large(self))
        return self.sums[name].at(self.parameters)

    @property
    def _dtype(self):
        arrays = self.sums["M"].arrays
        return arrays[0].dtype if arrays else jnp.result_type(float)

    def direction(self, direction: Direction) -> np.ndarray:
        """The weights d (n,) for which d.x is the displacement in `direction`, given as in `Joint`.

        **Raises:** `ValueError` for a direction that is zero or not of length n, and as `index`.
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
        """Summed absolute weights (m, n) of the degrees of freedom in each joint, if available."""
        weights = [np.abs(self._directions(joint)).sum(axis=0) for joint in self.joints]
        return np.array(weights).reshape(len(weights), self.n)

    def _directions(self, joint: Joint) -> list[np.ndarray]:
        """The tangential and, if there is one, the normal direction (n,) of a joint."""
        stored = (joint.tangential, joint.normal)
        return [self.direction(each) for each in stored if each is not None]

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

    def _forces(self, loads: Mapping[Any, ArrayLike]) -> Float[Array, " n"]:
        places = [self.index(dof) for dof in loads]
        twice = [dof for dof, place in zip(loads, places, strict=True) if places.count(place) > 1]
        if twice:
            raise ValueError(f"F gives one degree of freedom twice: {some_of(map(repr, twice))}")
        forces = [number(f"F at {dof}", force) for dof, force in loads.items()]
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
        matrices = {name: changes[name] for name in ("M", "C", "K", "K_loss") if name in changes}
        if "K" in matrices and "K_loss" not in matrices:
            # A complex K has its own loss; another K keeps the one that is there.
            _, loss = separated(matrices["K"], None)
            matrices |= {} if loss is None else {"K_loss": None}
        if matrices or "F" in changes:
            return self._with_terms(matrices, joints, changes.get("F", self.F), parameters)
        # The matrices are unchanged and need no new check or factorisation.
        new = eqx.tree_at(lambda structure: structure.joints, self, tuple(joints.values()))
        new._check_joints()
        if changes.keys() & parameters.keys():
            new = eqx.tree_at(lambda structure: structure.parameters, new, parameters)
            _check_coefficients(new)
        return new

    def _with_terms(self, matrices, joints, F, parameters) -> "Structure":
        """A checked copy with other matrices or terms of them, joints, F and parameters."""
        kept = {name: self._terms(name) for name in self.sums} | matrices
        arguments = {name: merged(X) for name, X in kept.items()}
        arguments |= {"joints": joints, "F": F, "names": self.names}
        arguments |= {"mesh": self._matching_mesh(), "notes": self.notes}
        if not self.parameters:
            return Structure(**arguments)
        return ParametricStructure(**arguments, parameters=parameters)

    def _matching_mesh(self) -> Mesh | None:
        """The mesh, if it has the degrees of freedom of the matrices, else None."""
        return self.mesh

    def _terms(self, name: str) -> list[tuple[Any, Any]]:
        """The terms (coefficient, matrix) of a matrix, with numeric coefficients multiplied in."""
        held = self.sums[name]
        return list(zip(held.coefficients, held.matrices, strict=True))

    def _quantity_names(self):
        names = ["M", "C", "K", "F", *self.parameters]
        for name, joint in zip(self.joint_names, self.joints, strict=True):
            names += [*quantities(joint), *(f"{name}.{plain}" for plain in quantities(joint))]
        return list(dict.fromkeys([*names, "K_loss"]))

    def _shown(self):
        yield f"n={self.n}"
        yield from (f"{name}={value}" for name, value in self.parameters.items())
        yield from (f"{name}={j!r}" for name, j in zip(self.joint_names, self.joints, strict=True))
        yield from map(repr, self.notes)

    @classmethod
    def _from_document(cls, document, folder):
        arguments = read_structure(document, folder)
        if "reduced" in arguments:
            from .reduced import ReducedStructure

            return ReducedStructure.from_file(arguments)
        if "parameters" in arguments or any(is_sum(x) for x in arguments.values()):
            return ParametricStructure(**arguments)
        return Structure(**arguments)

    def _more_tables(self) -> dict[str, Any]:
        """Additional tables of the TOML file."""
        return {}

    def _more_arrays(self) -> dict[str, np.ndarray]:
        """Additional arrays of the .npz file."""
        return {}

    def save(self, path: str | os.PathLike) -> None:
        """Write a TOML file at `path` and, beside it, the matrices as a .npz file of the same name.

        Both files are written or neither: an error leaves the files of an earlier structure intact.

        **Raises:** `OSError` if a file cannot be written; `ValueError` if the structure holds a
        batch, if `path` itself ends in .npz, and if a .npz file of that name exists which the TOML
        file at `path` does not name.
        """
        write_together(self._files(Path(path)))

    def embedded(self, beside: Path) -> tuple[str, dict[Path, bytes]]:
        """The name of the structure's file, and what `save` writes there."""
        return beside.name, self._files(beside)

    def _files(self, path: Path) -> dict[Path, bytes]:
        """The contents that `save` writes, by file; errors as there."""
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

    Derivatives reach each parameter; `replace(Omega=...)`, sweeps and designs accept their names.

    **Arguments:**

    - `M`, `C`, `K`: each a matrix as in `Structure`, or a list of (coefficient, matrix) to be
      summed. A coefficient is a number, a function of the parameters,
      `lambda p: p["Omega"] ** 2 - 1`, or the same as text, "Omega**2 - 1", with + - * / **, pi,
      sqrt, exp, log, sin, cos and tan, which a file can hold. For example, a gyroscopic term is
      ("Omega", G) in C and a circulatory one ("mu", N) in K.
    - `joints`: as in `Structure`, by default none.
    - `parameters`: {name: number}, by default none.
    - `F`, `names`, `mesh`, `notes`: as in `Structure`.
    - `K_loss`: as in `Structure`, or a list of (coefficient, matrix), such as ("eta", K_pad) for a
      loss factor that is a parameter. Matrices and numeric coefficients of K may be complex: their
      imaginary parts are added to it.

    **Raises:** as `Structure`; `ValueError` for a coefficient that is not finite or reads an
    unknown parameter, and for a parameter with the name of another quantity.
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
        K_loss: Any = None,
        mesh: Mesh | None = None,
        notes: Iterable[str] = (),
    ):
        if not isinstance(parameters or {}, Mapping):
            raise TypeError(f"parameters must be a mapping, got {brief(parameters)}")
        held = {name: number(str(name), value) for name, value in (parameters or {}).items()}
        matrices = {"M": M, "C": C, "K": K, "K_loss": K_loss}
        self._fill(matrices, held, joints, F, names, mesh, notes)
        taken = {"M", "C", "K", "F", "K_loss", "pi"}.union(*map(quantities, self.joints))
        for name in held:
            if not (isinstance(name, str) and name.isidentifier()):
                raise ValueError(f"a parameter's name must be like Omega or k_1, got {name!r}")
            if name in taken:
                raise ValueError(f"the parameter {name} has the name of another quantity")


@exported_jit
def _oscillator_matrices(oscillator: Oscillator):
    """M, C, K and F of the mass on a belt."""
    m, f = oscillator.m, oscillator.F / jnp.sqrt(2.0)
    omega = jnp.stack([oscillator.omega_1, oscillator.omega_2])
    xi = jnp.stack([oscillator.xi_1, oscillator.xi_2])
    M, C = m * jnp.eye(2, dtype=m.dtype), jnp.diag(2 * xi * omega * m)
    return M, C, jnp.diag(m * omega**2), jnp.stack([f, -f])


def too_large(structure: Structure) -> str:
    """The message for a structure that must be reduced first."""
    return (
        f"the structure is sparse with {structure.n} degrees of freedom, too many for this: "
        "take reduce(structure, ...) in its place"
    )


def _check_coefficients(structure: Structure) -> None:
    """Refuse concrete parameters at which a coefficient is not finite."""
    values = {name: concrete(value) for name, value in structure.parameters.items()}
    if any(value is None or value.ndim for value in values.values()):
        return
    p = {name: jnp.asarray(value) for name, value in values.items()}
    for name, held in structure.sums.items():
        for coefficient in held.coefficients:
            if coefficient is not None:
                at = ", ".join(f"{key} = {value:g}" for key, value in p.items())
                scalar(f"a coefficient of {name} at {at}", coefficient(p))
    mass = structure.sums["M"]
    if not mass.sparse and any(mass.coefficients) and concrete(mass.arrays[0]) is not None:
        mass_matrix(mass.at(p))


def _names_matrices(path: Path, matrices: str) -> bool:
    """True if `path` is a structure's TOML file with its matrices in the file `matrices`."""
    try:
        table = read_toml(path.read_bytes()).get("structure")
    except (OSError, ValueError):
        return False
    return isinstance(table, dict) and table.get("matrices") == matrices


def load(path: str | os.PathLike) -> Scene | Structure:
    """The mechanism in a TOML file: a structure if it has a table [structure], else a scene.

    **Arguments:**

    - `path`: the TOML file; files that it names are beside it.

    **Raises:** as `Scene.load` and `Structure.load`.
    """
    with naming(path):
        document = read_toml(read_bounded(path))
        kind = Structure if "structure" in document else Scene
        return kind._from_document(document, Path(path).parent)


def save(x: Any, path: str | os.PathLike) -> None:
    """Write a scene, a structure, a design or anything else that has a method `save`, by it.

    `load` reads a scene or a structure back, `repeat_design` a design.

    **Arguments:**

    - `x`: a `Scene`, a `Structure`, a `Design`, or a part of your own with a method `save(path)`.
    - `path`: the file.

    **Raises:** as the method; `TypeError` for what has none.
    """
    method = getattr(x, "save", None) if isinstance(x, Record) else None
    if method is None:
        raise TypeError(
            f"x must be a Scene, a Structure, a Design or have a method save, got {brief(x)}"
        )
    method(path)


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
        requirement = f"{n} printable strings, one a degree of freedom"
        raise ValueError(
            f"names must be {requirement}, got {len(names)}: {some_of(map(repr, names))}"
        )
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
