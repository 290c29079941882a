"""Measured heights from files: text, NumPy's own, and instruments' formats."""

import errno
import os
import stat
from pathlib import Path

import numpy as np

from ..base.numpy_file import read_npy, read_npz
from .measurement import Measurement, agreed, map_on_grid, measurement, profile_on_grid, scale
from .text import read_table

_TEXTS = {".csv", ".tsv", ".txt", ".dat", ".xyz"}
_ARRAYS = {".npy", ".npz"}
_MOST_TEXT, _MOST_ARRAYS, _MOST = 2**28, 2**30, 2**31  # bytes; the last of instruments' formats


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

    `.csv`, `.tsv`, `.txt`, `.dat`, `.xyz`: a text with one column (heights), two (position,
    height), three (x, y, height on a rectangular grid) or more (a map, a line of the text along
    x). `.npy`: heights (n,) or (n, m), x along the first axis. `.npz`: z, dx and perhaps dy in
    metres. All else is read by the SurfaceTopography package. At most 256 MiB of text are read,
    1 GiB of arrays, and 2 GiB in an instrument's format.

    `dx`, `dy` [m] are steps, `unit` that of the heights and `position_unit` that of positions (else
    the same), for files that do not say it; what a file says must not be contradicted. `channel`
    is the name or number of one of several. Cells without a height are NaN.

    **Raises:** `OSError` if the file cannot be read; `ValueError` naming it for a format that is
    unknown or damaged, a file that is too large, units or steps that neither the file nor an
    argument tells, positions that are not equidistant within a tenth of a step, and heights that
    are no profile or map.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    try:
        content = _content(path, suffix)
        if suffix in _ARRAYS:
            _refuse_channel(channel)
            return _read_arrays(path, content, dx, dy, unit)
        if suffix in _TEXTS and _is_text(content):
            _refuse_channel(channel)
            return _read_text(path, content, dx, dy, unit, position_unit)
        from .instrument_file import read_instrument_file

        return read_instrument_file(path, dx, dy, unit, channel)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _content(path, suffix) -> bytes:
    """The bytes of a text or of arrays, if they are not too many; of other files, none."""
    status, ours = path.stat(), suffix in _TEXTS | _ARRAYS
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not ours and not stat.S_ISREG(status.st_mode):  # its reader would open a pipe once more
        raise ValueError("it is no regular file: its name must end with .csv, .npy or .npz")
    most = _MOST_TEXT if suffix in _TEXTS else _MOST_ARRAYS if ours else _MOST
    size, content = status.st_size, b""
    if size <= most:
        with path.open("rb") as file:
            content = file.read(most + 1 if ours else 0)
    if max(size, len(content)) > most:
        raise ValueError(f"it is too large: at most {most >> 20} MiB are read")
    return content


def _is_text(content) -> bool:
    return b"\0" not in content or content.startswith((b"\xff\xfe", b"\xfe\xff"))


def _refuse_channel(channel):
    if channel is not None:
        raise ValueError(f"it has no channels, got channel {channel!r}")


def _read_text(path, content, dx, dy, unit, position_unit) -> Measurement:
    numbers, units, size = read_table(content)
    rows, columns = numbers.shape
    source = f"{path.name}: text of {rows} lines and {columns} columns"
    metre = scale(units[-1], unit, "heights", "--unit")
    if size is not None:
        dx, dy = agreed("dx", size[0] / columns, dx), agreed("dy", size[1] / rows, dy)
        return measurement(numbers.T * metre, dx, dy, source)
    if columns not in (2, 3):
        return measurement((numbers[:, 0] if columns == 1 else numbers.T) * metre, dx, dy, source)
    positions = numbers[:, :-1]
    if not np.isfinite(positions).all():
        raise ValueError("positions must not have gaps")
    given = position_unit or (None if any(units[:-1]) else unit)
    metres = [scale(own, given, "positions", "--position-unit") for own in units[:-1]]
    (x, *y), z = (positions * metres).T, numbers[:, -1] * metre
    if y:
        z, own_dx, own_dy = map_on_grid(x, y[0], z)
        dy = agreed("dy", own_dy, dy)
    else:
        z, own_dx = profile_on_grid(x, z)
    return measurement(z, agreed("dx", own_dx, dx), dy, source)


def _read_arrays(path, content, dx, dy, unit) -> Measurement:
    packed = path.suffix.lower() == ".npz"
    arrays = read_npz(content, _MOST_ARRAYS) if packed else {"z": read_npy(content, "z")}
    if packed:
        if not {"z", "dx"} <= set(arrays):
            raise ValueError(f"it must hold z and dx in metres, got {', '.join(arrays)}")
        dx, dy = (agreed(name, _number(arrays, name), x) for name, x in (("dx", dx), ("dy", dy)))
    metre = scale("m" if packed else None, unit, "heights", "--unit")
    with np.errstate(invalid="ignore", over="ignore"):  # what is no number in float32 is none here
        z = arrays["z"].astype(float)
    shape = " x ".join(map(str, z.shape))
    return measurement(z * metre, dx, dy, f"{path.name}: array of {shape}")


def _number(arrays, name) -> float | None:
    if name not in arrays:
        return None
    if arrays[name].size != 1:
        raise ValueError(f"{name} must be a number, got shape {arrays[name].shape}")
    return float(arrays[name].item())
