"""Instruments' own files: heights, steps and units are those that were put in."""

import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import instrument_files as files
from fractaljax.measured.files import read_measurement
from fractaljax.measured.instrument_file import _channel

DX, DY = 2.5e-7, 4e-7
STEP = 2.0**-31  # half a nanometre: 16-bit heights are exact


def heights(shape=(5, 4)):
    """Whole numbers of steps, two of them missing, nothing symmetric."""
    z = STEP * np.round(900 * np.sin(1.7 * np.arange(shape[0] * shape[1])).reshape(shape))
    z[1, 2] = z[3, 0] = np.nan
    return z


WRITTEN = {
    "text.sdf": lambda z: files.sdf_text(z, DX, DY),
    "bytes.sdf": lambda z: files.sdf_binary(z, DX, DY, STEP),
    "map.bcr": lambda z: files.bcr(z, DX, DY, STEP),
    "map.x3p": lambda z: files.x3p(z, DX, DY),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_heights_steps_and_units(tmp_path, name):
    """Whatever unit the format has, metres come out, and gaps are NaN, to rounding."""
    (tmp_path / name).write_bytes(WRITTEN[name](heights()))
    read = read_measurement(tmp_path / name)
    np.testing.assert_allclose(read.z, heights(), rtol=1e-12, atol=1e-24)
    assert (read.dx, read.dy) == pytest.approx((DX, DY), rel=1e-12)
    assert read.missing == 2 and read.source.startswith(f"{name}: ")


def test_content_tells_the_format_and_the_file_its_instrument(tmp_path):
    """A suffix that says nothing is no obstacle; who measured is in the words."""
    (tmp_path / "scan.data").write_bytes(files.x3p(heights(), DX, DY))
    read = read_measurement(tmp_path / "scan.data")
    assert read.z.shape == (5, 4) and "Test" in read.source and "Profiler" in read.source
    (tmp_path / "scan.dat").write_bytes(files.bcr(heights(), DX, DY, STEP))
    assert "BCR-STM" in read_measurement(tmp_path / "scan.dat").source


def test_what_the_file_says_is_not_contradicted(tmp_path):
    """The same step and unit are welcome, others refused."""
    path = tmp_path / "map.x3p"
    path.write_bytes(files.x3p(heights(), DX, DY))
    assert read_measurement(path, dx=DX, dy=DY, unit="m").dx == DX
    for given, message in [
        ({"dx": 1e-6}, r"map.x3p: dx is 2.5e-07 m in the file, got 1e-06"),
        ({"dy": 1e-6}, r"dy is 4e-07 m in the file, got 1e-06"),
        ({"unit": "um"}, r"the unit of heights is 1 m in the file, got 1e-06"),
    ]:
        with pytest.raises(ValueError, match=message):
            read_measurement(path, **given)


@pytest.fixture
def two_channels(tmp_path):
    """Phase, which the reader leaves out, before height, and another height."""
    z = np.nan_to_num(heights())
    channels = {"Phase": (z, DX, DY, "deg"), "Height": (z, DX, DY, "m")}
    channels |= {"Retrace": (2 * z, DX, DY, "m")}
    path = tmp_path / "scan.gwy"
    path.write_bytes(files.gwy(channels))
    return path, z


def test_channels(two_channels):
    """The first with heights, or by name or number."""
    path, z = two_channels
    for channel, factor in [(None, 1), ("Height", 1), ("Retrace", 2)]:
        read = read_measurement(path, channel=channel)
        np.testing.assert_allclose(read.z, factor * z, rtol=1e-15)
        assert (read.dx, read.dy) == pytest.approx((DX, DY), rel=1e-12)
        assert repr(channel or "Height") in read.source
    np.testing.assert_allclose(read_measurement(path, channel=1).z, 2 * z, rtol=1e-15)


def test_channels_refused(two_channels):
    """Names of those there are."""
    path, _ = two_channels
    with pytest.raises(ValueError, match=r"no channel 'Phase'; channels are 0 'Height', 1 'Retr"):
        read_measurement(path, channel="Phase")


def test_channels_without_heights():
    """Never the default, and refused by name."""
    phase, height = (
        SimpleNamespace(
            index=i, name=name, channel_id=name, is_height_channel=i > 0, data_unit=unit
        )
        for i, (name, unit) in enumerate([("Phase", "deg"), ("Height", "m")])
    )
    assert _channel([phase, height], phase, None) is height
    with pytest.raises(ValueError, match=r"'Phase' holds deg, no heights"):
        _channel([phase, height], phase, "Phase")
    with pytest.raises(ValueError, match=r"no channel holds heights; channels are 0 'Phase'"):
        _channel([phase], phase, None)


@pytest.fixture(scope="module")
def package():
    """SurfaceTopography, whose import warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import SurfaceTopography
    return SurfaceTopography


def test_line_scans(tmp_path, package):
    """Equal steps, steps equal up to a left-out point, and unequal ones, from NetCDF."""
    x, z = np.arange(20) * 0.5, np.cos(np.arange(20.0))
    package.UniformLineScan(z, 10.0, unit="µm").to_netcdf(str(tmp_path / "equal.nc"))
    read = read_measurement(tmp_path / "equal.nc")
    np.testing.assert_allclose(read.z, z * 1e-6, rtol=1e-14)
    assert read.dx == pytest.approx(0.5e-6, rel=1e-14) and read.dy is None

    keep = x != 3.5
    scan = package.NonuniformLineScan(x[keep], z[keep], unit="nm")
    scan.to_netcdf(str(tmp_path / "gap.nc"))
    read = read_measurement(tmp_path / "gap.nc")
    np.testing.assert_allclose(read.z, np.where(keep, z * 1e-9, np.nan), rtol=1e-12)
    assert read.dx == pytest.approx(0.5e-9, rel=1e-12) and read.missing == 1

    package.NonuniformLineScan(x**2, z, unit="nm").to_netcdf(str(tmp_path / "unequal.nc"))
    with pytest.raises(ValueError, match=r"unequal.nc: positions are not equidistant"):
        read_measurement(tmp_path / "unequal.nc")


def test_units_and_steps_that_a_file_lacks(tmp_path, package):
    """Asked for in a line, and then taken."""
    np.savetxt(tmp_path / "map.asc", np.nan_to_num(heights()).T * 1e9)
    with pytest.raises(ValueError, match=r"in which unit heights are: give it \(--unit um\)"):
        read_measurement(tmp_path / "map.asc", dx=DX)
    with pytest.raises(ValueError, match=r"give dx in metres"):
        read_measurement(tmp_path / "map.asc", unit="nm")
    read = read_measurement(tmp_path / "map.asc", unit="nm", dx=DX, dy=DY)
    np.testing.assert_allclose(read.z, np.nan_to_num(heights()), rtol=1e-12, atol=1e-24)
    assert (read.dx, read.dy) == (DX, DY)


def test_texts_with_a_header_of_their_own(tmp_path, package):
    """Gwyddion's ASCII has sizes and units; positions in metres are left to the core's reader."""
    z = np.arange(20.0).reshape(5, 4)
    package.Topography(z, (5.0, 8.0), unit="µm").to_matrix(str(tmp_path / "map.asc"))
    read = read_measurement(tmp_path / "map.asc")
    np.testing.assert_allclose(read.z, 1e-6 * z, rtol=1e-12)
    assert (read.dx, read.dy) == pytest.approx((1e-6, 2e-6), rel=1e-12)

    x = DX * np.cumsum(1.0 + np.arange(20) % 3)
    np.savetxt(tmp_path / "scan.prf", np.column_stack([x, np.ones(20)]))
    with pytest.raises(ValueError, match=r"steps are too small to check: save it as \.csv"):
        read_measurement(tmp_path / "scan.prf", unit="m")


def test_instrument_limits(tmp_path, package):
    """Resolution and tip radius, where a file tells them, in metres."""
    parameters = {
        "resolution": {"value": 0.3, "unit": "µm"},
        "tip_radius": {"value": 40, "unit": "nm"},
    }
    info = {"instrument": {"name": "Stylus", "parameters": parameters}}
    scan = package.UniformLineScan(np.cos(np.arange(20.0)), 10.0, unit="µm", info=info)
    scan.to_netcdf(str(tmp_path / "scan.nc"))
    read = read_measurement(tmp_path / "scan.nc")
    assert read.resolution == pytest.approx(0.3e-6) and read.stylus_radius == pytest.approx(40e-9)
    assert "Stylus" in read.source


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "noise.x3p",
            bytes(range(251)) * 8,
            "no format that SurfaceTopography .* knows, and not a",
        ),
        ("noise.bin", bytes(range(251)) * 8, "no format that SurfaceTopography .* knows$"),
        ("square", bytes(2 * 64**2), "no format that SurfaceTopography .* knows$"),
        ("nothing.sur", b"", "no format that SurfaceTopography .* knows"),
        ("zero.txt", b"1 2 3 4\n" * 4 + b"1.\0 2 3 4\n", "it is a text with zero bytes in it"),
        ("words.doc", b"no numbers here\n", "no format that SurfaceTopography .* knows"),
        ("cut.x3p", files.x3p(heights(), DX, DY)[:500], "not a sound file of XML 3D surface"),
        (
            "cut.bcr",
            files.bcr(heights(), DX, DY, STEP)[:-7],
            "cannot be read: The file ended after 33 of 40 bytes",
        ),
    ],
)
def test_unknown_and_damaged_files(tmp_path, capsys, name, content, message):
    """One line, and nothing from the package on the terminal."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_measurement(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name)) and "\n" not in str(caught.value)
    assert capsys.readouterr() == ("", "")


def test_without_the_package(tmp_path, monkeypatch):
    """The line says what to install."""
    (tmp_path / "map.x3p").write_bytes(files.x3p(heights(), DX, DY))
    monkeypatch.setitem(sys.modules, "SurfaceTopography", None)
    with pytest.raises(ValueError, match=r'pip install "fractaljax\[formats\]"'):
        read_measurement(tmp_path / "map.x3p")
