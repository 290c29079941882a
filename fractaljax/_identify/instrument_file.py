"""Instrument formats, through the SurfaceTopography package."""

import contextlib
import math
import warnings
import zipfile
from pathlib import Path

import numpy as np

from .._base.file_limits import FileLimits
from .._base.parts import one_line
from .grid import profile_on_grid
from .measurement import Measurement, measurement
from .topography import instrument_limits
from .units import Unit, reconcile, scale

_ANY_BYTES = {"hgt": ".hgt", "nms": ".nms"}  # formats that accept any bytes: by suffix only


def read_instrument_file(
    path: Path,
    dx: float | None,
    dy: float | None,
    unit: Unit,
    channel: str | int | None,
    limits: FileLimits,
) -> Measurement:
    """Read a file in a format known to SurfaceTopography; arguments as in `read_measurement`.

    **Raises:** `ValueError` if the package is not installed, and as `read_measurement` does.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the package and its dependencies
        try:
            import SurfaceTopography as package
        except ImportError:
            raise ValueError(
                "a file other than plain text, .npy or .npz needs SurfaceTopography:"
                ' python -m pip install "fractaljax[formats]"'
            ) from None
        _refuse_large_archive(path, limits.instrument)
        with _in_one_line(f"unknown to SurfaceTopography {package.__version__}, or damaged"):
            reader = package.open_topography(str(path))
        with reader, _in_one_line("it cannot be read"):
            kind = reader.format()
            if _ANY_BYTES.get(kind, path.suffix.lower()) != path.suffix.lower():
                raise ValueError("no known format")
            chosen = _channel(list(reader.channels), reader.default_channel, channel)
            if kind == "xyz" or (kind == "asc" and not (chosen.unit and chosen.physical_sizes)):
                raise ValueError("it is plain text: save it as .csv with columns of numbers only")
            points = math.prod(int(n) for n in np.ravel(chosen.nb_grid_pts))
            if not 0 < points <= limits.heights:
                raise ValueError(f"it holds {points} heights, at most {limits.heights} are read")
            topography, z, x = _heights(chosen)
            source = reader.name()
    metre = scale(topography.unit, unit, "heights", "--unit")
    if x is not None:
        z, step = profile_on_grid(x * metre, z)
        dx = reconcile("dx", step, dx)
    elif chosen.physical_sizes is not None:
        sizes = np.ravel(topography.physical_sizes)
        steps = [float(L) * metre / n for L, n in zip(sizes, z.shape, strict=True)]
        dx = reconcile("dx", steps[0], dx)
        dy = reconcile("dy", steps[1], dy) if z.ndim == 2 else dy
    instrument = topography.info.get("instrument") or {}
    words = [source, f"channel {chosen.name!r}", instrument.get("vendor"), instrument.get("name")]
    source = f"{path.name}: {', '.join(word for word in words if word)}"
    return measurement(z * metre, dx, dy, source, **instrument_limits(topography.info))


def _refuse_large_archive(path, most):
    """Refuse a zip archive, as many formats are, that unpacks to more than fits in memory."""
    if zipfile.is_zipfile(path):
        with _in_one_line("the archive is damaged"), zipfile.ZipFile(path) as packed:
            size = sum(member.file_size for member in packed.infolist())
        if size > most:
            raise ValueError(f"it unpacks to {size} bytes, at most {most} are read")


@contextlib.contextmanager
def _in_one_line(what):
    """Turn any error of a reader into a `ValueError` of one line."""
    try:
        yield
    except Exception as error:
        raise ValueError(f"{what}: {one_line(error)}") from None


def _channel(channels, default, key):
    """The channel of this name or number from 0; else the default, or the first with heights."""
    names = ", ".join(f"{channel.index} {channel.name!r}" for channel in channels)
    if key is None:
        candidates = [channel for channel in (default, *channels) if channel.is_height_channel]
        if not candidates:
            raise ValueError(f"no channel holds heights; channels are {names}")
        return candidates[0]
    named = {name: c for c in reversed(channels) for name in (c.name, c.channel_id)}
    chosen = ({str(c.index): c for c in channels} | named).get(str(key))
    if chosen is None:
        raise ValueError(f"there is no channel {key!r}; channels are {names}")
    if not chosen.is_height_channel:
        raise ValueError(f"channel {key!r} holds {chosen.data_unit}, not heights")
    return chosen


def _heights(channel):
    """The topography of a channel, its heights with NaN for gaps, and positions or None."""
    unknown = channel.physical_sizes is None and channel.is_uniform is not False
    topography = channel.topography(physical_sizes=(1.0,) * channel.dim if unknown else None)
    if topography.is_uniform:
        return topography, np.ma.filled(np.ma.asarray(topography.heights(), float), np.nan), None
    x, z = (np.asarray(column, float) for column in topography.positions_and_heights())
    return topography, z, x
