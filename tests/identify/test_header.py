"""Headers that give a factor for heights, the size of a pixel, or a unit of the data."""

import numpy as np
import pytest

from fractaljax._identify.files import read_measurement

Z = np.array([[1.0, -2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.5]])
NUMBERS = "1 -2 3 4\n5 6 7 8.5\n"
RAD = "data unit=rad\nheight conversion factor (-> m)=2.9e-8\n"
PIXEL = "pixel size=3.5e-7\n"
READ = [  # header, arguments, metres of one number, steps [m]
    (RAD + PIXEL, {}, 2.9e-8, 3.5e-7, 3.5e-7),
    (PIXEL + RAD, {"unit": "m"}, 2.9e-8, 3.5e-7, 3.5e-7),
    (RAD + "pixel size=0.35 um\n", {}, 2.9e-8, 3.5e-7, 3.5e-7),
    (RAD + "pixel size (µm) = 0.35\n", {}, 2.9e-8, 3.5e-7, 3.5e-7),
    (RAD + "pixel size=0.35\n", {"position_unit": "um"}, 2.9e-8, 3.5e-7, 3.5e-7),
    (RAD + "pixel size=0.35\n", {"dx": 1e-6}, 2.9e-8, 1e-6, 1e-6),
    (RAD + "x pixel size [nm]: 350\ny pixel size [nm]: 700\n", {}, 2.9e-8, 3.5e-7, 7e-7),
    (RAD, {"dx": 1e-6, "dy": 2e-6}, 2.9e-8, 1e-6, 2e-6),
    ("# Height_conversion_factor [nm/rad]: 29\n# Pixel size: .35 um\n", {}, 2.9e-8, 3.5e-7, 3.5e-7),
    ("conversion factor (m)\t2.9e-8\npixel size (m)\t3.5e-7\n", {}, 2.9e-8, 3.5e-7, 3.5e-7),
    ("height factor=29\n" + PIXEL, {"unit": "nm", "position_unit": "m"}, 2.9e-8, 3.5e-7, 3.5e-7),
    ("data unit=rad\n", {"unit": 2.9e-8, "dx": 1e-6}, 2.9e-8, 1e-6, 1e-6),
    ("data unit=rad\n", {"unit": "2.9e-8", "dx": 1e-6}, 2.9e-8, 1e-6, 1e-6),
    ("data unit=um\n", {"dx": 1e-6}, 1e-6, 1e-6, 1e-6),
    ("data unit=um\nheight conversion factor (-> m)=1e-6\n", {"dx": 1.0}, 1e-6, 1.0, 1.0),
    ("phase [rad]\n" + RAD, {"dx": 1e-6}, 2.9e-8, 1e-6, 1e-6),
]  # fmt: skip


@pytest.mark.parametrize(("header", "given", "metre", "dx", "dy"), READ)
def test_heights_are_data_times_the_factor(tmp_path, header, given, metre, dx, dy):
    path = tmp_path / "phase.txt"
    path.write_text(header + NUMBERS)
    read = read_measurement(path, **given)
    np.testing.assert_allclose(read.z, metre * Z.T, rtol=1e-14)
    assert (read.dx, read.dy) == (pytest.approx(dx, rel=1e-12), pytest.approx(dy, rel=1e-12))
    assert ("heights times 2.9e-08 m by its header" in read.source) == (
        "factor" in header and metre == 2.9e-8
    )


def test_a_profile_with_a_factor(tmp_path):
    (tmp_path / "a.txt").write_text(RAD + PIXEL + "1\n2\n3\n")
    read = read_measurement(tmp_path / "a.txt")
    np.testing.assert_allclose(read.z, [2.9e-8, 5.8e-8, 8.7e-8], rtol=1e-14)
    assert read.dx == pytest.approx(3.5e-7) and read.dy is None
    (tmp_path / "a.txt").write_text(RAD + PIXEL + "x [um];z [rad]\n0;1\n1;2\n2;3\n")
    read = read_measurement(tmp_path / "a.txt")  # positions say their step
    np.testing.assert_allclose(read.z, [2.9e-8, 5.8e-8, 8.7e-8], rtol=1e-14)
    assert read.dx == pytest.approx(1e-6)


REFUSED = [
    ("data unit=rad\n", {}, "line 1, 'data unit=rad', is no length: give the metres of one rad"),
    ("\ndata unit=rad\n", {"unit": "m"}, "line 2, 'data unit=rad', is no length.*--unit 2.9e-8"),
    (RAD, {"unit": "um"}, "the unit of heights is 1 m in the file, got 1e-06"),
    (RAD, {}, "the step between heights is not known"),
    (RAD + "pixel size=0.35\n", {}, r"line 3, 'pixel size=0.35', has no unit.*\(--dx 1e-6\)"),
    (RAD + "pixel size=9 V\n", {}, "line 3, 'pixel size=9 V', has no unit of length"),
    (RAD + PIXEL, {"dx": 1e-6}, "dx is 3.5e-07 m in the file, got 1e-06"),
    ("conversion factor=29\n", {}, "line 1, 'conversion factor=29', does not say its unit"),
    ("conversion factor (-> deg)=29\n", {}, "'conversion factor .*', does not lead to a length"),
    ("conversion factor (-> m)=0\n", {}, "line 1, .* must have a number above 0"),
    ("data unit=nm\n" + RAD.replace("rad", "nm"), {}, "line 3, .* contradicts the heights' unit"),
    ("phase [rad]\n", {"dx": 1e-6}, "does not say in which unit heights are"),
]  # fmt: skip


@pytest.mark.parametrize(("header", "given", "message"), REFUSED)
def test_what_the_header_leaves_open_is_named(tmp_path, header, given, message):
    (tmp_path / "phase.txt").write_text(header + NUMBERS)
    with pytest.raises(ValueError, match=message) as caught:
        read_measurement(tmp_path / "phase.txt", **given)
    assert "\n" not in str(caught.value)
