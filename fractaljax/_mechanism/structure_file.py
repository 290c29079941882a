"""Structures as files: a TOML file for the joints, and the matrices it names."""

import bz2
import gzip
import io
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .._base import toml
from .._base.files import read_bounded
from .._base.numpy_file import read_npz
from .._base.parts import brief
from .._version import __version__
from .damping import modal_damping, rayleigh_damping
from .joint import JOINT_LAWS, Joint
from .matrix_market import read_matrix_market

_LARGEST = 4000  # degrees of freedom; a sparse matrix of more is no reduced model
_LARGEST_FILE = 4 * 8 * _LARGEST**2
_ARRAYS = ("M", "C", "K", "F")
_KEYS = {  # of [structure]: what each may be
    **dict.fromkeys(("matrices", "M", "C", "K"), (str, "the name of a file")),
    "F": ((list, dict, str), "a list, a table or a file's name"),
    "rayleigh": (list, "[alpha, beta]"),
    "damping_ratio": ((float, int, list), "a number or a list of one a mode"),
    "names": (list, "a list"),
}


def read_structure(document: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The arguments of the `Structure` in a TOML file that lies in `folder`.

    **Raises:** `ValueError` naming the table and the key that is unknown, missing or of the wrong
    kind, or the file whose matrix is wrong; `OSError` if one cannot be read.
    """
    toml.refuse_unknown("the file", document, ("structure", "joints"))
    table, joints = toml.table_at(document, "structure"), toml.table_at(document, "joints")
    toml.refuse_unknown("[structure]", table, _KEYS)
    for key, value in table.items():
        kinds, wanted = _KEYS[key]
        if not isinstance(value, kinds):
            raise ValueError(f"[structure] {key} must be {wanted}, got {brief(value)}")
    names = table.get("names")
    given: dict[str, Any] = _npz(folder / table["matrices"]) if "matrices" in table else {}
    for name in _ARRAYS:
        if name in table and name in given:
            raise ValueError(f"[structure] gives {name} twice: in matrices and as {name}")
        if isinstance(table.get(name), str):
            given[name] = _matrix_market(folder / table[name])
    for name in ("M", "K"):
        if name not in given:
            raise ValueError(f"[structure] lacks the matrix {name}, or matrices that has it")
    damping = [key for key in ("C", "rayleigh", "damping_ratio") if key in table | given]
    if len(damping) > 1:
        raise ValueError(f"[structure] gives damping twice: {' and '.join(damping)}")
    if "rayleigh" in table:
        if len(table["rayleigh"]) != 2:
            raise ValueError(f"[structure] rayleigh must be [alpha, beta], got {table['rayleigh']}")
        given["C"] = rayleigh_damping(given["M"], given["K"], *table["rayleigh"])
    if "damping_ratio" in table:
        ratio = table["damping_ratio"]
        ratio = np.asarray(ratio) if isinstance(ratio, list) else ratio
        given["C"] = modal_damping(given["M"], given["K"], ratio)
    F = given.get("F", table.get("F"))
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
        attached[name] = toml.read_part(Joint, joint, JOINT_LAWS, f"joints.{name}")
    return {"C": None, **given, "F": F, "joints": attached, "names": names}


def _dof(key: str, names) -> int | str:
    """Keys of TOML are texts: one that is no name may be an index."""
    return int(key) if key not in names and re.fullmatch("0|[1-9][0-9]{0,8}", key) else key


def _npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file."""
    with toml.naming(path.name):
        arrays = read_npz(read_bounded(path, _LARGEST_FILE), _LARGEST_FILE)
    toml.refuse_unknown(path.name, arrays, _ARRAYS)
    return arrays


def _matrix_market(path: Path) -> np.ndarray:
    """The matrix in a Matrix Market file, which may be compressed: .mtx.gz, .mtx.bz2."""
    opener = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix, open)
    try:
        with opener(path, "rb") as file:
            return read_matrix_market(file, _LARGEST)
    except ValueError as error:
        raise ValueError(f"{path.name} {error}") from None
    except (zlib.error, struct.error, EOFError, OSError) as error:
        if getattr(error, "errno", None) is not None:  # of the system, not of the decompressor
            raise
        raise ValueError(f"{path.name} is damaged") from None


def structure_text(structure: Any, matrices: str) -> str:
    """The TOML text of a structure whose matrices are in the file `matrices` beside it."""
    table = {"matrices": toml.Noted(matrices, "M, C, K and perhaps F"), "names": structure.names}
    joints = {}
    for name, joint in zip(structure.joint_names, structure.joints, strict=True):
        directions = {
            which: _written(getattr(joint, which), structure.names or ())
            for which in ("tangential", "normal")
        }
        joints[name] = toml.part_table(joint, JOINT_LAWS) | directions
    comment = f"A fractaljax structure, in SI units; written by fractaljax {__version__}."
    return toml.write_toml(comment, {"structure": table, "joints": joints})


def _written(direction: tuple[Any, ...] | None, names: tuple[str, ...]) -> Any:
    """A direction in a TOML file: weights by degree of freedom as an inline table."""
    if direction is None or not isinstance(direction[0], tuple):
        return direction
    # An index that is another's name would be read as that name.
    weights = {
        str(names[dof] if str(dof) in names and isinstance(dof, int) else dof): weight
        for dof, weight in direction
    }
    return toml.Noted(weights, "")


def npz_bytes(structure: Any) -> bytes:
    """The matrices of a structure as the content of a .npz file."""
    content = io.BytesIO()
    arrays = {name: getattr(structure, name) for name in _ARRAYS}
    held: dict[str, Any] = {name: np.asarray(x) for name, x in arrays.items() if x is not None}
    np.savez(content, **held)
    return content.getvalue()
