"""The example brakes: against beams, plates, rigid bodies and waves known in closed form."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.sparse.linalg import eigsh
from scipy.special import ivp, jvp, kvp, yvp

import fractaljax as fj
from tools import ROOT, load_script

brakes = load_script(ROOT / "notebooks" / "brakes.py")
BEAM = brakes.beam_on_pad()
SMALL = brakes.disc_between_pads(12, 3)
FREE = {
    "plane": brakes.beam_on_pad(clamped=()),
    "solid": brakes.disc_between_pads(24, 3, clamped=()),
}


def places(brake, body):
    """Indexes of the degrees of freedom of a body."""
    return [i for i, name in enumerate(brake.names) if name.split()[0] == body]


def alone(brake, body, *matrices):
    """Matrices of one body of several."""
    its = places(brake, body)
    return [brake.matrices[name][its][:, its] for name in matrices]


def points(brake, body):
    """Of a body of which nothing is clamped, (nodes, dim)."""
    return brake.points[np.isin(brake.dofs[:, 0], places(brake, body))]


def rigid(x):
    """Translations, then rotations about x, y, z or z (nodes dim, 6 or 3) of x (nodes, dim)."""
    dim = x.shape[1]
    solid = np.pad(x, ((0, 0), (0, 3 - dim)))
    moves = [np.broadcast_to(axis, x.shape) for axis in np.eye(dim)]
    moves += [np.cross(axis, solid)[:, :dim] for axis in np.eye(3)[0 if dim == 3 else 2 :]]
    return np.stack([move.ravel() for move in moves], 1)


RING = np.pi * (0.14**2 - 0.07**2)
SECTOR = np.pi / 6 * (0.14**2 - (0.14 - 0.14 / 3) ** 2)
BODIES = {  # the kind of brake, volume [m^3], material
    "beam": ("plane", 0.2 * 0.01 * 0.04, brakes.STEEL),
    "pad": ("plane", 0.08 * 0.012 * 0.04, brakes.LINING),
    "disc": ("solid", RING * 0.012, brakes.IRON),
    "upper": ("solid", SECTOR * 0.012, brakes.LINING),
    "lower": ("solid", SECTOR * 0.012, brakes.LINING),
}


@pytest.mark.parametrize("body", BODIES)
def test_a_body_alone(body):
    """No stiffness against rigid motion, rho times volume, and uniaxial tension with E."""
    kind, size, material = BODIES[body]
    brake = FREE[kind]
    M, K = alone(brake, body, "M", "K")
    x = points(brake, body)
    still = rigid(x)
    assert abs(K @ still).max() < 1e-12 * abs(K).max() * abs(still).max()
    dim = x.shape[1]
    mass = still[:, :dim].T @ M @ still[:, :dim]
    np.testing.assert_allclose(mass, material.rho * size * np.eye(dim), atol=1e-12, rtol=1e-5)
    stretch = (x * [1, *[-material.nu] * (dim - 1)]).ravel()
    assert stretch @ K @ stretch == pytest.approx(material.E * size, rel=1e-5)


@pytest.mark.parametrize("brake", [BEAM, SMALL], ids=["beam", "disc"])
def test_what_a_brake_holds(brake):
    n = len(brake.names)
    for name, A in brake.matrices.items():
        assert A.format == "csr" and A.shape == (n, n)
        assert abs(A - (-A.T if name == "G" else A.T)).max() == 0
    for name in "MK":
        np.linalg.cholesky(brake.matrices[name].toarray())  # positive definite
    assert len(set(brake.names)) == n
    assert sorted(brake.dofs[brake.dofs >= 0]) == list(range(n))
    for node, axis in np.argwhere(brake.dofs >= 0):
        assert brake.names[brake.dofs[node, axis]].endswith(" " + "xyz"[axis])


def ends(brake, direction):
    """A direction as {body: (place, vector)}."""
    found = {}
    for dof, weight in direction.items():
        node, axis = np.argwhere(brake.dofs == dof)[0]
        body = brake.names[dof].split()[0]
        vector = found.setdefault(body, (brake.points[node], np.zeros(brake.points.shape[1])))[1]
        vector[axis] += weight
    return found


@pytest.mark.parametrize(
    ("brake", "moving", "pads", "nodes"),
    [(BEAM, "beam", ["pad"], 9), (SMALL, "disc", ["upper", "lower"], 25)],
    ids=["beam", "disc"],
)
def test_pairs(brake, moving, pads, nodes):
    """Facing nodes coincide; what moves drags the pads along, and is pressed by them."""
    assert len(brake.pairs) == len(brake.shares) == len(pads) * nodes
    assert (brake.shares > 0).all()
    np.testing.assert_allclose(brake.shares.reshape(len(pads), -1).sum(1), 1, rtol=1e-14)
    for pair, pad in zip(brake.pairs, np.repeat(pads, nodes), strict=True):
        tangential, normal = (ends(brake, direction) for direction in pair)
        assert tangential.keys() == normal.keys() == {moving, pad}
        place, t = tangential[pad]
        n = normal[pad][1]
        for found, vector in ((tangential, t), (normal, n)):
            np.testing.assert_allclose(found[pad][0], place)
            np.testing.assert_allclose(found[moving][0], place, atol=1e-12)
            np.testing.assert_array_equal(found[moving][1], -vector)
        if len(place) == 2:
            np.testing.assert_array_equal([t, n], np.eye(2))
        else:
            along = np.cross([0, 0, 1], place)
            np.testing.assert_allclose(t, along / np.linalg.norm(along), atol=1e-12)
            np.testing.assert_array_equal(n, [0, 0, -np.sign(place[2])])
            assert (place[2] > 0) == (pad == "upper")


def test_sizes_quads_and_shares_of_a_brake_as_a_structure():
    """Each face once: with the sides of the ring and of the sectors."""
    solid = 2 * RING + 4 * SECTOR + 0.012 * 2 * np.pi * (0.14 + 0.07)
    solid += 2 * 0.012 * (np.pi / 3 * (0.28 - 0.14 / 3) + 2 * 0.14 / 3)
    for brake, area in ((BEAM, 0.2 * 0.01 + 0.08 * 0.012), (FREE["solid"], solid)):
        a, b, c, d = np.moveaxis(brake.points[brake.quads], 1, 0)
        lengths = [(x * y).sum(1) for x, y in ((c - a, c - a), (d - b, d - b), (c - a, d - b))]
        found = np.sqrt(lengths[0] * lengths[1] - lengths[2] ** 2).sum() / 2
        assert found == pytest.approx(area, rel=3e-3)  # of chords
    sizes = [len(brakes.beam_on_pad(refine).names) for refine in (1, 2, 4)]
    assert sizes == [150, 526, 1950]
    assert len(brakes.disc_between_pads().names) == 4668
    with pytest.raises(ValueError, match="angular must be a multiple of 6, got 20"):
        brakes.disc_between_pads(20)
    # Their resultant acts at the centre of the area of the pad.
    places = np.array([ends(SMALL, normal)["disc"][0] for _, normal in SMALL.pairs])
    a, b, angle = 0.14 - 0.14 / 3, 0.14, np.pi / 3
    centre = 4 / 3 * (b**3 - a**3) / (b**2 - a**2) * np.sin(angle / 2) / angle
    expected = [centre * np.cos(angle / 2), centre * np.sin(angle / 2), 0.006]
    np.testing.assert_allclose(SMALL.shares[:25] @ places[:25], expected, rtol=1e-4)
    # A `Joint` takes every pair, and stiff joints raise the frequencies.
    contact = fj.FixedContact(1e7, 5e6, P=100.0)
    joints = [fj.Joint(contact, fj.Coulomb(0.3), t, n, preload=True) for t, n in BEAM.pairs]
    M, K = BEAM.matrices["M"], BEAM.matrices["K"]
    structure = fj.Structure(M, None, K, joints, names=BEAM.names)
    for joint, (_, normal) in zip(structure.joints, BEAM.pairs, strict=True):
        n = structure.direction(joint.normal or ())
        assert {int(i): n[i] for i in n.nonzero()[0]} == normal


def frequencies(brake, body, count):
    """The lowest of one body [rad/s], those of rigid motion included."""
    M, K = alone(brake, body, "M", "K")
    squares = eigsh(K, count, M, sigma=-1e4, return_eigenvectors=False)
    return np.sqrt(np.maximum(np.sort(squares), 0))


@pytest.mark.parametrize(
    ("clamped", "roots"),
    [
        (("left",), [1.8751040687, 4.6940911330, 7.8547574382]),
        (("left", "right"), [4.7300407449, 7.8532046241, 10.9956078380]),
        ((), [4.7300407449, 7.8532046241, 10.9956078380]),
    ],
    ids=["clamped and free", "clamped", "free"],
)
def test_frequencies_of_a_slender_beam(clamped, roots):
    """Euler and Bernoulli: omega = (root/l)^2 sqrt(EI/(rho A)), here with height l/100."""
    brake = brakes.beam_on_pad(4, length=1.0, clamped=clamped)
    found = frequencies(brake, "beam", 6)
    steel = brakes.STEEL
    expected = np.square(roots) * np.sqrt(steel.E * 0.01**2 / 12 / steel.rho)
    np.testing.assert_allclose(found[found > 1.0][:3], expected, rtol=5e-3)


@pytest.mark.slow
def test_frequencies_of_plates_and_a_thin_disc():
    """Quadratic elements of a body without corners that a clamp makes singular."""
    found = []
    for refine in (1, 2, 4, 8):
        brake = brakes.beam_on_pad(refine, clamped=())
        found.append(frequencies(brake, "beam", 6)[3:])
    steps = -np.diff(found, axis=0)
    assert (steps > 0).all()  # from above, as Rayleigh has it
    orders = np.log2(steps[:-1] / steps[1:])
    np.testing.assert_allclose(orders[-1], 4, atol=0.2)
    # Vogel and Skinner, J. Appl. Mech. 32 (1965) 926: nu = 0.3 and half the radius clamped.
    found = [plate_frequency(n, 0.3, 0.5) for n in range(4)]
    np.testing.assert_allclose(found, [13.0, 13.3, 14.7, 18.5], atol=0.1)
    # The clamped disc as Kirchhoff's plate, each with n > 0 nodal diameters twice.
    thickness, iron = 0.0028, brakes.IRON
    brake = brakes.disc_between_pads(24, 6, thickness=thickness)
    found = frequencies(brake, "disc", 7)
    speed = np.sqrt(iron.E * thickness**2 / 12 / (1 - iron.nu**2) / iron.rho) / 0.14**2
    expected = [speed * plate_frequency(n, iron.nu, 0.5) for n in (0, 1, 1, 2, 2, 3, 3)]
    np.testing.assert_allclose(found, expected, rtol=0.015)


def plate_determinant(x, n, nu, ratio):
    """Of Kirchhoff's annular plate, clamped at r = ratio and free at 1; zero at omega = x^2.

    Deflection and slope at the clamp, moment and Kirchhoff's shear force at the rim, of the four
    solutions of grad^4 w = x^4 w with n nodal diameters. Lengths, rigidity and mass are 1.
    """
    rows = []
    for function, sign in ((jvp, -1), (yvp, -1), (ivp, 1), (kvp, 1)):
        w, w_r, w_rr = (x**k * function(n, x, k) for k in range(3))
        moment = w_rr + nu * (w_r - n**2 * w)
        shear = sign * x**2 * w_r - (1 - nu) * n**2 * (w_r - w)
        rows.append([function(n, x * ratio, 0), function(n, x * ratio, 1), moment, shear])
    rows = np.array(rows)
    return np.linalg.det(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def plate_frequency(n, nu, ratio):
    """The lowest omega with n nodal diameters, in units of sqrt(rigidity / mass) / outer^2."""
    grid = np.linspace(1.5, 8, 100)
    values = [plate_determinant(x, n, nu, ratio) for x in grid]
    i = int(np.flatnonzero(np.diff(np.sign(values)))[0])
    root: Any = brentq(plate_determinant, grid[i], grid[i + 1], (n, nu, ratio))
    return root**2


SPIN = ("M", "K", "G", "K_convective", "K_centrifugal")


def test_rigid_motion_of_a_spinning_disc():
    """A free disc spins about any axis at rest, and wobbles at Omega I_polar/I_diametral.

    All rigid displacement is at equilibrium only with both terms of Omega^2.
    """
    M, _, G, convective, centrifugal = alone(FREE["solid"], "disc", *SPIN)
    R = rigid(points(FREE["solid"], "disc"))
    for A in (convective, centrifugal):
        assert (np.linalg.norm(A @ R, axis=0)[3:] > 1e-3).all()
    left = np.linalg.norm((convective + centrifugal) @ R, axis=0)
    assert (left < 1e-4 * np.linalg.norm(convective @ R[:, 3:], axis=0).max()).all()
    inertia, gyroscopic = R[:, 3:].T @ M @ R[:, 3:], R[:, 3:].T @ G @ R[:, 3:]
    polar = inertia[2, 2]
    expected = polar * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(gyroscopic, expected, atol=1e-6 * polar)
    mass, radii = brakes.IRON.rho * RING * 0.012, 0.14**2 + 0.07**2
    diametral = mass * (radii / 4 + 0.012**2 / 12)
    np.testing.assert_allclose(inertia, np.diag([diametral] * 2 + [mass * radii / 2]), atol=1e-6)


@pytest.mark.parametrize("clamped", [(), ("hub", "backs")], ids=["free", "clamped"])
def test_waves_travel_with_and_against_a_spinning_disc(clamped):
    """Bending with n nodal diameters splits to omega +- n Omega in the frame that stands still."""
    brake = brakes.disc_between_pads(24, 2, thickness=0.004, clamped=clamped)
    M, K, G, convective, centrifugal = alone(brake, "disc", *SPIN)
    count, Omega = 30, 20.0  # modes, rad/s
    squares, X = eigsh(K, count, M, sigma=-1e4)
    K_spin = np.diag(squares) + Omega**2 * X.T @ (convective + centrifugal) @ X
    A = np.block([[np.zeros_like(K_spin), np.eye(count)], [-K_spin, -Omega * X.T @ G @ X]])
    s = np.linalg.eigvals(A)
    assert abs(np.real(s)).max() < 1e-6 * abs(s).max()
    rim = brake.dofs[: 48 * 5 * 3].reshape(48, 5, 3, 3)[:, -1, 1, 2]
    waves = abs(np.fft.rfft(X[rim], axis=0)).argmax(0)
    for n in (2, 3, 4):
        omega = np.sqrt(squares[waves == n].min())
        backward, forward = (
            np.imag(s)[abs(np.imag(s) - omega - sign * n * Omega).argmin()] for sign in (-1, 1)
        )
        assert forward - backward == pytest.approx(2 * n * Omega, rel=2e-3)
        assert abs(forward + backward - 2 * omega) < (n * Omega) ** 2 / omega
