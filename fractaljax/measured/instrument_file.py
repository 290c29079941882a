"""Instruments' own files, through the readers of the SurfaceTopography package."""

import contextlib
import math
import warnings
import zipfile
from pathlib import Path

import numpy as np

from ..base.parts import one_line
from .measurement import Measurement, agreed, measurement, metres, profile_on_grid, scale

_ANY_BYTES = {"hgt": ".hgt", "nms": ".nms"}  # formats that only their suffix tells from others
_MOST_UNPACKED, _MOST_POINTS = 2**31, 2**27  # bytes, and heights
_TEXTS = {"asc", "xyz"}  # formats whose readers pass over what is no number
_TOLERANCE = 1e-6  # of SurfaceTopography for equal steps of x in a text, in the text's unit


def read_instrument_file(path: Path, dx, dy, unit, channel) -> Measurement:
    """Read a file of a format that SurfaceTopography knows; arguments as `read_measurement`.

    **Raises:** `ValueError` if the package is not installed, and as `read_measurement`.
    """
    _refuse_bomb(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the package and of those that it imports
        package = _package()
        with _open(package, path) as reader:
            form = reader.format(), reader.name()
            if form[0] in _TEXTS and b"\0" in path.read_bytes():
                raise ValueError("it is a text with zero bytes in it")
            with _readable(form[1]):
                channels, default = list(reader.channels), reader.default_channel
            chosen = _channel(channels, default, channel)
            points = math.prod(int(n) for n in np.ravel(chosen.nb_grid_pts))
            if not 0 < points <= _MOST_POINTS:
                raise ValueError(
                    f"channel {chosen.name!r} has {points} heights, at most {_MOST_POINTS} are read"
                )
            with _readable(f"channel {chosen.name!r}"):
                topography, z, x = _heights(chosen)
    metre = scale(topography.unit, unit, "heights", "--unit")
    if x is not None:
        z, *steps = profile_on_grid(x * metre, z)
    elif chosen.physical_sizes is None:
        steps = [None] * z.ndim
    else:
        sizes = np.ravel(topography.physical_sizes)
        steps = [float(L) * metre / n for L, n in zip(sizes, z.shape, strict=True)]
        if form[0] == "xyz" and z.ndim == 1 and steps[0] < 10 * _TOLERANCE * metre:
            raise ValueError("its steps are too small to check: save it as .csv or .xyz")
    dy = agreed("dy", steps[1], dy) if z.ndim == 2 else dy
    instrument = topography.info.get("instrument") or {}
    words = [form[1], f"channel {chosen.name!r}", instrument.get("vendor"), instrument.get("name")]
    source = f"{path.name}: {', '.join(word for word in words if word)}"
    return measurement(z * metre, agreed("dx", steps[0], dx), dy, source, **_limits(instrument))


def _package():
    try:
        import SurfaceTopography
        import SurfaceTopography.IO
    except ImportError:
        raise ValueError(
            "a file other than CSV and NPY needs SurfaceTopography:"
            ' python -m pip install "fractaljax[formats]"'
        ) from None
    return SurfaceTopography


def _refuse_bomb(path):
    """Refuse what would unpack to more than memory should hold; many formats are zip archives."""
    if not zipfile.is_zipfile(path):
        return
    with _readable("the archive"), zipfile.ZipFile(path) as packed:
        size = sum(member.file_size for member in packed.infolist())
    if size > _MOST_UNPACKED:
        raise ValueError(f"it unpacks to {size} bytes, at most {_MOST_UNPACKED} are read")


@contextlib.contextmanager
def _open(package, path):
    """The reader of a file, by its content; where there is none, the suffix may tell why."""
    suffix = path.suffix.lower()
    reasons = ""
    try:
        reader = package.open_topography(str(path))
    except Exception:
        for kind in package.IO.readers:
            if suffix.lstrip(".") in kind.file_extensions():
                reasons = _reason(package, path, kind)
        raise ValueError(
            f"no format that SurfaceTopography {package.__version__} knows{reasons}"
        ) from None
    with reader:
        if _ANY_BYTES.get(reader.format(), suffix) != suffix:
            raise ValueError(f"no format that SurfaceTopography {package.__version__} knows")
        yield reader


def _reason(package, path, kind) -> str:
    try:
        package.open_topography(str(path), format=kind.format()).close()
    except Exception as error:
        return f", and not a sound file of {kind.name()}: {one_line(error)}"
    return ""


@contextlib.contextmanager
def _readable(what):
    """Whatever a damaged file makes a reader raise, in one line."""
    try:
        yield
    except Exception as error:
        raise ValueError(f"{what} cannot be read: {one_line(error)}") from None


def _channel(channels, default, asked):
    """The channel of this name or number from 0; else the default, or the first with heights."""
    names = ", ".join(f"{channel.index} {channel.name!r}" for channel in channels)
    if asked is None:
        heights = [channel for channel in (default, *channels) if channel.is_height_channel]
        if not heights:
            raise ValueError(f"no channel holds heights; channels are {names}")
        return heights[0]
    chosen = [c for c in channels if str(asked) in (c.channel_id, c.name)]
    chosen += [c for c in channels if str(asked) == str(c.index)]
    if not chosen:
        raise ValueError(f"there is no channel {asked!r}; channels are {names}")
    if not chosen[0].is_height_channel:
        raise ValueError(f"channel {asked!r} holds {chosen[0].data_unit}, no heights")
    return chosen[0]


def _heights(channel):
    """The topography of a channel, its heights with NaN for gaps, and positions or None."""
    unknown = channel.physical_sizes is None and channel.is_uniform is not False
    topography = channel.topography(physical_sizes=(1.0,) * channel.dim if unknown else None)
    if topography.is_uniform:
        heights = np.ma.asarray(topography.heights(), float)
        return topography, np.ma.filled(heights, np.nan), None
    x, z = (np.asarray(column, float) for column in topography.positions_and_heights())
    return topography, z, x


def _limits(instrument) -> dict[str, float]:
    """The instrument limits that a file tells, in metres."""
    parameters = instrument.get("parameters") or {}
    names = {"resolution": "resolution", "tip_radius": "stylus_radius"}
    return {
        name: float(parameters[key]["value"]) * metres(parameters[key]["unit"])
        for key, name in names.items()
        if parameters.get(key)
    }
