"""Two example brakes as finite elements: a beam on a pad, and a disc that spins between two pads.

Both give sparse matrices M and K in SI units, and what a `fractaljax.Structure` needs to put joints
between the bodies. scikit-fem integrates quadratic Lagrangian elements: quadrilaterals of nine
nodes in plane stress, hexahedra of twenty-seven. Damping is left to the caller.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve
from skfem import Basis, BilinearForm, ElementHex2, ElementQuad2, MeshHex, MeshQuad
from skfem.mesh import MeshHex2, MeshQuad2


@dataclass(frozen=True)
class Material:
    """An isotropic elastic material: E [Pa], Poisson's ratio nu, density rho [kg/m^3]."""

    E: float
    nu: float
    rho: float


STEEL = Material(2.1e11, 0.3, 7800.0)
IRON = Material(1.2e11, 0.26, 7200.0)  # grey cast iron
LINING = Material(3e8, 0.25, 2500.0)  # an organic lining under light pressure


@dataclass(frozen=True)
class Brake:
    """Matrices of n degrees of freedom and where they are; clamped ones are left out.

    `matrices` (n, n) each: M [kg], K [N/m], and those of rotation if a body spins. `points`
    (nodes, dim) [m] are the nodes of all bodies; `dofs` (nodes, dim) their degrees of freedom, -1
    where clamped; `names` (n,) such as "beam 12 x", with nodes numbered in each body from 0.
    `quads` (quads, 4) are the nodes around each face to draw: all elements of a plane model, the
    outer surface of a solid one.

    `pairs` are the places where pads meet the moving body, as (tangential, normal) for
    `fractaljax.Joint`, mappings of degrees of freedom to weights: displacement of the pad less that
    of the moving body, along the motion of the latter and from the pad towards it. So normal
    displacement compresses, and friction pushes the pad along. `shares` (pairs,) of a pad's load
    fall to each pair when the pressure is uniform; those of one pad sum to 1.
    """

    matrices: dict[str, sp.csr_matrix]
    points: np.ndarray
    dofs: np.ndarray
    names: tuple[str, ...]
    pairs: tuple[tuple[dict[int, float], dict[int, float]], ...]
    shares: np.ndarray
    quads: np.ndarray


def beam_on_pad(
    refine: int = 1,
    *,
    length: float = 0.2,
    height: float = 0.01,
    width: float = 0.04,
    pad_height: float = 0.012,
    beam: Material = STEEL,
    pad: Material = LINING,
    clamped: Collection[str] = ("left", "right", "back"),
) -> Brake:
    """A steel beam, the unrolled disc, that moves to +x over a pad below it; plane stress.

    The pad lies under 0.4 to 0.8 of the length, off the middle, so that no symmetry keeps modes
    apart. `clamped` are ends of the beam and the back of the pad. Nine pairs and 150 degrees of
    freedom at `refine` = 1, about four times as many at twice that.
    """
    columns, first, last = 10 * refine, 4 * refine, 8 * refine
    bodies = {
        "beam": _body((columns, refine), lambda q: q * [[length], [height]], beam, width),
        "pad": _body(
            (last - first, refine),
            lambda q: np.stack([length * (0.4 + 0.4 * q[0]), pad_height * (q[1] - 1)]),
            pad,
            width,
        ),
    }
    top, face = bodies["beam"].index, bodies["pad"].index
    parts = {"left": ("beam", top[0]), "right": ("beam", top[-1]), "back": ("pad", face[:, 0])}
    axes = np.broadcast_to(np.eye(2), (len(face), 2, 2))
    contact = _Contact("pad", face[:, -1], top[2 * first : 2 * last + 1, 0], axes)
    shares = _simpson(last - first)
    return _joined(bodies, [parts[name] for name in clamped], [contact], shares)


def disc_between_pads(
    angular: int = 36,
    radial: int = 3,
    *,
    inner: float = 0.07,
    outer: float = 0.14,
    thickness: float = 0.012,
    pad_thickness: float = 0.012,
    disc: Material = IRON,
    pad: Material = LINING,
    clamped: Collection[str] = ("hub", "backs"),
) -> Brake:
    """A solid disc that spins about z between two pads; 4,668 degrees of freedom by default.

    `angular` (a multiple of 6) and `radial` elements around and across it. Each pad covers 60
    degrees and the outer two thirds of the elements across. `clamped`: the disc at its inner
    radius, the pads at their backs.

    The mesh stands still and the material flows through it. With the Cartesian displacement
    u(x, t) at a place x of the mesh, the velocity is Omega e_z x x + u_t + Omega u_theta, where
    u_theta = (e_z x x . grad) u. Lagrange's equations of its kinetic energy give

        M u'' + Omega G u' + (K + Omega^2 (K_convective + K_centrifugal)) u = 0
        G = B - B^T, B = int rho u_i . (u_j)_theta, which is 2 B where no material leaves
        K_convective = -int rho (u_i)_theta . (u_j)_theta
        K_centrifugal = int sigma : (grad u_i)^T grad u_j

    with the stress sigma under the centrifugal force rho r at Omega = 1 rad/s. For each of the
    bending modes of a free plate with n nodal diameters, this is a wave at omega - n Omega and
    another at omega + n Omega. Damping of the disc acts on u_t + Omega u_theta and adds a
    circulatory term that is not here. See Hochlenert, Spelsberg-Korspeter and Hagedorn, J. Appl.
    Mech. 74 (2007) 542.
    """
    if angular % 6:
        raise ValueError(f"angular must be a multiple of 6, got {angular}")
    arc, rows = angular // 6, max(round(2 * radial / 3), 1)
    hub = outer - (outer - inner) * rows / radial  # where the pads begin

    def part(turn: float, start: float, bottom: float, depth: float) -> Callable:
        def place(q):
            r, angle = start + (outer - start) * q[1], 2 * np.pi * turn * q[0]
            return np.stack([r * np.cos(angle), r * np.sin(angle), bottom + depth * q[2]])

        return place

    half = thickness / 2
    spinning = part(1, inner, -half, thickness)
    upper, lower = (part(1 / 6, hub, z, pad_thickness) for z in (half, -half - pad_thickness))
    bodies = {
        "disc": _body((angular, radial, 1), spinning, disc, around=True),
        "upper": _body((arc, rows, 1), upper, pad),
        "lower": _body((arc, rows, 1), lower, pad),
    }
    index = bodies["disc"].index
    parts = {"hub": [("disc", index[:, 0])], "backs": []}
    contacts = []
    for name, front, back, up in (("upper", 0, -1, -1.0), ("lower", -1, 0, 1.0)):
        parts["backs"].append((name, bodies[name].index[:, :, back]))
        face = bodies[name].index[:, :, front].ravel()
        x, y = bodies[name].points[face, :2].T
        axes = np.zeros((len(face), 2, 3))
        axes[:, 0, :2] = np.stack([-y, x], 1) / np.hypot(x, y)[:, None]
        axes[:, 1, 2] = up
        facing = index[: 2 * arc + 1, -2 * rows - 1 :, back].ravel()
        contacts.append(_Contact(name, face, facing, axes))
    shares = np.outer(_simpson(arc), _simpson(rows) * np.linspace(hub, outer, 2 * rows + 1)).ravel()
    held = [each for name in clamped for each in parts[name]]
    bodies["disc"].matrices.update(
        _rotation(bodies["disc"], disc, index[:, 0] if "hub" in clamped else None)
    )
    return _joined(bodies, held, contacts, np.tile(shares / shares.sum(), 2))


# --- bodies ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Body:
    """A body of a grid of nodes: `index` (grid) numbers the nodes, `points` (nodes, dim) [m]."""

    points: np.ndarray
    index: np.ndarray
    quads: np.ndarray
    matrices: dict[str, Any]  # M and K (nodes dim, nodes dim)
    integral: Callable[[Callable], sp.csr_matrix]  # of a form of u, v, w: (nodes, nodes), rows v
    gradient: Callable[[np.ndarray], np.ndarray]  # of u (nodes, dim): (dim, dim, elements, points)


def _body(
    elements: Sequence[int],
    place: Callable[[np.ndarray], np.ndarray],
    material: Material,
    width: float = 1.0,
    around: bool = False,
) -> _Body:
    """A body of elements in a grid; `place` maps the unit square or cube to points (dim, nodes).

    `around`: the grid closes on itself in its first direction.
    """
    dim, counts = len(elements), np.array(elements)
    plain, quadratic = (MeshQuad, MeshQuad2) if dim == 2 else (MeshHex, MeshHex2)
    element = ElementQuad2() if dim == 2 else ElementHex2()
    grid = quadratic.from_mesh(plain.init_tensor(*(np.arange(n + 1.0) for n in elements)))
    steps = np.rint(2 * Basis(grid, element, intorder=5).doflocs).astype(int)
    shape = 2 * counts + 1
    if around:
        shape[0] -= 1
        steps[0] %= shape[0]
    index = np.arange(shape.prod()).reshape(shape)
    number = index[tuple(steps)]
    mesh = replace(grid, doflocs=place(grid.doflocs / counts[:, None]))
    basis: Any = Basis(mesh, element, intorder=5)  # Gauss points 3 a direction: M of a brick exact
    points = np.zeros((index.size, dim))
    points[number] = basis.doflocs.T

    def integral(form):
        A = BilinearForm(form).assemble(basis).tocoo()
        return sp.csr_matrix((A.data, (number[A.row], number[A.col])), shape=(index.size,) * 2)

    def gradient(u):
        return np.stack([basis.interpolate(component).grad for component in u[number].T])

    # int lambda div(v) div(u) + 2 mu e(v) : e(u), of D_ij = int v,i u,j of scalars.
    lam, mu = _lame(material, dim)
    K = 0
    for i, j in np.ndindex(dim, dim):
        D = width * integral(lambda u, v, w, i=i, j=j: v.grad[i] * u.grad[j])
        unit = np.outer(np.eye(dim)[i], np.eye(dim)[j])
        K = K + sp.kron(D, lam * unit + mu * unit.T + mu * (i == j) * np.eye(dim), "csr")
    mass = integral(lambda u, v, w: width * material.rho * u * v)
    matrices = {"M": sp.kron(mass, np.eye(dim), "csr"), "K": K}

    sheets = [index]
    if dim == 3:
        closed = np.concatenate([index, index[:1]]) if around else index
        sheets = [closed.take(end, axis) for axis in range(around, dim) for end in (0, -1)]
    quads = np.concatenate([_quads(sheet) for sheet in sheets])
    return _Body(points, index, quads, matrices, integral, gradient)


def _lame(material: Material, dim: int) -> tuple[float, float]:
    """Lame's constants (lambda, mu) [Pa]; in two dimensions, lambda is that of plane stress."""
    E, nu = material.E, material.nu
    mu = E / 2 / (1 + nu)
    return E * nu / (1 + nu) / (1 - (dim - 1) * nu), mu


def _rotation(disc: _Body, material: Material, hub: np.ndarray | None) -> dict[str, Any]:
    """G, K_convective and K_centrifugal of a disc that spins about z, as `disc_between_pads`."""
    rho, (lam, mu) = material.rho, _lame(material, 3)

    def along(u, x):
        return x[0] * u.grad[1] - x[1] * u.grad[0]

    B = disc.integral(lambda u, v, w: rho * v * along(u, w.x))
    convective = disc.integral(lambda u, v, w: -rho * along(v, w.x) * along(u, w.x))

    M, u = disc.matrices["M"], np.zeros(disc.points.shape)
    free = np.setdiff1d(np.arange(u.size).reshape(u.shape), [] if hub is None else hub)
    # Beside K, M is nothing (at 1 (rad/s)^2), but it holds a free disc.
    held = (disc.matrices["K"] + M)[free][:, free].tocsc()
    u.flat[free] = spsolve(held, (M @ (disc.points * [1, 1, 0]).ravel())[free])
    strain = disc.gradient(u)
    strain = (strain + strain.swapaxes(0, 1)) / 2
    sigma = 2 * mu * strain + lam * np.einsum("ii...,jk->jk...", strain, np.eye(3))
    centrifugal = disc.integral(lambda u, v, w: np.einsum("ij...,i...,j...", sigma, v.grad, u.grad))
    scalars = {"G": B - B.T, "K_convective": convective, "K_centrifugal": centrifugal}
    return {name: sp.kron(scalar, np.eye(3), "csr") for name, scalar in scalars.items()}


# --- putting them together ---------------------------------------------------------------------


class _Contact(NamedTuple):
    """Nodes `face` of a pad on nodes `facing` of the first body, (k,) each.

    `axes` (k, 2, dim) are unit vectors: along its motion, and from the pad to it.
    """

    pad: str
    face: np.ndarray
    facing: np.ndarray
    axes: np.ndarray


def _joined(
    bodies: dict[str, _Body],
    clamped: Sequence[tuple[str, np.ndarray]],
    contacts: Sequence[_Contact],
    shares: np.ndarray,
) -> Brake:
    """The bodies side by side, the first of them moving, without the clamped nodes."""
    first, dim = next(iter(bodies.values())), len(next(iter(bodies.values())).index.shape)
    counts = [len(body.points) for body in bodies.values()]
    start = dict(zip(bodies, np.cumsum([0, *counts[:-1]]), strict=True))
    held = np.zeros((sum(counts), dim), bool)
    for name, nodes in clamped:
        held[start[name] + nodes] = True
    free, dofs = np.flatnonzero(~held), np.full(held.shape, -1)
    dofs.flat[free] = np.arange(len(free))
    matrices = {}
    for name in first.matrices:
        # Pads do not spin: they have no matrices of rotation.
        blocks = [
            b.matrices.get(name, sp.csr_matrix(b.matrices["M"].shape)) for b in bodies.values()
        ]
        A = sp.block_diag(blocks, "csr")[free][:, free]
        matrices[name] = A if name == "G" else (A + A.T) / 2  # assembly leaves rounding
    names = [
        f"{name} {node} {axis}"
        for name, count in zip(bodies, counts, strict=True)
        for node in range(count)
        for axis in "xyz"[:dim]
    ]

    def relative(pad: np.ndarray, moving: np.ndarray, axis: np.ndarray) -> dict[int, float]:
        both = zip([*pad, *moving], [*axis, *-axis], strict=True)
        return {int(dof): float(weight) for dof, weight in both if abs(weight) > 1e-12}

    pairs = []
    for pad, *rows in contacts:
        for node, facing, (t, n) in zip(*rows, strict=True):
            ends = dofs[start[pad] + node], dofs[facing]
            pairs.append((relative(*ends, t), relative(*ends, n)))
    return Brake(
        matrices,
        np.concatenate([body.points for body in bodies.values()]),
        dofs,
        tuple(names[i] for i in free),
        tuple(pairs),
        shares,
        np.concatenate([start[name] + body.quads for name, body in bodies.items()]),
    )


def _simpson(elements: int) -> np.ndarray:
    """Integrals of the quadratic functions of a line, (2 elements + 1,), that sum to 1."""
    weights = np.tile([2.0, 4.0], elements + 1)[:-1]
    weights[[0, -1]] = 1
    return weights / (6 * elements)


def _quads(index: np.ndarray) -> np.ndarray:
    """The nodes (quads, 4) around each cell of a grid of nodes."""
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack(corners, -1).reshape(-1, 4)
