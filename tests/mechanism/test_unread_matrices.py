"""What lies beside the matrices of a file and is none, and what a file leaves unsaid."""

import struct
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from test_matrix_file import K, csc, lines, op4_binary, op4_text

import fractaljax as fj
from tools import run_command

M = np.diag([1.0, 2, 3, 4])
LOADED = {
    "text": ({"note": "of a brake"}, "note must be real numbers, got text"),
    "cell": ({"parts": np.array([1.0, "disc"], dtype=object)}, "parts .* got a cell array"),
    "struct": ({"about": {"unit": "mm", "size": 3.0}}, "about must be .*, got a struct"),
    "table": ({"nodes": np.ones((7, 3))}, r"nodes must be square or one column, got shape \(7, 3"),
    "not finite": ({"A": np.array([[np.nan]])}, "A must be finite"),
}


@pytest.mark.parametrize("case", LOADED)
@pytest.mark.parametrize("compressed", [False, True])
def test_what_is_beside_matlabs_matrices(tmp_path, case, compressed):
    others, message = LOADED[case]
    path = tmp_path / "x.mat"
    scipy.io.savemat(path, {**others, "M": M, "K": csc(K)}, do_compression=compressed)
    found = fj.read_matrices(path)
    assert set(found.matrices) == {"M", "K"} and set(found.unread) == set(others)
    np.testing.assert_array_equal(found.matrices["K"].toarray(), K)
    np.testing.assert_array_equal(found.matrices["M"].toarray(), M)
    for name in others:
        with pytest.raises(ValueError, match=r"^x\.mat: ") as caught:
            found.matrices[name]
        assert "\n" not in str(caught.value) and str(caught.value)[7:] in repr(found)
    with pytest.raises(ValueError, match=message):
        found.matrices[next(iter(others))]
    with pytest.raises(KeyError):
        found.matrices["X"]
    scipy.io.savemat(path, others, do_compression=compressed)
    with pytest.raises(ValueError, match=message):
        fj.read_matrices(path)


def test_an_object_of_matlab(tmp_path):
    """Its name comes first, it has no size, and a part of it without a name ends the file."""

    def element(kind, content):
        content = content.ljust(-(-len(content) // 8) * 8, b"\0")
        return struct.pack("<2I", kind, len(content)) + content

    scipy.io.savemat(tmp_path / "x.mat", {"K": K})
    flags = element(6, struct.pack("<2I", 17, 0))
    names = b"".join(element(1, text) for text in (b"title\0\0\0", b"MCOS\0\0\0\0", b"string\0\0"))
    rest = element(6, struct.pack("<2I", 9, 0)) + element(5, struct.pack("<2i", 1, 8))
    rest += element(1, b"") + element(2, b"12345678")
    content = (tmp_path / "x.mat").read_bytes() + element(14, flags + names) + element(14, rest)
    (tmp_path / "x.mat").write_bytes(content)
    found = fj.read_matrices(tmp_path / "x.mat")
    assert list(found.matrices) == ["K"]
    assert "must be real numbers, got an object" in " ".join(found.unread.values())


def test_arrays_of_numpy(tmp_path):
    np.savez(tmp_path / "x.npz", M=M, K=K, Z=1j * K, note="a")
    found = fj.read_matrices(tmp_path / "x.npz")
    assert list(found.matrices) == ["M", "K", "Z"] and list(found.unread) == ["note"]
    np.testing.assert_array_equal(found.matrices["Z"].toarray(), 1j * K)


Z = np.array([[1 + 2j, 0], [3 - 1j, 4 + 1j]])


def complex_op4(word, kind, layout):
    """The two columns of Z, in words of 4 bytes or in text."""
    if word == "text":
        per = 2 if kind == 4 else 1
        big = layout == "big"
        found = [f"{2:8d}{-2 if big else 2:8d}{6:8d}{kind:8d}Z       1P,3E23.16"]
        for j in (0, 1):
            numbers = np.array([(x.real, x.imag) for x in Z[j:, j]]).ravel()
            words = per * len(numbers)
            if layout == "dense":
                found += [f"{j + 1:8d}{j + 1:8d}{len(numbers):8d}"]
            elif big:
                found += [f"{j + 1:8d}{0:8d}{words + 2:8d}", f"{words + 1:8d}{j + 1:8d}"]
            else:
                found += [f"{j + 1:8d}{0:8d}{words + 1:8d}", f"{j + 1 + 65536 * (words + 1):8d}"]
            texts = [f"{x:23.16E}" for x in numbers]
            found += ["".join(texts[k : k + 3]) for k in range(0, len(texts), 3)]
        return "\n".join([*found, f"{3:8d}{1:8d}{1:8d}", f"{1:23.16E}", ""]).encode()

    def record(content):
        return struct.pack("<i", len(content)) + content + struct.pack("<i", len(content))

    rows = -2 if layout == "big" else 2
    content = record(struct.pack("<4i", 2, rows, 6, kind) + b"Z       ")
    for j in (0, 1):
        numbers = Z[j:, j].astype("<c16" if kind == 4 else "<c8").tobytes()
        words = len(numbers) // 4
        if layout == "dense":
            head = struct.pack("<3i", j + 1, j + 1, words)
        elif layout == "big":
            head = struct.pack("<5i", j + 1, 0, words + 2, words + 1, j + 1)
        else:
            head = struct.pack("<4i", j + 1, 0, words + 1, j + 1 + 65536 * (words + 1))
        content += record(head + numbers)
    return content + record(struct.pack("<3i", 3, 1, 1) + b"\0" * 8)


@pytest.mark.parametrize("layout", ["dense", "small", "big"])
@pytest.mark.parametrize("kind", [3, 4])
@pytest.mark.parametrize("word", ["binary", "text"])
def test_a_complex_matrix_in_op4(tmp_path, word, kind, layout):
    """First, in the middle and last."""
    path = tmp_path / "x.op4"
    write = op4_text(layout) if word == "text" else op4_binary("<", 4, 2, layout)
    write(path, K)
    real, other = path.read_bytes(), complex_op4(word, kind, layout)
    mass = real.replace(b"KAA", b"MAA")
    again = other.replace(b"Z       ", b"Y       ", 1)
    for content in (other + real + mass, real + other + again + mass, real + mass + other):
        path.write_bytes(content)
        found = fj.read_matrices(path)
        assert set(found.matrices) == {"KAA", "MAA", "Z"} | ({"Y"} if again in content else set())
        np.testing.assert_array_equal(found.matrices["MAA"].toarray(), K)
        for name in found.matrices.keys() - {"KAA", "MAA"}:
            np.testing.assert_array_equal(found.matrices[name].toarray(), Z)


def test_matrices_of_op4_that_nobody_asks_for(tmp_path):
    """Empty, and with an entry outside."""
    op4_text("dense")(tmp_path / "x.op4", K)
    end = f"{1:23.16E}\n"
    empty = f"{0:8d}{4:8d}{2:8d}{2:8d}E       1P,3E23.16\n{1:8d}{1:8d}{1:8d}\n{end}"
    out = f"{1:8d}{1:8d}{2:8d}{2:8d}O       1P,3E23.16\n{1:8d}{2:8d}{1:8d}\n{end}"
    out += f"{2:8d}{1:8d}{1:8d}\n{end}"
    (tmp_path / "x.op4").write_text(empty + out + (tmp_path / "x.op4").read_text())
    found = fj.read_matrices(tmp_path / "x.op4")
    assert list(found.matrices) == ["KAA"] and set(found.unread) == {"E", "O"}
    assert "an entry lies outside 1 x 1" in found.unread["O"]


def test_a_complex_matrix_in_dmig_cards(tmp_path):
    """Real and imaginary parts, and amplitudes with phases in degrees; symmetric, not Hermitian."""
    parts = ["DMIG,K4,0,6,4", "DMIG,K4,7,2,,9,1,1.,3.", "+,7,2,2."]
    polar = ["DMIG,K5,0,6,3,,1", "DMIG,K5,7,2,,7,2,2.,90."]
    real = ["DMIG,K,0,6,2", "DMIG,K,7,2,,7,2,2.5"]
    for order in (parts + real + polar, real + polar + parts):
        lines(tmp_path / "x.pch", order)
        found = fj.read_matrices(tmp_path / "x.pch")
        assert found.names == ("7.2", "9.1") and not found.unread
        K, K4, K5 = (found.matrices[name].toarray() for name in ("K", "K4", "K5"))
        np.testing.assert_array_equal(K, [[2.5, 0], [0, 0]])
        np.testing.assert_array_equal(K4, [[2, 1 + 3j], [1 + 3j, 0]])
        np.testing.assert_allclose(K5, [[2j, 0], [0, 0]], atol=1e-15)


TRIANGLE = "1,1,1,1,2.\n2,1,1,1,-5.\n2,1,2,1,9.\n"


def test_a_mirrored_triangle_is_named(tmp_path):
    said = "n_STIF1 has entries in one triangle only, which was mirrored"
    for text in (TRIANGLE, "1 1 2.\n2 1 -5.\n2 2 9.\n"):
        (tmp_path / "n_STIF1.mtx").write_text(text)
        found = fj.read_matrices(tmp_path / "n_STIF1.mtx")
        np.testing.assert_array_equal(found.matrices["n_STIF1"].toarray(), [[2, -5], [-5, 9]])
        assert found.mirrored == ("n_STIF1",)
        assert found.notes[0].startswith(said) and said in repr(found)
    for text in (TRIANGLE + "1,1,2,1,-4.\n", "1,1,1,1,2.\n2,1,2,1,9.\n"):  # full, and diagonal
        (tmp_path / "n_STIF1.mtx").write_text(text)
        found = fj.read_matrices(tmp_path / "n_STIF1.mtx")
        assert found.mirrored == () and found.notes == () and "mirrored" not in repr(found)
    (tmp_path / "K.mtx").write_text(
        "%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n1 1 2\n2 1 3\n"
    )
    assert fj.read_matrices(tmp_path / "K.mtx").mirrored == ()  # the file says so


JOINT = """
[joints.pad]
tangential = "1.1"
normal = "2.1"
V = 0.2
[joints.pad.contact]
law = "fixed"
K_n = 3e6
K_t = 1e6
[joints.pad.friction]
law = "coulomb"
mu = 0.1
"""


def test_a_structure_tells_of_a_mirrored_triangle(tmp_path, capsys):
    (tmp_path / "n_STIF1.mtx").write_text(TRIANGLE)
    (tmp_path / "n_MASS1.mtx").write_text("1,1,1,1,1.\n2,1,2,1,1.\n")
    path = tmp_path / "brake.toml"
    path.write_text('[structure]\nM = "n_MASS1.mtx"\nK = "n_STIF1.mtx"\n' + JOINT)
    structure: Any = fj.load(path)
    note = "n_STIF1.mtx: n_STIF1 has entries in one triangle only"
    assert len(structure.notes) == 1 and structure.notes[0].startswith(note)
    assert note in repr(structure) and structure.replace(K_n=1e6).notes == structure.notes
    status, _, err = run_command(capsys, "stability", path)
    assert status == 0 and err.startswith(f"fractaljax: {note}") and err.count("\n") == 1
    _, _, err = run_command(capsys, "reduce", path, "--band", "0:9", "--out", tmp_path / "out")
    assert err.startswith(f"fractaljax: {note}")  # before it refuses so small a structure


def test_a_structure_takes_what_it_names(tmp_path):
    """From a file that also holds text and a complex K: K + i K_loss, where it is taken."""
    damped = {"M": M, "K": K + 0.5j * K, "K_r": K, "note": "a"}
    scipy.io.savemat(tmp_path / "x.mat", damped)
    path = tmp_path / "brake.toml"
    text = '[structure]\nmatrices = "x.mat"\n{}' + JOINT.replace('"1.1"', "0").replace('"2.1"', "1")
    path.write_text(text.format('K = "K_r"\n'))
    structure: Any = fj.load(path)
    np.testing.assert_array_equal(structure.K, K)
    assert structure.K_loss is None
    for line in ("", 'K = "K"\n', 'K = [{matrix = "K", file = "x.mat"}]\n'):
        path.write_text(text.format(line))
        structure = fj.load(path)
        np.testing.assert_array_equal(structure.K, K)
        np.testing.assert_array_equal(structure.K_loss, K / 2)
    scipy.io.savemat(tmp_path / "two.mat", {"K": K, "M": 1j * M})
    path.write_text(text.replace("x.mat", "two.mat").format(""))
    with pytest.raises(ValueError, match="M must be an array of real numbers, got complex128"):
        fj.load(path)


def logical(path, tagged_as, count):
    """A sparse logical as MATLAB writes it: the values are bytes, with the tag of doubles."""
    A = scipy.sparse.csc_matrix((np.ones(count, bool), np.arange(count), np.arange(count + 1)))
    scipy.io.savemat(path, {"A": A})
    content = bytearray(path.read_bytes())
    assert content.count(b"\x01" * count) == 1
    at = content.index(b"\x01" * count) - (4 if count <= 4 else 8)
    assert content[at] == 2  # of bytes
    content[at] = tagged_as
    path.write_bytes(content)


@pytest.mark.parametrize("tagged_as", [2, 9])
@pytest.mark.parametrize("count", [3, 7, 8, 16])
def test_sparse_logicals(tmp_path, tagged_as, count):
    logical(tmp_path / "x.mat", tagged_as, count)
    found = fj.read_matrices(tmp_path / "x.mat").matrices["A"]
    np.testing.assert_array_equal(found.toarray(), np.eye(count))


@pytest.mark.parametrize("order", "<>")
def test_matlab_4(tmp_path, order):
    """Full numbers of every type, sparse ones, text, and complex ones, in both orders of bytes."""

    def variable(name, number, what, array, imaginary=b""):
        machine = 1000 * (order == ">") + 10 * number + what
        head = (machine, *array.shape, int(bool(imaginary)), len(name) + 1)
        return struct.pack(f"{order}5i", *head) + name + b"\0" + array.tobytes("F") + imaginary

    content, types = b"", ("f8", "f4", "i4", "i2", "u2", "u1")
    whole = np.array([[1.0, 2], [3, 4]])
    for number, dtype in enumerate(types):
        content += variable(f"A{number}".encode(), number, 0, whole.astype(order + dtype))
    imaginary = whole.astype(f"{order}f8").tobytes()
    content += variable(b"Z", 0, 0, whole.T.astype(f"{order}f8"), imaginary)
    content += variable(b"note", 5, 1, np.array([[72, 105]], "u1"))
    table = np.array([[1, 1, 5.0], [3, 2, -1], [3, 3, 0]], f"{order}f8")
    content += variable(b"S", 0, 2, table)
    content += variable(b"Y", 0, 2, np.insert(table, 3, [2.0, 0, 0], axis=1))
    (tmp_path / "x.mat").write_bytes(content)
    found = fj.read_matrices(tmp_path / "x.mat")
    assert list(found.matrices) == [*(f"A{k}" for k in range(6)), "Z", "S", "Y"]
    for k in range(6):
        np.testing.assert_array_equal(found.matrices[f"A{k}"].toarray(), whole)
    np.testing.assert_array_equal(found.matrices["S"].toarray(), [[5, 0, 0], [0, 0, 0], [0, -1, 0]])
    # Columns come first in the file, so that the bytes of `whole` are those of its transpose.
    np.testing.assert_array_equal(found.matrices["Z"].toarray(), whole.T + 1j * whole.T)
    np.testing.assert_array_equal(found.matrices["Y"].toarray()[0], [5 + 2j, 0, 0])
    assert "text" in found.unread["note"]
    for bad in ([4, 1, 1], [1.5, 1, 1], [np.nan, 1, 1], [0, 1, 1]):
        table[0] = bad
        (tmp_path / "x.mat").write_bytes(variable(b"S", 0, 2, table))
        with pytest.raises(ValueError, match=r"^x\.mat: S is damaged: "):
            fj.read_matrices(tmp_path / "x.mat")


BANNER = "%%MatrixMarket matrix coordinate real general\n% a\n2 2 2\n1 1 3\n2 1 4\n"


@pytest.mark.parametrize("before", ["\n", " ", "\r\n\n  ", "\ufeff", "\ufeff\n"])
def test_blanks_before_matrix_market(tmp_path, before):
    path = tmp_path / "K.mtx"
    path.write_bytes((before + BANNER).encode())
    np.testing.assert_array_equal(fj.read_matrices(path).matrices["K"].toarray(), [[3, 0], [4, 0]])
    path.write_bytes((before + BANNER.replace("2 1 4", "2 x 4")).encode())
    line = 5 + before.count("\n")
    with pytest.raises(ValueError, match=rf"^K\.mtx: line {line} must be 'row column number'"):
        fj.read_matrices(path)
