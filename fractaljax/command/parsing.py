"""What the commands share in reading their arguments, and how they refuse."""

import argparse
import contextlib
import re
import sys
import warnings
from pathlib import Path


class _Once(argparse.Action):
    """Stores a value, and refuses a second one instead of forgetting the first."""

    given = False

    def __call__(self, parser, namespace, values, option_string=None):
        if self.given:
            raise argparse.ArgumentError(self, "given more than once")
        self.given = True
        setattr(namespace, self.dest, values)


class Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, and takes negative numbers of any form."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.register("action", None, _Once)
        # Older Pythons take -1e-5 for an option.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message):
        refuse(message)


def refuse(message) -> None:
    """One line on standard error, and exit status 2."""
    line = " ".join(str(message).split())
    print(f"fractaljax: {line}", file=sys.stderr)
    raise SystemExit(2)


def reason(error: Exception) -> str | None:
    """What a failure that a user can cause means, in a line; None for any other."""
    if isinstance(error, OSError):
        return _about_file(error)
    if isinstance(error, RecursionError):
        return "a file is too deeply nested"
    if isinstance(error, MemoryError):
        return f"not enough memory: {error}"
    if isinstance(error, ArithmeticError):
        return f"a number is out of range: {error}"
    text = str(error)
    if isinstance(error, (ValueError, TypeError)):
        return text
    # Raised while a compiled program ran: the line beside JAX's own account of the program.
    checked = re.search(r"EquinoxRuntimeError: (.+)", text)
    if checked:
        return checked[1]
    return f"not enough memory: {text}" if text.startswith("RESOURCE_EXHAUSTED") else None


def _about_file(error: OSError) -> str:
    words = {
        FileNotFoundError: "no such file",
        IsADirectoryError: "a folder, not a file",
        NotADirectoryError: "not a folder",
        PermissionError: "no permission for",
    }
    if error.filename is None:
        return str(error)
    return f"{words.get(type(error), error.strerror)}: {error.filename}"


@contextlib.contextmanager
def remarks():
    """Warnings as lines on standard error."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_, **__: print(
            f"fractaljax: {message}", file=sys.stderr
        )
        yield


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


def pairs_of(option, texts, form) -> dict[str, str]:
    """Several NAME=VALUE as texts by name; `form` says how each should look."""
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise ValueError(f"{option} must be {form}, got {text!r}")
        if name in found:
            raise ValueError(f"{option} has {name} more than once")
        found[name] = value
    return found


def number(option, text) -> float:
    """A number that was given as a text to `option`."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{option} must be numbers, got {text!r}") from None
