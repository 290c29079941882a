"""Measured heights from files: plain text, NumPy's own, and instrument formats."""

import os
from pathlib import Path

import numpy as np

from .._base.numpy_file import read_npy, read_npz
from .grid import map_on_grid, profile_on_grid
from .measurement import Measurement, measurement
from .text import read_table, text_encoding
from .units import agreed, scale

_TEXTS, _ARRAYS = {".csv", ".tsv", ".txt", ".dat", ".xyz", ".asc"}, {".npy", ".npz"}
_MOST_TEXT, _MOST_ARRAYS, _MOST = 2**28, 2**30, 2**31  # bytes; the last of instrument formats
_GWYDDION = b"# Value units:"  # in the header of its text export, which has sizes and units


def read_measurement(
    path: str | os.PathLike,
    *,
    dx: float | None = None,
    dy: float | None = None,
    unit: str | None = None,
    position_unit: str | None = None,
    channel: str | int | None = None,
) -> Measurement:
    """Read a profile or a map of heights.

    `.csv`, `.tsv`, `.txt`, `.dat`, `.xyz`, `.asc`: text with one column (heights), two (position,
    height), three (x, y, height on a rectangular grid) or more (a map, each line along x).
    `.npy`: heights (n,) or (n, m), x along the first axis. `.npz`: z, dx and perhaps dy in metres.
    Everything else is read by the SurfaceTopography package. At most 256 MiB of text are read,
    1 GiB of arrays, and 2 GiB in an instrument's format.

    `dx`, `dy` [m] are steps, `unit` that of the heights and `position_unit` that of positions
    (default `unit`), for files that do not say. They must not contradict the file. `channel` is
    the name or number of one of several. Missing heights are NaN.

    **Raises:** `OSError` if the file cannot be read; `ValueError` naming it for an unknown or
    damaged format, a file that is too large, a unit or step that neither the file nor an argument
    gives, positions that are not equidistant, and heights that are not a profile or map.
    """
    path = Path(path)
    size, suffix = path.stat().st_size, path.suffix.lower()
    most = _MOST_TEXT if suffix in _TEXTS else _MOST_ARRAYS if suffix in _ARRAYS else _MOST
    try:
        if not path.is_file():
            raise ValueError("it is not a regular file")
        if size > most:
            raise ValueError(f"it is too large: at most {most >> 20} MiB are read")
        content = path.read_bytes() if suffix in _TEXTS | _ARRAYS else b""
        encoding = text_encoding(content) if suffix in _TEXTS else None
        if _GWYDDION in content[:4096]:
            encoding = None
        if encoding is None and suffix not in _ARRAYS:
            from .instrument_file import read_instrument_file

            return read_instrument_file(path, dx, dy, unit, channel)
        if channel is not None:
            raise ValueError(f"it has no channels, got channel {channel!r}")
        if encoding is None:
            return _read_arrays(path, content, dx, dy, unit)
        numbers, units = read_table(content, encoding)
        return _from_table(path, numbers, units, dx, dy, unit, position_unit)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _from_table(path, numbers, units, dx, dy, unit, position_unit) -> Measurement:
    rows, columns = numbers.shape
    source = f"{path.name}: text of {rows} lines and {columns} columns"
    z = numbers * scale(units[-1], unit, "heights", "--unit")
    if columns not in (2, 3):
        return measurement(z[:, 0] if columns == 1 else z.T, dx, dy, source)
    if np.isnan(numbers[:, :-1]).any():
        raise ValueError("positions must not have gaps")
    given = position_unit or (None if any(units[:-1]) else unit)
    metres = [scale(own, given, "positions", "--position-unit") for own in units[:-1]]
    place = (numbers[:, :-1] * metres).T
    if columns == 2:
        z, own_dx = profile_on_grid(place[0], z[:, 1])
    else:
        z, own_dx, own_dy = map_on_grid(place[0], place[1], z[:, 2])
        dy = agreed("dy", own_dy, dy)
    return measurement(z, agreed("dx", own_dx, dx), dy, source)


def _read_arrays(path, content, dx, dy, unit) -> Measurement:
    if path.suffix.lower() == ".npz":
        arrays = read_npz(content, _MOST_ARRAYS)
        if not {"z", "dx"} <= set(arrays):
            raise ValueError(f"it must hold z and dx in metres, got {', '.join(arrays)}")
        z, own = arrays["z"], "m"
        dx, dy = agreed("dx", _step(arrays, "dx"), dx), agreed("dy", _step(arrays, "dy"), dy)
    else:
        z, own = read_npy(content, "z"), None
    shape = " x ".join(map(str, z.shape))
    with np.errstate(invalid="ignore", over="ignore"):  # of NaN and large numbers in float16
        z = z.astype(float) * scale(own, unit, "heights", "--unit")
    return measurement(z, dx, dy, f"{path.name}: array of {shape}")


def _step(arrays, name) -> float | None:
    if name not in arrays:
        return None
    if arrays[name].size != 1:
        raise ValueError(f"{name} must be a number, got shape {arrays[name].shape}")
    return float(arrays[name].item())
