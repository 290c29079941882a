"""Programs that a command keeps on disk.

JAX's persistent cache saves the compilation of a program, which is still traced to look it up.
`jax.export` saves the trace, too: a second run of a command starts computing at once.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import inspect
import json
import os
import stat
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.core import Tracer

from .files import read_bounded, write_whole

# The settings of JAX that a trace depends on.
TRACED_UNDER = (
    "jax_enable_x64",
    "jax_threefry_partitionable",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_numpy_dtype_promotion",
)
_TRUSTED = "fractaljax", "equinox"  # packages whose classes a kept program may hold
_MOST_BYTES = 300_000_000  # in the folder; the least recently used files are removed
_CACHE = "jax_compilation_cache_dir"
_CHECKSUMS = "checksums.json"

_folder: Path | None = None
_programs: dict[Any, Callable] = {}


def exported_jit(function: Callable, static_argnames: str | tuple[str, ...] = ()) -> Callable:
    """`jax.jit` whose exported program is kept on disk inside `keep_programs`."""
    jitted = jax.jit(function, static_argnames=static_argnames)
    static = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
    signature = inspect.signature(function)

    @functools.wraps(jitted)
    def call(*args, **kwargs):
        inside = any(isinstance(x, Tracer) for x in jax.tree.leaves((args, kwargs)))
        if _folder is None or inside or jax.device_count() > 1:
            return jitted(*args, **kwargs)
        arguments = signature.bind(*args, **kwargs).arguments
        fixed = {name: arguments.pop(name) for name in static if name in arguments}
        leaves, tree = jax.tree.flatten(arguments)
        kinds = tuple((x.shape, x.dtype, x.weak_type) for x in map(jax.typeof, leaves))
        key = function, tuple(fixed.items()), tree, kinds
        if key not in _programs:
            traced = functools.partial(_traced, jitted, tree, fixed)
            _programs[key] = _find(_folder, key, traced) or traced
        return _programs[key](*leaves)

    return call


def _traced(jitted: Callable, tree, fixed: dict[str, Any], *leaves) -> Any:
    return jitted(**jax.tree.unflatten(tree, leaves), **fixed)


def _find(folder: Path, key, program: Callable) -> Callable | None:
    """The program from its file, which is written first if missing; None if that fails."""
    function, fixed, tree, kinds = key
    with contextlib.suppress(ValueError):  # a class whose code the file's name does not cover
        arguments = jax.tree.unflatten(tree, [_Leaf()] * tree.num_leaves)
        stated = json.dumps(_described((_place(function), fixed, arguments), []))
        name = f"{_surroundings()} {stated} {kinds}"
        file = folder / hashlib.sha256(name.encode()).hexdigest()
        with contextlib.suppress(OSError, ValueError):
            return _read(file)
        with contextlib.suppress(OSError, NotImplementedError):
            _write(file, program, kinds)
            return _read(file)
    return None


def _write(file: Path, program: Callable, kinds) -> None:
    """**Raises:** `ValueError` or `NotImplementedError` for what cannot be exported."""
    skeleton = None

    def flat(*leaves):
        nonlocal skeleton
        result, values = program(*leaves), []
        skeleton = json.dumps(_described(result, values))
        return values

    arguments = [jax.ShapeDtypeStruct(*kind[:2], weak_type=kind[2]) for kind in kinds]
    exported = jax.export.export(jax.jit(flat))(*arguments)
    content = f"{skeleton}\n".encode() + exported.serialize()
    digest = hashlib.sha256(content).hexdigest()
    write_whole(file, f"{digest}\n".encode() + content, durable=False)
    file.chmod(0o600)


def _read(file: Path) -> Callable:
    """**Raises:** `OSError` or `ValueError` for a file that is missing, damaged or not safe."""
    if not _is_private(file):
        raise PermissionError(f"{file} can be written by others")
    digest, _, content = read_bounded(file, _MOST_BYTES).partition(b"\n")
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise ValueError(f"{file} is damaged")
    skeleton, _, serialized = content.partition(b"\n")
    described = json.loads(skeleton)
    call = jax.export.deserialize(bytearray(serialized)).call
    program = jax.jit(call)
    os.utime(file)
    return lambda *leaves: _rebuilt(described, program(*leaves))


class _Leaf:
    """Stands for an array of an argument."""


def _described(x: Any, leaves: list) -> Any:
    """A tree as JSON with indices for its leaves, which are appended to `leaves` in that order.

    **Raises:** `ValueError` for objects of other packages or without a name.
    """
    if isinstance(x, type):
        return {"type": _place(x)}
    if dataclasses.is_dataclass(x):  # such as a module of Equinox
        fields = {f.name: _described(getattr(x, f.name), leaves) for f in dataclasses.fields(x)}
        return {"class": _place(type(x)), "fields": fields}
    if isinstance(x, tuple) and (names := getattr(x, "_fields", None)):  # a named tuple
        fields = {name: _described(getattr(x, name), leaves) for name in names}
        return {"named": _place(type(x)), "fields": fields}
    if isinstance(x, tuple | list | dict):
        pairs = [*(x.items() if isinstance(x, dict) else enumerate(x))]
        if not all(isinstance(key, str | int) for key, _ in pairs):
            raise ValueError("cannot be kept: a key that is no text")
        return {type(x).__name__: [[key, _described(value, leaves)] for key, value in pairs]}
    if isinstance(x, jax.Array | _Leaf):
        leaves.append(x)
        return {"leaf": len(leaves) - 1}
    if x is None or type(x) in (bool, int, float, str):
        return {"value": x}
    if isinstance(x, jax.sharding.Mesh):  # of the only device
        return {"mesh": x.axis_names}
    if hasattr(x, "key"):  # a program of a sweep
        return {"key": x.key().hex()}
    raise ValueError(f"cannot be kept: {type(x).__name__}")


def _rebuilt(described: dict[str, Any], leaves: list) -> Any:
    match described:
        case {"leaf": number}:
            return leaves[number]
        case {"value": value}:
            return value
        case {"type": place}:
            return _class_at(place)
        case {"named": place, "fields": fields}:
            return _class_at(place)(*(_rebuilt(value, leaves) for value in fields.values()))
        case {"class": place, "fields": fields}:
            module = object.__new__(_class_at(place))
            for name, value in fields.items():
                object.__setattr__(module, name, _rebuilt(value, leaves))
            return module
    ((kind, pairs),) = described.items()
    values = {key: _rebuilt(value, leaves) for key, value in pairs}
    return values if kind == "dict" else {"tuple": tuple, "list": list}[kind](values.values())


def _place(named: Any) -> str:
    """The module and the qualified name of a class or a function."""
    place = f"{named.__module__}:{named.__qualname__}"
    if named.__module__.partition(".")[0] not in _TRUSTED or "<" in place:
        raise ValueError(f"cannot be kept: {place}")
    return place


def _class_at(place: str) -> type:
    module, _, name = place.partition(":")
    if module.partition(".")[0] not in _TRUSTED:
        raise ValueError(f"{place} is of another package")
    return functools.reduce(getattr, name.split("."), importlib.import_module(module))


@functools.cache
def _surroundings() -> str:
    """What determines a program besides its arguments: sources, versions and settings."""
    sources = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        sources.update(file.read_bytes())
    versions = *sys.version_info[:3], *map(version, ("jax", "jaxlib", "equinox", "diffrax"))
    settings = [getattr(jax.config, name) for name in TRACED_UNDER]
    return f"{sources.hexdigest()} {versions} {settings} {jax.default_backend()}"


# --- where they are kept -------------------------------------------------------------------


@contextlib.contextmanager
def keep_programs() -> Iterator[None]:
    """Keep programs in the user's cache folder, or in JAX_COMPILATION_CACHE_DIR; never raise.

    Only a folder that no one else can write to is used, since its content is executed.
    """
    global _folder
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    chosen = getattr(jax.config, _CACHE)
    with contextlib.suppress(OSError, RuntimeError):  # not writable, or no home
        folder = Path(chosen) if chosen is not None else _cache_folder()
        programs = folder / "programs"
        first = not programs.exists()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        programs.mkdir(mode=0o700, exist_ok=True)
        if all(_is_private(x) and os.access(x, os.W_OK | os.X_OK) for x in (folder, programs)):
            _folder = programs
            if chosen is None:
                _drop_damaged(folder)
                jax.config.update(_CACHE, str(folder))
                jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
            if first and sys.stderr is not None and sys.stderr.isatty():
                print(f"first run: compiled programs are kept in {folder}", file=sys.stderr)
    try:
        yield
    finally:
        if _folder is not None:
            with contextlib.suppress(OSError):
                if chosen is None:
                    _make_room(_folder.parent)
                    _write_checksums(_folder.parent)
                else:
                    _make_room(_folder)
        _folder = None


def _is_private(path: Path) -> bool:
    """True if a file or folder belongs to the user and no one else may write to it."""
    if not hasattr(os, "getuid"):  # Windows separates the folders of users
        return path.exists()
    about = path.stat()
    return about.st_uid == os.getuid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _cache_folder() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "fractaljax" / "compiled"


def _checksums(folder: Path) -> dict[str, str]:
    """Checksums of the files that JAX keeps in the folder, for which it has none itself."""
    entries = (x for x in folder.iterdir() if x.name.endswith("-cache"))
    return {x.name: hashlib.sha256(x.read_bytes()).hexdigest() for x in entries}


def _write_checksums(folder: Path) -> None:
    content = json.dumps(_checksums(folder), indent=0)
    write_whole(folder / _CHECKSUMS, content.encode(), durable=False)


def _drop_damaged(folder: Path) -> None:
    """Remove executables changed since a command wrote them: they could crash the process."""
    try:
        expected = json.loads((folder / _CHECKSUMS).read_text())
    except (OSError, ValueError):
        expected = {}
    for name, checksum in _checksums(folder).items():
        if expected.get(name) != checksum:
            (folder / name).unlink(missing_ok=True)


def _make_room(folder: Path) -> None:
    files = [x for x in folder.rglob("*") if x.is_file()]
    ages = sorted((x.stat().st_mtime, x.stat().st_size, x) for x in files)
    over = sum(size for _, size, _ in ages) - _MOST_BYTES
    for _, size, file in ages:
        if over <= 0:
            return
        file.unlink(missing_ok=True)
        over -= size
