"""Matrices of finite-element models in the files that the programs write."""

import bz2
import dataclasses
import gzip
import io
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .._base.files import read_bounded
from .._base.numpy_file import read_members, read_npy
from .._base.parts import one_line
from .matlab_file import read_matlab
from .matrix_entries import LARGEST, assemble, check_size, read_abaqus, read_harwell_boeing
from .matrix_market import BANNER, read_entries
from .nastran import read_dmig, read_op4

_MOST = 2**30  # bytes of a file, unpacked
_PACKED = {".gz": gzip.open, ".bz2": bz2.open}


@dataclasses.dataclass(frozen=True)
class Matrices:
    """Matrices by name, in float64, and the names of their degrees of freedom if a file has them.

    Each is a `scipy.sparse.csr_array`, square (n, n) or one column (n, 1) of a load. Only those of
    Nastran may have another shape, for it writes matrices to recover results beside them.
    """

    matrices: dict[str, Any]
    names: tuple[str, ...] | None = None


def read_matrices(path: str | os.PathLike) -> Matrices:
    """Read the matrices of a finite-element model, sparse.

    `.npz`: one sparse matrix of `scipy.sparse.save_npz`, or arrays of `numpy.savez`. `.mat`: MATLAB
    up to version 7. `.mtx`: Matrix Market, or Abaqus (*MATRIX OUTPUT). `.op4`: OUTPUT4 of Nastran.
    `.pch`, `.bdf`, `.dat`: its DMIG cards. `.hb`, `.rb`, `.rua`, `.rsa`, `.matrix`: Harwell-Boeing
    in ASCII, which Ansys writes with HBMAT. Each may be compressed as .gz or .bz2. A single matrix
    has the name of its file. Symmetric matrices are filled. Matrices of Abaqus and DMIG cards have
    names of degrees of freedom, "node.dof", in order. At most 1 GiB and 1000000 degrees of freedom
    are read.

    **Raises:** `OSError` if the file cannot be read; `ValueError` in a line that begins with its
    name for a format that is unknown or damaged, and for matrices that are complex, not finite, or
    neither square nor one column, of Nastran's rectangular ones excepted.
    """
    path = Path(path)
    packed = path.suffix.lower() if path.suffix.lower() in _PACKED else ""
    inner = path.with_suffix("") if packed else path
    try:
        reader = _READERS.get(inner.suffix.lower())
        if reader is None:
            raise ValueError(f"of unknown format; known are {', '.join(_READERS)}, .gz and .bz2")
        content = read_bounded(path, _MOST)
        found, names = reader(inner.stem, _unpacked(content, packed) if packed else content)
        if not found:
            raise ValueError("it holds no matrix")
        any_shape = reader in (_op4, _dmig)
        return Matrices({x: _sound(x, found[x], any_shape) for x in found}, names)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def _unpacked(content: bytes, packed: str) -> bytes:
    try:
        with _PACKED[packed](io.BytesIO(content), "rb") as file:
            content = file.read(_MOST + 1)
    except (zlib.error, struct.error, EOFError, OSError):
        raise ValueError("it is damaged") from None
    if len(content) > _MOST:
        raise ValueError(f"it unpacks to more than {_MOST / 1e6:g} MB, the most that is read")
    return content


def _sound(name: str, value: Any, any_shape: bool):
    """A matrix, dense or sparse, as a checked sparse one in float64."""
    import scipy.sparse

    if value.dtype.kind not in "iufb":
        raise ValueError(f"{name} must be real numbers, got {value.dtype}")
    shape = value.shape
    if len(shape) == 1 or (len(shape) == 2 and shape[0] == 1 and not scipy.sparse.issparse(value)):
        value = value.reshape(-1, 1)  # a load
    fits = any_shape or value.shape[-1:] in ((1,), value.shape[:1])
    if value.ndim != 2 or not fits:
        raise ValueError(f"{name} must be square or one column, got shape {shape}")
    check_size(name, value.shape)
    with np.errstate(over="ignore"):  # of numbers that are longer than 64 bits
        matrix = scipy.sparse.csr_array(value, dtype=np.float64)
    if not np.isfinite(matrix.data).all():
        raise ValueError(f"{name} must be finite")
    matrix.sum_duplicates()  # which is what SciPy means by an entry given twice
    matrix.eliminate_zeros()  # OUTPUT4 and others write columns dense
    return matrix


def _npz(stem: str, content: bytes):
    import scipy.sparse

    members = read_members(content, _MOST)
    if "format" not in members:
        return {name: read_npy(member, name) for name, member in members.items()}, None
    kind = next(
        (k for k in ("csr", "csc", "coo", "bsr", "dia") if k.encode() in members["format"]), ""
    )
    arrays = {
        name: read_npy(member, name)
        for name, member in members.items()
        if name not in ("format", "_is_array")
    }
    try:
        index = [arrays[x] for x in ("indices", "indptr", "offsets") if x in arrays]
        if kind == "coo":
            index = [(arrays["row"], arrays["col"])]
        if not kind:
            raise ValueError("its format is unknown")
        shape = tuple(arrays["shape"].tolist())
        check_size(stem, shape)
        matrix = getattr(scipy.sparse, f"{kind}_array")((arrays["data"], *index), shape=shape)
        if kind in ("csr", "csc", "bsr"):
            matrix.check_format(full_check=True)
        return {stem: matrix}, None
    except Exception as error:  # each constructor has its own kind
        raise ValueError(f"it is no sound file of SciPy's save_npz: {one_line(error)}") from None


def _mtx(stem: str, content: bytes):
    if content[: len(BANNER)].lower() != BANNER.lower():
        matrix, names = read_abaqus(stem, content)
        return {stem: matrix}, names
    shape, i, j, values = read_entries(io.BytesIO(content), LARGEST, _MOST)
    if np.iscomplexobj(values):
        raise ValueError("it must be real numbers, got complex ones")
    return {stem: assemble(stem, shape, i, j, values)}, None


def _mat(_, content: bytes):
    return read_matlab(content, _MOST), None


def _op4(_, content: bytes):
    return read_op4(content), None


def _dmig(_, content: bytes):
    return read_dmig(content)


def _harwell_boeing(stem: str, content: bytes):
    return {stem: read_harwell_boeing(stem, content)}, None


_READERS = {
    ".npz": _npz,
    ".mat": _mat,
    ".mtx": _mtx,
    ".op4": _op4,
    **dict.fromkeys((".pch", ".bdf", ".dat"), _dmig),
    **dict.fromkeys((".hb", ".rb", ".rua", ".rsa", ".matrix"), _harwell_boeing),
}
