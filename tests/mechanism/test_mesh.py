"""Meshes of structures: their files, what refuses them, and that reductions and files keep them."""

from typing import Any

import numpy as np
import pytest

import fractaljax as fj
from structures import two_joints
from tools import assert_whole, refusals

POINTS = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
DOFS = [[0, 1], [2, 3], [4, 5], [-1, -1]]
CELLS = [[0, 1, 2, 3]]


def meshed(**change: Any) -> Any:
    plain = two_joints(6)
    mesh = fj.Mesh(**{"points": POINTS, "dofs": DOFS, "cells": CELLS} | change)
    joints = dict(zip(plain.joint_names, plain.joints, strict=True))
    return fj.Structure(plain.M, plain.C, plain.K, joints, plain.F, mesh=mesh)


def test_a_file_and_a_reduction_keep_the_mesh(tmp_path):
    x = meshed()
    x.save(tmp_path / "brake.toml")
    again: Any = fj.load(tmp_path / "brake.toml")
    assert again.mesh == x.mesh and hash(again.mesh) == hash(x.mesh)
    for name, array in x.mesh.arrays().items():
        np.testing.assert_array_equal(again.mesh.arrays()[name], array)
    assert x.mesh != fj.Mesh(POINTS, DOFS, [[0, 1, 2]])
    assert x.replace(**{"left.K_n": 2e6}).mesh is x.mesh
    assert x.replace(F=np.zeros(6)).mesh == x.mesh
    x = meshed()
    reduced = fj.reduce(x, {}, (0.0, 1e5), tol=1e-6)
    assert reduced.mesh == x.mesh
    reduced.save(tmp_path / "reduced.toml")
    again = fj.load(tmp_path / "reduced.toml")
    assert again.mesh == x.mesh
    np.testing.assert_array_equal(again._touched(), x._touched())


def test_a_file_names_a_mesh_of_its_own(tmp_path):
    x = two_joints(6)
    x.save(tmp_path / "brake.toml")
    np.savez(tmp_path / "nodes.npz", points=POINTS, dofs=DOFS, cells=CELLS)
    text = (tmp_path / "brake.toml").read_text()
    named = text.replace("[structure]", '[structure]\nmesh = "nodes.npz"', 1)
    (tmp_path / "brake.toml").write_text(named)
    again: Any = fj.load(tmp_path / "brake.toml")
    assert again.mesh == meshed().mesh
    np.savez(tmp_path / "nodes.npz", points=POINTS, cells=CELLS)
    with pytest.raises(ValueError, match=r"nodes\.npz lacks dofs: a mesh is points, dofs, cells"):
        fj.load(tmp_path / "brake.toml")


test_refused = refusals(
    [
        ({"dofs": [[0, 1], [2, 3], [4, 6], [-1, -1]]}, "dofs must be whole numbers from -1 to 5"),
        ({"dofs": [[0.5, 1], [2, 3], [4, 5], [-1, -1]]}, "dofs must be whole numbers from -1"),
        ({"dofs": DOFS[:3]}, "dofs must have shape"),
        ({"cells": [[0, 1, 2, 4]]}, "cells must be whole numbers from 0 to 3"),
        ({"points": [[0.0]]}, "points must be"),
    ],
    lambda change: meshed(**change),
)


@pytest.mark.slow
def test_stability_draws_the_modes_of_a_mesh(tmp_path, capsys):
    from fractaljax.__main__ import main

    meshed().save(tmp_path / "brake.toml")
    assert main(["stability", str(tmp_path / "brake.toml"), "--out", str(tmp_path / "out")]) == 0
    assert "written to" in capsys.readouterr().out
    assert (tmp_path / "out" / "mode_1.png").read_bytes()[:4] == b"\x89PNG"
    two_joints(6).save(tmp_path / "plain.toml")
    with pytest.raises(SystemExit):
        main(["stability", str(tmp_path / "plain.toml"), "--out", str(tmp_path / "none")])
    assert "--out needs a structure whose file names a mesh" in capsys.readouterr().err
    x = meshed()
    mode = fj.stability(x)._modes()[0]
    ax = fj.plot.complex_mode(mode.shape, **x.mesh.arrays())
    assert_whole(ax.figure)
