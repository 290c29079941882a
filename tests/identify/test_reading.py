"""Measurements from plain text, arrays and instrument files, in metres."""

import io
import os
import re
import sys
import warnings
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest

import fractaljax as fj
import instrument_files as files
from fractaljax._identify.files import read_measurement
from fractaljax._identify.grid import equal_steps, map_on_grid
from fractaljax._identify.instrument_file import _channel
from fractaljax._identify.measurement import measurement
from fractaljax._identify.units import metres
from tools import refusals

NAN, NUMBER = np.nan, r"[-+]?(\d+\.?\d*|\.\d+)(e-?\d+)?"
U, UM = {"unit": "um"}, {"unit": "um", "dx": 1e-6}
DX, DY, STEP = 2.5e-7, 4e-7, 2.0**-31  # half a nanometre: 16-bit heights are exact


def npy(array) -> bytes:
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def npz(**members: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        for name, member in members.items():
            file.writestr(f"{name}.npy", member)
    return content.getvalue()


def heights(shape=(5, 4)):
    """Whole numbers of steps, two of them missing, nothing symmetric."""
    z = STEP * np.round(900 * np.sin(1.7 * np.arange(shape[0] * shape[1])).reshape(shape))
    z[1, 2] = z[3, 0] = NAN
    return z


def assert_refused(path, content, message, **given):
    """One line that names the file."""
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as caught:
        read_measurement(path, **given)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


PROFILE = [1.5, -2.0, NAN, 4e-3]
Z = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, NAN, 7.0, 8.0]])
W = np.array([[1, -2, 0], [1.5, -3, 1], [3, -6, 2], [2, 5, 3]])
GWYDDION = (
    "# Channel: a\n# {}: 4 µm\n# {}: 3000 nm\n# Value units: m\n1 1.5 3 2\n-2 -3 -6 5\n0 1 2 3"
)
READ = [
    ("a.csv", "0,1.5\n0.5,-2\n1,\n1.5,4e-3\n", U, PROFILE, 5e-7, None),
    ("a.csv", "0;1,5\n0,5;-2\n1;\n1,5;4e-3\n", U, PROFILE, 5e-7, None),
    ("a.csv", "0;1.5;\r\n0.5;-2;\r\n1; ;\r\n1.5;4E-3;", U, PROFILE, 5e-7, None),
    ("a.tsv", "0\t1,5\t\n0,5\t-2\t\n1\t\t\n1,5\t0,004\t\n", U, PROFILE, 5e-7, None),
    ("a.dat", "  0  1.5\n 0.5 -2\n 1  ***\n 1.5 4e-3\n\n\n", U, PROFILE, 5e-7, None),
    ("a.TXT", "0 1,5\n0,5 -2\n1 n/a\n1,5 0,004\n", U, PROFILE, 5e-7, None),
    ("a.csv", '"x","z"\n0, 1.5\n0.5, -2.0\n1.0, NaN\n1.5, 4e-3\n', U, PROFILE, 5e-7, None),
    ("a.csv", "# a\nx;z\n\n0;1,5\n# b\n0,5;-2\n\n1;bad\n1,5;0,004\n", U, PROFILE, 5e-7, None),
    ("a.csv", "1.5,4e-3\n1,\n0.5,-2\n0,1.5\n", U, PROFILE, 5e-7, None),
    ("a.csv", "0,1\n2,5\n4,0\n10,1\n", U, [1, 5, 0, NAN, NAN, 1], 2e-6, None),
    ("a.csv", "h\n1\n\n3.5\n\n", UM, [1, NAN, 3.5], 1e-6, None),
    ("a.csv", "0,0012\n0,13\n", UM, [0.0012, 0.13], 1e-6, None),
    ("a.csv", "x [um],z [nm]\n0,1500\n0.5,2000\n", {}, [1.5, 2], 5e-7, None),
    ("a.csv", '"x (µm)","z (nm)"\n0,1500\n0.5,2000\n', {}, [1.5, 2], 5e-7, None),
    ("a.csv", "# x [um], z [nm]\n0,1500\n0.5,2000\n", {}, [1.5, 2], 5e-7, None),
    ("a.csv", "Scan of 3 March (pad)\nx_mm,z_um\n0,1\n1,2\n", {}, [1, 2], 1e-3, None),
    ("a.csv", "position,height\nmm,µm\n0,1\n1,2\n", {}, [1, 2], 1e-3, None),
    ("a.csv", "Lateral um,Raw Micrometer,\n0.0,-0.5,,\n0.2,0.25,,\n", {}, [-0.5, 0.25], 2e-7, None),
    ("a.csv", "lengths [mm]\nx,z\n0,1\n1,2\n", {}, [1e3, 2e3], 1e-3, None),
    ("a.csv", "x [um],z\n0,1\n2,5\n", U, [1, 5], 2e-6, None),
    ("a.txt", "x z[um]\n0 1\n1 2\n", {"position_unit": "mm"}, [1, 2], 1e-3, None),
    ("a.csv", "1,2,3,4\n5,,7,8\n", UM | {"dy": 2e-6}, Z.T, 1e-6, 2e-6),
    ("a.csv", "# z [um]\n1,2,3,4\n5,,7,8\n", {"dx": 1e-6}, Z.T, 1e-6, 1e-6),
    ("a.xyz", "0 0 1\n0 2 2\n1 0 3\n1 2 4\n", U, [[1, 2], [3, 4]], 1e-6, 2e-6),
    ("a.npy", npy(Z), UM | {"dy": 2e-6}, Z, 1e-6, 2e-6),
    ("a.npy", npy(np.arange(4, dtype=">i2")), UM, np.arange(4), 1e-6, None),
    ("a.npz", npz(z=npy(1e-6 * Z), dx=npy(1e-6), dy=npy(2e-6)), {}, Z, 1e-6, 2e-6),
    ("gwyddion.txt", GWYDDION.format("Width", "Height"), {}, 1e6 * W, 1e-6, 1e-6),
    ("gwyddion.txt", GWYDDION.format("Breite", "Höhe"), {"channel": 0}, 1e6 * W, 1e-6, 1e-6),
    ("map.bcr", files.bcr(heights(), DX, DY, STEP), {}, 1e6 * heights(), DX, DY),
    ("scan.dat", files.bcr(heights(), DX, DY, STEP), {}, 1e6 * heights(), DX, DY),
    ("map.x3p", files.x3p(heights(), DX, DY), {"dx": DX, "unit": "m"}, 1e6 * heights(), DX, DY),
    ("map.data", files.x3p(heights(), DX, DY), {}, 1e6 * heights(), DX, DY),
]  # fmt: skip


def without_bytes(value):
    """A test's name for pytest: not of an archive's bytes, which hold the time it was written."""
    return "" if isinstance(value, bytes) else None


@pytest.mark.parametrize(("name", "content", "given", "z", "dx", "dy"), READ, ids=without_bytes)
def test_read(tmp_path, name, content, given, z, dx, dy):
    """Heights in micrometres: separators, decimal signs, gaps, comments, titles, shapes, units."""
    path = tmp_path / name
    encodings = ("utf-8", "utf-16", "latin-1") if "gwy" not in name else ("utf-8",)
    for encoding in encodings if isinstance(content, str) else [""]:
        path.write_bytes(content.encode(encoding) if isinstance(content, str) else content)
        read = read_measurement(path, **given)
        np.testing.assert_allclose(read.z, 1e-6 * np.asarray(z), rtol=1e-12, atol=1e-24)
        assert read.dx == pytest.approx(dx, rel=1e-12)
        assert read.dy == (dy if dy is None else pytest.approx(dy, rel=1e-12))
        assert read.source.startswith(f"{name}: ") and read.resolution is None
        assert read.missing == np.isnan(np.asarray(z, float)).sum()


X3P, BCR = files.x3p(heights(), DX, DY), files.bcr(heights(), DX, DY, STEP)
NOISE, TENTH = bytes(range(251)) * 8, npy(np.array(1e-6))
LOCKED = npz(z=npy(np.ones(5)), dx=TENTH).replace(
    b"PK\x01\x02\x14\x03\x14\0\0", b"PK\x01\x02\x14\x03\x14\0\1"
)
HUGE = npy(np.zeros(3)).replace(b"(3,), }" + b" " * 12, b"(3000000000000,), }")
REFUSED = [
    # What is not known, or contradicted.
    ("a.csv", "1\n2\n", {"dx": 1}, r"in which unit heights are: give it \(--unit um\)"),
    ("a.csv", "1\n2\n", U, "the step between heights is not known"),
    ("a.csv", "x,z [um]\n0,1\n1,2\n", {}, r"unit positions are: give it \(--position-unit um"),
    ("a.csv", "x [um],z [V]\n0,1\n1,2\n", {}, "unit of heights must be one of .* got 'V'"),
    ("a.csv", "z [um]\n1\n2\n", {"dx": 1, "unit": "nm"}, "unit of heights is 1e-06 m in the f"),
    ("a.csv", "0,1\n1,2\n", {"unit": "m", "dx": 2}, "dx is 1 m in the file, got 2"),
    ("a.csv", "0,1\n1,2\n", {"unit": "m", "dy": 2}, "dy is for maps"),
    ("a.csv", "0,1\n1,2\n", {"unit": "m", "channel": 1}, "no channels, got channel 1"),
    ("a.npz", npz(h=npy(Z)), {}, "must hold z and dx in metres, got h"),
    ("a.npz", npz(z=npy(Z), dx=npy(np.ones(2))), {}, r"dx must be a number, got shape \(2,\)"),
    ("a.npz", npz(z=npy(Z), dx=TENTH), U, "the unit of heights is 1 m in the file"),
    ("map.x3p", X3P, {"dx": 1e-6}, r"dx is 2.5e-07 m in the file, got 1e-06"),
    # Positions.
    ("a.csv", "0,1\n,2\n2,3\n", {"unit": "m"}, "positions must not have gaps"),
    ("a.csv", "0,1\n1,2\n4,3\n9,4\n", {"unit": "m"}, "not equidistant"),
    ("a.csv", "0,12\n0,13\n", {"unit": "m"}, "decimal commas need semicolons"),
    # Text that is not plain numbers.
    ("a.csv", "", {}, "no line of numbers"),
    ("a.csv", "1,2\n3\n", {}, "line 2 has 1 columns, the first one has 2"),
    ("a.csv", "# a\nx,z\n1,2\n3,4,5\n", {}, "line 4 has 3 columns, the first one has 2"),
    ("a.csv", "1,2\n3,abc\n5,6\n", {}, "line 2: 'abc' is not a number"),
    ("a.csv", "0;1\n1;1.0D6\n", {}, "line 2: '1.0D6' is not a number"),
    ("a.csv", "0 1\n1 1_000\n", {}, "line 2: '1_000' is not a number"),
    ("a.csv", "0 1\n1 \u0661\n", {}, "line 2: '\u0661' is not a number"),
    ("a.csv", '0,1\n1,"2\n', {}, "line 2: '\"2' is not a number"),
    ("a.csv", "1,234.5\n2,034.5\n", {}, "line 2: '034.5' is not a number"),
    ("a.csv", "0,1\n1,1e400\n", {}, "line 2: '1e400' is too large"),
    ("a.csv", "0;1,5\n1;2.5\n", {}, "mixes decimal points and decimal commas"),
    ("a.csv", "x,z\n0,1.2x\n1,2\n", {}, "line 2 is neither a title nor numbers: '0,1.2x'"),
    ("a.csv", "1," * 2**22 + "1", {}, "line 1 is longer than 8388608 characters"),
    ("zero.txt", "1 2 3 4\n" * 4 + "1.\0 2 3 4\n", {}, "it is plain text"),
    ("columns.prf", "0 1\n1e-7 2\n2e-7 1\n" * 9, {"unit": "m"}, "it is plain text: save"),
    # Damaged, too large or unknown.
    ("a.npy", npy(Z + 0j), UM, "z must be real numbers, got complex128"),
    ("a.npy", HUGE, UM, "24000000000000 bytes were to follow its header, 24 do"),
    ("a.npy", npy(np.ones(5)) + b"\0", UM, "40 bytes were to follow its header, 41 do"),
    ("b.npz", b"no zip", {}, "no sound file of numbers from NumPy"),
    ("huge.npz", npz(z=HUGE, dx=TENTH), {}, "24000000000000 bytes were to follow"),
    ("bomb.npz", npz(z=npy(np.zeros(2**22)), dx=TENTH), {}, "it unpacks to 33554"),
    ("cut.npz", npz(z=npy(np.ones(500)), dx=TENTH)[:300], {}, "not a zip file"),
    ("locked.npz", LOCKED, {}, "is encrypted"),
    ("long.csv", "1\n" * 2**20, {}, "it is too large: at most 1 MiB are read"),
    ("long.sur", "1\n" * 2**20, {}, "it is too large: at most 1 MiB are read"),
    ("bomb.x3p", npz(z=npy(np.zeros(2**22))), {}, "it unpacks to 33554"),
    ("map.x3p", X3P, {"limits": fj.FileLimits(heights=19)}, "it holds 20 heights, at most 19 are"),
    ("noise.x3p", NOISE, {}, "unknown to SurfaceTopography .*, or damaged"),
    ("square", bytes(2 * 64**2), {}, "no known format"),
    ("cut.x3p", X3P[:500], {}, "unknown to SurfaceTopography .*, or damaged"),
    ("cut.bcr", BCR[:-7], {}, "cannot be read: The file ended after 33 of 40 bytes"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "given", "message"), REFUSED, ids=without_bytes)
def test_refused(tmp_path, capsys, name, content, given, message):
    """One line that says what to do, no memory taken for what a file only claims to hold."""
    if "1 MiB" in message or "unpacks" in message:
        given = {**given, "limits": fj.FileLimits(text=2**20, arrays=2**20, instrument=2**20)}
    assert_refused(tmp_path / name, content, message, **given)
    assert capsys.readouterr() == ("", "")


def test_what_cannot_be_read(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError):
        read_measurement(tmp_path / "nowhere.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "folder.csv").mkdir()
    for name in ("pipe.csv", "folder.csv"):
        assert_refused(tmp_path / name, None, "it is not a regular file")
    monkeypatch.setitem(sys.modules, "SurfaceTopography", None)
    assert_refused(tmp_path / "map.x3p", X3P, r'pip install "fractaljax\[formats\]"')


def test_random_damage(tmp_path):
    """Bytes changed, lost and put in: an error in one line, or numbers that are in the file."""
    rng, path, refused = np.random.default_rng(0), tmp_path / "a.csv", 0
    rows = "".join(f"{i / 2},{h:.6g}\n" for i, h in enumerate(np.cumsum(rng.normal(size=40))))
    for trial in range(120):
        content = bytearray(f"x[um],z[nm]\n{rows}".encode())
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
        path.write_bytes(content)
        try:
            read = read_measurement(path)
        except ValueError as error:
            refused += 1
            assert "\n" not in str(error)
            continue
        cells = re.split(r"[\r\n,]", content.decode("latin-1"))
        numbers = np.array([float(cell) for cell in cells if re.fullmatch(NUMBER, cell)])
        for height in read.z[~np.isnan(read.z)]:
            assert np.isclose(height, 1e-9 * numbers, rtol=1e-12, atol=0).any()
    assert refused > 40


@pytest.mark.parametrize(
    ("channel", "factor"), [(None, 1), ("Height", 1), ("Retrace", 2), (1, 2), ("1", 2)]
)
def test_channels(tmp_path, channel, factor):
    """The first with heights, or by name or number."""
    z = np.nan_to_num(heights())
    channels = {"Phase": (z, DX, DY, "deg"), "Height": (z, DX, DY, "m")}
    channels |= {"Retrace": (2 * z, DX, DY, "m")}
    path = tmp_path / "scan.gwy"
    path.write_bytes(files.gwy(channels))
    read = read_measurement(path, channel=channel)
    np.testing.assert_allclose(read.z, factor * z, rtol=1e-15)
    assert ("'Height'" if factor == 1 else "'Retrace'") in read.source
    said = r"no channel 'Phase'; channels are 0 'Height', 1 'R"
    assert_refused(path, None, said, channel="Phase")


def test_channels_without_heights():
    """Never the default, and refused by name."""
    phase, height = (
        SimpleNamespace(index=i, name=name, channel_id=name, is_height_channel=i > 0, data_unit="x")
        for i, name in enumerate(["Phase", "Height"])
    )
    assert _channel([phase, height], phase, None) is height
    with pytest.raises(ValueError, match=r"'Phase' holds x, not heights"):
        _channel([phase, height], phase, "Phase")
    with pytest.raises(ValueError, match=r"no channel holds heights; channels are 0 'Phase'"):
        _channel([phase], phase, None)


@pytest.fixture(scope="module")
def package():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import SurfaceTopography
    return SurfaceTopography


def test_line_scans_and_instrument_limits(tmp_path, package):
    """Equal steps, steps equal up to a left-out point, unequal ones; resolution and tip radius."""
    x, z = np.arange(20) * 0.5, np.cos(np.arange(20.0))
    parameters = {
        "resolution": {"value": 0.3, "unit": "µm"},
        "tip_radius": {"value": 40, "unit": "nm"},
    }
    info = {"instrument": {"name": "Stylus", "parameters": parameters}}
    path = tmp_path / "scan.nc"
    package.UniformLineScan(z, 10.0, unit="µm", info=info).to_netcdf(str(path))
    read = read_measurement(path)
    np.testing.assert_allclose(read.z, z * 1e-6, rtol=1e-14)
    assert read.dx == pytest.approx(0.5e-6, rel=1e-14) and read.dy is None
    assert read.resolution == pytest.approx(0.3e-6) and read.stylus_radius == pytest.approx(40e-9)
    assert "Stylus" in read.source

    keep = x != 3.5
    package.NonuniformLineScan(x[keep], z[keep], unit="nm").to_netcdf(str(path))
    read = read_measurement(path)
    np.testing.assert_allclose(read.z, np.where(keep, z * 1e-9, NAN), rtol=1e-12)
    package.NonuniformLineScan(x**2, z, unit="nm").to_netcdf(str(path))
    assert_refused(path, None, "positions are not equidistant")


def kept(n, *out):
    return np.delete(np.arange(n), out)


EVERY = np.arange(64)
STEPS = [
    # As a stylus instrument writes them: 0.1 um at steps of 0.156 um.
    (np.round(0.15625 * np.arange(9600), 1), 0.15625, np.arange(9600)),
    (np.round(0.0999 * np.arange(300), 1), 0.0999, np.arange(300)),
    (np.round(0.13 * EVERY, 1), 0.13, EVERY),
    (np.round(0.00737 * np.arange(100_001), 3), 0.00737, np.arange(100_001)),
    # Points left out, also of rounded positions.
    (0.1 * kept(400, 7, 100, 101, 350), 0.1, kept(400, 7, 100, 101, 350)),
    (np.round(0.0123 * kept(1000, 5, 6, 7, 400), 3), 0.0123, kept(1000, 5, 6, 7, 400)),
]


@pytest.mark.parametrize(("x", "dx", "k"), STEPS)
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_equal_steps(x, dx, k, unit):
    step, found = equal_steps(x * unit)
    assert step == pytest.approx(dx * unit, rel=max(0.1 / x.size / dx, 1e-6))
    np.testing.assert_array_equal(found, k)


test_unequal_steps = refusals(
    [
        ([0.0], "at least 2 positions, got 1"),
        ([0.0, 1.0, 1.0, 2.0], "positions must rise or fall throughout, got 1 and then 1 m"),
        ([0.0, 1.0, 0.5, 2.0], "positions must rise or fall throughout, got 1 and then 0.5 m"),
        (np.arange(9.0) ** 2, "positions are not equidistant, steps are 1 to 15 m: resample"),
        ([0.0, 1.0, 2.0, 2.8, 4.0], "positions are not equidistant"),
        (np.sort(np.random.default_rng(0).choice(2000, 400, replace=False)) * 0.1, "equidistant"),
    ],
    lambda x: equal_steps(np.array(x)),
)


def test_map_of_points_in_any_order():
    """x first or y first, one point missing, positions that jitter; and points on no grid."""
    z = np.arange(20.0).reshape(5, 4)
    z[1, 2] = NAN
    x, y = np.meshgrid(0.2 * np.arange(5), 7.0 + 0.3 * np.arange(4), indexing="ij")
    random = np.random.default_rng(0)
    x, y = (axis + 1e-3 * random.uniform(size=axis.shape) for axis in (x, y))
    for x_first in (False, True):
        points = np.stack([(axis.T if x_first else axis).ravel() for axis in (x, y, z)])
        found, dx, dy = map_on_grid(*points[:, np.isfinite(points[2])])
        np.testing.assert_array_equal(found, z)
        assert (dx, dy) == pytest.approx((0.2, 0.3), rel=5e-3)
    line = np.arange(9.0)
    square = np.array([0.0, 0, 1, 1]), np.array([0.0, 0, 1, 0]), np.ones(4)
    for points, message in [
        (random.uniform(size=(3, 50)), "equidistant"),
        ((line, line, line), "not on a rectangular grid: 9 of 9 x 9"),
        (square, "two points have the same position"),
    ]:
        with pytest.raises(ValueError, match=message):
            map_on_grid(*points)


def test_measurement_and_units():
    """A map without dy has dx; one line of a map is a profile; all gaps are counted."""
    z = np.ones((3, 4))
    z[0, 0], z[0, 1] = NAN, np.inf
    read = measurement(z, 1e-6, None, "a.npy", resolution=2e-6)
    assert (read.dx, read.dy, read.missing, read.stylus_radius) == (1e-6, 1e-6, 2, None)
    assert repr(read) == (
        "Measurement(map of 3 x 4 heights, 2 missing, dx = 1e-06 m, dy = 1e-06 m,"
        " resolution = 2e-06 m, from a.npy)"
    )
    for line, n, dx in ((z[:, :1], 3, 1e-6), (z[:1], 4, 3e-6)):
        read = measurement(line, 1e-6, 3e-6, "")
        assert (read.z.shape, read.dx, read.dy) == ((n,), dx, None)
    found = [
        metres(unit) for unit in ["m", "cm", "mm", "um", "µm", "μm", "Micron", " nm ", "pm", "Å"]
    ]
    assert found == [1.0, 1e-2, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6, 1e-9, 1e-12, 1e-10]
    for unknown in ["V", "Mm", "", "MM"]:
        with pytest.raises(ValueError, match=r"the unit must be one of m, cm, mm, um, .* got '"):
            metres(unknown)


test_measurement_refused = refusals(
    [
        (np.ones(9), None, None, r"the step between heights is not known: give dx in metres"),
        (np.ones(9), NAN, None, "dx must be above 0 and finite, in m, got nan"),
        (np.ones((9, 9)), 1.0, 0.0, "dy must be above 0 and finite, in m, got 0"),
        (np.ones(9), 1.0, 2.0, "dy is for maps, got 2 for a profile"),
        (np.ones((2, 2, 2)), 1.0, None, r"of shape \(n,\) or \(n, m\), got \(2, 2, 2\)"),
        (np.full(9, NAN), 1.0, None, "there are no heights in it"),
    ],
    lambda z, dx, dy: measurement(z, dx, dy, ""),
)
