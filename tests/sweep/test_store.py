"""The Zarr store of a sweep: labelled, whole, recognised, and refused in a line where it is not."""

import json
import os
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
import zarr

import fractaljax as fj
from fractaljax._base.versions import versions
from fractaljax._sweep.blocks import blocks
from fractaljax._sweep.store import Store, axis_names, describe, leaf_names

ABOUT = {"key": "1", "axes": [["D", "2"]], "batch": 2, "arrays": [""]}
AXES = {"D": np.array([2.2, 2.4, 2.6]), "G": np.array([1e-11, 1e-10])}
SCENE = fj.brake_scene()


def opened(path, leaves=None, about=ABOUT):
    leaves = {"value": np.empty(())} if leaves is None else leaves
    return Store(path, about, SCENE, AXES, leaves, blocks((3, 2), 2))


def test_what_is_written_is_read(tmp_path):
    """To the last bit, whatever the dtype and shape, and in any order."""
    rng = np.random.default_rng(0)
    words = {f"leaf.{i}": np.empty(shape) for i, shape in enumerate([(), (3,), (2, 3), (0,), ()])}
    words |= {"i": np.empty((), np.int32), "b": np.empty(2, bool), "z": np.empty((), complex)}
    words |= {"u": np.empty((), np.uint8), "f": np.empty((), np.float32)}
    store = opened(tmp_path / "new" / "folder", words)
    arrays = [
        rng.integers(0, 256, (2, *leaf.shape, leaf.itemsize), np.uint8).view(leaf.dtype)[..., 0]
        if leaf.dtype != bool
        else rng.random((2, *leaf.shape)) > 0.5
        for leaf in words.values()
    ]
    # Two that Zarr would take for the fill value.
    arrays[0] = np.array([-np.nan, np.nan])
    arrays[4] = np.array([0x7FF8000000000001, 0xFFF8000000000002], np.uint64).view(float)
    arrays = [array[None] for array in arrays]  # of a block (1, 2)
    assert store.there() == set()
    store.write(2, arrays)
    again = opened(tmp_path / "new" / "folder", words)
    assert store.there() == again.there() == {2}
    for found, given in zip(again.read(2), arrays, strict=True):
        assert (found.dtype, found.shape) == (given.dtype, given.shape)
        assert found.tobytes() == given.tobytes()
    assert describe(tmp_path / "new" / "folder") == ABOUT | {
        "names": [*words],
        "versions": versions(),
    }
    assert describe(tmp_path) is None


def test_xarray_opens_a_store_that_is_not_finished(tmp_path):
    """What is not there yet is told from a NaN, and whole numbers stay whole."""
    leaves = {"growth": np.empty(()), "count": np.empty((), np.int32), "s": np.empty(4, complex)}
    arrays = [np.array([np.nan, 7.0]), np.array([3, 0], np.int32), np.ones((2, 4)) + 1j]
    opened(tmp_path / "run.zarr", leaves).write(1, [array[None] for array in arrays])
    data = xarray.open_zarr(tmp_path / "run.zarr")
    assert data.growth.dims == data.computed.dims == ("D", "G")
    assert data.s.dims == ("D", "G", "s_0") and data["count"].dtype == np.int32
    for name, (unit, meaning) in {"D": ("-", "fractal dim"), "G": ("m", "fractal rough")}.items():
        np.testing.assert_array_equal(data[name], AXES[name])
        assert data[name].attrs["units"] == unit and meaning in data[name].attrs["long_name"]
    assert data.growth.sel(D=2.41, G=9e-11, method="nearest") == 7
    assert np.isnan(data.growth).sum() == 5
    np.testing.assert_array_equal(data.computed != 0, [[False] * 2, [True] * 2, [False] * 2])
    assert int(data["count"].where(data.computed > 0).count()) == 2
    assert "0: not computed yet" in data.computed.attrs["long_name"]


def test_names_of_arrays():
    def measure(scene):
        return {"a/b": 1, "D": 2, "computed": 3, "c": (4, [5]), "C": 6}

    assert axis_names({"K_t/K_n": 0, "left.D": 0}) == ["K_t_over_K_n", "left.D"]
    named = leaf_names(measure, measure(None), {"D": 0})
    assert named == ["C", "D_", "a_over_b", "c.0", "c.1.0", "computed_"]
    assert leaf_names(fj.growth_rate, 0, {}) == ["growth_rate"]
    assert leaf_names(jax.jit(fj.growth_rate), 0, {}) == ["growth_rate"]
    assert leaf_names(lambda scene: 1, 0, {}) == leaf_names(SCENE, 0, {}) == ["value"]
    assert leaf_names(measure, 0, {"measure": 0}) == ["measure_"]


def test_a_ratio_is_no_group(tmp_path):
    axes = {"K_t/K_n": [0.2, 0.4], "V": [0.1]}
    found = fj.sweep(fj.stiffness, SCENE, None, False, tmp_path / "run.zarr", **axes)
    data = xarray.open_zarr(tmp_path / "run.zarr").drop_vars("computed")
    assert data["0"].dims == ("K_t_over_K_n", "V")
    assert data.K_t_over_K_n.attrs == {"long_name": "stiffness ratio K_t/K_n", "units": "-"}
    xarray.testing.assert_equal(data, found.to_xarray().rename({"K_t/K_n": "K_t_over_K_n"}))


@pytest.mark.parametrize("name", ["thesis.tex", "sweep.json"])  # and shards of an earlier build
def test_a_folder_with_other_files(tmp_path, name):
    (tmp_path / name).write_text("{}")
    with pytest.raises(ValueError, match="out must be an empty folder or that of this sweep, got"):
        opened(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert not list(tmp_path.parent.glob(f".{tmp_path.name}-*"))


def test_a_sweep_killed_before_its_store_was_there(tmp_path):
    (tmp_path / ".run.zarr-1a2b3c4d" / "D").mkdir(parents=True)
    opened(tmp_path / "run.zarr").write(0, [np.arange(2.0)[None]])
    (tmp_path / "run.zarr" / "value" / "c.1.0a1b2c3d.partial").write_bytes(b"half")
    assert opened(tmp_path / "run.zarr").there() == {0}


def test_two_processes_begin_at_once(tmp_path, monkeypatch):
    """The slower one finds the store of the faster one in its place."""
    rename = os.rename

    def slower(start, end):
        shutil.copytree(start, end)
        opened(end).write(1, [np.arange(2.0)[None]])
        rename(start, end)

    monkeypatch.setattr(os, "rename", slower)
    assert opened(tmp_path / "run.zarr").there() == {1}
    assert [file.name for file in tmp_path.iterdir()] == ["run.zarr"]


OTHERS = [b"", b"[1]", b"{}", b'{"attributes": {"fractaljax": {"key": 1}}}', b"\xff\xfe"]
NO_BATCH = ABOUT | {"names": ["value"], "versions": {}, "batch": "two"}
OTHERS.append(json.dumps({"attributes": {"fractaljax": NO_BATCH}}).encode())


@pytest.mark.parametrize("content", [*OTHERS, b"[" * 9999, b'{"attributes": {"fractaljax": 3}}'])
def test_a_store_of_something_else(tmp_path, content):
    (tmp_path / "zarr.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"zarr\.json does not describe a sweep: "):
        opened(tmp_path)
    zarr.open_group(tmp_path / "other.zarr", mode="w")
    with pytest.raises(ValueError, match=r"zarr\.json does not describe a sweep: "):
        describe(tmp_path / "other.zarr")


def test_no_damaged_batch_is_read(tmp_path):
    """Cut short, gone, or with one bit flipped anywhere."""
    store = opened(tmp_path / "run.zarr")
    store.write(0, [np.arange(2.0)[None]])
    mark = tmp_path / "run.zarr" / "computed" / "c.0.0"
    for file in (tmp_path / "run.zarr" / "value" / "c.0.0", mark):
        content = file.read_bytes()
        damaged = [content[:cut] for cut in (0, 10, -1)]
        for place in range(len(content)):
            flipped = bytearray(content)
            flipped[place] ^= 1 << place % 8
            damaged.append(bytes(flipped))
        for bad in damaged:
            file.write_bytes(bad)
            with pytest.raises(ValueError, match=r"batch 0 .* remove .*computed.c\.0\.0 and sweep"):
                store.read(0)
        if file == mark:
            with pytest.raises(ValueError, match=r"batch 0 of .*run\.zarr cannot be read, remove"):
                store.there()
        file.unlink()
        with pytest.raises(ValueError, match="it is damaged, or no batch of this sweep"):
            store.read(0)
        file.write_bytes(content)
    np.testing.assert_array_equal(store.read(0)[0], np.arange(2.0)[None])
    (tmp_path / "run.zarr" / "value" / "zarr.json").write_text("{")
    with pytest.raises(ValueError, match=r"out .*run\.zarr cannot be read: "):
        opened(tmp_path / "run.zarr")


def test_batches_stay_in_their_place_and_sweep(tmp_path):
    one, two = (opened(tmp_path / name, about=ABOUT | {"key": name}) for name in "12")
    one.write(0, [np.arange(2.0)[None]])
    for to, k, folder in [(two, 0, "2"), (one, 1, "1")]:
        for array in ("value", "computed"):
            shutil.copy(tmp_path / "1" / array / "c.0.0", tmp_path / folder / array / f"c.{k}.0")
        with pytest.raises(ValueError, match="it is damaged, or no batch of this sweep"):
            to.read(k)


def test_signs_of_zero_are_other_axes(tmp_path):
    scene = SCENE.replace(contact=fj.FixedContact(K_n=1e8, K_t=1e7))
    fj.sweep(fj.growth_rate, scene, None, False, tmp_path, K_t=[0.0])
    with pytest.raises(ValueError, match="holds another sweep: axes differ"):
        fj.sweep(fj.growth_rate, scene, None, False, tmp_path, K_t=[-0.0])


def test_what_cannot_be_kept_is_refused(tmp_path, monkeypatch):
    """Numbers that NumPy has not, an address, and anything without zarr; nothing is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="out cannot keep value, which is of dtype bfloat16"):
        opened(tmp_path / "run.zarr", {"value": jax.ShapeDtypeStruct((), jnp.bfloat16)})
    with pytest.raises(ValueError, match="out must be a folder of this machine, got s3://bucket/a"):
        fj.sweep(fj.growth_rate, SCENE, None, False, "s3://bucket/a", D=[2.4])
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r'^out needs zarr: .* install "fractaljax\[sweep\]"$'):
        fj.sweep(fj.growth_rate, SCENE, None, False, tmp_path, D=[2.4])
    fj.sweep(fj.growth_rate, SCENE, None, False, D=[2.4])
    assert not list(tmp_path.iterdir())


def test_attributes_are_those_of_the_sweep(tmp_path):
    opened(tmp_path)
    found = json.loads((tmp_path / "zarr.json").read_text())
    assert found["attributes"]["title"] == "a sweep over D, G"
    assert found["attributes"]["fractaljax"]["versions"] == versions()
