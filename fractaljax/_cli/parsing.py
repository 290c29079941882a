"""How the commands read their arguments and report errors."""

import argparse
import contextlib
import math
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

from .._base.suggest import did_you_mean
from .._version import __version__
from .json_text import add_json


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


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line and takes negative numbers of any form.

    `commands` are those of the whole command; `pairs` are options that take LOW:HIGH as two words.
    """

    commands: Sequence[str] = ()
    pairs: Sequence[str] = ()

    def __init__(self, *arguments, **options):
        self.actions: list[argparse.Action] = []
        super().__init__(*arguments, **options)
        self.register("action", None, _Once)

    def add_argument(self, *names, **options):
        """As argparse does; a whole number is shown as N and any other as X."""
        letter = {int: "N", float: "X"}.get(options.get("type"))
        if letter and names[0].startswith("-"):
            options.setdefault("metavar", letter)
        self.actions.append(super().add_argument(*names, **options))
        return self.actions[-1]

    def parse_known_args(self, args=None, namespace=None):
        """As argparse does, with LOW:HIGH of `pairs` in two, and options that are like others."""
        words = list(sys.argv[1:] if args is None else args)
        for k in reversed(range(len(words))):
            option, equals, value = words[k].partition("=")
            if option in self.pairs and equals and value.count(":") == 1:
                words[k : k + 1] = [option, *value.split(":")]
            elif option in self.pairs and words[k + 1 : k + 2] and words[k + 1].count(":") == 1:
                words[k + 1 : k + 2] = words[k + 1].split(":")
        # argparse takes for an option what begins as -0.1:0.2 and -1e-5 do.
        single = {x for each in self.actions if each.nargs is None for x in each.option_strings}
        for k in reversed(range(1, len(words))):
            if re.match(r"-\.?\d", words[k]) and words[k - 1] in single:
                words[k - 1 : k + 1] = [f"{words[k - 1]}={words[k]}"]
        words = [_plain(word) for word in words]
        namespace, unknown = super().parse_known_args(words, namespace)
        options = [word.partition("=")[0] for word in unknown if word.startswith("--")]
        if options and not self.commands:
            name = options[0].lstrip("-")
            known = [name for action in self.actions for name in action.option_strings]
            near = did_you_mean(name, (x.lstrip("-") for x in known))
            near = near.replace("mean ", "mean --").replace(" or ", " or --")
            if not near and "--bounds" in known and name.isidentifier():
                near = f": did you mean --bounds {name}=LOW:HIGH or --set {name}=VALUE?"
            self.error(f"unrecognized arguments: {' '.join(unknown)}{near or self._see}")
        return namespace, unknown

    @property
    def _see(self) -> str:
        return f"; see {self.prog} --help"

    def error(self, message):
        if message.startswith("the following arguments are required"):
            message += self._see
        wrong = re.search(r"argument COMMAND: invalid choice: '(.*?)'", message)
        if wrong:
            word = wrong[1]
            near = did_you_mean(word, self.commands)
            if Path(word).suffix:
                near = f": a command comes before its file, fractaljax stability {word}"
            message = f"invalid choice: {word!r}, not one of {', '.join(self.commands)}{near}"
        refuse(message)


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


def _plain(word: str) -> str:
    """A negative number as argparse knows it, without an exponent."""
    try:
        number = float(word) if re.match(r"-\.?\d.*[eE.]", word) else math.inf
    except ValueError:
        return word
    return f"{Decimal(repr(number)):f}" if math.isfinite(number) else word


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
    add_set(parser)


def add_set(parser) -> None:
    """Add `--set`, and `--json`, which every command has that takes a scene."""
    parser.add_argument(
        "--set",
        action="extend",
        nargs="+",
        metavar="NAME=VALUE",
        help="change quantities of the scene for this run, in SI units: --set D=2.5 P=1500",
    )
    add_json(parser)


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
    changes: Sequence[str] | None = None,
) -> Any:
    """The scene in a file, with `structures` also a structure; without a file the reference brake.

    A large sparse structure is reduced as the table [reduction] of its file says, also over the
    ranges of quantities in `over`. `changes` are those of --set, NAME=VALUE each.

    **Raises:** `ValueError` if it has no such table, and for a file that holds no scene.
    """
    from .._mechanism.scene import Scene, brake_scene

    with remarks():
        if path is None:
            return changed(brake_scene(), changes)
        _require_scene_file(path)
        mechanism = changed(load_noted(path) if structures else Scene.load(path), changes)
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


def changed(mechanism: Any, changes: Sequence[str] | None) -> Any:
    """The scene or structure with the quantities of --set, NAME=VALUE each."""
    if not changes:
        return mechanism
    stray = [text for text in changes if text.endswith(".toml") and "=" not in text]
    if stray:
        raise ValueError(f"--set must be NAME=VALUE, got {stray[0]!r}: the file comes before it")
    pairs = parse_pairs("--set", list(changes), "NAME=VALUE")
    return mechanism.replace(**{name: number(f"--set {name}", x) for name, x in pairs.items()})


def _require_scene_file(path: Path) -> None:
    """Refuse a file of matrices or heights, and say which command or file takes it."""
    kind = path.suffix.lower()
    if kind in ("", ".toml", ".txt"):
        return
    if kind in (".mtx", ".mat", ".npz", ".npy", ".pch", ".bdf", ".csv", ".inp"):
        raise ValueError(
            f"{path}: a scene or structure is a TOML file; one with [structure], M = "
            f'"{path.name}" and K = "another file", and its joints, takes matrices '
            "(docs/model.md); fractaljax identify takes heights"
        )


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
