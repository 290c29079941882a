"""Texts and NumPy's files as measurements, in metres."""

import numpy as np
import pytest

from fractaljax.measured.files import read_measurement

Z = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, np.nan, 7.0, 8.0]])


def written(folder, name, content):
    """The path of a file with a text, bytes or arrays."""
    path = folder / name
    if name.endswith(".npy"):
        np.save(path, content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


CASES = [
    ("a.csv", "1.5\n2\n", {"unit": "nm", "dx": 1e-6}, [1.5e-9, 2e-9], 1e-6, None),
    ("a.csv", "z [nm]\n1.5\n2\n", {"dx": 1e-6}, [1.5e-9, 2e-9], 1e-6, None),
    ("a.csv", "x [um],z [nm]\n0,1\n0.5,2\n1,\n", {}, [1e-9, 2e-9, np.nan], 0.5e-6, None),
    ("a.csv", "x [um],z\n0,1\n2,5\n", {"unit": "nm"}, [1e-9, 5e-9], 2e-6, None),
    ("a.txt", "0;1,5\n1;2,5\n", {"unit": "um"}, [1.5e-6, 2.5e-6], 1e-6, None),
    ("a.tsv", "3\t1\n2\t2\n0\t4\n", {"unit": "nm", "position_unit": "um"}, None, 1e-6, None),
    ("a.DAT", "x z[nm]\n0 1\n1 2\n", {"position_unit": "mm"}, [1e-9, 2e-9], 1e-3, None),
    ("a.csv", "1,2,3,4\n5,,7,8\n", {"unit": "um", "dx": 1e-6, "dy": 2e-6}, Z.T, 1e-6, 2e-6),
    (
        "a.xyz",
        "0 0 1\n0 2 2\n1 0 3\n1 2 4\n",
        {"unit": "um"},
        Z.ravel()[:4].reshape(2, 2),
        1e-6,
        2e-6,
    ),
    ("a.npy", Z, {"unit": "um", "dx": 1e-6, "dy": 2e-6}, Z, 1e-6, 2e-6),
    ("a.npy", np.arange(4, dtype="i2"), {"unit": "m", "dx": 1}, 1e6 * np.arange(4), 1.0, None),
    ("a.npz", {"z": 1e-6 * Z, "dx": 1e-6, "dy": 2e-6}, {}, Z, 1e-6, 2e-6),
]


@pytest.mark.parametrize(("name", "content", "given", "z", "dx", "dy"), CASES)
def test_read(tmp_path, name, content, given, z, dx, dy):
    """One column, two, three, a map with lines along x, arrays; units from wherever they are."""
    read = read_measurement(written(tmp_path, name, content), **given)
    assert (read.dx, read.dy) == (pytest.approx(dx), dy if dy is None else pytest.approx(dy))
    if name == "a.tsv":
        z = [4e-9, np.nan, 2e-9, 1e-9]
    elif np.ndim(z) == 2 or name == "a.npy":
        z = 1e-6 * np.asarray(z)
    np.testing.assert_allclose(read.z, z, rtol=1e-12)
    assert read.source.startswith(f"{name}: ") and read.resolution is None


@pytest.mark.parametrize(
    ("name", "content", "given", "message"),
    [
        ("a.csv", "1\n2\n", {"dx": 1}, r"in which unit heights are: give it \(--unit um\)"),
        ("a.csv", "1\n2\n", {"unit": "um"}, "the step between heights is not known"),
        ("a.csv", "x,z [um]\n0,1\n1,2\n", {}, r"unit positions are: give it \(--position-unit um"),
        ("a.csv", "x [um],z [V]\n0,1\n1,2\n", {}, "unit of heights must be one of .* got 'V'"),
        ("a.csv", "x [s],z [um]\n0,1\n1,2\n", {}, "unit of positions must be one of .* got 's'"),
        ("a.csv", "z [um]\n1\n2\n", {"dx": 1, "unit": "nm"}, "unit of heights is 1e-06 m in the f"),
        ("a.csv", "0,1\n1,2\n", {"unit": "m", "dx": 2}, "dx is 1 m in the file, got 2"),
        ("a.csv", "0,1\n1,2\n", {"unit": "m", "dy": 2}, "dy is for maps"),
        ("a.csv", "0,1\n,2\n2,3\n", {"unit": "m"}, "positions must not have gaps"),
        ("a.csv", "0,1\n1,2\n4,3\n9,4\n", {"unit": "m"}, "not equidistant"),
        ("a.csv", "0,0012\n0,0013\n", {"unit": "m"}, "decimal commas need semicolons"),
        ("a.csv", "0,1\n1,2\n", {"unit": "m", "channel": 1}, "no channels, got channel 1"),
        ("a.csv", "words\n", {}, "no line of numbers"),
        ("a.npy", Z, {"dx": 1}, "in which unit heights are"),
        ("a.npy", Z + 0j, {"dx": 1, "unit": "m"}, "z must be real numbers, got complex128"),
        ("a.npy", np.array(["x"]), {"dx": 1, "unit": "m"}, "z must be real numbers, got <U1"),
        ("b.npz", b"no zip", {}, "no sound file of numbers from NumPy"),
        ("b.npz", b"", {}, "no sound file of numbers from NumPy"),
        ("a.npz", {"h": Z}, {}, "must hold z and dx in metres, got h"),
        ("a.npz", {"z": Z, "dx": [1.0, 2.0]}, {}, r"dx must be a number, got shape \(2,\)"),
        ("a.npz", {"z": Z, "dx": 1.0}, {"unit": "um"}, "the unit of heights is 1 m in the file"),
    ],
)
def test_refused(tmp_path, name, content, given, message):
    """One line that names the file and says what to give."""
    path = written(tmp_path, name, content)
    with pytest.raises(ValueError, match=message) as caught:
        read_measurement(path, **given)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_no_file(tmp_path):
    """The operating system's own words."""
    with pytest.raises(FileNotFoundError):
        read_measurement(tmp_path / "nowhere.csv")
    with pytest.raises(IsADirectoryError):
        read_measurement(tmp_path)
