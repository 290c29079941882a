"""Structures in files: every kind read, round trips, damage and mistakes refused in one line."""

import bz2
import errno
import gzip
import io
import os
import threading
import warnings
import zipfile
from typing import Any

import jax
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import fractaljax as fj
from fractaljax._mechanism.structure_file import _npz
from structures import matrices, two_joints
from tools import refused_command, run_command

M, C, K = matrices(3)
CONTACT = '[joints.pad.contact]\nlaw = "fixed"\nK_n = 3e6\nK_t = 1e6\n'
JOINT = f"""
[joints.pad]
tangential = ["x", "y"]
normal = "z"
V = 0.2

{CONTACT}
[joints.pad.friction]
law = "coulomb"
mu = 0.4
"""


def equal(left, right):
    assert (left.joint_names, left.names) == (right.joint_names, right.names)
    assert jax.tree.structure(left) == jax.tree.structure(right)
    same = jax.tree.map(lambda x, y: bool((x == y).all()) and x.dtype == y.dtype, left, right)
    assert jax.tree.all(same)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Matrices of three degrees of freedom in files of every kind, and damaged ones."""
    folder = tmp_path_factory.mktemp("files")
    archives: dict[str, dict[str, Any]] = {
        "all": dict(M=M, C=C, K=K, F=np.array([1.0, 2.0, 3.0])),
        "two": dict(M=M, K=K),
        "big": dict(M=M.astype(">f8"), K=np.asfortranarray(K)),
        "odd": dict(M=M, Kay=K),
        "pickled": dict(M=np.array([None, 1], dtype=object), K=K),
        "scalar": dict(M=np.array(1.0), K=K),
    }
    for name, arrays in archives.items():
        np.savez(folder / f"{name}.npz", **arrays)
    scipy.io.mmwrite(folder / "M.mtx", scipy.sparse.coo_matrix(M), symmetry="symmetric")
    scipy.io.mmwrite(folder / "K.mtx", K)
    scipy.io.mmwrite(folder / "C.mtx", scipy.sparse.coo_matrix(C), symmetry="general")
    scipy.io.mmwrite(folder / "F.mtx", np.array([[1.0], [2.0], [3.0]]))
    scipy.io.mmwrite(folder / "huge.mtx", scipy.sparse.eye_array(100_000).tocoo())
    for suffix, compress in ((".gz", gzip.compress), (".bz2", bz2.compress)):
        packed = compress((folder / "K.mtx").read_bytes())
        (folder / f"K.mtx{suffix}").write_bytes(packed)
        (folder / f"cut.mtx{suffix}").write_bytes(packed[:-9])
        (folder / f"no.mtx{suffix}").write_text("hello")
    header = io.BytesIO()
    about = {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
    np.lib.format.write_array_header_1_0(header, about)
    packed_members = {"bomb": [b""], "twice": [b"", b""], "liar": [header.getvalue()]}
    for name, members in packed_members.items():
        with warnings.catch_warnings(), zipfile.ZipFile(folder / f"{name}.npz", "w") as file:
            warnings.simplefilter("ignore")  # of the name twice
            for member in members:
                file.writestr("M.npy", member)
    bomb = (folder / "bomb.npz").read_bytes()
    place = bomb.index(b"PK\x01\x02") + 24  # of the size in the directory
    size = (4_000_000_000).to_bytes(4, "little")
    (folder / "bomb.npz").write_bytes(bomb[:place] + size + bomb[place + 4 :])
    whole = bytearray((folder / "two.npz").read_bytes())
    (folder / "cut.npz").write_bytes(whole[:-50])
    for mark, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        whole[whole.index(mark) + flags] |= 1
    (folder / "encrypted.npz").write_bytes(whole)
    (folder / "no.mtx").write_text("hello")
    return folder


def written(folder, structure, joints=JOINT, names='names = ["x", "y", "z"]'):
    path = folder / "brake.toml"
    path.write_text(f"[structure]\n{names}\n{structure}\n{joints}")
    return path


@pytest.mark.parametrize(
    "text",
    [
        'matrices = "all.npz"',
        'M = "M.mtx"\nC = "C.mtx"\nK = "K.mtx"\nF = "F.mtx"',
        'M = "M.mtx"\nC = "C.mtx"\nK = "K.mtx.gz"\nF = "F.mtx"',
        'M = "M.mtx"\nC = "C.mtx"\nK = "K.mtx.bz2"\nF = "F.mtx"',
        'matrices = "two.npz"\nC = "C.mtx"\nF = [1.0, 2.0, 3]',
        'matrices = "big.npz"\nC = "C.mtx"\nF = {x = 1.0, y = 2.0, 2 = 3}',
    ],
)
def test_matrices_from_every_kind_of_file(files, text):
    joint = fj.Joint(fj.FixedContact(3e6, 1e6), fj.Coulomb(0.4), ("x", "y"), "z", V=0.2)
    expected = fj.Structure(M, C, K, {"pad": joint}, [1.0, 2.0, 3.0], ("x", "y", "z"))
    found = fj.load(written(files, text))
    assert isinstance(found, fj.Structure)
    equal(found, expected)


def test_terms_add_to_the_matrix_of_the_file(files):
    """The file of matrices holds K, and the table adds a part of another file to it."""
    scipy.io.mmwrite(files / "part.mtx", np.diag([1e6, 0.0, 2e6]))
    text = 'matrices = "all.npz"\nK = [{matrix = "K"}, {matrix = "part", file = "part.mtx"}]'
    found = fj.load(written(files, text))
    np.testing.assert_allclose(found.K, K + np.diag([1e6, 0.0, 2e6]), rtol=1e-15)


@pytest.mark.parametrize(
    ("names", "F", "expected"),
    [
        ('names = ["2", "0", "1"]', '{"0" = 500, 2 = 7}', [7.0, 500.0, 0.0]),  # these are names
        ("", "{0 = 500}", [500.0, 0.0, 0.0]),
    ],
)
def test_forces_by_name_or_index(files, names, F, expected):
    path = written(files, f'matrices = "two.npz"\nF = {F}', "[joints]", names)
    structure: Any = fj.Structure.load(path)
    np.testing.assert_array_equal(structure.F, expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", np.zeros((3, 3))),
        ("rayleigh = [2.0, 1e-6]", fj.rayleigh_damping(M, K, 2.0, 1e-6)),
        ("damping_ratio = 0.01", fj.modal_damping(M, K, 0.01)),
        ("damping_ratio = [0.01, 0, 0.03]", fj.modal_damping(M, K, np.array([0.01, 0, 0.03]))),
    ],
)
def test_damping_from_numbers(files, text, expected):
    structure = fj.Structure.load(written(files, f'matrices = "two.npz"\n{text}'))
    np.testing.assert_allclose(structure.C, expected, rtol=1e-12, atol=1e-12)


def test_no_flipped_byte_of_a_npz_file_passes_unnoticed(files):
    whole = (files / "two.npz").read_bytes()
    for place in np.random.default_rng(0).integers(len(whole), size=150):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (place % 8)
        (files / "damaged.npz").write_bytes(damaged)
        try:
            found = _npz(files / "damaged.npz")
        except ValueError as error:
            assert "\n" not in str(error)
            continue
        np.testing.assert_array_equal(found["M"], M)
        np.testing.assert_array_equal(found["K"], K)


NAMES = ('a "quoted" one', "b\\c", "dünn", "d")
BEAM = matrices(4)
FRACTAL = fj.Joint(fj.brake_scene().contact, fj.Coulomb(0.3), "d", 0)


@pytest.mark.parametrize(
    "structure",
    [
        two_joints(4),
        two_joints(4).replace(F=None, friction=fj.Coulomb(0.3)),
        fj.Structure(*BEAM, FRACTAL, names=NAMES),
        fj.Structure(BEAM[0], None, BEAM[2], []),
        jax.tree.map(lambda x: x.astype(np.float32), fj.Structure(*BEAM, [])),
    ],
)
def test_round_trip(tmp_path, structure):
    structure.save(tmp_path / "s.toml")
    equal(fj.Structure.load(tmp_path / "s.toml"), structure)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["s.npz", "s.toml"]
    assert f"written by fractaljax {fj.__version__}." in (tmp_path / "s.toml").read_text()


def test_save_refuses_and_a_pipe_is_read_once(tmp_path):
    structure = two_joints(4)
    with pytest.raises(ValueError, match=r"path must be that of the TOML file, got '.*s.npz'"):
        structure.save(tmp_path / "s.npz")
    with pytest.raises(ValueError, match="K_n must be a scalar"):
        structure.replace(K_n=np.array([1e6, 2e6])).save(tmp_path / "s.toml")
    with pytest.raises(OSError, match="nowhere"):
        structure.save(tmp_path / "nowhere" / "s.toml")
    assert list(tmp_path.iterdir()) == []
    os.mkfifo(tmp_path / "pipe")
    scene = fj.brake_scene()
    writer = threading.Thread(target=(tmp_path / "pipe").write_text, args=[scene.to_toml()])
    writer.start()
    found = fj.load(tmp_path / "pipe")
    writer.join()
    assert isinstance(found, fj.Scene)
    assert found.to_toml() == scene.to_toml()


@pytest.mark.parametrize(
    "text", [None, "", "[structure]\nmatrices = 'other.npz'", "structure = 3", "not = = toml"]
)
def test_save_leaves_matrices_of_others_alone(tmp_path, text):
    """A .npz file belongs to the TOML file that names it."""
    np.savez(tmp_path / "s.npz", mine=np.arange(3.0))
    before = (tmp_path / "s.npz").read_bytes()
    if text is not None:
        (tmp_path / "s.toml").write_text(text)
    with pytest.raises(ValueError, match=r"s\.npz is not of a structure saved as s\.toml"):
        two_joints(4).save(tmp_path / "s.toml")
    assert (tmp_path / "s.npz").read_bytes() == before


@pytest.mark.parametrize("step", [1, 3, 4])
def test_a_failed_save_leaves_the_old_structure(tmp_path, monkeypatch, step):
    """The TOML file and the matrices it names."""
    old, new = two_joints(4), two_joints(4).replace(K=2 * two_joints(4).K, V=0.7)
    old.save(tmp_path / "s.toml")
    replace, count = os.replace, [0]

    def fail(*arguments):
        count[0] += 1
        if count[0] == step:
            raise OSError(errno.ENOSPC, "disk full")
        replace(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(OSError, match="disk full"):
            new.save(tmp_path / "s.toml")
    equal(fj.Structure.load(tmp_path / "s.toml"), old)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["s.npz", "s.toml"]
    new.save(tmp_path / "s.toml")
    equal(fj.Structure.load(tmp_path / "s.toml"), new)


TWO, MTX = 'matrices = "two.npz"\n', 'M = "M.mtx"\nK = '
BAD = [
    ('matrices = "all.npz"\nmass = 3', "[structure] has the unknown key 'mass'"),
    ("matrices = 3", "[structure] matrices must be the name of a file, got 3"),
    ('M = "M.mtx"', "[structure] lacks the matrix K"),
    ('matrices = "all.npz"\nK = "K.mtx"', "[structure] gives K twice"),
    ('matrices = "all.npz"\nF = [1, 2, 3]', "[structure] gives F twice"),
    (TWO + 'C = "damping"', "two.npz has no 'damping'; it holds"),
    ('matrices = "all.npz"\ndamping_ratio = 0.01', "gives damping twice: C and damping_ratio"),
    (TWO + "rayleigh = [1, 0]\ndamping_ratio = 0.01", "gives damping twice"),
    (TWO + "rayleigh = 3", "rayleigh must be [alpha, beta], got 3"),
    (TWO + "rayleigh = [1]", "rayleigh must be [alpha, beta], got [1]"),
    (TWO + 'rayleigh = ["a", 0]', "alpha must be a number, got 'a'"),
    (TWO + "rayleigh = [-1, 0]", "alpha must be at least 0, got -1.0"),
    (TWO + "damping_ratio = [1, 2]", "damping_ratio must be a scalar or have shape"),
    (TWO + 'damping_ratio = "low"', "damping_ratio must be a number or a list of one a mode"),
    (TWO + "F = 3", "F must be a list, a table or a file's name, got 3"),
    (TWO + 'F = ["a", 2, 3]', "F must be an array of real numbers"),
    (TWO + f"F = [1{'0' * 400}, 2, 3]", "F must be an array of real numbers"),
    (TWO + f"F = {'[' * 9000}{']' * 9000}", "nested too deeply"),
    (TWO + "F = {w = 3}", "unknown degree of freedom 'w'"),
    (TWO + "F = {x = 1, 0 = 2}", "F gives one degree of freedom twice"),
    (TWO + "F = {0 = 1, 00 = 2}", "unknown degree of freedom '00'"),
    (TWO + 'F = {"\u0660" = 1}', "unknown degree of freedom '\u0660'"),
    ('matrices = "odd.npz"', "odd.npz has the unknown key 'Kay'; known are M, C, K, F"),
    ('matrices = "pickled.npz"', "pickled.npz: M must be real numbers, got object"),
    ('matrices = "scalar.npz"', "M must be a square matrix, got shape ()"),
    ('matrices = "encrypted.npz"', "encrypted.npz: M is encrypted"),
    ('matrices = "bomb.npz"', "bomb.npz: it unpacks to 4000000000 bytes, at most 1073741824"),
    ('matrices = "twice.npz"', "twice.npz: it holds two arrays of one name"),
    ('matrices = "liar.npz"', "liar.npz: M is damaged: 8000000000000 bytes"),
    ('matrices = "cut.npz"', "cut.npz: it is no sound file of numbers"),
    ('matrices = "missing.npz"', "missing.npz"),
    ('M = "no.mtx"\nK = "K.mtx"', "no.mtx: it is neither a Matrix Market file nor"),
    ('M = "/dev/zero"\nK = "K.mtx"', "zero: of unknown format"),
    ('M = "huge.mtx"\nK = "K.mtx"', "K must have shape (100000, 100000) as M demands"),
    (MTX + '"F.mtx"', "K must be a square matrix, got shape (3, 1)"),
    *((MTX + f'"{name}"', f"{name}: it is damaged") for name in ("cut.mtx.gz", "cut.mtx.bz2")),
    *((MTX + f'"{name}"', f"{name}: it is damaged") for name in ("no.mtx.gz", "no.mtx.bz2")),
    ('matrices = "all.npz"\nM =', "not a TOML file"),
]
BAD_JOINTS = [
    ("", "the table [joints] is missing"),
    (JOINT.replace("V = 0.2", "speed = 0.2"), "[joints.pad] has the unknown key 'speed'"),
    (JOINT.replace('normal = "z"', ""), "[joints.pad] a joint without normal needs a contact with"),
    (JOINT.replace('"z"', '"w"'), "joint pad: unknown degree of freedom 'w'; the structure has x"),
    (JOINT.replace('"z"', "1.5"), "[joints.pad] normal must be a degree of freedom or a pair"),
    (JOINT.replace("pad.contact", "pad.spring"), "[joints.pad] has the unknown key 'spring'"),
    (JOINT.replace(CONTACT, ""), "the table [joints.pad.contact] is missing"),
    (JOINT.replace('"fixed"', '"glued"'), "[joints.pad.contact] law must be"),
    (JOINT.replace("mu = 0.4", "mu = -1"), "[joints.pad.friction] mu must be above 0, got -1.0"),
    (JOINT.replace("V = 0.2", "V = -1"), "[joints.pad] V must be at least 0, got -1.0"),
    (JOINT.replace("joints.pad", 'joints."a b"'), "a joint's name must be of letters"),
    (JOINT + "[oscillator]\nm = 1", "the file has the unknown key 'oscillator'"),
]


@pytest.mark.parametrize(
    ("text", "joints", "message"),
    [
        *((text, JOINT, message) for text, message in BAD),
        *(('matrices = "all.npz"', joints, message) for joints, message in BAD_JOINTS),
    ],
)
def test_bad_files_are_refused_in_one_line(files, text, joints, message):
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        fj.load(written(files, text, joints))
    error = str(caught.value)
    assert message in error and "\n" not in error
    assert "brake.toml: " in error or isinstance(caught.value, FileNotFoundError)


@pytest.mark.slow
def test_the_command_lists_the_joints(tmp_path, capsys):
    two_joints(4).save(tmp_path / "brake.toml")
    status, shown, _ = run_command(capsys, "stability", tmp_path / "brake.toml")
    assert status == 0 and "it squeals" in shown
    assert all(name in shown for name in ("left", "right"))
    assert f"{fj.growth_rate(two_joints(4)):+.6g}" in shown


@pytest.mark.parametrize(
    ("C", "K", "said"),
    [
        (0.1, 1e4, "0  (stable against small disturbances)"),
        (0.0, 1e4, "0  (2 unresolved; else stable against small disturbances)"),
        (-0.1, 1e4, "2  (it squeals)"),
        (0.1, 0.0, "1/s: rigid bodies; else stable against small disturbances)"),
    ],
)
def test_what_the_command_says(tmp_path, capsys, C, K, said):
    fj.Structure(np.eye(2), C * np.eye(2), K * np.diag([1, 1.1]), []).save(tmp_path / "s.toml")
    status, shown, _ = run_command(capsys, "stability", tmp_path / "s.toml")
    assert status == 0 and said in shown.splitlines()[1]
    assert shown.count("unresolved to") == (2 if "unresolved" in said else 0)


FREE = 1e6 * np.kron(np.eye(2), [[1, -1], [-1, 1]])
DRIVEN = fj.Joint(fj.FixedContact(1e5, 5e4), fj.Stribeck(0.4, 0.2, 0.5), (0, 1), (2, 3), V=0.1)
STIFF = fj.Joint(fj.FixedContact(1.5e308, 1e5), fj.Coulomb(0.3), 0, 1)


@pytest.mark.parametrize(
    ("structure", "message"),
    [
        (fj.Structure(np.eye(4), None, FREE, DRIVEN, F=[0, 0, 1, 2]), "no static equilibrium"),
        (fj.Structure(np.eye(4), None, FREE, DRIVEN), "F must be given"),
        (fj.Structure(np.eye(2), None, 1e308 * np.eye(2), STIFF), "K with the joints attached"),
    ],
)
def test_the_command_refuses_in_one_line(tmp_path, capsys, structure, message):
    structure.save(tmp_path / "s.toml")
    assert message in refused_command(capsys, "stability", tmp_path / "s.toml")


def test_save_writes_what_load_reads(tmp_path):
    """A scene and a structure come back; files are those of the method."""
    scene, structure = fj.brake_scene(), fj.Structure.from_scene(fj.brake_scene())
    for name, x in (("scene", scene), ("structure", structure)):
        (tmp_path / "own").mkdir(exist_ok=True)
        fj.save(x, tmp_path / f"{name}.toml")
        x.save(tmp_path / "own" / f"{name}.toml")
        text = (tmp_path / f"{name}.toml").read_bytes()
        assert text == (tmp_path / "own" / f"{name}.toml").read_bytes()
        back = fj.load(tmp_path / f"{name}.toml")
        assert type(back) is type(x) and float(fj.growth_rate(back)) == float(fj.growth_rate(x))


@pytest.mark.parametrize("x", [None, 3, np, np.ones(2), fj.Scene, fj.brake_scene().contact])
def test_save_refuses_what_cannot_be_saved(x, tmp_path):
    wanted = "^x must be a Scene, a Structure, a Design or have a method save, got "
    with pytest.raises(TypeError, match=wanted) as refused:
        fj.save(x, tmp_path / "x.toml")
    assert "\n" not in str(refused.value) and not list(tmp_path.iterdir())
