"""Structures as files: a TOML file for the joints, and the matrices it names."""

import bz2
import gzip
import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .._version import __version__
from ..base.numpy_file import read_npz
from ..base.scene_file import (
    parts_of,
    quoted,
    read_bounded,
    refuse_unknown,
    table_of,
    tables_of,
)
from .matrix_market import read_matrix_market

_LARGEST = 4000  # degrees of freedom; a sparse matrix of more is no reduced model
_LARGEST_FILE = 4 * 8 * _LARGEST**2

_DAMAGED = (zlib.error, struct.error, EOFError)  # of Python's readers of compressed files

_ARRAYS = ("M", "C", "K", "F")
_KEYS = ("matrices", "M", "C", "K", "rayleigh", "damping_ratio", "F", "names")


def parse_structure(document: dict[str, Any], folder: Path, laws) -> dict[str, Any]:
    """The arguments of a `Structure` in the TOML tables `document`, files sought from `folder`.

    `joints` maps names to arguments of a `Joint`; `damping` holds `rayleigh` or `damping_ratio`
    where the file asks for such a C.

    **Raises:** `ValueError` naming the table and the key that is unknown, missing or of the wrong
    kind, or the file that holds no such matrix; `OSError` if one cannot be read.
    """
    refuse_unknown("the file", document, ("structure", "joints"))
    table = table_of(document, "structure")
    refuse_unknown("[structure]", table, _KEYS)
    found: dict[str, Any] = {}
    if "matrices" in table:
        found = _npz(_path(table, "matrices", folder))
    for name in ("M", "C", "K"):
        if name in table:
            _once(name, found)
            found[name] = _matrix_market(_path(table, name, folder))
    for name in ("M", "K"):
        if name not in found:
            raise ValueError(f"[structure] lacks the matrix {name}: neither a file nor in matrices")
    if "F" in table:
        _once("F", found)
        found["F"] = _force(table["F"], _names(table), folder)
    joints = table_of(document, "joints")
    return {
        "M": found["M"],
        "C": found.get("C"),
        "K": found["K"],
        "F": found.get("F"),
        "names": _names(table),
        "damping": _damping(table, "C" in found),
        "joints": {name: _joint(name, table_of(joints, name, "joints."), laws) for name in joints},
    }


def _once(name, found):
    if name in found:
        raise ValueError(f"[structure] gives {name} twice: in matrices and as {name}")


def _path(table, key, folder: Path) -> Path:
    if not isinstance(table[key], str):
        raise ValueError(f"[structure] {key} must be the name of a file, got {table[key]!r}")
    return folder / table[key]


def _names(table) -> list[str] | None:
    names = table.get("names")
    if names is not None and not isinstance(names, list):
        raise ValueError(f"[structure] names must be a list, got {names!r}")
    return names


def _force(given, names, folder: Path):
    if isinstance(given, str):
        force = _matrix_market(folder / given)
        return force.ravel() if 1 in force.shape else force
    if isinstance(given, dict):
        return _by_degree_of_freedom(given, names or ())
    if not isinstance(given, list):
        raise ValueError(f"[structure] F must be a list, a table or a file's name, got {given!r}")
    return given


def _by_degree_of_freedom(given, names) -> dict[int | str, Any]:
    """Keys of TOML are texts: one that is no name may be an index."""
    found = {}
    for key, force in given.items():
        index = key.isascii() and key.isdecimal() and key not in names
        dof = int(key[:9]) if index else key  # more digits than that are no index either
        if dof in found:
            raise ValueError(f"[structure] F gives the degree of freedom {dof} twice")
        found[dof] = force
    return found


def _damping(table, has_matrix: bool) -> dict[str, Any]:
    asked = {key: table[key] for key in ("rayleigh", "damping_ratio") if key in table}
    if len(asked) + has_matrix > 1:
        raise ValueError("[structure] gives damping twice: C, rayleigh and damping_ratio exclude")
    if "rayleigh" in asked and not (
        isinstance(asked["rayleigh"], list) and len(table["rayleigh"]) == 2
    ):
        raise ValueError(f"[structure] rayleigh must be [alpha, beta], got {asked['rayleigh']!r}")
    if isinstance(asked.get("damping_ratio"), list):
        asked["damping_ratio"] = np.asarray(asked["damping_ratio"])
    return asked


def _joint(name: str, table: dict[str, Any], laws) -> dict[str, Any]:
    refuse_unknown(f"[joints.{name}]", table, ("tangential", "normal", "V", *laws))
    for key in ("tangential", "normal"):
        if key not in table:
            raise ValueError(f"[joints.{name}] lacks the key {key!r}")
    own = {key: table[key] for key in ("tangential", "normal", "V") if key in table}
    return own | parts_of(table, laws, f"joints.{name}.")


def _npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file."""
    try:
        arrays = read_npz(read_bounded(path, _LARGEST_FILE), _LARGEST_FILE)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
    refuse_unknown(path.name, arrays, _ARRAYS)
    return arrays


def _matrix_market(path: Path) -> np.ndarray:
    """The matrix in a Matrix Market file, which may be compressed: .mtx.gz, .mtx.bz2."""
    opener = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix, open)
    try:
        with opener(path, "rb") as file:
            return read_matrix_market(file, _LARGEST)
    except ValueError as error:
        raise ValueError(f"{path.name} {error}") from None
    except _DAMAGED:
        raise ValueError(f"{path.name} is damaged") from None
    except OSError as error:
        if error.errno is None:  # of bz2, not of the system
            raise ValueError(f"{path.name} is damaged") from None
        raise


def render_structure(structure, matrices: str, laws) -> str:
    """The TOML text of a structure whose matrices are in the file `matrices` beside it."""
    lines = [f"# A fractaljax structure, in SI units; written by fractaljax {__version__}."]
    lines += ["", "[structure]"]
    lines.append(f"matrices = {quoted(matrices)}  # M, C, K and perhaps F")
    if structure.names is not None:
        lines += ["names = [", *(f"    {quoted(name)}," for name in structure.names), "]"]
    for name, joint in zip(structure.joint_names, structure.joints, strict=True):
        lines += ["", f"[joints.{name}]"]
        for key in ("tangential", "normal"):
            dofs = [quoted(d) if isinstance(d, str) else str(d) for d in getattr(joint, key)]
            lines.append(f"{key} = [{', '.join(dofs)}]")
        if joint.V is not None:
            lines.append(f"V = {float(joint.V)!r}  # m/s: sliding velocity")
        lines += tables_of(joint, laws, f"joints.{name}.")
    if not structure.joints:
        lines += ["", "[joints]"]
    return "\n".join(lines) + "\n"


def npz_of(structure) -> bytes:
    """The matrices of a structure as the content of a .npz file."""
    content = io.BytesIO()
    arrays = {name: getattr(structure, name) for name in _ARRAYS}
    held: dict[str, Any] = {name: np.asarray(x) for name, x in arrays.items() if x is not None}
    np.savez(content, **held)
    return content.getvalue()
