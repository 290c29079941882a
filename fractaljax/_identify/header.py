"""Settings in the header of a text file: a factor for heights, sizes of pixels, a unit."""

import dataclasses
import math
import re

from .units import Unit, metres, scale, unit_named

_SETTING = re.compile(r"\W*([^\W\d][^=:;,\t]*)[=:;,\t]\s*(\S.*?)\s*")
_PLAIN = re.compile(r"\W*[^\W\d][^=:]*[=:]")  # sets anything
_KEY_UNIT = re.compile(r"\s*(?:[\[(]\s*(?:->|to\b|in\b)?|->)\s*([^\[\]()]*?)\s*[\])]?$")
_VALUE = re.compile(
    r"([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:e[-+]?\d+)?)\s*[\[(]?([^\d\s\])]*)[\])]?", re.I
)
_FACTOR = re.compile(
    r"(?:height|z|data|phase)(?: to height)?(?: conversion| scale| scaling)? factor"
)
_CONVERSION = re.compile(r"conversion factor")
_PIXEL = re.compile(r"(?:([xy]) )?(?:pixel|px) (?:size|pitch|spacing)(?: ([xy]))?")
_DATA_UNIT = re.compile(r"(?:data|heights?|z|values?) units?")


@dataclasses.dataclass(frozen=True)
class Setting:
    """A line of a header: a number with its unit, either of which may be missing."""

    line: str  # as an error names it
    number: float | None
    unit: str | None


Settings = dict[str, Setting]  # by "factor", "unit", "dx" and "dy"


def sets_something(line: str) -> bool:
    """True if a line of the header is a key and its value."""
    return bool(_PLAIN.match(line)) or is_setting(line)


def is_setting(line: str) -> bool:
    """True if `read_settings` reads this line of the header."""
    return bool(_settings_in(line))


def read_settings(header: list[str]) -> Settings:
    """The settings of heights and steps in the lines above the numbers.

    **Raises:** `ValueError` for a factor or a size that is not above 0.
    """
    settings: Settings = {}
    for at, line in enumerate(header, 1):
        for name, setting in _settings_in(line, f"line {at}, {line.strip()[:60]!r},").items():
            settings.setdefault(name, setting)
    return settings


def _settings_in(line: str, named: str = "") -> Settings:
    parts = _SETTING.fullmatch(line.strip().strip('"'))
    if parts is None:
        return {}
    key, value = parts[1].rstrip(), parts[2]
    unit = _KEY_UNIT.search(key)
    words = " ".join(re.split(r"[\s_-]+", key[: unit.start()] if unit else key)).strip().lower()
    if _DATA_UNIT.fullmatch(words):
        return {"unit": Setting(named, None, value.strip("[]()\"' "))}
    pixel = _PIXEL.fullmatch(words)
    number = _VALUE.fullmatch(value)
    if number is None or not (pixel or _FACTOR.fullmatch(words) or _CONVERSION.fullmatch(words)):
        return {}
    of = (unit[1] if unit and unit[1] else number[2]).strip()
    of = re.split(r"[/\s]", of)[0]  # m/rad
    setting = Setting(named, float(number[1].replace(",", ".")), of or None)
    if named and not 0 < (setting.number or 0) < math.inf:
        raise ValueError(f"{named} must have a number above 0")
    axis = pixel and (pixel[1] or pixel[2])
    names = [f"d{axis}"] if axis else ["dx", "dy"] if pixel else ["factor"]
    return dict.fromkeys(names, setting)


def height_scale(settings: Settings, column_unit: str | None, user_unit: Unit) -> float:
    """Factor that converts numbers to heights in metres.

    `column_unit` is that of their column, `user_unit` that of the user, for heights after the
    factor of the header.

    **Raises:** `ValueError` naming the line that is no length or contradicts another, and as
    `scale` does.
    """
    factor, data = settings.get("factor"), settings.get("unit")
    said = column_unit or (data.unit if data else None)
    if factor is None or factor.number is None:
        is_length = said is None or unit_named(said) is not None
        if not is_length and user_unit is not None and not unit_named(str(user_unit).strip()):
            return metres(user_unit)
        if not is_length and column_unit is None and data:
            of = f"the metres of one {said}"
            raise ValueError(f"{data.line} is no length: give {of} as unit (--unit 2.9e-8)")
        return scale(said, user_unit, "heights", "--unit")
    if factor.unit is None and user_unit is None:
        raise ValueError(
            f"{factor.line} does not say its unit: give that of the heights after it (--unit m)"
        )
    if factor.unit is not None and unit_named(factor.unit) is None:
        raise ValueError(
            f"{factor.line} does not lead to a length: take it out of the header, and give the"
            " metres of one number as unit (--unit 2.9e-8)"
        )
    metre = factor.number * scale(factor.unit, user_unit, "heights", "--unit")
    if said and unit_named(said) and abs(metre - metres(said)) > 1e-6 * metre:
        raise ValueError(f"{factor.line} contradicts the heights' unit {said}: take one out")
    return metre


def step(settings: Settings, axis: str, user_step: float | None, unit: Unit) -> float | None:
    """The size of a pixel along an axis [m]; None if the header has none.

    Without a unit of its own it is in `unit`, or in metres if the factor leads to metres and it is
    at most 1e-3.

    **Raises:** `ValueError` naming the line if its unit is unknown and there is no `user_step`.
    """
    pixel, factor = settings.get(axis), settings.get("factor")
    if pixel is None or pixel.number is None:
        return None
    if pixel.unit and unit_named(pixel.unit):
        return pixel.number * metres(pixel.unit)
    if pixel.unit is None and unit is not None:
        return pixel.number * metres(unit)
    if pixel.unit is None and factor and factor.unit == "m" and pixel.number <= 1e-3:
        return pixel.number
    if user_step is None:
        raise ValueError(
            f"{pixel.line} has no unit of length: give it (--position-unit um), or {axis} in"
            f" metres (--{axis} 1e-6)"
        )
    return None
