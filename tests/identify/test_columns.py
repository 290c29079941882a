"""Which columns of a text are positions, heights and flags of valid heights."""

import numpy as np
import pytest

from fractaljax._identify.files import read_measurement

NAN = np.nan
FLAGGED = "X;Y;valid\n[mm];[mm];[1/0]\n0;5;1\n.5;6;1\n1;0;0\n1.5;7;1\n"
HEIGHTS = [5.0, 6.0, NAN, 7.0]
READ = [  # text, columns, heights in the file's unit (1 mm), step [mm]
    (FLAGGED, None, HEIGHTS, 0.5),
    (FLAGGED.replace("[", "").replace("]", ""), None, HEIGHTS, 0.5),
    (FLAGGED.replace("valid", "quality").replace("[1/0]", "[-]"), None, HEIGHTS, 0.5),
    (FLAGGED.replace("valid", "quality").replace("[1/0]", "%"), None, HEIGHTS, 0.5),
    (FLAGGED.replace("valid", "is_valid").replace(";", "\t"), None, HEIGHTS, 0.5),
    (FLAGGED.replace("valid", "missing"), None, [NAN, NAN, 0, NAN], 0.5),
    (FLAGGED.replace("1;0;0", "1;nan;0"), None, HEIGHTS, 0.5),
    (FLAGGED.replace("1;0;0", "nan;nan;0"), None, HEIGHTS, 0.5),
    (FLAGGED.replace("1;0;0", "1;0;"), None, HEIGHTS, 0.5),  # a flag that is missing
    (FLAGGED.replace("valid", "mask"), {"valid": "mask"}, HEIGHTS, 0.5),
    (FLAGGED.replace("valid", "mask"), {"invalid": 2}, [NAN, NAN, 0, NAN], 0.5),
    (FLAGGED.replace("valid", "mask"), {"x": "X", "z": "1"}, [5, 6, 0, 7], 0.5),
    (FLAGGED, {"x": "X", "z": "Y"}, HEIGHTS, 0.5),  # named columns leave clear flags in force
    ("x_mm,z_mm,ok\n0,5,True\n.5,6,true\n1,9,False\n1.5,7,True\n", None, HEIGHTS, 0.5),
    ("valid x[mm] z[mm]\n1 0 5\n1 .5 6\n0 1 9\n1 1.5 7\n", None, HEIGHTS, 0.5),
    ("z in mm;x in mm\n5;0\n6;.5\n7;1\n", None, [5, 6, 7], 0.5),
    ("x [mm],z [mm],intensity [V]\n0,5,3\n.5,6,1\n1,7,2\n", None, [5, 6, 7], 0.5),
    ("time [s],x [mm],intensity [V],height [mm]\n0,0,4,5\n1,.5,4,6\n", None, [5, 6], 0.5),
    ("0;1;5\n.5;1;6\n1;0;9\n", {"x": 0, "z": 2, "valid": 1}, [5, 6, NAN], 0.5),
    ("0;1;5\n.5;1;6\n1;0;9\n", {"z": 2}, [5, 6, 9], 1.0),
    ("z [mm];valid\n5;1\n6;0\n7;1\n", None, [5, NAN, 7], 1.0),
]


@pytest.mark.parametrize(("text", "columns", "z", "dx"), READ)
def test_columns_that_are_clear_or_chosen(tmp_path, text, columns, z, dx):
    path = tmp_path / "a.csv"
    path.write_text(text)
    unit = None if "mm" in text else "mm"
    read = read_measurement(path, columns=columns, dx=None if dx == 0.5 else 1e-3, unit=unit)
    np.testing.assert_allclose(read.z, 1e-3 * np.array(z), rtol=1e-14)
    assert read.dx == pytest.approx(1e-3 * dx, rel=1e-12) and read.dy is None


def test_a_map_of_points_with_flags(tmp_path):
    (tmp_path / "a.csv").write_text(
        "x [um],y [um],z [nm],valid\n0,0,1,1\n0,2,2,1\n1,0,3,0\n1,2,4,1\n"
    )
    read = read_measurement(tmp_path / "a.csv")
    np.testing.assert_allclose(read.z, [[1e-9, 2e-9], [NAN, 4e-9]], rtol=1e-14)
    assert (read.dx, read.dy, read.missing) == (pytest.approx(1e-6), pytest.approx(2e-6), 1)
    assert "4 columns, of which 3 for positions and heights" in read.source


PLAIN = "0;1;1\n1;2;0\n2;3;1\n"
NAMED = "columns are 0 'X', 1 'Y', 2 'mask': say which is which"
REFUSED = [
    (FLAGGED.replace("valid", "mask"), None, f"1 in column 'mask' may stand for .*; {NAMED}"),
    (FLAGGED.replace("valid", "Flag"), None, "1 in column 'Flag' may stand for good or bad"),
    (FLAGGED.replace("1;0;0", "1;0;.9"), None, "0 or 1, got 0.9 in column 'valid'.* leaves it out"),
    (PLAIN, None, r"columns are 0, 1, 2: say which is which \(--columns x=0 z=1 valid=2\)"),
    (FLAGGED.replace("valid", "mask"), {"valid": "masks"}, f"no column 'masks'; {NAMED}"),
    (FLAGGED, {"height": "Y"}, "role of a column must be one of x, y, z, valid, invalid"),
    (FLAGGED, {"x": "X"}, "x and y need z"),
    (FLAGGED, {"x": "X", "z": "X"}, "each has its own column"),
    (FLAGGED, {"valid": 2, "invalid": 1}, "valid excludes invalid"),
    ("x;z;w\n0;1;1\n1;True;1\n2;3;1\n", None, "line 3: 'True' is not a number"),
    ("x;z;height\n0;1;1\n1;2;1\n2;3;1\n", None, "which column is the height is not clear"),
    ("x;y;a;b\n0;1;1;5\n1;2;1;4\n", None, "which column is the height is not clear"),
    ("x [um];a [V];b [W]\n0;1;1\n1;2;1\n", None, "got 'W'; columns are 0 'x', 1 'a', 2 'b'"),
    ("a;b;c;valid\n0;1;1;5\n1;2;1;4\n" * 1, {"z": 1, "valid": 3}, "must be 0 or 1, got 5"),
]


@pytest.mark.parametrize(("text", "columns", "message"), REFUSED)
def test_columns_that_are_not_clear_are_named(tmp_path, text, columns, message):
    (tmp_path / "a.csv").write_text(text)
    unit = None if "[mm]" in text or "[um]" in text else "um"
    with pytest.raises(ValueError, match=message) as caught:
        read_measurement(tmp_path / "a.csv", columns=columns, unit=unit)
    assert "\n" not in str(caught.value)


def test_files_without_columns(tmp_path):
    np.save(tmp_path / "a.npy", np.ones(5))
    with pytest.raises(ValueError, match=r"no table of text, got columns \{'z': 1\}"):
        read_measurement(tmp_path / "a.npy", dx=1.0, unit="m", columns={"z": 1})
