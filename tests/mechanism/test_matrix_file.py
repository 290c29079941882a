"""Matrices in the files of finite-element programs: each format read back, damage refused."""

import bz2
import gzip
import io
import struct
import tracemalloc

import numpy as np
import pytest
import scipy.io
import scipy.sparse

import fractaljax as fj

K = np.array([[7.5, -2, 0, 0.1], [-2, 9, -1e-7, 0], [0, -1e-7, 1 / 3, 0], [0.1, 0, 0, 2e12]])
MATRICES = {
    "symmetric": K,
    "unsymmetric": K + np.array([[0, 0.5, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 3e5, 0]]),
    "diagonal": np.diag([1.0, 2, 3, 4]),
}
NODES = np.array([[-1, 1], [3, 1], [3, 2], [1204, 3]])  # an internal node of Abaqus is negative
POINTS = np.array([[3, 1], [3, 2], [10000001, 0], [10000002, 6]])  # with a scalar point
SWAPPED = np.array([2, 0, 3, 1])  # the order of a file that is not in order


def is_symmetric(A):
    return bool((A == A.T).all())


def triangle(A):
    """Rows, columns and values of the entries that a file gives: a triangle where symmetric."""
    i, j = np.nonzero(np.triu(A) if is_symmetric(A) else A)
    return list(zip(i.tolist(), j.tolist(), A[i, j].tolist(), strict=True))


def matrix_market(path, A):
    symmetry = "symmetric" if is_symmetric(A) else "general"
    scipy.io.mmwrite(path, scipy.sparse.coo_matrix(A), symmetry=symmetry, precision=17)


def packed(compress):
    def write(path, A):
        file = io.BytesIO()
        matrix_market(file, A)
        path.write_bytes(compress(file.getvalue()))

    return write


def lines(path, found):
    path.write_text("".join(f"{line}\n" for line in found))


def matrix_input(path, A):
    """Abaqus, in another order of nodes than by number."""
    A = A[np.ix_(SWAPPED, SWAPPED)]
    n = NODES[SWAPPED].tolist()
    found = [f"{n[i][0]},{n[i][1]}, {n[j][0]},{n[j][1]}, {x:.17e}" for i, j, x in triangle(A)]
    lines(path, ["** of a model", *found])


def coordinate(path, A):
    lines(path, [f" {i + 1} {j + 1} {x:.17E}" for i, j, x in triangle(A)])


def labels(path, A):
    n = NODES.tolist()
    lines(path, [f"{n[i][0]} {n[i][1]} {n[j][0]} {n[j][1]} {x:.17e}" for i, j, x in triangle(A)])


def op4_columns(A):
    """Number, and strings of first row and values, of the columns that are not empty."""
    A = scipy.sparse.csc_array(A)
    for j, (start, end) in enumerate(zip(A.indptr[:-1], A.indptr[1:], strict=True), 1):
        rows, values = A.indices[start:end], A.data[start:end]
        gaps = np.flatnonzero(np.diff(rows) > 1) + 1
        strings = zip(np.split(rows, gaps), np.split(values, gaps), strict=True)
        yield j, [(int(k[0]) + 1, x) for k, x in strings]


def op4_strings(strings, big, per_number):
    """The words before each string of a sparse column, and all its words."""
    heads = [
        (per_number * len(x) + 1, row) if big else (row + 65536 * (per_number * len(x) + 1),)
        for row, x in strings
    ]
    return heads, sum(map(len, heads)) + per_number * sum(len(x) for _, x in strings)


def op4_binary(order, wide, kind, layout):
    real = f"{order}f{8 if kind == 2 else wide}"
    per_number = int(real[2]) // wide

    def write(path, A):
        n = A.shape[0]
        whole = "i" if wide == 4 else "q"

        def record(*parts):
            content = b"".join(
                struct.pack(f"{order}{len(x)}{whole}", *x) if isinstance(x, tuple) else x
                for x in parts
            )
            mark = struct.pack(f"{order}i", len(content))
            return mark + content + mark

        name = "KAA     " if wide == 4 else "KAA             "
        written = [record((n, -n if layout == "big" else n, 6, kind), name.encode())]
        for j, strings in op4_columns(A):
            if layout == "dense":
                first, last = strings[0][0], strings[-1][0] + len(strings[-1][1])
                data = A[first - 1 : last - 1, j - 1].astype(real).tobytes()
                written += [record((j, first, len(data) // wide), data)]
            else:
                heads, words = op4_strings(strings, layout == "big", per_number)
                data = [
                    x
                    for head, (_, values) in zip(heads, strings, strict=True)
                    for x in (head, values.astype(real).tobytes())
                ]
                written += [record((j, 0, words), *data)]
        written += [record((n + 1, 1, 1), b"\0" * 8)]  # Nastran says 1 word and writes 2
        path.write_bytes(b"".join(written))

    return write


def op4_text(layout, kind=2):
    def numbers(values):
        texts = [f"{x:23.16E}" for x in values]
        return ["".join(texts[k : k + 3]) for k in range(0, len(texts), 3)]

    def write(path, A):
        n = len(A)
        found = [f"{n:8d}{-n if layout == 'big' else n:8d}{6:8d}{kind:8d}KAA     1P,3E23.16"]
        for j, strings in op4_columns(A):
            if layout == "dense":
                first, last = strings[0][0], strings[-1][0] + len(strings[-1][1])
                found += [f"{j:8d}{first:8d}{last - first:8d}"]
                found += numbers(A[first - 1 : last - 1, j - 1])
            else:
                heads, words = op4_strings(strings, layout == "big", kind)
                found += [f"{j:8d}{0:8d}{words:8d}"]
                for head, (_, values) in zip(heads, strings, strict=True):
                    found += ["".join(f"{x:8d}" for x in head), *numbers(values)]
        lines(path, [*found, f"{n + 1:8d}{1:8d}{1:8d}", f"{1:23.16E}"])

    return write


def dmig(style):
    def write(path, A):
        p, found = POINTS.tolist(), []
        form = 6 if is_symmetric(A) else 1
        if style == "free":
            found += [f"DMIG,KAA,0,{form},2,0"]
            found += [
                f"DMIG,KAA,{p[j][0]},{p[j][1]},,{p[i][0]},{p[i][1]},{x:.17e}".replace("e", "D")
                for i, j, x in triangle(A)
            ]
        else:
            found += [
                "$ a model",
                f"DMIG    KAA     {0:8d}{form:8d}{2:8d}{0:8d}",
                "GRID,3,,0.,0.,0.",
            ]
            for i, j, x in triangle(A):
                found += [f"DMIG*   {'KAA':16s}{p[j][0]:16d}{p[j][1]:16d}{'':16s}+ABC"]
                # Of 16 columns a number of two signs has 10 digits.
                found += [f"*{'ABC':7s}{p[i][0]:16d}{p[i][1]:16d}{x:16.9E}".replace("E", "D")]
        lines(path, found)

    return write


def rsa(path, A):
    """Harwell-Boeing like Ansys: a triangle, no blanks between numbers, and a right side."""
    L = scipy.sparse.csc_array(np.tril(A) if is_symmetric(A) else A)
    count = L.nnz
    half = -(-count // 2)
    values = [f"{x:24.17E}".replace("E", "D") for x in L.data]
    found = [f"{'Stiffness':72s}KEY     "]
    found += ["".join(f"{x:14d}" for x in (5 + 2 * half + 4, 5, half, half, 4))]
    found += [f"{'RSA' if is_symmetric(A) else 'RUA':14s}{4:14d}{4:14d}{count:14d}{0:14d}"]
    found += [f"{'(1I8)':16s}{'(2I8)':16s}{'(1P,2D24.17)':20s}{'(1D24.17)':20s}"]
    found += [f"{'F':14s}{1:14d}{0:14d}"]
    found += [f"{x + 1:8d}" for x in L.indptr]
    rows = [f"{x + 1:8d}" for x in L.indices]
    for each in (rows, values):
        found += ["".join(each[k : k + 2]) for k in range(0, count, 2)]
    lines(path, [*found, *(f"{1:24.16E}" for _ in range(4))])


def dof_names(nodes):
    return tuple(f"{node}.{dof}" for node, dof in nodes.tolist())


def npz(kind):
    return lambda path, A: scipy.sparse.save_npz(path, kind(A))


def mat(kind, **options):
    return lambda path, A: scipy.io.savemat(path, {"KAA": kind(A)}, **options)


csc = scipy.sparse.csc_matrix
CASES = {  # by name: the file, what writes it, the names, and the relative error of its digits
    "npz csr": ("KAA.npz", npz(scipy.sparse.csr_array), None, 0),
    "npz coo": ("KAA.npz", npz(scipy.sparse.coo_matrix), None, 0),
    "npz dia": ("KAA.npz", npz(scipy.sparse.dia_array), None, 0),
    "npz bsr": ("KAA.npz", npz(scipy.sparse.bsr_array), None, 0),
    "npz dense": ("x.npz", lambda p, A: np.savez(p, KAA=A), None, 0),
    "mtx": ("KAA.mtx", matrix_market, None, 0),
    "mtx dense": ("KAA.mtx", lambda p, A: scipy.io.mmwrite(p, A, precision=17), None, 0),
    "mtx.gz": ("KAA.mtx.gz", packed(gzip.compress), None, 0),
    "mtx.bz2": ("KAA.MTX.bz2", packed(bz2.compress), None, 0),
    "mat dense": ("x.mat", mat(np.asarray), None, 0),
    "mat sparse": ("x.mat", mat(csc), None, 0),
    "mat 7": ("x.mat", mat(csc, do_compression=True), None, 0),
    "mat 4": ("x.mat", mat(np.asarray, format="4"), None, 0),
    "mat 4 sparse": ("x.mat", mat(csc, format="4"), None, 0),
    "abaqus": ("KAA.mtx", matrix_input, dof_names(NODES), 0),
    "abaqus labels": ("KAA.mtx", labels, dof_names(NODES), 0),
    "abaqus coordinate": ("KAA.mtx", coordinate, None, 0),
    "op4 dense": ("x.op4", op4_binary("<", 4, 2, "dense"), None, 0),
    "op4 sparse": ("x.op4", op4_binary("<", 4, 2, "small"), None, 0),
    "op4 bigmat": ("x.op4", op4_binary(">", 4, 2, "big"), None, 0),
    "op4 single": ("x.op4", op4_binary(">", 4, 1, "big"), None, 1e-7),
    "op4 of 64 bits": ("x.op4", op4_binary("<", 8, 1, "small"), None, 0),
    "op4 text dense": ("x.op4", op4_text("dense"), None, 0),
    "op4 text sparse": ("x.op4", op4_text("small"), None, 0),
    "op4 text bigmat": ("x.op4", op4_text("big", 1), None, 0),
    "dmig": ("x.pch", dmig("large"), dof_names(POINTS), 1e-9),
    "dmig free": ("x.bdf", dmig("free"), dof_names(POINTS), 0),
    "hb": ("KAA.hb", lambda p, A: scipy.io.hb_write(p, csc(A)), None, 1e-15),
    "ansys": ("KAA.MATRIX", rsa, None, 0),
}
ENDLESS = ("abaqus", "dmig")  # files that do not say how long they are


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("kind", MATRICES)
def test_what_is_written_is_read(tmp_path, case, kind):
    name, write, names, error = CASES[case]
    write(tmp_path / name, MATRICES[kind])
    found = fj.read_matrices(tmp_path / name)
    assert list(found.matrices) == ["KAA"] and found.names == names
    matrix = found.matrices["KAA"]
    assert isinstance(matrix, scipy.sparse.csr_array) and matrix.dtype == np.float64
    np.testing.assert_allclose(matrix.toarray(), MATRICES[kind], rtol=error, atol=0)
    assert matrix.nnz == np.count_nonzero(MATRICES[kind])


@pytest.mark.parametrize("case", CASES)
def test_no_matrix_is_larger_than_the_limit(tmp_path, case):
    name, write, *_ = CASES[case]
    write(tmp_path / name, K)
    assert fj.read_matrices(tmp_path / name, fj.FileLimits(dofs=len(K))).matrices
    with pytest.raises(ValueError, match=rf"\b{len(K) - 1}\b"):
        fj.read_matrices(tmp_path / name, fj.FileLimits(dofs=len(K) - 1))


@pytest.mark.parametrize("case", CASES)
def test_damage_gives_one_line_or_a_matrix(tmp_path, case):
    name, write, *_ = CASES[case]
    path = tmp_path / name
    write(path, K)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    size = len(whole.rstrip())
    for place in [*rng.integers(size, size=12).tolist(), 0, 1]:
        path.write_bytes(whole[:place])
        if case.startswith(ENDLESS):
            try_to_read(path)
        else:
            with pytest.raises(ValueError, match=f"^{name}: [^\n]+$"):
                fj.read_matrices(path)
    for place in rng.integers(size, size=100).tolist():
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try_to_read(path)


def try_to_read(path):
    try:
        found = fj.read_matrices(path)
    except ValueError as error:
        assert str(error).startswith(f"{path.name}: ") and "\n" not in str(error)
    else:
        assert all(np.isfinite(matrix.data).all() for matrix in found.matrices.values())


def test_several_matrices_of_one_file(tmp_path):
    arrays = {"M": np.eye(4), "K": K, "F": np.arange(4.0)}
    np.savez(tmp_path / "x.npz", **arrays)
    scipy.io.savemat(tmp_path / "x.mat", arrays)
    for name in ("x.npz", "x.mat"):
        found = fj.read_matrices(tmp_path / name).matrices
        assert list(found) == ["M", "K", "F"]
        np.testing.assert_array_equal(found["F"].toarray()[:, 0], arrays["F"])
        np.testing.assert_array_equal(found["K"].toarray(), K)
    for name, write in (("a.op4", op4_binary("<", 4, 2, "big")), ("a.op4", op4_text("big"))):
        write(tmp_path / name, K)
        first = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(first + first.replace(b"KAA", b"MAA"))
        assert list(fj.read_matrices(tmp_path / name).matrices) == ["KAA", "MAA"]


def test_op4_as_nastran_writes_it(tmp_path):
    """Two columns of a matrix of three, the second of one string that has a negative number."""
    (tmp_path / "n.op4").write_text(
        "       3      -3       6       2KGG     1P,5E16.9\n"
        "       1       0       8\n       5       1\n 1.000000000E+00-2.000000000E-01\n"
        "       3       3\n 4.000000000E+00\n"
        "       2       0       4\n       3       1\n-2.000000000E-01\n"
        "       4       1       1\n 1.000000000E+00\n"
    )
    with pytest.raises(ValueError, match="line 5 must begin a string of its column"):
        fj.read_matrices(tmp_path / "n.op4")  # 9 words, not 8
    text = (tmp_path / "n.op4").read_text().replace("       0       8", "       0      10")
    (tmp_path / "n.op4").write_text(text)
    found = fj.read_matrices(tmp_path / "n.op4").matrices["KGG"].toarray()
    np.testing.assert_array_equal(found, [[1, -0.2, 0], [-0.2, 0, 0], [4, 0, 0]])


def test_dmig_matrices_share_their_degrees_of_freedom(tmp_path):
    lines(
        tmp_path / "x.dat",
        [
            "SOL 103",
            "DMIG    K       0       6       2       0",
            "DMIG    K       7       2               7       2       2.5",
            "+       9       1       -1.+3",
            "DMIG,M,0,1,1",
            "DMIG,M,9,1,,9,1,1.5",
            "DMIG    P       0       9       1       0                       1",
            "DMIG*   P                              1               0",
            "*                      7               3 2.0D0",
            "GRID    7               0.      0.      0.",
            "+       9       9       9",
        ],
    )
    found = fj.read_matrices(tmp_path / "x.dat")
    assert found.names == ("7.2", "7.3", "9.1")
    K, M, P = (found.matrices[x].toarray() for x in "KMP")
    np.testing.assert_array_equal(K, [[2.5, 0, -1000], [0, 0, 0], [-1000, 0, 0]])
    np.testing.assert_array_equal(M, np.diag([0, 0, 1.5]))
    np.testing.assert_array_equal(P, [[0], [2], [0]])


ONE = "%%MatrixMarket matrix coordinate real general\n"
HEAD = "DMIG,K,0,6,2\n"
OP4 = f"{1:8d}{1:8d}{6:8d}{2:8d}K\n"
BOEING = "t\n 3 1 1 1 0\nRSA 2 2 2 0\n(3I8) (2I8) (2E12.4)\n       1       3       3\n"
BAD = [
    ("x.txt", "", "of unknown format; known are .npz, .mat, .mtx, .op4, .pch, .bdf, .dat, .hb"),
    ("x", "", "of unknown format"),
    ("x.gz", b"", "of unknown format"),
    ("x.mtx.gz", b"no", "it is damaged"),
    ("x.mtx", ONE + "2 3 1\n1 1 1", r"x must be square or one column, got shape \(2, 3\)"),
    ("x.mtx", ONE + "2000000 2000000 1\n1 1 1", "reduce the model to 1000000 at most"),
    ("x.mtx", "%%MatrixMarket matrix array real general\n9999 9999\n1", "as a dense array at most"),
    ("x.mtx", "*CLOAD\n1,1,5.", "neither a Matrix Market file nor"),
    ("x.mtx", "1,1,1,1,5.\n** a\n1,1,1,2,x", "line 3 must be 'node dof node dof number'"),
    ("x.mtx", "1,1,1,1,5.\n1,1,2", "line 2 must be 'node dof node dof number'"),
    ("x.mtx", "1 1 5.\n\n0 1 2.", "line 3 must be counted from 1"),
    ("x.mtx", "1 1 5.\n1 1 2.", "x gives row 1, column 1 twice"),
    ("x.mtx", "1 1 1e999", "line 1 must be finite"),
    ("x.mtx", "1,-1,1,1,1.", "line 1 must have dofs from 0"),
    ("x.mtx", "1 999999999999999 1.", "x must have from 1 to 1000000 rows"),
    ("x.mtx", "999999999999999 1 1 1 1.", "too large a number"),
    ("x.op4", "hello", "line 1 must begin a matrix of an OUTPUT4 file"),
    ("x.op4", f"{1:8d}{1:8d}{6:8d}{5:8d}K       1P,3E23.16", "got type 5, of 1 to 4"),
    ("x.op4", OP4.replace("2K", "4K") + "  1  1  1\n 1.", "K is damaged: a complex number"),
    ("x.op4", f"{1:8d}{1:8d}{6:8d}{2:8d}K       1P,3E23.16\n", "it ends within a matrix"),
    ("x.op4", OP4 + "       1       1       1\nx\n", "line 3 must be numbers"),
    ("x.op4", OP4 + "  1  2  1\n 1.\n  2  1  1\n 1.", "an entry lies outside 1"),
    ("x.op4", f"{10**7:8d}{1:8d}{6:8d}{2:8d}K\n", "K must have from 1 to 1000000 rows"),
    ("x.op4", b"\x18\0\0\0" + b"\0" * 30, "it is damaged: no record at byte 0"),
    ("x.pch", "DMIG,K,1,1,,1,1,2.", "it holds no DMIG card that begins"),
    ("x.pch", HEAD + "DMIG,M,1,1,,1,1,2.", "no DMIG card begins M"),
    ("x.pch", HEAD + HEAD, "line 2 must have a form .* and a new name"),
    ("x.pch", "DMIG,K,0,6,5", "line 1 must have a form of 1, 2, 6 and 9, a type of 1 to 4"),
    ("x.pch", "DMIG,K,0,6,4\nDMIG,K,1,1,,1,1,2.,x", "line 2 begins a DMIG card that cannot"),
    ("x.pch", HEAD + "DMIG,K,1,1,,1,1,2.,3.", "line 2 begins a DMIG card that cannot be read"),
    ("x.pch", HEAD + "DMIG,K,1,1,,1,x,2.", "line 2 begins a DMIG card"),
    ("x.pch", HEAD + "DMIG,K,1,1,,1,1,1.+999", "K must have finite numbers"),
    ("x.pch", HEAD + "DMIG,K,1,1,,1,2,2.\nDMIG,K,1,2,,1,1,2.", "twice, or above and below"),
    ("x.hb", "hello", "it is no Harwell-Boeing file in ASCII"),
    ("x.hb", BOEING.replace("RSA", "CSA"), "line 3 must have the type RUA"),
    ("x.hb", BOEING.replace("3I8", "*"), "line 4 must have the formats"),
    ("x.hb", BOEING, "it ends after 5 lines of 7"),
    ("x.hb", BOEING.replace(" 3 1", " 0 1"), "it ends before 2 numbers from line 6 on"),
    ("x.hb", BOEING + "       1       3\n 1. 2.", "row indices must be from 1 to 2"),
    ("x.hb", BOEING + "       1       x\n 1. 2.", "line 6 must be numbers in their fields"),
    ("x.hb", BOEING.replace("1       3  ", "1       4  ") + " 1 1\n 1. 2.", "pointers are damag"),
    ("x.hb", BOEING.replace("2 2 2", "3 2 2") + " 1 2\n 1. 2.", "and calls them symmetric"),
    ("x.npz", "hello", "it is no sound file of numbers from NumPy"),
    ("x.mat", "hello", "it is no file of MATLAB's version 5 to 7"),
    ("x.mat", b"MATLAB 7.3 MAT-file, Platform: PCWIN64", "it is damaged|save it with -v7"),
]


@pytest.mark.parametrize(("name", "content", "message"), BAD)
def test_bad_files_are_refused_in_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as caught:
        fj.read_matrices(path)
    assert str(caught.value).startswith(f"{name}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"M": np.ones((2, 3))}, r"M must be square or one column, got shape \(2, 3\)"),
        ({"M": np.array([[np.nan]])}, "M must be finite"),
        ({"M": np.array(["a"])}, "M must be real numbers, got "),
    ],
)
def test_matrices_that_are_none(tmp_path, arrays, message):
    np.savez(tmp_path / "x.npz", **arrays)
    scipy.io.savemat(tmp_path / "x.mat", arrays)
    for name in ("x.npz", "x.mat"):
        with pytest.raises(ValueError, match=f"^{name}: {message}"):
            fj.read_matrices(tmp_path / name)


@pytest.mark.parametrize("index", [4, 1_000_000, -1, -1_000_000])
def test_indices_out_of_range(tmp_path, index):
    """SciPy's compiled loops would read and write outside of their arrays."""
    matrix = scipy.sparse.csc_matrix(K)
    matrix.indices[-1] = index
    scipy.sparse.save_npz(tmp_path / "x.npz", matrix)
    scipy.io.savemat(tmp_path / "x.mat", {"K": matrix})
    for name in ("x.npz", "x.mat"):
        with pytest.raises(ValueError, match=f"^{name}: .* must be (< 4|>= 0)"):
            fj.read_matrices(tmp_path / name)


def test_too_many_rows_and_a_skew_matrix(tmp_path):
    scipy.sparse.save_npz(tmp_path / "x.npz", scipy.sparse.eye_array(1_000_001).todia())
    np.savez(tmp_path / "y.npz", y=np.zeros(1_000_001))
    scipy.io.savemat(tmp_path / "y.mat", {"y": scipy.sparse.csc_matrix((1_000_001, 1))})
    for name in ("x.npz", "y.npz", "y.mat"):
        with pytest.raises(ValueError, match=f"^{name}: .*[xy] must have from 1 to 1000000 rows"):
            fj.read_matrices(tmp_path / name)
    (tmp_path / "G.rb").write_text(
        "gyroscopic\n 3 1 1 1\nrza 3 3 2 0\n(4I2) (2I2) (2F8.3)\n 1 3 3 3\n 2 3\n   1.500  -2.500\n"
    )
    found = fj.read_matrices(tmp_path / "G.rb").matrices["G"].toarray()
    np.testing.assert_array_equal(found, [[0, -1.5, 2.5], [1.5, 0, 0], [-2.5, 0, 0]])


def test_what_unpacks_to_too_much_and_room_that_is_not_used(tmp_path):
    limits = fj.FileLimits(matrices=10**6)
    zeros = np.zeros((1000, 1000))
    scipy.io.savemat(tmp_path / "x.mat", {"K": zeros}, do_compression=True)
    np.savez_compressed(tmp_path / "x.npz", K=zeros)
    (tmp_path / "x.mtx.gz").write_bytes(gzip.compress(b"\n" * 2 * 10**6))
    (tmp_path / "x.mtx").write_bytes(b"\n" * 2 * 10**6)
    for name, message in {"x.npz": "unpacks", "x.mat": "unpacks", "x.mtx.gz": "unpacks"}.items():
        with pytest.raises(ValueError, match=f"^{name}: .*{message} to "):
            fj.read_matrices(tmp_path / name, limits)
    with pytest.raises(ValueError, match=r"^x\.mtx: the file is larger than 1 MB"):
        fj.read_matrices(tmp_path / "x.mtx", limits)
    # MATLAB keeps it after entries were removed; what is there means nothing.
    full = scipy.sparse.csc_matrix(K)
    spare = np.array([9, 9]), np.array([np.nan, 7])
    A = scipy.sparse.csc_matrix(K)
    A.indices, A.data = (
        np.append(x, y) for x, y in zip((full.indices, full.data), spare, strict=True)
    )
    A.has_sorted_indices = True  # or SciPy would write it without
    scipy.io.savemat(tmp_path / "x.mat", {"K": A})
    assert (tmp_path / "x.mat").stat().st_size > 128 + 12 * (full.nnz + 2)
    found = fj.read_matrices(tmp_path / "x.mat").matrices["K"]
    np.testing.assert_array_equal(found.toarray(), K)


@pytest.mark.parametrize("case", ["mtx", "abaqus", "op4", "hb", "mat", "npz"])
def test_no_dense_matrix_is_made_of_a_sparse_one(tmp_path, case):
    """Of 10000 rows, whose dense matrix has 800 MB; as OP4, which is written here, of 4000."""
    n = 4000 if case == "op4" else 10_000
    rng = np.random.default_rng(0)
    i, j = rng.integers(n, size=(2, 4 * n))
    A = scipy.sparse.coo_array((rng.standard_normal(4 * n), (i, j)), shape=(n, n)).tocsr()
    A = (A + A.T + scipy.sparse.eye_array(n)).tocsc()
    path = tmp_path / f"K.{'mtx' if case == 'abaqus' else case}"
    if case == "abaqus":
        L = scipy.sparse.tril(A)
        table = [L.row // 3 + 1, L.row % 3 + 1, L.col // 3 + 1, L.col % 3 + 1, L.data]
        np.savetxt(path, np.column_stack(table), fmt="%d,%d, %d,%d, %.17e")
    elif case == "op4":
        op4_binary("<", 4, 2, "big")(path, A)
    else:
        write = {
            "mtx": lambda: scipy.io.mmwrite(path, A, symmetry="symmetric", precision=17),
            "hb": lambda: scipy.io.hb_write(path, A),
            "mat": lambda: scipy.io.savemat(path, {"K": A}, do_compression=True),
            "npz": lambda: scipy.sparse.save_npz(path, A),
        }
        write[case]()
    tracemalloc.start()
    try:
        (found,) = fj.read_matrices(path).matrices.values()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 50e6
    assert abs(found - A).max() < 1e-15 * abs(A).max()
