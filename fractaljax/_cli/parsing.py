"""How the commands read their arguments and report errors."""

import argparse
import contextlib
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._version import __version__


class Version(argparse.Action):
    """Print the version, and a note where JAX is newer than what was tested, and exit."""

    def __call__(self, parser, namespace, values, option_string=None):
        print(f"{parser.prog} {__version__}")
        from .._base.versions import untested_jax

        if note := untested_jax():
            print(f"{parser.prog}: {note}", file=sys.stderr)
        parser.exit()


class _Once(argparse.Action):
    """Store a value, and refuse a second one."""

    stored = False

    def __call__(self, parser, namespace, values, option_string=None):
        if self.stored:
            raise argparse.ArgumentError(self, "given more than once")
        self.stored = True
        setattr(namespace, self.dest, values)


class _Help(argparse.HelpFormatter):
    """Show a whole number as N and any other as X."""

    def _get_default_metavar_for_optional(self, action):
        default = super()._get_default_metavar_for_optional(action)
        return {int: "N", float: "X"}.get(action.type, default)  # pyright: ignore[reportArgumentType]


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line and takes negative numbers of any form."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, formatter_class=_Help, **options)
        self.register("action", None, _Once)
        # Older Pythons take -1e-5 for an option.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message):
        missing = message.startswith("the following arguments are required")
        refuse(f"{message}; see {self.prog} --help" if missing else message)


def add_out(parser, folder: str) -> None:
    """Add `--out`."""
    words = f"the folder to write to; default {folder}"
    parser.add_argument("--out", type=Path, default=Path(folder), metavar="FOLDER", help=words)


def refuse(message: str) -> None:
    """Print one line on standard error and exit with status 2."""
    print(f"fractaljax: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)


_FILE_ERRORS = {
    FileNotFoundError: "no such file",
    IsADirectoryError: "a folder, not a file",
    NotADirectoryError: "not a folder",
    PermissionError: "no permission for",
}


def reason(error: Exception) -> str | None:
    """The message of an error that a user can cause, or None for a defect of the program."""
    text = str(error)
    match error:
        case OSError(filename=None):
            return text
        case OSError():
            return f"{_FILE_ERRORS.get(type(error), error.strerror)}: {error.filename}"
        case RecursionError():
            return "a file is too deeply nested"
        case MemoryError():
            return f"not enough memory: {text}"
        case ArithmeticError():
            return f"a number is out of range: {text}"
        case ValueError() | TypeError():
            return text
    return f"not enough memory: {text}" if text.startswith("RESOURCE_EXHAUSTED") else None


@contextlib.contextmanager
def remarks():
    """Print warnings as lines on standard error."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_, **__: print(
            f"fractaljax: {message}", file=sys.stderr
        )
        yield


def add_scene_file(parser) -> None:
    """Add the optional argument `scene`."""
    parser.add_argument(
        "scene", nargs="?", type=Path, help="a scene file; else the reference brake"
    )


def add_constant_friction(parser) -> None:
    """Add the option `--constant-friction`."""
    parser.add_argument(
        "--constant-friction",
        action="store_true",
        help="leave out the slope of the friction law (the source's Eq. 43)",
    )


def load_mechanism(
    path: Path | None,
    structures: bool = False,
    over: Mapping[str, Sequence[float]] | None = None,
    quiet: bool = False,
) -> Any:
    """The scene in a file, with `structures` also a structure; without a file the reference brake.

    A large sparse structure is reduced as the table [reduction] of its file says, also over the
    ranges of quantities in `over`.

    **Raises:** `ValueError` if it has no such table.
    """
    from .._mechanism.scene import Scene, brake_scene

    if path is None:
        return brake_scene()
    mechanism: Any = load_noted(path) if structures else Scene.load(path)
    if not mechanism.is_sparse:
        return mechanism
    from .._stability.reduction import reduce

    options = parse_reduction(path)
    if "band" not in options:
        raise ValueError(
            f"{path}: {mechanism.n} degrees of freedom need a reduction: run `fractaljax reduce`, "
            "or add a table [reduction] with band = [low, high] in rad/s"
        )
    options["over"] = options.get("over", {}) | dict(over or {})
    return reduce(mechanism, **options, progress=not quiet)


def load_noted(path: Path) -> Any:
    """The scene or structure in a file; its notes are printed on standard error."""
    from .._mechanism.structure import load

    mechanism = load(path)
    for note in getattr(mechanism, "notes", ()):
        print(f"fractaljax: {note}", file=sys.stderr)
    return mechanism


def parse_reduction(path: Path) -> dict[str, Any]:
    """The table [reduction] of a structure's file: band, tol and over, if it has them.

    **Raises:** `ValueError` for another key.
    """
    from .._base.files import read_bounded
    from .._base.toml import naming, read_toml, refuse_unknown, table_at

    with naming(path):
        document = read_toml(read_bounded(path))
        table = table_at(document, "reduction") if "reduction" in document else {}
        refuse_unknown("[reduction]", table, ("band", "tol", "over"))
        if "over" in table:
            table_at(table, "over", "reduction.")
    return table


def parse_pairs(option: str, texts: list[str], form: str) -> dict[str, str]:
    """The values of several NAME=VALUE by name; an error message shows the `form` of one."""
    pairs = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not (name and value):
            raise ValueError(f"{option} must be {form}, got {text!r}")
        if name in pairs:
            raise ValueError(f"{option} has {name} more than once")
        pairs[name] = value
    return pairs


def number(option: str, text: str) -> float:
    """The number in the text of an option."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{option} must be numbers, got {text!r}") from None


def numbers(option: str, text: str, separator: str) -> list[float]:
    """The numbers in the text of an option."""
    return [number(option, value) for value in text.split(separator)]


def parse_envelope(texts: list[str]) -> Any:
    """The `Envelope` of --envelope: NAME=LOW:HIGH, or NAME=V1,V2,V3 measured together."""
    from .._design.envelope import Envelope

    ranges, samples = {}, {}
    for name, text in parse_pairs("--envelope", texts, "NAME=LOW:HIGH").items():
        into, separator = (ranges, ":") if ":" in text else (samples, ",")
        into[name] = numbers(f"--envelope {name}", text, separator)
        if len(into[name]) < 2:
            raise ValueError(
                f"--envelope {name} must be LOW:HIGH or at least two samples, got {text!r}"
            )
    return Envelope(ranges, samples)


def parse_windows(option: str, texts: list[str], form: str) -> dict[str, tuple[float, float]]:
    """The windows of several NAME=LOW:HIGH by name; an error message shows the `form` of one."""
    windows = {}
    for name, ends in parse_pairs(option, texts, form).items():
        window = numbers(f"{option} {name}", ends, ":")
        if len(window) != 2:
            raise ValueError(f"{option} must be {form}, got '{name}={ends}'")
        windows[name] = (window[0], window[1])
    return windows


def kick_size(option: str, text: str) -> float | list[float]:
    """A radius, or semi-axes separated by commas."""
    axes = numbers(option, text, ",")
    return axes if len(axes) > 1 else axes[0]
