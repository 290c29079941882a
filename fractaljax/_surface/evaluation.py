"""The part of the heights that is evaluated: sections of a profile, area of a map."""

from .._base.parts import Numbers, whole
from .._base.warn import warn_user
from .gaussian_filter import length_in_metres


def section_bounds(
    n: int, dx: Numbers, cutoff: Numbers | None, shortest: Numbers | None, sections: int | None
) -> tuple[int, ...]:
    """Where the sections of n points begin, and where the last one ends.

    With a cutoff they are as long as it, five (ISO 21920-3) or as many as fit, in the middle of the
    profile and half a cutoff from its ends. Without one, they divide the profile.

    **Raises:** `ValueError` if the profile is too short; `TypeError` for traced lengths.
    """
    if sections is not None:
        sections = whole("sections", sections, 1, n)
    if cutoff is None:
        start, end = _inner_points(n, "z", "shortest", shortest, dx)
        count = sections or 1
        if end - start < 2 * count:
            raise ValueError(f"sections must be at most {(end - start) // 2}, got {count}")
        return tuple(start + round(k * (end - start) / count) for k in range(count + 1))
    length, step = length_in_metres("cutoff", cutoff), length_in_metres("dx", dx)
    most = int(n * step / length + 1e-6) - 1  # a whole ratio may be rounded down
    count = sections or min(most, 5)
    held = (
        f"z is {n * step:.6g} m long and holds {max(most, 0)} sections of cutoff = {length:.6g} m"
    )
    if most < max(count, 1):
        raise ValueError(f"{held} (half of it is dropped at both ends), fewer than {max(count, 1)}")
    if count < 5 and sections is None:
        warn_user(f"{held} (half of it is dropped at both ends), fewer than 5")
    start = (n - round(count * length / step)) // 2
    return tuple(start + round(k * length / step) for k in range(count + 1))


def evaluation_area(
    shape: tuple[int, ...], steps, cutoff: Numbers | None, shortest: Numbers | None
) -> tuple[tuple[int, int], ...]:
    """First point and end along each axis of a map, without half a nesting index at its edges.

    ISO 25178-3 evaluates a square with the cutoff as its side: a warning says if there is less.

    **Raises:** `ValueError` if too little is left; `TypeError` for traced lengths.
    """
    name, longest = ("shortest", shortest) if cutoff is None else ("cutoff", cutoff)
    axes = ("the first axis of z", "the second axis of z")
    area = tuple(
        _inner_points(n, axis, name, longest, step)
        for axis, n, step in zip(axes, shape, steps, strict=True)
    )
    if cutoff is not None:
        length = length_in_metres("cutoff", cutoff)
        sides = [
            (end - start) * length_in_metres("dx", step)
            for (start, end), step in zip(area, steps, strict=True)
        ]
        if min(sides) < length * (1 - 1e-6):
            warn_user(
                f"z holds an area of {sides[0]:.6g} m x {sides[1]:.6g} m (half of cutoff = "
                f"{length:.6g} m is dropped at all edges), less than the cutoff squared",
            )
    return area


def _inner_points(n, axis, name, longest, dx) -> tuple[int, int]:
    """(start, end) of the points without half the longest nesting index at both ends."""
    if longest is None:
        return 0, n
    length, step = length_in_metres(name, longest), length_in_metres("dx", dx)
    drop = round(length / step / 2)
    if n - 2 * drop < 8:
        raise ValueError(
            f"{axis} is {n * step:.6g} m long, too short for {name} = {length:.6g} m: half of it is"
            " dropped at both ends"
        )
    return drop, n - drop
