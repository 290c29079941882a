"""Numeric matrices in MATLAB files of version 7.3, which are HDF5: by h5py, where installed."""

import importlib
import io
from typing import Any

import numpy as np

from .._base.file_limits import FileLimits
from .._base.parts import one_line
from .matrix_entries import check_size


def read_matlab_7_3(content: bytes, limits: FileLimits) -> dict[str, Any]:
    """The variables of a file by name, as arrays or sparse matrices within `limits`.

    A variable that is no matrix of numbers is returned as a `ValueError`.

    **Raises:** `ValueError` if h5py is not installed, and if the file is damaged.
    """
    try:
        h5py: Any = importlib.import_module("h5py")
    except ImportError:
        raise ValueError(
            "it is of MATLAB's version 7.3, which h5py reads: type 'pip install h5py', or save it "
            "with -v7"
        ) from None
    variables: dict[str, Any] = {}
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            for name, item in file.items():
                if name.startswith("#"):  # what cells and objects refer to
                    continue
                try:
                    variables[name] = _matrix(name, item, limits)
                except ValueError as error:
                    variables[name] = error
    except (OSError, KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"it is damaged: {one_line(error)}") from None
    return variables


def _matrix(name: str, item: Any, limits: FileLimits) -> Any:
    """An array, or a sparse matrix from its group of data, rows and begins of columns."""
    import scipy.sparse

    kind = item.attrs.get("MATLAB_class", b"double").decode("ascii", "replace")
    rows = item.attrs.get("MATLAB_sparse")
    if rows is None:
        if kind in ("char", "cell", "struct", "function_handle") or not hasattr(item, "dtype"):
            kind = {"char": "text", "cell": "a cell array"}.get(kind, f"MATLAB's class {kind}")
            raise ValueError(f"{name} must be real numbers, got {kind}")
        if "MATLAB_empty" in item.attrs:
            raise ValueError(f"{name} must have from 1 to {limits.dofs} rows and columns")
        return _numbers(name, item, limits).T  # MATLAB stores columns first
    if not {"ir", "jc"} <= set(item):
        raise ValueError(f"{name} must have entries, got none")
    data, i, begun = (_numbers(name, item[key], limits) for key in ("data", "ir", "jc"))
    shape = int(rows), len(begun) - 1
    check_size(name, shape, limits.dofs)
    try:
        matrix = scipy.sparse.csc_array((data, i.astype(np.int64), begun.astype(np.int64)), shape)
        matrix.check_format(full_check=True)
    except (ValueError, IndexError, OverflowError) as error:
        raise ValueError(f"{name} is damaged: {one_line(error)}") from None
    return matrix


def _numbers(name: str, stored: Any, limits: FileLimits) -> np.ndarray:
    """The numbers of a data set; a complex one has the fields real and imag."""
    if stored.size * stored.dtype.itemsize > limits.matrices:
        raise ValueError(f"{name} unpacks to more than is read")
    array = stored[()]
    return array["real"] + 1j * array["imag"] if array.dtype.names else array
