"""Tables in texts: every dialect gives the same numbers, and bad lines are named."""

import numpy as np
import pytest

from fractaljax.measured.text import read_table

NAN = np.nan
PROFILE = [[0.0, 1.5], [0.5, -2.0], [1.0, NAN], [1.5, 4e-3]]


@pytest.mark.parametrize(
    "text",
    [
        "0,1.5\n0.5,-2\n1,\n1.5,4e-3\n",
        "0;1,5\n0,5;-2\n1;\n1,5;4e-3\n",
        "0;1.5;\n0.5;-2;\n1; ;\n1.5;4e-3;",
        "0;1.5\r\n0.5;-2\r\n1;nan\r\n1.5;4E-3",
        "0\t1.5\n0.5\t-2\n1\t---\n1.5\t0.004\n",
        "0\t1,5\t\n0,5\t-2\t\n1\t\t\n1,5\t0,004\t\n",
        "  0   1.5\n 0.5  -2\n   1  ***\n 1.5   4e-3\n\n\n",
        "0 1,5\n0,5 -2\n1 n/a\n1,5 0,004\n",
        "# made by hand\nx;z\n\n0;1,5\n# a pause\n0,5;-2\n\n1;bad\n1,5;0,004\n",
        '"x","z"\n"0","1.5"\n"0.5","-2"\n"1",""\n"1.5","0.004"\n',
        "\ufeff0, 1.5\n0.5, -2.0\n1.0, NaN\n1.5, 4e-3\n",
    ],
)
def test_dialects(text):
    """Separators, decimal signs, gaps, comments, quotes, blank lines and ends of lines."""
    for encoding in ("utf-8", "utf-16"):
        numbers, units, _ = read_table(text.encode(encoding))
        np.testing.assert_array_equal(numbers, PROFILE)
        assert units == [None, None]


def test_one_column_and_a_map():
    """A blank line among single heights is a gap; at the end it is not."""
    np.testing.assert_array_equal(read_table(b"h\n1\n\n3.5\n\n").numbers[:, 0], [1, NAN, 3.5])
    np.testing.assert_array_equal(
        read_table(b"1,2,3,4\n5,,7,8\n").numbers, [[1, 2, 3, 4], [5, NAN, 7, 8]]
    )


def test_separators_at_the_ends_of_lines():
    """However many, as long as every line has them; a header names the columns that are left."""
    text = b"Lateral um,Raw Micrometer,\n0.0,-0.5,,\n0.2,0.25,,\n"
    numbers, units, size = read_table(text)
    np.testing.assert_array_equal(numbers, [[0.0, -0.5], [0.2, 0.25]])
    assert units == ["um", "Micrometer"] and size is None
    numbers, _, _ = read_table(b"1,2,,\n3,,4,\n")
    np.testing.assert_array_equal(numbers, [[1, 2, NAN], [3, NAN, 4]])


@pytest.mark.parametrize(
    "header",
    [
        "# Channel: a b\n# Width: 12.34 µm\n# Height: 5678.9 nm\n",
        "# Breite: 12.34 µm\n# Höhe: 5678.9 nm\n",
    ],
)
def test_a_header_that_tells_the_size_of_a_map(header):
    text = header + "# Value units: m\n1 1.5 3\n-2 -3 -6\n"
    numbers, units, size = read_table(text.encode())
    np.testing.assert_array_equal(numbers, [[1, 1.5, 3], [-2, -3, -6]])
    assert units == ["m"] * 3
    assert size == pytest.approx((12.34e-6, 5678.9e-9))


def test_lengths_in_a_header_are_no_units_of_columns():
    assert read_table(b"Length,1500.0 um\nz\n1\n2\n").units == [None]


@pytest.mark.parametrize(
    ("header", "units"),
    [
        ("x [um],z [nm]", ["um", "nm"]),
        ('"x (µm)","z (nm)"', ["µm", "nm"]),
        ("# x [um], z [nm]", ["um", "nm"]),
        ("Scan of 3 March (pad)\nx_mm,z_um", ["mm", "um"]),
        ("position,height\nmm,µm", ["mm", "µm"]),
        ("Distance in mm,Height/nm", ["mm", "nm"]),
        ("lengths [mm]\nx,z", ["mm", "mm"]),
        ("a [mm],b [mm]\nx [um],z [nm]", ["um", "nm"]),
        ("x,z [um]", [None, "um"]),
        ("x [um],z [V]", ["um", "V"]),
        ("taken (in room 3)\nx,z", [None, None]),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_units(header, units, encoding):
    """From titles, from a line of their own, or one for everything."""
    assert read_table(f"{header}\n0,1\n1,2\n".encode(encoding)).units == units


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no line of numbers"),
        (b"one\ntwo\n", "no line of numbers"),
        (b"1,2\n3\n", "line 2 has 1 columns, the first one has 2"),
        (b"1,5\n3\n", "line 2 has 1 columns, the first one has 2"),
        (b"# a\nx,z\n1,2\n3,4,5\n", "line 4 has 3 columns, the first one has 2"),
        (b"1,2\n3,abc\n5,6\n", "line 2: 'abc' is not a number"),
        (b"1\0\0\2", "it is not a text"),
    ],
)
def test_refused(content, message):
    """One line that names the line."""
    with pytest.raises(ValueError, match=message):
        read_table(content)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"0;1\n1;1.0D6\n", "line 2: '1.0D6' is not a number"),
        (b"0 1\n1 1_000\n", "line 2: '1_000' is not a number"),
        ("0 1\n1 \u0661\n".encode(), "line 2: '\u0661' is not a number"),
        (b"0;1\n1;5 nm\n", "line 2: '5 nm' is not a number"),
        (b'0 1\n1 2."5\n', "line 2: '2.\"5' is not a number"),
        (b"0,1\n1,1e400\n", "line 2 has a number that is too large"),
        (b"0;1,5\n1;2.5\n", "both decimal points and decimal commas"),
        (b"1,234.5\n2,034.5\n", "line 2: does a comma separate thousands in '2,034.5'"),
        (b'0,1\n1,"2\n', "line 2 has 1 columns, the first one has 2"),
        (b"x,z\n0,1.2x\n1,2\n", "line 2 is neither a title nor numbers: '0,1.2x'"),
        (b"1\n1,2\n1,2\n1,2\n", "line 1 is neither a title nor numbers"),
        (b"1,\n" * (2**24 + 1), "too many lines: at most 16777216 are read"),
        (b"1," * 2**22 + b"1", "line 1 has 8388609 characters: at most 8388608"),
    ],
)
def test_what_is_no_plain_number_is_refused(content, message):
    """Never read in part, nor passed over."""
    with pytest.raises(ValueError, match=message):
        read_table(content)


def test_a_first_line_of_a_map_without_heights_is_kept():
    text = (
        b"# Width: 4 um\n# Height: 3 um\n# Value units: m\n---\t---\t---\t---\n"
        + b"1\t2\t3\t4\n" * 2
    )
    numbers, _, _ = read_table(text)
    assert numbers.shape == (3, 4) and np.isnan(numbers[0]).all()
