"""The batches of a sweep as a Zarr store, so that an interrupted sweep resumes and xarray opens it.

Every leaf of the measure is an array over the grid, and every batch a chunk of it. At each point
the array `computed` holds a checksum of the sweep, the number of the batch and its values, or 0
where there are none yet. It is written after the values: a killed sweep leaves no half batch, a
NaN that was computed differs from one that was not, and no damaged or misplaced chunk is read.
"""

import contextlib
import hashlib
import json
import os
import re
import secrets
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._base.parts import one_line
from .._base.versions import versions, versions_differ
from .._base.warn import warn_user
from .._mechanism.quantities import meaning, quantity_names, unit
from .blocks import Blocks
from .labels import dimensions, leaf_names as names_of_leaves, measure_name
from .program import Program, array_digest

_ABOUT = "fractaljax"  # the attribute that describes the sweep
_VERSIONS = "versions"  # the versions that wrote the store
_NAMES = "names"  # names of the arrays: one program may come from measures of several names
_MEANINGS = {
    "key": "measure or scene",
    "axes": "axes",
    "batch": "batch size",
    "arrays": "arrays of the measure",
}
_COMPUTED = "computed"
_SETTINGS = {"array.write_empty_chunks": True}  # every NaN has bits of its own


class Store:
    """The Zarr store of one sweep. Every file of it is written whole or not at all."""

    def __init__(
        self,
        path: str | os.PathLike,
        about: Mapping[str, Any],
        scene: Any,
        axes: Mapping[str, np.ndarray],
        leaves: Mapping[str, Any],
        blocks: Blocks,
    ):
        """Create the store of the sweep that `about` describes, or resume it.

        `leaves` are the shapes and dtypes of the measure at one point, by name. Warns if other
        versions wrote the store.

        **Raises:** `ValueError` for the store of another sweep, a folder with other files, and
        dtypes that NumPy itself lacks, such as bfloat16.
        """
        for name, leaf in leaves.items():
            if np.dtype(leaf.dtype).kind not in "biufc":
                raise ValueError(f"out cannot keep {name}, which is of dtype {leaf.dtype}")
        self._path, self._blocks = folder(path), blocks
        self._sweep = json.dumps(about).encode()
        if describe(path) is None:
            if self._path.exists() and any(self._path.iterdir()):
                raise ValueError(f"out must be an empty folder or that of this sweep, got {path}")
            self._make(about, scene, axes, leaves)
        names = self._compare(path, about)
        try:
            with zarr().config.set(_SETTINGS):
                group = zarr().open_group(self._path, mode="r+", use_consolidated=False)
                *self._leaves, self._computed = (group[name] for name in (*names, _COMPUTED))
        except Exception as error:  # whatever Zarr raises for damaged files
            raise ValueError(f"out {path} cannot be read: {one_line(error)}") from None

    def _make(self, about, scene, axes, leaves) -> None:
        """Write everything but the batches, in a folder beside its place until it is complete."""
        beside = self._path.with_name(f".{self._path.name}-{secrets.token_hex(4)}")
        names, blocks = axis_names(axes), self._blocks
        try:
            with self._named_errors():
                beside.parent.mkdir(parents=True, exist_ok=True)
                words: Any = {"title": f"a sweep over {', '.join(axes)}"}
                words[_ABOUT] = {**about, _NAMES: list(leaves), _VERSIONS: versions()}
                group = zarr().open_group(beside, mode="w", zarr_format=3, attributes=words)
                for name, (quantity, values) in zip(names, axes.items(), strict=True):
                    words = {}
                    if quantity in quantity_names(scene):
                        words = {"long_name": meaning(scene, quantity)}
                        words["units"] = unit(scene, quantity)
                    _add(group, name, values.dtype, values.shape, values.shape, [name], words)
                    group[name][:] = values
                beyond = dimensions({name: leaf.shape for name, leaf in leaves.items()})
                for name, leaf in leaves.items():
                    more = _distinct(beyond[name], [*names, *leaves])
                    shape, chunks = (first + leaf.shape for first in (blocks.shape, blocks.block))
                    _add(group, name, leaf.dtype, shape, chunks, [*names, *more])
                words = {"long_name": "checksum of the batch of the point; 0: not computed yet"}
                _add(group, _COMPUTED, np.uint64, blocks.shape, blocks.block, names, words)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # that Zarr 3 does not specify it yet
                    zarr().consolidate_metadata(group.store)
                with contextlib.suppress(OSError):
                    self._path.rmdir()  # Windows replaces no folder, empty or not
                try:
                    os.rename(beside, self._path)
                except OSError:
                    if describe(self._path) is None:
                        raise
                    # Another process of the same sweep was faster.
        finally:
            shutil.rmtree(beside, ignore_errors=True)

    def _compare(self, path, about) -> list[str]:
        """Refuse the store of another sweep; return the names of the arrays in this one."""
        stored = describe(path) or {}
        others = versions_differ(stored.get(_VERSIONS, {}))
        differs = [words for key, words in _MEANINGS.items() if stored.get(key) != about[key]]
        if differs:
            note = f" (it was {others})" if others else ""
            raise ValueError(f"out {path} holds another sweep: {', '.join(differs)} differ{note}")
        if others:
            warn_user(f"out {path} was {others}: digits may differ")
        return stored[_NAMES]

    def there(self) -> set[int]:
        """The numbers of the batches that are stored now, with all their files."""
        step = tuple(slice(None, None, size) for size in self._blocks.block)
        try:
            sums = self._computed[step]
        except Exception:
            for k in range(self._blocks.number):
                self._sum(k)  # names the damaged one
            raise
        return {k for k in np.flatnonzero(sums).tolist() if all(map(Path.exists, self._files(k)))}

    def write(self, k: int, arrays: Sequence[np.ndarray]) -> None:
        """Store the arrays (*shape of batch k, ...) of the leaves."""
        index = self._blocks.index(k)
        with self._named_errors():
            for kept, array in zip(self._leaves, arrays, strict=True):
                kept[index] = array
            self._computed[index] = self._checksum(k, arrays)

    def read(self, k: int) -> list[np.ndarray]:
        """The arrays of batch k. **Raises:** `ValueError` for one that is damaged or missing."""
        index, checksum = self._blocks.index(k), self._sum(k)
        try:
            arrays = [np.asarray(kept[index]) for kept in self._leaves]
            reason = "it is damaged, or no batch of this sweep"
        except Exception as error:  # whatever a codec raises for damaged bytes
            arrays, reason = None, one_line(error)
        if arrays is None or checksum != self._checksum(k, arrays):
            raise self._damaged(k, reason)
        return arrays

    def _sum(self, k: int) -> int:
        try:
            return np.unique(self._computed[self._blocks.index(k)]).item()
        except Exception as error:
            raise self._damaged(k, one_line(error)) from None

    def _checksum(self, k: int, arrays: Sequence[np.ndarray]) -> int:
        digest = hashlib.sha256(self._sweep + b"%d" % k)
        for array in arrays:
            digest.update(array_digest(array))
        return max(1, int.from_bytes(digest.digest()[:8], "little"))

    def _files(self, k: int) -> Iterator[Path]:
        """The files of batch k, that of its checksum first."""
        for array in (self._computed, *self._leaves):
            if array.size:
                place = (*self._blocks.place(k), *[0] * (array.ndim - len(self._blocks.shape)))
                yield self._path / array.basename / ".".join(map(str, ("c", *place)))

    def _damaged(self, k: int, reason: str) -> ValueError:
        file = next(self._files(k))
        return ValueError(
            f"batch {k} of {self._path} cannot be read, remove {file} and sweep again: {reason}"
        )

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if error.filename is None:
                error.filename = str(self._path)
            raise


def zarr() -> Any:
    """The package; raises an `ImportError` of one line without it."""
    try:
        import zarr
    except ImportError:
        raise ImportError('out needs zarr: python -m pip install "fractaljax[sweep]"') from None
    return zarr


def _add(group, name, dtype, shape, chunks, dimensions, attributes=None) -> None:
    from zarr.codecs import Crc32cCodec, ZstdCodec

    dtype = np.dtype(dtype)
    # Floating-point digits hardly compress.
    packed = [] if dtype.kind in "fc" else [ZstdCodec()]
    group.create_array(
        name,
        shape=shape,
        chunks=tuple(max(1, n) for n in chunks),
        dtype=dtype,
        # NaN marks a missing float. There is no such integer: `computed` tells.
        fill_value=np.nan if dtype.kind in "fc" else np.zeros((), dtype).item(),
        compressors=[*packed, Crc32cCodec()],
        chunk_key_encoding={"name": "default", "separator": "."},
        dimension_names=dimensions,
        attributes=attributes,
    )


def folder(path: str | os.PathLike) -> Path:
    """The folder of a store, links resolved. **Raises:** `ValueError` for a URL."""
    if "://" in str(path):
        raise ValueError(f"out must be a folder of this machine, got {path}")
    return Path(os.path.realpath(path))


def describe(path: str | os.PathLike) -> dict[str, Any] | None:
    """The description of its sweep in a store, or None if there is no file zarr.json.

    **Raises:** `ValueError` for a file that does not describe a sweep.
    """
    file = folder(path) / "zarr.json"
    if not file.exists():
        return None
    try:
        about = json.loads(file.read_bytes())["attributes"][_ABOUT]
        kinds = {_VERSIONS: dict, _NAMES: list, "key": str, "axes": list, "batch": int}
        if {name: type(value) for name, value in about.items()} != kinds | {"arrays": list}:
            raise ValueError("other keys than those of a sweep")
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{file} does not describe a sweep: {one_line(error)}") from None
    return about


def description(
    program: Program, scene: Any, axes: Mapping[str, np.ndarray], batch: int
) -> dict[str, Any]:
    """The identity of a sweep: equal for equal sweeps on any number of devices.

    **Raises:** `ValueError` for a measure that calls functions outside its program.
    """
    content = hashlib.sha256(program.key())
    for array in jax.tree.leaves(scene):
        content.update(array_digest(array))
    leaves = jax.tree_util.tree_leaves_with_path(program.shapes)
    return {
        "key": content.hexdigest(),
        # 0.0 and -0.0 are two values of an axis.
        "axes": [[name, array_digest(values).hex()] for name, values in axes.items()],
        "batch": batch,
        "arrays": [jax.tree_util.keystr(place) for place, _ in leaves],
    }


def axis_names(axes: Mapping[str, Any]) -> list[str]:
    """The quantities as names of arrays: "K_t/K_n" is K_t_over_K_n, since a slash is a group."""
    return _distinct(axes, ["zarr.json", _COMPUTED])


def leaf_names(measure: Any, shapes: Any, axes: Mapping[str, Any]) -> list[str]:
    """The names of the arrays of a measure: its own, or for several those of `Sweep.to_xarray`."""
    names = names_of_leaves(measure_name(measure), shapes)
    return _distinct(names, ["zarr.json", _COMPUTED, *axis_names(axes)])


def _distinct(names, taken: Sequence[str]) -> list[str]:
    """Names of files, distinct from one another and from `taken` on any system."""
    used, distinct = {name.casefold() for name in taken}, []
    for name in names:
        name = re.sub(r"[^\w.+-]", "_", name.replace("/", "_over_"))
        while name.casefold() in used:
            name += "_"
        used.add(name.casefold())
        distinct.append(name)
    return distinct
