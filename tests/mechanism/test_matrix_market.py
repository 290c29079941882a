"""Matrix Market files: every number as its writer meant it, anything else refused."""

import bz2
import gzip
import io
from fractions import Fraction

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from fractaljax.mechanism.matrix_market import read_matrix_market
from fractaljax.mechanism.structure_file import _matrix_market

ONE = "%%MatrixMarket matrix coordinate real general\n1 1 1\n1 1 "


def read(text):
    return read_matrix_market(io.BytesIO(text.encode()), 4000)


@pytest.mark.parametrize("n", [1, 4])
def test_what_scipy_writes(n):
    rng = np.random.default_rng(n)
    A = rng.standard_normal((n, n)) * 10.0 ** rng.integers(-30, 30, (n, n))
    cases = [(A, None), (A[:, :1], None), (np.arange(n), None), (A + A.T, "symmetric")]
    cases += [(A - A.T, "skew-symmetric")] * (n > 1) + [(A + A.T + 0j, "hermitian"), (A * 1j, None)]
    for X, symmetry in cases:
        for convert in (np.atleast_2d, scipy.sparse.coo_matrix):
            file = io.BytesIO()
            scipy.io.mmwrite(file, convert(X), symmetry=symmetry)
            found = read(file.getvalue().decode())
            np.testing.assert_array_equal(found, np.atleast_2d(X))
            assert np.iscomplexobj(found) == bool(np.imag(X).any())


def test_numbers_as_c_and_fortran_write_them():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        digits = "".join(rng.choice(list("0123456789"), rng.integers(1, 20)))
        point = rng.integers(len(digits) + 1)
        mantissa = rng.choice(["", "+", "-"]) + digits[:point] + "." + digits[point:]
        letter, sign = rng.choice(["", "E", "e", "D", "d"]), rng.choice(["+", "-"])
        exponent = f"{rng.integers(280):0{rng.integers(1, 4)}d}"
        sign = rng.choice([sign, ""]) if letter else sign
        exact = Fraction(f"{mantissa}e{sign}{exponent}")
        found = read(f"{ONE}{mantissa}{letter}{sign}{exponent}\n")[0, 0]
        assert found == float(f"{mantissa}e{sign}{exponent}")
        if abs(exact) > 1e-300:
            assert abs(Fraction(found) - exact) <= abs(exact) / 2**52
    for text, value in [("1.0D6", 1e6), ("1.0+6", 1e6), (".5", 0.5), ("-3.", -3.0), ("7", 7.0)]:
        assert read(ONE + text)[0, 0] == value


NONE = (
    "1500,75|1.5abc|1_000|0x1F|nan|inf|-inf|1e400|1e|e5|1.0D|1.2.3|--1|1+|1.0 2|1 .0|1 % a||\u0661"
)


@pytest.mark.parametrize("text", NONE.split("|"))
def test_texts_that_are_no_number(text):
    with pytest.raises(ValueError, match="line 3 must be") as caught:
        read(ONE + text)
    assert "\n" not in str(caught.value)


BAD = [
    ("coordinate pattern general\n1 1 1\n1 1", "line 1 must have the field real .* got 'pattern'"),
    ("coordinate real lower\n1 1 1\n1 1 1", "line 1 must have the symmetry general"),
    ("coordinate real symmetric\n2 2 3\n1 1 1\n2 1 2\n1 2 2", "line 5 must lie below the diagonal"),
    ("coordinate real skew-symmetric\n2 2 1\n1 2 1", "line 3 must lie below the diagonal"),
    ("coordinate real skew-symmetric\n2 2 1\n1 1 1", "line 3 must lie below the diagonal"),
    (
        "coordinate real symmetric\n2 2 4\n1 1 1",
        "line 2 must have the number of entries, at most 3",
    ),
    (
        "coordinate real symmetric\n2 3 1\n1 1 1",
        "line 2 must have the size of a matrix that is sym",
    ),
    ("coordinate real general\n2 2 2\n1 1 1\n1 1 2", "line 4 must not give an entry twice"),
    ("coordinate real general\n2 2 2\n1 1 1\n", "ends after 1 of 2 numbers"),
    ("coordinate real general\n2 2 1\n1 1 1\n2 2 2", "line 4 must not be there, after all of 1"),
    (
        "coordinate real general\n2 2 1\n0 1 1",
        "line 3 must be inside 2 x 2, counted from 1, got '0",
    ),
    (
        "coordinate real general\n2 2 1\n3 1 1",
        "line 3 must be inside 2 x 2, counted from 1, got '3",
    ),
    ("coordinate real general\n2 2 1\n1 1", "line 3 must be 'row column number' and nothing else"),
    ("coordinate real general\n2 2\n1 1 1", "line 2 must have the 3 whole numbers of the size"),
    ("coordinate real general\n1000000000000 1 1\n1 1 1", "reduce the model to 4000 at most"),
    (
        "coordinate real general\n9 9 999999999999999\n1 1 1",
        "line 2 must have the number of entries",
    ),
    ("array real general\n4000 4000\n1", "ends after 1 of 16000000 numbers"),
    ("array integer general\n1 1\n1.5", "line 3 must be 'number' and nothing else, got '1.5'"),
    ("array real general\n0 0\n", "line 2 must have the size of a matrix"),
    ("array real general\n1 1\n" + "1" * 2000, "line 3 must have 1000 characters at most"),
    ("array real general\n1 1\n" + "\n" * 20000, "must not be blank"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_files_that_are_not_right(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        read(f"%%MatrixMarket matrix {text}")
    assert "\n" not in str(caught.value)


def test_blank_lines_and_remarks():
    found = read("%%matrixmarket MATRIX Array Real General\r\n% a\n\n%\n 1\t2 \r\n\n1.5\n\n2\n\n")
    np.testing.assert_array_equal(found, [[1.5, 2.0]])


def test_compressed_files(tmp_path):
    for suffix, compress in ((".gz", gzip.compress), (".bz2", bz2.compress)):
        path = tmp_path / f"K.mtx{suffix}"
        path.write_bytes(compress(f"{ONE}3.0\n".encode()))
        assert _matrix_market(path) == 3
        path.write_bytes(path.read_bytes()[:-9])
        with pytest.raises(ValueError, match=f"K.mtx{suffix} is damaged"):
            _matrix_market(path)
        path.write_bytes(b"hello")
        with pytest.raises(ValueError, match=f"K.mtx{suffix} is damaged"):
            _matrix_market(path)
