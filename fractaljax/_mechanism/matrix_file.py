"""Matrices of finite-element models from the files of several programs."""

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

from .._base.file_limits import FileLimits
from .._base.files import read_bounded
from .._base.numpy_file import read_members, read_npy
from .._base.parts import one_line
from .matlab_file import read_matlab
from .matrix_entries import assemble, check_size, read_abaqus, read_harwell_boeing
from .matrix_market import BANNER, read_entries
from .nastran import read_dmig, read_op4

_PACKED = {".gz": gzip.open, ".bz2": bz2.open}
_KINDS = "iufc"  # of numbers in NumPy


class _ByName(dict[str, Any]):
    """Matrices by name; the name of an unreadable one raises the reason."""

    def __init__(self, matrices: dict[str, Any], file: str, unread: dict[str, str]):
        super().__init__(matrices)
        self._file, self._unread = file, unread

    def __missing__(self, name: str):
        if name in self._unread:
            raise ValueError(f"{self._file}: {self._unread[name]}")
        raise KeyError(name)


@dataclasses.dataclass(frozen=True, repr=False)
class Matrices:
    """Matrices by name, and the names of their degrees of freedom if a file has them.

    Each is a `scipy.sparse.csr_array`, square (n, n), or a load of one column (n, 1), in float64,
    or in complex128 where a number has an imaginary part: as K, `Structure` takes it for K + i
    K_loss with structural damping. Only Nastran matrices may have another shape, because it also
    writes matrices for recovering results.

    `unread` says by name why another item of the file is no such matrix; `matrices[name]` raises
    that as a `ValueError`. `mirrored` names matrices of which the file holds one triangle without
    declaring them symmetric.
    """

    matrices: dict[str, Any]  # by name
    names: tuple[str, ...] | None = None  # of the degrees of freedom, where the file has them
    unread: dict[str, str] = dataclasses.field(default_factory=dict)
    mirrored: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Changes that the file does not ask for, one line each."""
        said = "{} has entries in one triangle only, which was mirrored as of a symmetric matrix"
        return tuple(said.format(name) for name in self.mirrored)

    def __repr__(self) -> str:
        shown = [
            f"{name} {X.shape[0]} x {X.shape[1]} of {X.nnz} numbers"
            for name, X in self.matrices.items()
        ]
        left = [f"not read: {why}" for why in self.unread.values()]
        return f"Matrices({'; '.join([*shown, *self.notes, *left])})"


def read_matrices(path: str | os.PathLike, limits: FileLimits = FileLimits()) -> Matrices:
    """Read the matrices of a finite-element model, sparse.

    `.npz`: one sparse matrix of `scipy.sparse.save_npz`, or arrays of `numpy.savez`. `.mat`: MATLAB
    version 4 to 7, and 7.3 where h5py is installed. `.mtx`: Matrix Market, or Abaqus (*MATRIX
    OUTPUT). `.op4`: OUTPUT4 of Nastran. `.pch`, `.bdf`, `.dat`: DMIG cards of Nastran. `.hb`,
    `.rb`, `.rua`, `.rsa`, `.matrix`: Harwell-Boeing in ASCII, which Ansys writes with HBMAT. Each
    may be compressed as .gz or .bz2. A single matrix is named after its file. Symmetric matrices
    are filled. Matrices of Abaqus and DMIG cards come with sorted names of degrees of freedom,
    "node.dof". At most 1 GiB and 1000000 degrees of freedom are read, or what `limits` says.

    A matrix that is not finite, or neither square nor one column (except rectangular ones of
    Nastran), and text or a cell array of MATLAB leave the others readable: `unread` says why.
    Abaqus does not say whether it writes one triangle: `mirrored` names matrices that were filled
    because no entry has a mirror image.

    **Arguments:**

    - `path`: the file, whose ending tells its format.
    - `limits`: how much is read, a `FileLimits`.

    **Returns:** `Matrices`, in the units of the file.

    **Raises:** `OSError` if the file cannot be read; `ValueError`, one line that begins with the
    file name, for an unknown format, a damaged file, and a file without a matrix as above.
    """
    path = Path(path)
    packed = path.suffix.lower() if path.suffix.lower() in _PACKED else ""
    inner = path.with_suffix("") if packed else path
    try:
        reader = _READERS.get(inner.suffix.lower())
        if reader is None:
            raise ValueError(f"of unknown format; known are {', '.join(_READERS)}, .gz and .bz2")
        content = read_bounded(path, limits.matrices)
        unpacked = _unpack(content, packed, limits.matrices) if packed else content
        candidates, names, *mirrored = reader(inner.stem, unpacked, limits)
        if not candidates:
            raise ValueError("it holds no matrix")
        matrices, unread = _check_candidates(candidates, reader in (_op4, _dmig), limits.dofs)
        if not matrices:
            raise ValueError("; ".join(unread.values()))
        by_name = _ByName(matrices, path.name, unread)
        return Matrices(by_name, names, unread, tuple(candidates) if any(mirrored) else ())
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None


def _unpack(content: bytes, packed: str, most: int) -> bytes:
    try:
        with _PACKED[packed](io.BytesIO(content), "rb") as file:
            content = file.read(most + 1)
    except (zlib.error, struct.error, EOFError, OSError):
        raise ValueError("it is damaged") from None
    if len(content) > most:
        raise ValueError(f"it unpacks to more than {most / 1e6:g} MB, the most that is read")
    return content


def _check_candidates(
    candidates: dict[str, Any], any_shape: bool, largest: int
) -> tuple[dict[str, Any], dict[str, str]]:
    """The valid matrices, and by name the reason why each other candidate is invalid."""
    matrices, unread = {}, {}
    for name, value in candidates.items():
        try:
            if isinstance(value, ValueError):
                raise value
            matrices[name] = _check_matrix(name, value, any_shape, largest)
        except ValueError as error:
            unread[name] = str(error)
    return matrices, unread


def _check_matrix(name: str, value: Any, any_shape: bool, largest: int):
    """A checked sparse matrix from a dense or sparse one, complex if any number in it is."""
    import scipy.sparse

    if value.dtype.kind not in "b" + _KINDS:
        raise ValueError(f"{name} must be real numbers, got {value.dtype}")
    shape = value.shape
    if len(shape) == 1 or (len(shape) == 2 and shape[0] == 1 and not scipy.sparse.issparse(value)):
        value = value.reshape(-1, 1)  # a load
    fits = any_shape or value.shape[-1:] in ((1,), value.shape[:1])
    if value.ndim != 2 or not fits:
        raise ValueError(f"{name} must be square or one column, got shape {shape}")
    check_size(name, value.shape, largest)
    with np.errstate(over="ignore"):  # numbers may be longer than 64 bits
        kind = np.complex128 if value.dtype.kind == "c" else np.float64
        matrix: Any = scipy.sparse.csr_array(value, dtype=kind)
    if kind is np.complex128 and not matrix.data.imag.any():
        matrix = matrix.real.tocsr()
    if not np.isfinite(matrix.data).all():
        raise ValueError(f"{name} must be finite")
    matrix.sum_duplicates()  # SciPy adds duplicate entries
    matrix.eliminate_zeros()  # OUTPUT4 and others write dense columns
    return matrix


def _npz(stem: str, content: bytes, limits: FileLimits):
    import scipy.sparse

    members = read_members(content, limits.matrices)
    if "format" not in members:
        return {name: _array(member, name) for name, member in members.items()}, None
    kind = next(
        (k for k in ("csr", "csc", "coo", "bsr", "dia") if k.encode() in members["format"]), ""
    )
    arrays = {
        name: read_npy(member, name, _KINDS)
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
        check_size(stem, shape, limits.dofs)
        matrix = getattr(scipy.sparse, f"{kind}_array")((arrays["data"], *index), shape=shape)
        if kind in ("csr", "csc", "bsr"):
            matrix.check_format(full_check=True)
        return {stem: matrix}, None
    except Exception as error:  # each constructor raises its own kind
        raise ValueError(f"it is no sound file of SciPy's save_npz: {one_line(error)}") from None


def _array(member: bytes, name: str) -> np.ndarray | ValueError:
    try:
        return read_npy(member, name, _KINDS)
    except ValueError as error:
        return error


def _mtx(stem: str, content: bytes, limits: FileLimits):
    content = content.removeprefix(b"\xef\xbb\xbf")  # the byte order mark of UTF-8
    banner = content.lstrip()
    if banner[: len(BANNER)].lower() != BANNER.lower():
        matrix, names, mirrored = read_abaqus(stem, content, limits.dofs)
        return {stem: matrix}, names, mirrored
    # Blank lines move behind the banner, where they are allowed; line numbers are kept.
    blank = content[: len(content) - len(banner)].count(b"\n")
    content = banner.replace(b"\n", b"\n" * (1 + blank), 1)
    shape, i, j, values = read_entries(io.BytesIO(content), limits.dofs, limits.matrices)
    return {stem: assemble(stem, shape, i, j, values, limits.dofs)}, None


def _mat(_, content: bytes, limits: FileLimits):
    return read_matlab(content, limits), None


def _op4(_, content: bytes, limits: FileLimits):
    return read_op4(content, limits.dofs), None


def _dmig(_, content: bytes, limits: FileLimits):
    return read_dmig(content, limits.dofs)


def _harwell_boeing(stem: str, content: bytes, limits: FileLimits):
    return {stem: read_harwell_boeing(stem, content, limits.dofs)}, None


_READERS = {
    ".npz": _npz,
    ".mat": _mat,
    ".mtx": _mtx,
    ".op4": _op4,
    **dict.fromkeys((".pch", ".bdf", ".dat"), _dmig),
    **dict.fromkeys((".hb", ".rb", ".rua", ".rsa", ".matrix"), _harwell_boeing),
}
