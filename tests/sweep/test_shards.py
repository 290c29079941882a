"""The files of a sweep: whole, recognised, and refused in a line where they are not."""

import numpy as np
import pytest

from fractaljax._base.versions import versions
from fractaljax._sweep.shards import Shards, describe

ABOUT = {"key": "1", "axes": {"D": [2.4]}, "batch": 4, "arrays": [""]}


def test_what_is_written_is_read(tmp_path):
    folder = tmp_path / "new" / "folder"
    shards = Shards(folder, ABOUT)
    arrays = [np.arange(3.0), np.ones((3, 2), np.int32), np.array([1j, 2, np.nan])]
    arrays += [np.array([float(i)]) for i in range(12)]  # more than ten keep their order
    assert not shards.has(7)
    shards.write(7, arrays)
    assert shards.has(7)
    for found, given in zip(Shards(folder, ABOUT).read(7), arrays, strict=True):
        np.testing.assert_array_equal(found, given)
        assert found.dtype == given.dtype
    assert describe(folder) == ABOUT | {"versions": versions()}
    assert describe(tmp_path) is None


def test_a_folder_with_other_files(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ValueError, match="out must be an empty folder or that of this sweep, got"):
        Shards(tmp_path, ABOUT)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_sweep_killed_before_it_was_described(tmp_path):
    (tmp_path / ".sweep.json-1a2b3c").write_text('{"key":')
    Shards(tmp_path, ABOUT).write(0, [np.arange(3.0)])
    assert Shards(tmp_path, ABOUT).has(0)


@pytest.mark.parametrize("content", [b"", b"[1]", b'{"key": 1}', b"\xff\xfe", b"[" * 9999])
def test_a_file_that_describes_no_sweep(tmp_path, content):
    (tmp_path / "sweep.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"sweep\.json does not describe a sweep: "):
        describe(tmp_path)


def test_no_damaged_batch_is_read(tmp_path):
    """Cut short, or with one bit flipped anywhere."""
    shards = Shards(tmp_path, ABOUT)
    shards.write(0, [np.arange(3.0)])
    file = tmp_path / "00000000.npz"
    content = file.read_bytes()
    damaged = [content[:cut] for cut in (0, 10, -1)]
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        damaged.append(bytes(flipped))
    for bad in damaged:
        file.write_bytes(bad)
        with pytest.raises(ValueError, match=r"00000000\.npz cannot be read, .* it is damaged"):
            shards.read(0)
    file.write_bytes(content)
    np.testing.assert_array_equal(shards.read(0)[0], np.arange(3.0))


def test_batches_stay_in_their_place_and_sweep(tmp_path):
    one, two = (Shards(tmp_path / name, ABOUT | {"key": name}) for name in "12")
    one.write(0, [np.arange(3.0)])
    for to, k in [(two, 0), (one, 1)]:
        to._file(k).write_bytes(one._file(0).read_bytes())
        with pytest.raises(ValueError, match="it is damaged, or no batch of this sweep"):
            to.read(k)


def test_signs_of_zero_are_other_axes(tmp_path):
    Shards(tmp_path, ABOUT | {"axes": {"K_t": [0.0]}})
    with pytest.raises(ValueError, match="holds another sweep: axes differ"):
        Shards(tmp_path, ABOUT | {"axes": {"K_t": [-0.0]}})
