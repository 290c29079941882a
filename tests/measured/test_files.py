"""Texts and NumPy's files as measurements, in metres."""

import io
import os
import threading
import warnings
import zipfile

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


def npy(array):
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def packed(**members):
    """An NPZ file with any bytes under the names z.npy, dx.npy, ..."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        for name, member in members.items():
            file.writestr(f"{name}.npy", member)
    return content.getvalue()


HUGE = npy(np.zeros(3)).replace(b"(3,), }" + b" " * 12, b"(3000000000000,), }")
STEP = npy(np.array(1e-6))
DAMAGED = {
    "huge.npy": (HUGE, "24000000000000 bytes were to follow its header, 24 do"),
    "long.npy": (npy(np.ones(5)) + b"\0", "40 bytes were to follow its header, 41 do"),
    "object.npy": (npy(np.array([1, None], object)), "z must be real numbers, got object"),
    "huge.npz": (packed(z=HUGE, dx=STEP), "24000000000000 bytes were to follow"),
    "bomb.npz": (packed(z=npy(np.zeros(2**22)), dx=STEP), "it unpacks to 33554"),
    "cut.npz": (packed(z=npy(np.ones(500)), dx=STEP)[:300], "not a zip file"),
    "locked.npz": (
        packed(z=npy(np.ones(5)), dx=STEP).replace(
            b"PK\x01\x02\x14\x03\x14\0\0", b"PK\x01\x02\x14\x03\x14\0\1"
        ),
        "is encrypted",
    ),
    "long.csv": (b"1\n" * 2**20, "it is too large: at most 1 MiB are read"),
    "long.sur": (b"1\n" * 2**20, "it is too large: at most 1 MiB are read"),
    "bomb.x3p": (packed(z=npy(np.zeros(2**22))), "it unpacks to 33554"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_and_huge_files(tmp_path, monkeypatch, name):
    """One line, and no memory taken for what a file only claims to hold."""
    for limit in ("files._MOST_TEXT", "files._MOST_ARRAYS", "files._MOST"):
        monkeypatch.setattr(f"fractaljax.measured.{limit}", 2**20)
    monkeypatch.setattr("fractaljax.measured.instrument_file._MOST_UNPACKED", 2**20)
    content, message = DAMAGED[name]
    path = written(tmp_path, name, np.zeros(0) if name.endswith(".npy") else content)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_measurement(path, dx=1e-6, unit="m")
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_two_arrays_of_one_name(tmp_path):
    content = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(content, "w") as file:
        warnings.simplefilter("ignore")
        for height in (1.0, 2.0):
            file.writestr("z.npy", npy(np.full(5, height)))
    path = written(tmp_path, "a.npz", content.getvalue())
    with pytest.raises(ValueError, match="two arrays of one name"):
        read_measurement(path)


def test_pipes_and_devices(tmp_path):
    """Read once and up to a limit, or refused before they are opened."""
    for suffix in (".csv", ".sur"):
        os.mkfifo(tmp_path / f"pipe{suffix}")
    sender = threading.Thread(target=(tmp_path / "pipe.csv").write_text, args=["1\n2\n"])
    sender.start()
    read = read_measurement(tmp_path / "pipe.csv", dx=1e-6, unit="m")
    sender.join()
    np.testing.assert_array_equal(read.z, [1, 2])
    for path in (tmp_path / "pipe.sur", "/dev/zero"):
        with pytest.raises(ValueError, match="it is no regular file"):
            read_measurement(path)


def test_random_damage(tmp_path):
    """Bytes changed, lost and put in: an error in a line, or numbers that are there."""
    rng = np.random.default_rng(0)
    z = np.cumsum(rng.standard_normal(40))
    text = "x[um],z[nm]\n" + "".join(f"{i / 2},{h:.6g}\n" for i, h in enumerate(z))
    sound = {"a.csv": text.encode(), "a.npy": npy(z), "a.npz": packed(z=npy(z), dx=STEP)}
    refused = 0
    for trial in range(300):
        name = [*sound][trial % 3]
        content = bytearray(sound[name])
        at = int(rng.integers(len(content)))
        match trial % 4:
            case 0:
                content[at] ^= 1 << int(rng.integers(8))
            case 1:
                del content[at : at + int(rng.integers(1, 9))]
            case 2:
                content[at:at] = [b"1e400", b",", b"\n", b"1.0D6", b'"'][rng.integers(5)]
            case 3:
                del content[at:]
        (tmp_path / name).write_bytes(content)
        given = {"dx": 1e-6, "unit": "m"} if name == "a.npy" else {}
        try:
            read = read_measurement(tmp_path / name, **given)
        except ValueError as error:
            refused += 1
            assert "\n" not in str(error)
            continue
        if name == "a.npz":
            np.testing.assert_array_equal(read.z, z)  # what a checksum guards
        elif name == "a.csv":
            lines = content.decode("latin-1").replace("\r", "\n").split("\n")
            cells = {line.split(",")[-1].strip().strip('"') for line in lines[1:]}
            heights = {h for h in read.z.tolist() if h == h}
            assert len(heights) <= len(lines) and all(
                any(abs(float(c) * 1e-9 - h) <= 1e-12 * abs(h) for c in cells if _is_number(c))
                for h in heights
            )
    assert refused > 120


def _is_number(cell):
    try:
        return float(cell) == float(cell)
    except ValueError:
        return False
