"""Decks with loss factors: complex stiffness in every format, parts added by grid and component."""

import re
import sys
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.linalg
import scipy.sparse
from test_unread_matrices import complex_op4

import fractaljax as fj
from tools import run_command

PAD = np.array([[2.0, -1.0, 0.0], [-1.0, 3.0, -1.0], [0.0, -1.0, 2.0]]) * 1e6
SHIM = np.diag([0.0, 4e5, 1e5])
GE = {"pad": 0.06, "shim": 0.3}  # loss factors
K, K_LOSS = PAD + SHIM, GE["pad"] * PAD + GE["shim"] * SHIM
M = np.diag([0.2, 0.1, 0.3])
NAMES = ("7.1", "7.3", "9.1")
JOINT = """
[joints.pad]
tangential = {t}
normal = {n}
V = 0.2
loss_factor = 0.05
[joints.pad.contact]
law = "fixed"
K_n = 3e5
K_t = 1e5
[joints.pad.friction]
law = "coulomb"
mu = 0.3
"""
BY_NAME, BY_INDEX = JOINT.format(t='"7.1"', n='"7.3"'), JOINT.format(t=0, n=1)


def eigenvalues(mu=0.3):
    """With Im s > 0, of the deck with its joint, by SciPy."""
    k_n, k_t = 3e5 * (1 + 0.05j), 1e5 * (1 + 0.05j)
    joint = np.array([[k_t, -mu * k_n, 0], [mu * k_t, k_n, 0], [0, 0, 0]])
    s = np.sqrt(-scipy.linalg.eigvals(np.linalg.solve(M, K + 1j * K_LOSS + joint)))
    return np.sort_complex(np.where(s.imag > 0, s, -s))


def assert_right(structure: Any):
    np.testing.assert_allclose(structure.K, K, rtol=1e-15)
    np.testing.assert_allclose(structure.K_loss, K_LOSS, rtol=1e-15)
    assert structure.joints[0].loss_factor == 0.05
    ours: Any = np.asarray(fj.stability(structure).eigenvalues)
    np.testing.assert_allclose(np.sort_complex(ours[ours.imag > 0]), eigenvalues(), rtol=1e-11)


def dmig(name, matrix, kind=2):
    """Cards of a symmetric matrix; complex ones are of type 4."""
    cards = [f"DMIG,{name},0,6,{kind}"]
    for i in range(3):
        for j in range(i + 1):
            x = complex(matrix[i, j])
            if x:
                row, column = NAMES[i].replace(".", ","), NAMES[j].replace(".", ",")
                more = f",{x.imag:.17e}" if kind == 4 else ""
                cards.append(f"DMIG,{name},{column},,{row},{x.real:.17e}{more}")
    return "\n".join(cards) + "\n"


def write_mat(path):
    scipy.io.savemat(path / "deck.mat", {"M": M, "K": scipy.sparse.csc_array(K + 1j * K_LOSS)})
    return 'matrices = "deck.mat"\n' + BY_INDEX


def write_market(path):
    for name, X in {"M": M, "K": K + 1j * K_LOSS}.items():
        scipy.io.mmwrite(path / f"{name}.mtx", scipy.sparse.coo_array(X), precision=17)
    return 'M = "M.mtx"\nK = "K.mtx"\n' + BY_INDEX


def write_dmig(path):
    text = dmig("K2GG", K + 1j * K_LOSS, 4) + dmig("M2GG", M)
    (path / "deck.pch").write_text(text)
    return 'matrices = "deck.pch"\nK = "K2GG"\nM = "M2GG"\n' + BY_NAME


def write_parts(path):
    """Each part with its GE, among other matrices of a file; the shim by its own cards."""
    (path / "deck.pch").write_text(dmig("KGG", PAD) + dmig("MGG", M) + dmig("K4", PAD))
    (path / "shim.bdf").write_text(dmig("K2PP", SHIM) + dmig("OTHER", SHIM))
    shim = '{matrix = "K2PP", file = "shim.bdf", loss_factor = 0.3}'
    terms = f'K = [{{matrix = "KGG", loss_factor = 0.06}}, {shim}]\n'
    return 'matrices = "deck.pch"\nM = "MGG"\n' + terms + BY_NAME


def write_numpy(path):
    np.savez(path / "deck.npz", M=M, K=K, K_loss=K_LOSS)
    return 'matrices = "deck.npz"\n' + BY_INDEX


DECKS = [write_mat, write_market, write_dmig, write_parts, write_numpy]


@pytest.mark.parametrize("write", DECKS)
def test_a_deck_with_loss_factors(tmp_path, write, capsys):
    path = tmp_path / "deck.toml"
    path.write_text("[structure]\n" + write(tmp_path))
    structure: Any = fj.load(path)
    assert_right(structure)
    structure.save(tmp_path / "again.toml")
    assert_right(fj.load(tmp_path / "again.toml"))
    if write is write_parts:
        status, out, _ = run_command(capsys, "stability", path)
        growth = float(re.findall(r"growth rate \[1/s\] +(\S+)", out)[0])
        assert status == 0 and abs(growth - eigenvalues().real.max()) < 1e-4


def test_one_loss_factor_for_all(tmp_path):
    """As Nastran's PARAM,G; Rayleigh's damping takes the real part of K."""
    np.savez(tmp_path / "deck.npz", M=M, K=K)
    path = tmp_path / "deck.toml"
    text = (
        '[structure]\nmatrices = "deck.npz"\nrayleigh = [0.0, 1e-6]\nloss_factor = {}\n[joints]\n'
    )
    path.write_text(text.format(0.04))
    structure: Any = fj.load(path)
    np.testing.assert_allclose(structure.K_loss, 0.04 * K, rtol=1e-15)
    np.testing.assert_allclose(structure.C, 1e-6 * K, rtol=1e-15)
    for value in ("-0.1", '"a"'):
        path.write_text(text.format(value))
        with pytest.raises(ValueError, match="loss_factor"):
            fj.load(path)


def test_a_complex_matrix_of_op4_is_taken(tmp_path):
    (tmp_path / "K.op4").write_bytes(complex_op4("binary", 4, "big"))
    Z = fj.read_matrices(tmp_path / "K.op4").matrices["Z"]
    structure = fj.Structure(np.eye(2), None, Z)
    np.testing.assert_array_equal(structure.K, [[1, 0], [3, 4]])
    np.testing.assert_array_equal(structure.K_loss, [[2, 0], [-1, 1]])


def test_parts_are_added_by_name():
    base = fj.Structure(M, None, PAD, names=NAMES, K_loss=GE["pad"] * PAD)
    small = SHIM[1:, 1:]
    whole = base.add(NAMES[1:], (1 + 1j * GE["shim"]) * small)
    np.testing.assert_allclose(whole.complex_K, K + 1j * K_LOSS, rtol=1e-15)
    swapped = base.add(["9.1", 1], small[::-1, ::-1], M=np.eye(2), C=2 * np.eye(2))
    np.testing.assert_allclose(swapped.K, K, rtol=1e-15)
    np.testing.assert_array_equal(swapped.M, M + np.diag([0, 1, 1]))
    np.testing.assert_array_equal(swapped.C, np.diag([0, 2, 2]))
    assert type(whole) is fj.Structure and whole.names == NAMES
    sums = fj.ParametricStructure(M, None, [("k", PAD)], parameters={"k": 2.0})
    more = sums.add([1, 2], [("k", small)]).replace(k=3.0)
    np.testing.assert_allclose(more.K, 3 * K, rtol=1e-15)
    sparse = fj.Structure(scipy.sparse.eye_array(2001), None, scipy.sparse.eye_array(2001))
    held = sparse.add([3, 2000], small, K_loss=small).sums
    assert held["K"].sparse[0].matrix[3, 3] == 1 + 4e5
    assert held["K_loss"].sparse[0].matrix[2000, 2000] == 1e5
    for dofs, X, message in [
        (("7.1", "x"), small, "unknown degree of freedom 'x'"),
        (("7.1", 0), small, "dofs gives one degree of freedom twice"),
        (("7.1",), small, r"K must have shape \(1, 1\), one row for each of dofs, got \(2, 2\)"),
    ]:
        with pytest.raises(ValueError, match=message):
            base.add(dofs, X)


def test_a_file_of_some_degrees_of_freedom(tmp_path):
    """Its entries go to the places of their names; a name without a place is refused."""
    (tmp_path / "deck.pch").write_text(dmig("KGG", PAD) + dmig("MGG", M))
    (tmp_path / "k2pp.bdf").write_text("DMIG,K2PP,0,6,2\nDMIG,K2PP,9,1,,7,3,-5.\n,9,1,7.\n")
    path = tmp_path / "deck.toml"
    text = '[structure]\nmatrices = "deck.pch"\nM = "MGG"\nK = [{}]\n' + BY_NAME
    both = '{matrix = "KGG"}, {matrix = "K2PP", file = "k2pp.bdf"}'
    path.write_text(text.replace("{}", both))
    structure: Any = fj.load(path)
    np.testing.assert_array_equal(structure.K - PAD, [[0, 0, 0], [0, 0, -5], [0, -5, 7]])
    path.write_text(text.replace("{}", both.replace('"K2PP"', '"X"')))
    with pytest.raises(ValueError, match=r"k2pp\.bdf has no 'X'; it holds K2PP"):
        fj.load(path)
    (tmp_path / "k2pp.bdf").write_text("DMIG,K2PP,0,6,2\nDMIG,K2PP,8,1,,8,1,7.\n")
    path.write_text(text.replace("{}", both))
    with pytest.raises(ValueError, match=r"k2pp\.bdf has the degree of freedom 8\.1, which the"):
        fj.load(path)


def test_matlab_7_3(tmp_path, monkeypatch):
    """By h5py: columns first, complex numbers as pairs, sparse matrices as groups."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "x.mat"
    pair = np.dtype([("real", "f8"), ("imag", "f8")])
    S = scipy.sparse.csc_array([[0.0, 2.0], [3.0, 0.0]])
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name, value, kind=b"double", **attributes):
            item = (
                file.create_group(name) if value is None else file.create_dataset(name, data=value)
            )
            for key, x in {"MATLAB_class": np.bytes_(kind), **attributes}.items():
                item.attrs[key] = x
            return item

        A = np.array([[1.0, 2.0], [3.0, 4.0]])
        put("A", A.T)
        put("n", np.array([[7]], "i4"), b"int32")
        put("Z", np.array([*zip(A.T.ravel(), A.ravel(), strict=True)], pair).reshape(2, 2))
        sparse = put("S", None, MATLAB_sparse=np.uint64(2))
        for name, x in (("data", S.data), ("ir", S.indices), ("jc", S.indptr)):
            sparse.create_dataset(name, data=x)
        put("note", np.array([[97], [98]], "u2"), b"char", MATLAB_int_decode=2)
        put("parts", np.zeros((1, 1)), b"cell")
        put("about", None, b"struct")
        file.create_group("#refs#")
    content = bytearray(path.read_bytes())
    content[:10] = b"MATLAB 7.3"
    path.write_bytes(content)
    found = fj.read_matrices(path)
    assert set(found.matrices) == {"A", "n", "Z", "S"}
    assert set(found.unread) == {"note", "parts", "about"} and "text" in found.unread["note"]
    np.testing.assert_array_equal(found.matrices["A"].toarray(), A)
    np.testing.assert_array_equal(found.matrices["Z"].toarray(), A + 1j * A.T)
    np.testing.assert_array_equal(found.matrices["S"].toarray(), S.toarray())
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"^x\.mat: it is damaged"):
        fj.read_matrices(path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ValueError, match=r"version 7\.3, which h5py reads: type 'pip"):
        fj.read_matrices(path)
