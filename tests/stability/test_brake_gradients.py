"""The growth rate of a random brake in plane stress and its derivatives by D and G of each joint.

The oracle has the contact law in many digits (`make_contact.py`) and NumPy's eigenvalues: left and
right vectors give the derivatives by stiffness, and differences of the law those by D and ln G.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import fractaljax as fj
from random_brakes import PAIRS, random_brake
from tools import ROOT, load_script

LAW = load_script(ROOT / "tests" / "reference" / "make_contact.py")
ORDER = 24  # of quadrature, which leaves more digits than a double has


def by_numpy(x) -> Any:
    """The eigenvalue with the largest real part, and the derivatives (18,) of its real part."""
    M, C, K = (np.array(A, float) for A in (x.M, x.C, x.K))
    n, moved = len(M), []
    for joint in x.joints:
        contact, mu = joint.contact, float(joint.friction.mu_s)
        parts: list[Any] = [(contact.surface, ("D", "G", "gamma")), (contact, ("P",))]
        parts += [(contact.material, ("E", "nu", "sigma_y", "H"))]
        row = {name: float(getattr(part, name)) for part, names in parts for name in names}
        found = LAW.joint(row | {"mu_s": mu, "mu_m": mu}, ORDER)
        along, across = np.zeros((2, n))
        for direction, dofs in ((along, joint.tangential), (across, joint.normal)):
            for dof, weight in dofs:
                direction[dof] = weight
        # Eq. 43: friction of each elastic force, which turns with it.
        forces = {
            "K_n": np.outer(across - mu * along, across),
            "K_t": np.outer(along + mu * across, along),
        }
        by_quantity = np.zeros((2, n, n))
        for name, force in forces.items():
            force *= float(found[name])
            K += force
            for dK, by in zip(by_quantity, found[f"dln_{name}"] or (0, 0), strict=False):
                dK += float(by) * force
        moved += [*by_quantity]
    unit = 1e5  # of time, 1/s: both halves of a state are of one size
    below = -np.linalg.solve(M, np.hstack([K / unit, C]))
    A = np.block([[np.zeros((n, n)), unit * np.eye(n)], [below]])
    solved: Any = scipy.linalg.eig(A, left=True)
    s, left, right = solved
    i = int(np.argmax(s.real))
    w, v = left[:, i].conj(), right[:, i]
    y = np.linalg.solve(M, w[n:]) / unit / (w @ v)
    return s[i], np.array([-(y @ dK @ v[:n]).real for dK in moved])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 6])
def test_growth_rate_and_its_18_derivatives(seed):
    """Of brakes that squeal, from scikit-fem's matrices; some of their joints slip."""
    x = random_brake(seed)
    s, wanted = by_numpy(x)
    assert s.real > 1000

    def rate(q):
        surfaces = {f"{pair}.D": D for pair, (D, _) in zip(PAIRS, q, strict=True)}
        surfaces |= {f"{pair}.G": jnp.exp(ln_G) for pair, (_, ln_G) in zip(PAIRS, q, strict=True)}
        return fj.growth_rate(x.replace(**surfaces))

    surfaces = [joint.contact.surface for joint in x.joints]
    q = jnp.array([[surface.D, jnp.log(surface.G)] for surface in surfaces])
    direction = np.random.default_rng(seed).standard_normal(q.shape)

    @jax.jit
    def both(q):
        found, along = jax.linearize(rate, q)
        (slopes,) = jax.linear_transpose(along, q)(1.0)
        return found, slopes.ravel(), along(direction)

    found, slopes, forward = both(q)
    room = 1e-11 * np.abs(wanted).max()
    assert float(found) == pytest.approx(s.real, rel=1e-9)
    np.testing.assert_allclose(slopes, wanted, rtol=1e-9, atol=room)
    assert float(forward) == pytest.approx(wanted @ direction.ravel(), rel=1e-9, abs=50 * room)
