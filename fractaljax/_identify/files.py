"""Measured heights from files: plain text, NumPy's own, and instrument formats."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .._base.file_limits import FileLimits
from .._base.numpy_file import read_npy, read_npz
from .columns import choose_columns, suggest_columns
from .grid import map_on_grid, profile_on_grid
from .header import height_scale, step
from .measurement import Measurement, measurement
from .text import Table, read_table, text_encoding
from .units import reconcile, scale, unit_named

_TEXTS, _ARRAYS = {".csv", ".tsv", ".txt", ".dat", ".xyz", ".asc"}, {".npy", ".npz"}
_GWYDDION = b"# Value units:"  # in the header of its text export, which has sizes and units


def read_measurement(
    path: str | os.PathLike,
    *,
    dx: float | None = None,
    dy: float | None = None,
    unit: str | float | None = None,
    position_unit: str | float | None = None,
    channel: str | int | None = None,
    columns: Mapping[str, str | int] | None = None,
    limits: FileLimits = FileLimits(),
) -> Measurement:
    """Read a profile or a map of heights.

    `.csv`, `.tsv`, `.txt`, `.dat`, `.xyz`, `.asc`: text with one column (heights), two (position,
    height), three (x, y, height on a rectangular grid) or more (a map, each line along x). `.npy`:
    heights (n,) or (n, m), x along the first axis. `.npz`: z, dx and perhaps dy in metres.
    Everything else is read by the SurfaceTopography package. At most 256 MiB of text are read, 1
    GiB of arrays, and 2 GiB in an instrument's format, or what `limits` says.

    In text, titles such as X, Z, valid or quality choose the columns, also where there are others;
    heights whose flag is 0 are missing. A factor for heights and the size of a pixel in the header
    count: `height conversion factor (-> m)=2.9e-8`, `pixel size=0.35 um`; `unit` is then that of
    heights after the factor, and a size without a unit is in metres if the factor leads to them.
    Missing heights are NaN.

    **Arguments**, by default what the file states, which they must not contradict:

    - `path`: the file, whose ending tells its format.
    - `dx`, `dy`: steps along x and y [m].
    - `unit`: that of heights, such as "um", or a number of metres, 2.9e-8.
    - `position_unit`: that of positions, by default `unit`.
    - `channel`: the name or number of one of several channels.
    - `columns`: columns of text by title, or by number from 0, where titles do not tell: {"x": "X",
      "z": "Y", "valid": "flag"}, of x, y, z, valid and invalid (whose 1 stands for a missing
      height).
    - `limits`: how much is read, a `FileLimits`.

    **Returns:** a `Measurement`.

    **Raises:** `OSError` if the file cannot be read; `ValueError` naming it for an unknown or
    damaged format, a file that is too large, a unit or step that neither the file nor an argument
    gives, positions that are not equidistant, and heights that are not a profile or map.
    """
    path = Path(path)
    size, suffix = path.stat().st_size, path.suffix.lower()
    is_text, is_array = suffix in _TEXTS, suffix in _ARRAYS
    most = limits.text if is_text else limits.arrays if is_array else limits.instrument
    try:
        if not path.is_file():
            raise ValueError("it is not a regular file")
        if size > most:
            raise ValueError(f"it is too large: at most {most >> 20} MiB are read")
        content = path.read_bytes() if is_text or is_array else b""
        encoding = text_encoding(content) if is_text else None
        if _GWYDDION in content[:4096]:
            encoding = None
        if encoding is None and columns is not None:
            raise ValueError(f"it is no table of text, got columns {dict(columns)!r}")
        if encoding is None and not is_array:
            from .instrument_file import read_instrument_file

            return read_instrument_file(path, dx, dy, unit, channel, limits)
        if channel is not None:
            raise ValueError(f"it has no channels, got channel {channel!r}")
        if encoding is None:
            return _read_arrays(path, content, dx, dy, unit, limits.arrays)
        table = choose_columns(whole := read_table(content, encoding), columns)
        return _from_table(path, whole, table, dx, dy, unit, position_unit)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _from_table(path, whole: Table, table: Table, dx, dy, unit, position_unit) -> Measurement:
    """A measurement from the chosen columns of the whole table."""
    numbers, units, settings = table.numbers, table.units, table.settings
    rows, columns = whole.numbers.shape
    source = f"{path.name}: text of {rows} lines and {columns} columns"
    columns = numbers.shape[1]
    if columns < whole.numbers.shape[1]:
        source += f", of which {columns} for positions and heights"
    try:
        metre = height_scale(settings, units[-1], unit)
    except ValueError as error:
        is_length = units[-1] is None or unit_named(units[-1]) is not None
        raise (error if is_length else suggest_columns(whole, error)) from None
    if "factor" in settings:
        source += f", heights times {metre:g} m by its header"
    z = numbers * metre
    if columns not in (2, 3):
        dx = reconcile("dx", step(settings, "dx", dx, position_unit), dx)
        if columns > 1:
            user_step = dx if dy is None else dy
            dy = reconcile("dy", step(settings, "dy", user_step, position_unit), dy)
        return measurement(z[:, 0] if columns == 1 else z.T, dx, dy, source)
    if np.isnan(numbers[:, :-1]).any():
        raise ValueError("positions must not have gaps")
    user_unit = position_unit or (None if any(units[:-1]) else unit)
    metres = [
        scale(file_unit, user_unit, "positions", "--position-unit") for file_unit in units[:-1]
    ]
    place = (numbers[:, :-1] * metres).T
    if columns == 2:
        z, grid_dx = profile_on_grid(place[0], z[:, 1])
    else:
        try:
            z, grid_dx, grid_dy = map_on_grid(place[0], place[1], z[:, 2])
        except ValueError as error:
            raise suggest_columns(whole, error) from None
        dy = reconcile("dy", grid_dy, dy)
    return measurement(z, reconcile("dx", grid_dx, dx), dy, source)


def _read_arrays(path, content, dx, dy, unit, most) -> Measurement:
    if path.suffix.lower() == ".npz":
        arrays = read_npz(content, most)
        if not {"z", "dx"} <= set(arrays):
            raise ValueError(f"it must hold z and dx in metres, got {', '.join(arrays)}")
        z, stored_unit = arrays["z"], "m"
        dx, dy = reconcile("dx", _step(arrays, "dx"), dx), reconcile("dy", _step(arrays, "dy"), dy)
    else:
        z, stored_unit = read_npy(content, "z"), None
    shape = " x ".join(map(str, z.shape))
    with np.errstate(invalid="ignore", over="ignore"):  # of NaN and large numbers in float16
        z = z.astype(float) * scale(stored_unit, unit, "heights", "--unit")
    return measurement(z, dx, dy, f"{path.name}: array of {shape}")


def _step(arrays, name) -> float | None:
    if name not in arrays:
        return None
    if arrays[name].size != 1:
        raise ValueError(f"{name} must be a number, got shape {arrays[name].shape}")
    return float(arrays[name].item())
