"""What the commands share in reading their arguments, and how they refuse."""

import argparse
import re
import sys
from pathlib import Path


class Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, and takes negative numbers of any form."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        # Older Pythons take -1e-5 for an option.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message):
        refuse(message)


def refuse(message) -> None:
    """One line on standard error, and exit status 2."""
    line = " ".join(str(message).split())
    print(f"fractaljax: {line}", file=sys.stderr)
    raise SystemExit(2)


def add_scene_file(parser) -> None:
    """A scene file, or nothing."""
    parser.add_argument(
        "scene", nargs="?", type=Path, help="a scene file; else the reference brake"
    )


def add_constant_friction(parser) -> None:
    """Whether stability counts the slope of the friction law."""
    parser.add_argument(
        "--constant-friction",
        action="store_true",
        help="leave out the slope of the friction law (the source's Eq. 43)",
    )


def load_scene(arguments):
    """The scene asked for: the reference brake where no file is given."""
    from ..mechanism.scene import Scene, brake_scene

    return brake_scene() if arguments.scene is None else Scene.load(arguments.scene)


def low_and_high(option, text):
    """LOW:HIGH as two numbers, either of them None where it is absent; LOW alone is LOW:."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    return tuple(number(option, end) if end else None for end in (low, high))


def pair(option, text, form):
    """NAME=VALUE as two texts; `form` says how it should look."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise ValueError(f"{option} must be {form}, got {text!r}")
    return name, value


def number(option, text) -> float:
    """A number that was given as a text to `option`."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{option} must be numbers, got {text!r}") from None
