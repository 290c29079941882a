"""Matrix Market files: every number as its writer meant it, anything else refused."""

import io
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from fractaljax._mechanism.matrix_market import read_matrix_market
from tools import refusals

ONE = "%%MatrixMarket matrix coordinate real general\n1 1 1\n1 1 "


def read(text, largest=4000):
    return read_matrix_market(io.BytesIO(text.encode()), largest)


@pytest.mark.parametrize("n", [1, 4])
def test_what_scipy_writes(n):
    rng = np.random.default_rng(n)
    A = rng.standard_normal((n, n)) * 10.0 ** rng.integers(-30, 30, (n, n))
    cases = [(A, None), (A[:, :1], None), (np.arange(n), None), (A + A.T, "symmetric")]
    cases += [(A - A.T, "skew-symmetric")] * (n > 1) + [(A * 1j, None)]
    cases += [(A + A.T + 1j * (A - A.T), "hermitian")]
    for X, symmetry in cases:
        for convert in (np.atleast_2d, scipy.sparse.coo_matrix):
            file = io.BytesIO()
            scipy.io.mmwrite(file, convert(X), symmetry=symmetry)
            found = read(file.getvalue().decode())
            np.testing.assert_array_equal(found, np.atleast_2d(X))
            assert np.iscomplexobj(found) == bool(np.imag(X).any())


def test_numbers_blanks_and_comments():
    """Each is the float that is nearest to the exact fraction."""
    rng = np.random.default_rng(0)
    exact: list[Any]
    texts, exact = ["1.0D6", "1.0+6", ".5", "-3.", "7"], [1e6, 1e6, 0.5, -3.0, 7.0]
    for _ in range(2000):
        digits = "".join(rng.choice(list("0123456789"), rng.integers(1, 20)))
        point = rng.integers(len(digits) + 1)
        mantissa = rng.choice(["", "+", "-"]) + digits[:point] + "." + digits[point:]
        letter, sign = rng.choice(["", "E", "e", "D", "d"]), rng.choice(["+", "-"])
        exponent = f"{rng.integers(280):0{rng.integers(1, 4)}d}"
        sign = rng.choice([sign, ""]) if letter else sign
        texts.append(f"{mantissa}{letter}{sign}{exponent}")
        exact.append(Fraction(f"{mantissa}e{sign}{exponent}"))
    found = read(f"%%MatrixMarket matrix array real general\n{len(texts)} 1\n" + "\n".join(texts))
    assert found[:, 0].tolist() == [float(value) for value in exact]
    found = read("%%matrixmarket MATRIX Array Real General\r\n% a\n\n%\n 1\t2 \r\n\n1.5\n\n2\n\n")
    np.testing.assert_array_equal(found, [[1.5, 2.0]])


NONE = (
    "1500,75|1.5abc|1_000|0x1F|nan|inf|-inf|1e400|1e|e5|1.0D|1.2.3|--1|1+|1.0 2|1 .0|1 % a||\u0661"
)
BAD = [
    *(
        (f"coordinate real general\n1 1 1\n1 1 {text}", "line 3 must be")
        for text in NONE.split("|")
    ),
    ("coordinate pattern general\n1 1 1\n1 1", "line 1 must have the field real .* got 'pattern'"),
    ("coordinate real lower\n1 1 1\n1 1 1", "line 1 must have the symmetry general"),
    ("coordinate real symmetric\n2 2 3\n1 1 1\n2 1 2\n1 2 2", "line 5 must lie below the diagonal"),
    ("coordinate real skew-symmetric\n2 2 1\n\n1 2 1", "line 4 must lie below the diagonal"),
    ("coordinate real skew-symmetric\n2 2 1\n1 1 1", "line 3 must lie below the diagonal"),
    ("coordinate real symmetric\n2 2 4\n1 1 1", "line 2 must have .* of entries, at most 3"),
    ("coordinate real symmetric\n2 3 1\n1 1 1", "line 2 must have the size of a matrix that"),
    ("coordinate real general\n2 2 2\n1 1 1\n1 1 2", "line 4 must not give an entry twice"),
    ("coordinate real general\n2 2 2\n1 1 1\n", "ends after 1 of 2 numbers"),
    ("coordinate real general\n2 2 1\n1 1 1\n2 2 2", "line 4 must not be there, after all of 1"),
    ("coordinate real general\n2 2 1\n0 1 1", "line 3 must be inside 2 x 2, .* 1, got '0 1 1'"),
    ("coordinate real general\n2 2 1\n3 1 1", "line 3 must be inside 2 x 2, .* 1, got '3 1 1'"),
    ("coordinate real general\n2 2 1\n1 1", "line 3 must be 'row column number' and nothing else"),
    ("coordinate real general\n%\n2 2\n1 1 1", "line 3 must have the 3 whole numbers of the size"),
    ("coordinate real general\n1000000000000 1 1\n1 1 1", "reduce the model to 4000 at most"),
    ("coordinate real general\n9 9 999999999999999\n1 1 1", "line 2 must have the number of entri"),
    ("array real general\n4000 4000\n1", "ends after 1 of 16000000 numbers"),
    ("array complex general\n1 1\n1", "line 3 must be 'number number' and nothing else"),
    ("array integer general\n1 1\n1.5", "line 3 must be 'number' and nothing else, got '1.5'"),
    ("array real general\n0 0\n", "line 2 must have the size of a matrix"),
    ("array real general\n1 1\n" + "1" * 2000, "line 3 must be finite, got '1{40}'"),
    ("array real general\n1 1\n" + "\n" * 20000, "ends after 0 of 1 numbers"),
]


test_files_that_are_not_right = refusals(BAD, lambda text: read(f"%%MatrixMarket matrix {text}"))


def test_other_and_endless_files():
    for text in ("", "hello", "%%MatrixMarket", "%%MatrixMarket matrix\n1 1\n"):
        with pytest.raises(ValueError, match="is not a Matrix Market file"):
            read(text)
    with open("/dev/zero", "rb") as file, pytest.raises(ValueError, match="is not a Matrix Market"):
        read_matrix_market(file, 4000)
    with pytest.raises(ValueError, match="is larger than"):
        read(f"{ONE}1{' ' * 1000}", largest=5)
