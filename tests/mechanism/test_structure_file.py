import errno
import io
import os
import re
import threading
import warnings
import zipfile

import jax
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import fractaljax as fj
from fractaljax.__main__ import main
from fractaljax.mechanism.structure import load
from fractaljax.mechanism.structure_file import _npz
from structures import matrices, two_joints

JOINT = """
[joints.pad]
tangential = ["x", "y"]
normal = "z"
V = 0.2

[joints.pad.contact]
law = "fixed"
K_n = 3e6
K_t = 1e6

[joints.pad.friction]
law = "coulomb"
mu = 0.4
"""


def equal(left, right):
    assert left.joint_names == right.joint_names
    assert left.names == right.names
    assert jax.tree.structure(left) == jax.tree.structure(right)
    assert jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), left, right))


@pytest.fixture
def folder(tmp_path):
    """Matrices of three degrees of freedom in files of every kind."""
    M, C, K = matrices(3)
    np.savez(tmp_path / "all.npz", M=M, C=C, K=K, F=np.array([1.0, 2.0, 3.0]))
    np.savez(tmp_path / "two.npz", M=M, K=K)
    np.savez(tmp_path / "odd.npz", M=M, Kay=K)
    np.savez(tmp_path / "pickled.npz", M=np.array([None, 1], dtype=object), K=K)
    scipy.io.mmwrite(tmp_path / "M.mtx", scipy.sparse.coo_matrix(M), symmetry="symmetric")
    scipy.io.mmwrite(tmp_path / "K.mtx", K)
    scipy.io.mmwrite(tmp_path / "C.mtx", scipy.sparse.coo_matrix(C), symmetry="general")
    scipy.io.mmwrite(tmp_path / "F.mtx", np.array([[1.0], [2.0], [3.0]]))
    scipy.io.mmwrite(tmp_path / "complex.mtx", 1j * K)
    scipy.io.mmwrite(tmp_path / "huge.mtx", scipy.sparse.eye_array(100_000).tocoo())
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("M.npy", b"")
    bomb = (tmp_path / "bomb.npz").read_bytes()
    place = bomb.index(b"PK\x01\x02") + 24  # of the size in the directory
    size = (4_000_000_000).to_bytes(4, "little")
    (tmp_path / "bomb.npz").write_bytes(bomb[:place] + size + bomb[place + 4 :])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the name twice
        with zipfile.ZipFile(tmp_path / "twice.npz", "w") as file:
            file.writestr("M.npy", b"")
            file.writestr("M.npy", b"")
    for name, X in {"complex": 1j * M, "text": np.array(["a"]), "scalar": np.array(1.0)}.items():
        np.savez(tmp_path / f"{name}.npz", M=X, K=K)
    whole = bytearray((tmp_path / "two.npz").read_bytes())
    (tmp_path / "cut.npz").write_bytes(whole[:-50])
    for mark, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        whole[whole.index(mark) + flags] |= 1
    (tmp_path / "encrypted.npz").write_bytes(whole)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
    )
    with zipfile.ZipFile(tmp_path / "liar.npz", "w") as file:
        file.writestr("M.npy", header.getvalue())
    (tmp_path / "no.npz").write_text("hello")
    (tmp_path / "no.mtx").write_text("hello")
    return tmp_path


def written(folder, structure, joints=JOINT):
    path = folder / "brake.toml"
    path.write_text(f'[structure]\nnames = ["x", "y", "z"]\n{structure}\n{joints}')
    return path


def test_matrices_from_every_kind_of_file(folder):
    M, C, K = matrices(3)
    joint = fj.Joint(fj.FixedContact(3e6, 1e6), fj.Coulomb(0.4), ("x", "y"), "z", V=0.2)
    expected = fj.Structure(M, C, K, {"pad": joint}, [1.0, 2.0, 3.0], ("x", "y", "z"))
    for text in [
        'matrices = "all.npz"',
        'M = "M.mtx"\nC = "C.mtx"\nK = "K.mtx"\nF = "F.mtx"',
        'matrices = "two.npz"\nC = "C.mtx"\nF = [1.0, 2.0, 3]',
        'matrices = "two.npz"\nC = "C.mtx"\nF = {x = 1.0, y = 2.0, 2 = 3}',
    ]:
        equal(fj.Structure.load(written(folder, text)), expected)


def test_names_that_are_numerals_are_names(folder):
    path = folder / "brake.toml"
    joints = JOINT.replace('["x", "y"]', '["2", "0"]').replace('"z"', '"1"')
    text = '[structure]\nmatrices = "two.npz"\n'
    path.write_text(f'{text}names = ["2", "0", "1"]\nF = {{"0" = 500, 2 = 7}}\n{joints}')
    structure = fj.Structure.load(path)
    np.testing.assert_array_equal(structure.F, [7.0, 500.0, 0.0])
    path.write_text(f"{text}F = {{0 = 500}}\n[joints]\n")
    np.testing.assert_array_equal(fj.Structure.load(path).F, [500.0, 0.0, 0.0])


def test_a_pipe_is_read_once(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for scene in (fj.brake_scene(), fj.brake_scene().replace(D=2.5)):
        writer = threading.Thread(target=pipe.write_text, args=[scene.to_toml()])
        writer.start()
        found = load(pipe)
        assert isinstance(found, fj.Scene)
        assert found.to_toml() == scene.to_toml()
        writer.join()


def test_endless_and_large_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="/dev/zero: the file is larger than 10 MB"):
        load("/dev/zero")
    with open(tmp_path / "large.toml", "wb") as file:
        file.truncate(10**12)
    for read in (load, fj.Scene.load, fj.Structure.load):
        with pytest.raises(ValueError, match=r"large.toml: the file is larger than 10 MB"):
            read(tmp_path / "large.toml")


def test_arrays_of_any_order_of_bytes(folder):
    M, _, K = matrices(3)
    np.savez(folder / "big.npz", M=M.astype(">f8"), K=np.asfortranarray(K))
    structure = fj.Structure.load(written(folder, 'matrices = "big.npz"'))
    np.testing.assert_array_equal(structure.K, K)


def test_no_flipped_byte_of_a_npz_file_passes_unnoticed(folder):
    whole = (folder / "two.npz").read_bytes()
    M, _, K = matrices(3)
    for place in np.random.default_rng(0).integers(len(whole), size=150):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (place % 8)
        (folder / "damaged.npz").write_bytes(damaged)
        try:
            found = _npz(folder / "damaged.npz")
        except ValueError as error:
            assert "\n" not in str(error)
            continue
        np.testing.assert_array_equal(found["M"], M)
        np.testing.assert_array_equal(found["K"], K)


def test_damping_from_numbers(folder):
    M, _, K = matrices(3)
    for text, C in [
        ("", np.zeros((3, 3))),
        ("rayleigh = [2.0, 1e-6]", fj.rayleigh_damping(M, K, 2.0, 1e-6)),
        ("damping_ratio = 0.01", fj.modal_damping(M, K, 0.01)),
        ("damping_ratio = [0.01, 0, 0.03]", fj.modal_damping(M, K, np.array([0.01, 0, 0.03]))),
    ]:
        structure = fj.Structure.load(written(folder, f'matrices = "two.npz"\n{text}'))
        np.testing.assert_allclose(structure.C, C, rtol=1e-12, atol=1e-12)


def test_round_trip(tmp_path):
    brake = fj.brake_scene().contact
    M, C, K = matrices(4)
    names = ('a "quoted" one', "b\\c", "dünn", "d")
    structures = [
        two_joints(4),
        two_joints(4).replace(F=None, friction=fj.Coulomb(0.3)),
        fj.Structure(M, C, K, fj.Joint(brake, fj.Coulomb(0.3), "d", 0), names=names),
        fj.Structure(M, None, K, []),
        jax.tree.map(lambda x: x.astype(np.float32), fj.Structure(M, C, K, [])),
    ]
    for structure in structures:
        structure.save(tmp_path / "s.toml")
        again = fj.Structure.load(tmp_path / "s.toml")
        equal(again, structure)
        assert again.M.dtype == structure.M.dtype
    assert sorted(file.name for file in tmp_path.iterdir()) == ["s.npz", "s.toml"]


def test_save_refuses(tmp_path):
    with pytest.raises(ValueError, match=r"path must be that of the TOML file, got '.*s.npz'"):
        two_joints(4).save(tmp_path / "s.npz")
    with pytest.raises(ValueError, match="K_n must be a scalar"):
        two_joints(4).replace(K_n=np.array([1e6, 2e6])).save(tmp_path / "s.toml")
    with pytest.raises(OSError, match="nowhere"):
        two_joints(4).save(tmp_path / "nowhere" / "s.toml")
    assert list(tmp_path.iterdir()) == []


def test_save_leaves_matrices_of_others_alone(tmp_path):
    """A .npz file belongs to the TOML file that names it."""
    np.savez(tmp_path / "s.npz", mine=np.arange(3.0))
    before = (tmp_path / "s.npz").read_bytes()
    for text in [None, "", "[structure]\nmatrices = 'other.npz'", "structure = 3", "not = = toml"]:
        if text is not None:
            (tmp_path / "s.toml").write_text(text)
        with pytest.raises(ValueError, match=r"s\.npz is not of a structure saved as s\.toml"):
            two_joints(4).save(tmp_path / "s.toml")
        assert (tmp_path / "s.npz").read_bytes() == before
    two_joints(4).save(tmp_path / "t.toml")
    with pytest.raises(ValueError, match=r"t\.npz is not of a structure saved as t\.txt"):
        two_joints(4).save(tmp_path / "t.txt")


@pytest.mark.parametrize(
    ("name", "failing"), [("fsync", 1), ("fsync", 2)] + [("replace", k) for k in range(1, 5)]
)
def test_save_that_fails_leaves_the_old_structure(tmp_path, monkeypatch, name, failing):
    """The TOML file and the matrices it names, whichever step fails."""
    old, new = two_joints(4), two_joints(4).replace(K=2 * two_joints(4).K, V=0.7)
    old.save(tmp_path / "s.toml")
    call, count = getattr(os, name), [0]

    def fail(*arguments):
        count[0] += 1
        if count[0] == failing:
            raise OSError(errno.ENOSPC, "disk full")
        call(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(os, name, fail)
        with pytest.raises(OSError, match="disk full"):
            new.save(tmp_path / "s.toml")
    equal(fj.Structure.load(tmp_path / "s.toml"), old)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["s.npz", "s.toml"]
    new.save(tmp_path / "s.toml")
    equal(fj.Structure.load(tmp_path / "s.toml"), new)


def test_the_file_says_who_wrote_it(tmp_path):
    two_joints(4).save(tmp_path / "s.toml")
    assert f"written by fractaljax {fj.__version__}." in (tmp_path / "s.toml").read_text()


def test_load_tells_structures_from_scenes(folder):
    assert isinstance(load(written(folder, 'matrices = "all.npz"')), fj.Structure)
    fj.brake_scene().save(folder / "scene.toml")
    assert isinstance(load(folder / "scene.toml"), fj.Scene)


BAD = [
    ('matrices = "all.npz"\nmass = 3', "[structure] has the unknown key 'mass'"),
    ("matrices = 3", "[structure] matrices must be the name of a file, got 3"),
    ('M = "M.mtx"', "[structure] lacks the matrix K"),
    ('K = "K.mtx"', "[structure] lacks the matrix M"),
    ('matrices = "all.npz"\nK = "K.mtx"', "[structure] gives K twice"),
    ('matrices = "all.npz"\nF = [1, 2, 3]', "[structure] gives F twice"),
    ('matrices = "all.npz"\ndamping_ratio = 0.01', "gives damping twice"),
    ('matrices = "two.npz"\nrayleigh = [1, 0]\ndamping_ratio = 0.01', "gives damping twice"),
    ('matrices = "two.npz"\nrayleigh = 3', "rayleigh must be [alpha, beta], got 3"),
    ('matrices = "two.npz"\nrayleigh = ["a", 0]', "alpha must be a number, got 'a'"),
    ('matrices = "two.npz"\nrayleigh = [-1, 0]', "alpha must be at least 0, got -1.0"),
    (
        'matrices = "two.npz"\ndamping_ratio = [1, 2]',
        "damping_ratio must be a scalar or have shape",
    ),
    ('matrices = "two.npz"\ndamping_ratio = "low"', "damping_ratio must be a number, got 'low'"),
    ('matrices = "two.npz"\nF = 3', "F must be a list, a table or a file's name, got 3"),
    ('matrices = "two.npz"\nF = [1, 2]', "F must have shape (3,) as M demands, got (2,)"),
    ('matrices = "two.npz"\nF = ["a", 2, 3]', "F must be an array of real numbers"),
    ('matrices = "two.npz"\nF = {w = 3}', "unknown degree of freedom 'w'"),
    ('matrices = "odd.npz"', "odd.npz has the unknown key 'Kay'; known are M, C, K, F"),
    ('matrices = "pickled.npz"', "pickled.npz: M must be real numbers, got object"),
    ('matrices = "no.npz"', "no.npz"),
    ('matrices = "M.mtx"', "M.mtx"),
    ('M = "no.mtx"\nK = "K.mtx"', "no.mtx is not a Matrix Market file"),
    ('M = "two.npz"\nK = "K.mtx"', "two.npz is not a Matrix Market file"),
    ('M = "M.mtx"\nK = "complex.mtx"', "K must be an array of real numbers, got complex128"),
    ('M = "huge.mtx"\nK = "K.mtx"', "huge.mtx holds 100000 x 100000 numbers; reduce the model"),
    ('M = "M.mtx"\nK = "F.mtx"', "K must have shape (3, 3) as M demands, got (3, 1)"),
    ('M = "missing.mtx"\nK = "K.mtx"', "missing.mtx"),
    ('matrices = "missing.npz"', "missing.npz"),
    ('matrices = "all.npz"\nM =', "not a TOML file"),
]

BAD += [
    ('matrices = "two.npz"\nF = {x = 1, 0 = 2}', "F gives one degree of freedom twice"),
    ('matrices = "two.npz"\nF = {0 = 1, 00 = 2}', "[structure] F gives the degree of freedom 0"),
    ('matrices = "two.npz"\nF = {"\u0660" = 1}', "unknown degree of freedom '\u0660'"),
    ('matrices = "two.npz"\nF = [true, 2, 3]', "F must be an array of real numbers"),
    (f'matrices = "two.npz"\nF = [1{"0" * 400}, 2, 3]', "F must be an array of real numbers"),
    (f'matrices = "two.npz"\nF = {"[" * 30}{"]" * 30}', "nested too deeply"),
    (f'matrices = "two.npz"\nF = {"[" * 9000}{"]" * 9000}', "nested too deeply"),
    ('matrices = "/dev/zero"', "larger than"),
    ('M = "/dev/zero"\nK = "K.mtx"', "zero is not a Matrix Market file"),
    ('matrices = "encrypted.npz"', "encrypted.npz: M is encrypted"),
    (
        'matrices = "bomb.npz"',
        "bomb.npz: it unpacks to 4000000000 bytes, at most 512000000 are read",
    ),
    ('matrices = "twice.npz"', "twice.npz: it holds two arrays of one name"),
    ('matrices = "complex.npz"', "complex.npz: M must be real numbers, got complex128"),
    ('matrices = "text.npz"', "text.npz: M must be real numbers, got <U1"),
    (
        'matrices = "liar.npz"',
        "liar.npz: M is damaged: 8000000000000 bytes were to follow its header, 0 do",
    ),
    ('matrices = "cut.npz"', "cut.npz: it is no sound file of numbers from NumPy"),
    ('matrices = "scalar.npz"', "M must be a square matrix, got shape ()"),
]

GOOD = 'matrices = "all.npz"'
BAD_JOINTS = [
    ("", "the table [joints] is missing"),
    (JOINT.replace("V = 0.2", "speed = 0.2"), "[joints.pad] has the unknown key 'speed'"),
    (JOINT.replace('normal = "z"', ""), "[joints.pad] lacks the key 'normal'"),
    (JOINT.replace('"z"', '"w"'), "joint pad: unknown degree of freedom 'w'; the structure has x"),
    (JOINT.replace('"z"', "1.5"), "[joints.pad] normal must be a degree of freedom or a pair"),
    (JOINT.replace("pad.contact", "pad.spring"), "[joints.pad] has the unknown key 'spring'"),
    (JOINT.split("[joints.pad.contact]")[0], "the table [joints.pad.contact] is missing"),
    (JOINT.replace('"fixed"', '"glued"'), "[joints.pad.contact] law must be"),
    (JOINT.replace("mu = 0.4", "mu = -1"), "[joints.pad.friction] mu must be above 0, got -1.0"),
    (JOINT.replace("V = 0.2", "V = 0"), "[joints.pad] V must be above 0, got 0.0"),
    (JOINT + "[joints]\nother = 3", "brake.toml"),
    (JOINT.replace("joints.pad", 'joints."a b"'), "a joint's name must be of letters"),
    (JOINT + "[oscillator]\nm = 1", "the file has the unknown key 'oscillator'"),
]


@pytest.mark.parametrize(
    ("text", "joints", "message"),
    [
        *((text, JOINT, message) for text, message in BAD),
        *((GOOD, joints, message) for joints, message in BAD_JOINTS),
    ],
)
def test_bad_files_are_refused_in_one_line(folder, capsys, text, joints, message):
    path = written(folder, text, joints)
    before = sorted(folder.iterdir())
    with pytest.raises(SystemExit) as stopped:
        main(["stability", str(path)])
    assert stopped.value.code == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith("fractaljax: ")
    assert error.count("\n") == 1
    assert message in error
    assert sorted(folder.iterdir()) == before


def test_the_command(tmp_path, capsys):
    structure = two_joints(4)
    structure.save(tmp_path / "brake.toml")
    assert main(["stability", str(tmp_path / "brake.toml")]) == 0
    shown = capsys.readouterr().out
    rate = fj.growth_rate(structure)
    assert "unstable modes       2  (it squeals)" in shown
    assert f"{rate:+.6g}" in shown
    assert re.search("left +right", shown)
    assert shown.count("unstable") == 3
    assert main(["stability", "--constant-friction", str(tmp_path / "brake.toml")]) == 0
    shown = capsys.readouterr().out
    assert "unstable modes       0  (stable against small disturbances)" in shown
    for command in ("design", "cycle"):
        with pytest.raises(SystemExit):
            main([command, str(tmp_path / "brake.toml"), "--out", str(tmp_path / "out")])
        assert "has the unknown key 'structure'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("C", "K", "verdict"),
    [
        (0.1, 1e4, "0  (stable against small disturbances)"),
        (0.0, 1e4, "0  (2 unresolved; else stable against small disturbances)"),
        (-0.1, 1e4, "2  (it squeals)"),
        (0.1, 0.0, "1/s: rigid bodies; else stable against small disturbances)"),
    ],
)
def test_the_verdict(tmp_path, capsys, C, K, verdict):
    fj.Structure(np.eye(2), C * np.eye(2), K * np.diag([1, 1.1]), []).save(tmp_path / "s.toml")
    assert main(["stability", str(tmp_path / "s.toml")]) == 0
    shown = capsys.readouterr().out
    assert verdict in shown.splitlines()[1]
    assert shown.count("unresolved to") == (2 if "unresolved" in verdict else 0)


def test_the_command_refuses_numbers_out_of_range(tmp_path, capsys):
    joint = fj.Joint(fj.FixedContact(1.5e308, 1e5), fj.Coulomb(0.3), 0, 1)
    fj.Structure(np.eye(2), None, 1e308 * np.eye(2), joint).save(tmp_path / "s.toml")
    with pytest.raises(SystemExit) as stopped:
        main(["stability", str(tmp_path / "s.toml")])
    assert stopped.value.code == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error == "fractaljax: K with the joints attached must be finite\n"


def test_the_command_reads_a_pipe(tmp_path, capsys):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_text, args=[fj.brake_scene().to_toml()])
    writer.start()
    assert main(["stability", str(pipe)]) == 0
    writer.join()
    assert "it squeals" in capsys.readouterr().out


def test_the_command_refuses_what_has_no_equilibrium(tmp_path, capsys):
    K = 1e6 * np.kron(np.eye(2), [[1, -1], [-1, 1]])
    joint = fj.Joint(fj.FixedContact(1e5, 5e4), fj.Stribeck(0.4, 0.2, 0.5), (0, 1), (2, 3), V=0.1)
    path = tmp_path / "free.toml"
    for F, message in [
        ([0, 0, 1.0, 2.0], "F has no static equilibrium"),
        (None, "F must be given"),
    ]:
        fj.Structure(np.eye(4), None, K, joint, F=F).save(path)
        with pytest.raises(SystemExit):
            main(["stability", str(path)])
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert main(["stability", str(path), "--constant-friction"]) == 0
        capsys.readouterr()
