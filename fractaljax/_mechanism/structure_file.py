"""Files of a structure: a TOML file for the joints, and the files of its matrices."""

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._base import toml
from .._base.file_limits import FileLimits
from .._base.files import read_bounded
from .._base.numpy_file import read_npz
from .._base.parts import brief, scalar
from .._version import __version__
from .coefficient import Expression
from .damping import modal_damping, rayleigh_damping
from .joint import Joint
from .matrices import MatrixSum, is_sparse
from .matrix_file import Matrices, read_matrices
from .mesh import Mesh

_MATRICES = ("M", "C", "K", "K_loss")
_BASES = ("V", "W", "residuals", "touched", "coarse_V", "coarse_W")
_MESH = "mesh."  # prefix of its arrays in the file of matrices
_TABLES = ("structure", "parameters", "joints", "reduction", "reduced")
_SPARSE = ("data", "indices", "indptr", "shape")  # a matrix in compressed rows
_MATRIX_FORMS = (
    "the name of a file or of a matrix, or a list of {coefficient = ..., matrix = ..., file = ...}"
)
_TERM = ("coefficient", "matrix", "file")
_KEYS = {  # of [structure]: types, and their description
    "matrices": (str, "the name of a file"),
    **dict.fromkeys(_MATRICES, ((str, list), _MATRIX_FORMS)),
    "F": ((list, dict, str), "a list, a table or a file's name"),
    "loss_factor": ((float, int), "a number"),
    "rayleigh": (list, "[alpha, beta]"),
    "damping_ratio": ((float, int, list), "a number or a list of one a mode"),
    "names": (list, "a list"),
    "mesh": (str, "the name of a .npz file with points, dofs and cells"),
}


class _Source:
    """Matrices that the file of a structure names, and the names of degrees of freedom."""

    def __init__(self, table: dict[str, Any], folder: Path):
        self.folder = folder
        self.names: Any = table.get("names")
        self.names_of_files = False
        self.held: dict[str, Any] = {}
        self.unread: dict[str, str] = {}  # reasons by name, for the file of matrices
        self.notes: list[str] = []
        self.used: set[str] = set()
        self.file = table.get("matrices")
        if self.file is not None:
            path = folder / self.file
            # NumPy arrays stay dense.
            if path.suffix.lower() == ".npz":
                self.held = _npz(path)
            else:
                model = self._read(path)
                self.held, self.unread = model.matrices, model.unread

    def matrix(self, key: str, value: str) -> Any:
        """The matrix `value` of the file of matrices, or the matrix `key` in the file `value`."""
        if value in self.held or value in self.unread:
            self.used.add(value)
            return self.held[value]
        path = self.folder / value
        if self.held and not path.suffix and not path.exists():
            raise ValueError(f"{self.file} has no {value!r}; it holds {', '.join(self.held)}")
        read = self._read(path)
        matrices = read.matrices
        if len(matrices) == 1 and key not in read.unread:
            return next(iter(matrices.values()))
        if key not in matrices and key not in read.unread:
            raise ValueError(
                f"{value} must hold {key} or one matrix; it holds {', '.join(matrices)}"
            )
        return matrices[key]

    def chosen(self, file: str, name: str) -> Any:
        """The matrix `name` of another file."""
        matrices = self._read(self.folder / file).matrices
        try:
            return matrices[name]
        except KeyError:
            raise ValueError(f"{file} has no {name!r}; it holds {', '.join(matrices)}") from None

    def sum(self, key: str, value: Any) -> Any:
        """M, C, K or K_loss in the form that `Structure` takes.

        A term of K with a loss factor is complex, K (1 + i eta).
        """
        if isinstance(value, str):
            return self.matrix(key, value)
        terms, allowed = [], (*_TERM, "loss_factor") if key == "K" else _TERM
        for term in value:
            if not isinstance(term, dict):
                raise ValueError(f"[structure] {key} must be {_MATRIX_FORMS}, got {brief(term)}")
            toml.refuse_unknown(f"a term of [structure] {key}", term, allowed)
            name, file = term.get("matrix"), term.get("file")
            if not isinstance(name, str):
                raise ValueError(f"a term of [structure] {key} lacks the key 'matrix'")
            if not (file is None or isinstance(file, str)):
                raise ValueError(f"file in a term of [structure] {key} must be a name, got {file}")
            X = self.matrix(key, name) if file is None else self.chosen(file, name)
            eta = term.get("loss_factor")
            X = X if eta is None else _with_loss(X, _loss_factor(f"a term of {key}", eta))
            terms.append((term.get("coefficient"), X))
        return terms

    def refuse_unused(self) -> None:
        """Refuse unused arrays in the file of matrices."""
        if self.file is not None and self.file.lower().endswith(".npz"):
            allowed = ["M", "C", "K", "F", "K_loss", *_BASES]
            rest = [
                name for name in self.held if name not in self.used and not name.startswith(_MESH)
            ]
            toml.refuse_unknown(self.file, rest, allowed)

    def mesh(self, name: str | None) -> Mesh | None:
        """The mesh in the file `name`, or in the file of matrices."""
        if name is None:
            held = {key.removeprefix(_MESH): x for key, x in self.held.items() if _MESH in key}
            return Mesh.from_arrays(held, str(self.file)) if held else None
        if any(key.startswith(_MESH) for key in self.held):
            raise ValueError("[structure] gives mesh twice: in matrices and as mesh")
        if Path(name).suffix.lower() != ".npz":
            raise ValueError(f"[structure] mesh must be {_KEYS['mesh'][1]}, got {brief(name)}")
        return Mesh.from_arrays(_npz(self.folder / name), name)

    def _read(self, path: Path) -> Matrices:
        model = read_matrices(path)
        self.notes += [f"{path.name}: {note}" for note in model.notes]
        if self.names is None:
            self.names, self.names_of_files = model.names, True
        if model.names is None or tuple(self.names) == model.names:
            return model
        missing = [name for name in model.names if name not in self.names]
        if missing and self.names_of_files:
            raise ValueError(
                f"{path.name} has the degree of freedom {missing[0]}, which the files before it "
                "have not"
            )
        return model if missing else _expanded(model, self.names)


def read_structure(document: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The arguments of the structure in a TOML file that lies in `folder`, by name.

    They include `parameters` and the arguments `reduced` of a reduction, if the file has them.

    **Raises:** `ValueError` naming the table and the key that is unknown, missing or of the wrong
    kind, or the file whose matrix is wrong; `OSError` if one cannot be read.
    """
    toml.refuse_unknown("the file", document, _TABLES)
    table = toml.table_at(document, "structure")
    joints, parameters = (
        toml.table_at(document, key) if key in document else {} for key in ("joints", "parameters")
    )
    if not parameters and "reduced" not in document:
        toml.table_at(document, "joints")  # required, even if empty, in a plain structure
    toml.refuse_unknown("[structure]", table, _KEYS)
    for key, value in table.items():
        kinds, expected = _KEYS[key]
        if not isinstance(value, kinds):
            raise ValueError(f"[structure] {key} must be {expected}, got {brief(value)}")
    source = _Source(table, folder)
    matrices: dict[str, Any] = {}
    for name in (*_MATRICES, "F"):
        given = name in table and name in source.held
        if given and not _is_stored(name, table[name], source.held):
            raise ValueError(f"[structure] gives {name} twice: in matrices and as {name}")
        if name not in table and (name in source.held or name in source.unread):
            matrices[name] = source.held[name]
        elif name in table and (name != "F" or isinstance(table[name], str)):
            matrices[name] = source.sum(name, table[name])
    source.refuse_unused()
    for name in ("M", "K"):
        if name not in matrices:
            raise ValueError(f"[structure] lacks the matrix {name}, or matrices that has it")
    if "loss_factor" in table:
        eta = _loss_factor("[structure]", table["loss_factor"])
        terms = matrices["K"] if isinstance(matrices["K"], list) else [(None, matrices["K"])]
        terms = [(c, _with_loss(X, eta)) for c, X in terms]
        matrices["K"] = terms if isinstance(matrices["K"], list) else terms[0][1]
    damping = [key for key in ("C", "rayleigh", "damping_ratio") if key in table | matrices]
    if len(damping) > 1:
        raise ValueError(f"[structure] gives damping twice: {' and '.join(damping)}")
    if "rayleigh" in table:
        if len(table["rayleigh"]) != 2:
            raise ValueError(f"[structure] rayleigh must be [alpha, beta], got {table['rayleigh']}")
        matrices["C"] = _rayleigh(matrices["M"], _real(matrices["K"]), *table["rayleigh"])
    if "damping_ratio" in table:
        ratio = table["damping_ratio"]
        ratio = np.asarray(ratio) if isinstance(ratio, list) else ratio
        matrices["C"] = modal_damping(_one("M", matrices), _real(_one("K", matrices)), ratio)
    names = source.names
    F = matrices.get("F", table.get("F"))
    F = np.asarray(F.toarray()) if F is not None and is_sparse(F) else F
    if isinstance(F, dict):
        F = {_dof(key, names or ()): force for key, force in F.items()}
    elif isinstance(F, np.ndarray) and 1 in F.shape:
        F = F.ravel()
    attached = {}
    for name in joints:
        joint = dict(toml.table_at(joints, name, "joints."))
        for which in ("tangential", "normal"):
            if isinstance(joint.get(which), dict):
                joint[which] = {_dof(key, names or ()): x for key, x in joint[which].items()}
        attached[name] = toml.read_part(Joint, joint, f"joints.{name}")
    arguments = {"C": None, **matrices, "F": F, "joints": attached, "names": names}
    arguments["mesh"] = source.mesh(table.get("mesh"))
    arguments["notes"] = tuple(dict.fromkeys(source.notes))  # a file may be read twice
    if "reduced" in document:
        bases = {name: source.held.get(name) for name in _BASES}
        arguments["reduced"] = {**toml.table_at(document, "reduced"), **bases}
    return arguments | ({"parameters": parameters} if parameters else {})


def _loss_factor(where: str, value: Any) -> float:
    """A checked loss factor of stiffness."""
    return float(scalar(f"loss_factor of {where}", value, at_least=0))


def _with_loss(K: Any, eta: float) -> Any:
    """K (1 + i eta), beside the structural damping that it already has."""
    return K + 1j * eta * K.real


def _expanded(model: Matrices, names: Sequence[str]) -> Matrices:
    """A model of some of the degrees of freedom `names`, with all of them, by their names."""
    from scipy.sparse import coo_array

    place = {name: i for i, name in enumerate(names)}
    index = np.array([place[name] for name in model.names or ()])
    n, k = len(names), len(index)
    for name, X in list(model.matrices.items()):
        if X.shape not in ((k, k), (k, 1)):
            continue
        entries = X.tocoo()
        i, j = entries.coords
        width, j = (n, index[j]) if X.shape[1] == k else (1, j)
        whole = coo_array((entries.data, (index[i], j)), shape=(n, width))
        model.matrices[name] = whole.tocsr()
    return model


def _is_stored(name: str, value: Any, held: Mapping[str, Any]) -> bool:
    """True if what the table gives as `name` is of the file of matrices, or adds to its `name`."""
    terms = value if isinstance(value, list) else [{"matrix": value}]
    terms = [term if isinstance(term, dict) else {} for term in terms]
    if name in (term.get("matrix") for term in terms if "file" not in term):
        return True
    return all(term.get("matrix") in [*held] for term in terms)


def _one(name: str, matrices: Mapping[str, Any]) -> Any:
    if isinstance(matrices[name], list):
        raise ValueError(f"[structure] damping_ratio needs {name} as one matrix: give C")
    return matrices[name]


def _real(K: Any) -> Any:
    """K, or each of its terms, without structural damping."""
    return [(c, X.real) for c, X in K] if isinstance(K, list) else K.real


def _rayleigh(M: Any, K: Any, alpha: Any, beta: Any) -> Any:
    """alpha M + beta K, also for sums and sparse matrices."""
    if not isinstance(M, list) and not isinstance(K, list) and not is_sparse(M):
        return rayleigh_damping(M, K, alpha, beta)
    terms = []
    for factor, X in ((alpha, M), (beta, K)):
        for coefficient, matrix in X if isinstance(X, list) else [(None, X)]:
            number = 1.0 if coefficient is None else coefficient
            scaled = f"{factor!r} * ({number})" if isinstance(number, str) else factor * number
            terms.append((scaled, matrix))
    return terms


def _dof(key: str, names) -> int | str:
    """A degree of freedom from a TOML key: a name, or else an index written as text."""
    return int(key) if key not in names and re.fullmatch("0|[1-9][0-9]{0,8}", key) else key


def _npz(path: Path) -> dict[str, Any]:
    """The arrays of a .npz file, sparse ones from the parts "K.data", "K.indices", ..."""
    most = FileLimits.matrices
    with toml.naming(path.name):
        arrays: dict[str, Any] = read_npz(read_bounded(path, most), most, kinds="iufc")
        for name in [key.removesuffix(".data") for key in arrays if key.endswith(".data")]:
            parts = [arrays.pop(f"{name}.{part}", None) for part in _SPARSE]
            arrays[name] = _compressed(name, *parts)
    return arrays


def _compressed(name: str, data, indices, indptr, shape) -> Any:
    from scipy.sparse import csr_array

    try:
        matrix = csr_array((data, indices, indptr), shape=tuple(shape))
        matrix.check_format(full_check=True)
    except (ValueError, TypeError):
        raise ValueError(f"{name} is no sound sparse matrix") from None
    return matrix


def structure_text(structure: Any, matrices: str) -> str:
    """The TOML text of a structure whose matrices are in the file `matrices` in its folder.

    **Raises:** `ValueError` for a coefficient that is a function.
    """
    table = {
        "matrices": toml.Noted(matrices, "M, C, K and perhaps K_loss, F and a mesh"),
        "names": structure.names,
    }
    for name, held in structure.sums.items():
        if held.coefficients != (None,):
            table[name] = [
                _term(name, i, coefficient)
                for i, coefficient in enumerate(held.coefficients, start=1)
            ]
    joints = {}
    for name, joint in zip(structure.joint_names, structure.joints, strict=True):
        directions = {
            which: _written(getattr(joint, which), structure.names or ())
            for which in ("tangential", "normal")
        }
        joints[name] = toml.part_table(joint) | directions
    comment = f"A fractaljax structure, in SI units; written by fractaljax {__version__}."
    document = {"structure": table, "parameters": structure.parameters, "joints": joints}
    document = {name: x for name, x in document.items() if x or name != "parameters"}
    return toml.write_toml(comment, document | structure._more_tables())


def _term(name: str, i: int, coefficient: Any) -> dict[str, str]:
    if coefficient is None:
        return {"matrix": f"{name}_{i}"}
    if not isinstance(coefficient, Expression):
        raise ValueError(
            f"the coefficient of {name}, term {i} is a function, which no file can hold: give it "
            'as text, such as "Omega**2 - 1"'
        )
    return {"coefficient": coefficient.text, "matrix": f"{name}_{i}"}


def _written(direction: tuple[Any, ...] | None, names: tuple[str, ...]) -> Any:
    """A direction in TOML form: weights by degree of freedom become an inline table."""
    if direction is None or not isinstance(direction[0], tuple):
        return direction
    # An index that equals a name would be read as that name.
    weights = {
        str(names[dof] if str(dof) in names and isinstance(dof, int) else dof): weight
        for dof, weight in direction
    }
    return toml.Noted(weights, "")


def npz_bytes(structure: Any) -> bytes:
    """The matrices of a structure as the content of a .npz file."""
    arrays: dict[str, Any] = dict(structure._more_arrays())
    for name, held in structure.sums.items():
        arrays |= _matrix_arrays(name, held)
    if structure.F is not None:
        arrays["F"] = np.asarray(structure.F)
    if structure.mesh is not None:
        arrays |= {f"{_MESH}{name}": array for name, array in structure.mesh.arrays().items()}
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def _matrix_arrays(name: str, held: MatrixSum) -> dict[str, np.ndarray]:
    one = held.coefficients == (None,)
    arrays = {}
    for i, X in enumerate(held.matrices, start=1):
        key = name if one else f"{name}_{i}"
        if is_sparse(X):
            arrays |= {f"{key}.{part}": np.asarray(getattr(X, part)) for part in _SPARSE}
        else:
            arrays[key] = np.asarray(X)
    return arrays
