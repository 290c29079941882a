"""`fractaljax reduce`, and the other commands on a model that must be reduced first."""

import numpy as np
import pytest

import fractaljax as fj
from fractaljax.__main__ import main
from tools import refused_command

COUNT = 2100  # too many to stay dense
SPEED = 2e4 * np.sin(np.pi * np.arange(1, 4) / (2 * (COUNT + 1)))  # the lowest frequencies [rad/s]


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """A chain of masses in Matrix Market files, with what makes a gyroscopic pair of it."""
    import scipy.io
    from scipy.sparse import diags_array, eye_array

    folder = tmp_path_factory.mktemp("chain")
    offsets: list = [-1, 0, 1]
    K = 1e8 * diags_array([-1.0, 2.0, -1.0], offsets=offsets, shape=(COUNT, COUNT))  # type: ignore
    scipy.io.mmwrite(folder / "K.mtx", K.tocoo(), symmetry="symmetric")
    scipy.io.mmwrite(folder / "M.mtx", eye_array(COUNT).tocoo(), symmetry="symmetric")
    (folder / "plain.toml").write_text(
        '[structure]\nM = "M.mtx"\nC = [{coefficient = "alpha", matrix = "M.mtx"}]\n'
        'K = [{coefficient = "kappa", matrix = "K.mtx"}]\n'
        "[parameters]\nalpha = -3.0\nkappa = 1.0\n"
    )
    (folder / "chain.toml").write_text(
        (folder / "plain.toml").read_text() + "[reduction]\nband = [0, 50.0]\n"
    )
    return folder


def test_reduce(chain, tmp_path, capsys):
    arguments = ["reduce", str(chain / "plain.toml"), "--band", "0:50", "--out", str(tmp_path)]
    assert main([*arguments, "--over", "kappa=0.8:1.2", "--quiet"]) == 0
    printed, progress = capsys.readouterr()
    assert progress == ""  # quiet
    assert f"of {COUNT}" in printed and "it squeals" in printed and "kappa" in printed
    reduced = fj.load(tmp_path / "reduced.toml")
    assert isinstance(reduced, fj.ReducedStructure)
    assert reduced.reduction.over == {"kappa": (0.8, 1.2)}
    s = fj.stability(reduced.replace(kappa=1.1))
    found = np.sort(np.imag(np.asarray(s.eigenvalues)[np.asarray(s.counted)]))
    wanted = np.sqrt(1.1 * SPEED**2 - 1.5**2)
    np.testing.assert_allclose(found[found > 0], wanted[wanted < 50], rtol=1e-9)
    errors = fj.reduction_errors(reduced)
    assert (errors[np.asarray(s.counted)] < 1e-6).all()
    assert reduced.full(np.ones(reduced.n)).shape == (COUNT,)


def test_stability_reduces_as_the_file_says(chain, capsys):
    assert main(["stability", str(chain / "chain.toml")]) == 0
    assert "it squeals" in capsys.readouterr().out


REFUSED = {
    "run `fractaljax reduce`, or add a table [reduction]": ["stability", "plain.toml"],
    "--band must be LOW:HIGH in rad/s": ["reduce", "plain.toml"],
    "band must be (low, high)": ["reduce", "plain.toml", "--band", "50:0"],
    "structure has no quantity 'nu'": ["reduce", "chain.toml", "--over", "nu=1:2"],
    "[reduction] has the unknown key 'bands'": ["reduce", "wrong.toml"],
}


@pytest.mark.parametrize("message", REFUSED)
def test_refused(message, chain, tmp_path, capsys):
    (chain / "wrong.toml").write_text(
        (chain / "plain.toml").read_text() + "[reduction]\nbands = [0, 50.0]\n"
    )
    command, file, *more = REFUSED[message]
    out = ["--out", str(tmp_path / "none")] if command == "reduce" else []
    assert message in refused_command(capsys, command, chain / file, *more, *out)
    assert not (tmp_path / "none").exists()
