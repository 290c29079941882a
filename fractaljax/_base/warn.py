"""Warnings that name the line of the user's code, however deep they arise."""

import inspect
import warnings

_LIBRARIES = ("fractaljax", "equinox")  # whose frames are not the user's


def warn_user(message: str) -> None:
    """Warn as from the nearest caller outside of this package."""
    frame, level = inspect.currentframe(), 0
    while frame is not None:
        level += 1
        if frame.f_globals.get("__name__", "").partition(".")[0] not in _LIBRARIES:
            break
        frame = frame.f_back
    warnings.warn(message, stacklevel=level)
