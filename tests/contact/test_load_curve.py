"""The load curve dN/du = K_n(N): against its closed form for powers, and SciPy's integration."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fractaljax as fj
from fractaljax._base.parts import substitute
from fractaljax._contact.load_curve import tabulated
from tools import both_modes

MATERIAL = fj.Material(E=1.154e11, nu=0.3, sigma_y=3.55e8, H=9.94e8)
P, K_N = 1907.3, 4e8
TABLE = np.array([50.0, 300.0, 1200.0, 4000.0]), np.array([4e7, 1.6e8, 3e8, 7e8])


def power_law(alpha):
    loads = np.array([P / 10, 10 * P])
    return fj.MeasuredContact(loads, K_N * (loads / P) ** alpha, P, 0.8)


def persson(D: Any = 2.4, G: Any = 1.342e-10, load: Any = P, area: Any = 1e-3):
    return fj.PerssonContact(fj.Surface(D, G), MATERIAL, load, area=area, L=1e-2, L_s=1e-6)


@jax.jit
def _at(law, N):
    return substitute(law, {"P": N}).stiffness(0.4, 0.3)[0]


@jax.jit
def _load(law, u):
    return law.load(u)


@jax.jit
def _slopes(law, u):
    return jax.vmap(jax.grad(law.load))(u)


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, 1 / 3, 0.5, 0.9])
def test_powers(alpha):
    """N = P (1 + (1 - alpha) e)^(1/(1 - alpha)): a constant spring, Hertz, and nearly exponential.

    The slope is K_n(N), and the joint opens at u = -P/((1 - alpha) K_n).
    """
    law, opening = power_law(alpha), P / ((1 - alpha) * K_N)
    loads = P * np.array([1e-4, 1e-2, 0.1, 0.5, 1.0, 2.0, 10.0, 30.0])
    u = opening * ((loads / P) ** (1 - alpha) - 1)
    beyond = -opening * np.array([1.0000001, 1.5, 10.0])
    computed, opened = np.split(np.asarray(_load(law, np.concatenate([u, beyond]))), [len(u)])
    np.testing.assert_allclose(computed, loads, rtol=1e-9)
    slopes = _slopes(law, u)
    np.testing.assert_allclose(slopes, K_N * (loads / P) ** alpha, rtol=1e-7)
    np.testing.assert_array_equal(opened, 0.0)
    assert computed[u == 0] == pytest.approx(P, rel=1e-14)


@pytest.mark.parametrize(
    ("D", "G", "load", "area"),
    [(2.1, 1e-10, P, 1e-3), (2.4, 1.342e-10, 1.0, 1e-3), (2.5, 1e-10, 1e5, 1e-3),
     (2.7, 1e-10, P, 1e-4), (2.9, 1e-10, P, 1e-3), (2.4, 1.342e-10, 1e6, 1e-3)],
)  # fmt: skip
def test_persson(D, G, load, area):
    """Beside SciPy's integration of du = dN/K_n from P, down to P/1000 and up to 8 P."""
    law = persson(D, G, load, area)
    logs = np.log(np.array([1e-3, 1e-2, 0.1, 0.5, 2.0, 5.0, 8.0]))

    def by_log(log_n, u):
        return [load * np.exp(log_n) / float(_at(law, load * np.exp(log_n)))]

    sides = logs[logs < 0][::-1], logs[logs > 0]
    options: Any = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-25}
    u = [solve_ivp(by_log, (0.0, x[-1]), [0.0], t_eval=x, **options).y[0] for x in sides]
    loads = load * np.exp(np.concatenate(sides))
    np.testing.assert_allclose(_load(law, np.concatenate(u)), loads, rtol=1e-8, atol=1e-8 * load)


@jax.jit
def _table_and_curve(curve, share):
    """Value and slope of the table of a load curve, and of the curve."""
    table = jax.tree.map(lambda leaf: leaf[..., None], tabulated(curve))
    e = share * jnp.where(share < 0, curve.opening, curve.ends[-1])
    return [jax.jvp(f, (e,), (jnp.ones_like(e),)) for f in (table, curve)]


@pytest.mark.parametrize("law", [persson(), persson(2.7, 1e-10, P, 1e-4), power_law(1 / 3)])
def test_table(law):
    """What motions look up: within 1e-11 of P or N, its slope within 1e-8, up to full contact."""
    curve = law.load_curve(0.4, 0.3)
    computed, expected = _table_and_curve(curve, jnp.linspace(-1.2, 1.1, 4001))
    np.testing.assert_allclose(computed[0], expected[0], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(computed[1], expected[1], rtol=1e-8, atol=1e-8)


@jax.jit
@jax.vmap
def _persson_lanes(D, load):
    """Curve and table at rest, and beside each other from the opening to far above P."""
    law = fj.PerssonContact(fj.Surface(D, 1.342e-10), MATERIAL, load, 1e-4, 1e-2, 1e-4)
    curve = law.load_curve(0.4, 0.3)
    assert curve is not None
    table = jax.tree.map(lambda leaf: leaf[..., None], tabulated(curve))
    share = jnp.geomspace(1e-6, 1, 200)
    e = jnp.concatenate([jnp.zeros(1), -share * curve.opening, 1.5 * share * curve.ends[-1]])
    return curve(e), table(e), e / curve.opening


@pytest.mark.slow
def test_nothing_moves_at_rest():
    """N = P without approach, from the lightest loads to full contact of surfaces of any D."""
    D, load = np.meshgrid(np.linspace(2.02, 2.98, 9), 10.0 ** np.arange(7))
    computed, tabled, e = map(np.asarray, _persson_lanes(D.ravel(), load.ravel()))
    np.testing.assert_array_equal(computed[:, 0], 1)
    np.testing.assert_allclose(tabled[:, 0], 1, rtol=0, atol=1e-13)
    np.testing.assert_allclose(tabled, computed, rtol=1e-9, atol=1e-9)
    # N never falls with the approach, and is 0 where the joint opens.
    rising = np.take_along_axis(computed, np.argsort(e, axis=1), axis=1)
    assert (rising[:, 1:] >= rising[:, :-1]).all()
    assert (computed[:, 200] == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("D", [2.05, 2.5, 2.8, 2.97])
def test_mass_at_rest_stays(D):
    """Under a preload, with its own load curve: it once moved by 6.7 P/K_n."""
    law = fj.PerssonContact(fj.Surface(D, 1.342e-10), MATERIAL, P, 1e-4, 1e-2, 1e-4)
    joint = fj.Joint(law, fj.Coulomb(1e-9), [1.0, 0.0], [0.0, 1.0], V=0.1, preload=True)
    structure = fj.Structure(np.eye(2), np.eye(2), 1e4 * np.eye(2), [joint])
    K_n = float(law.stiffness(0.4, 0.3)[0])
    motion, size = fj.simulate(structure, np.zeros(4), 100 / np.sqrt(K_n)), P / K_n
    assert abs(np.asarray(motion.states)[:, 1]).max() < 1e-9 * size


@pytest.mark.slow
def test_measured_table_and_laws_without_a_curve():
    """A table whose K_n has kinks at its loads; on one of them, between and beyond."""
    for load in (1200.0, 700.0, 20.0, 9000.0):
        law = fj.MeasuredContact(*TABLE, load, 0.8)
        u = np.linspace(-1, 3, 9) * load / float(law.stiffness(0.4, 0.3)[0])

        for side in (u[u < 0][::-1], u[u > 0]):
            computed = solve_ivp(
                lambda u, N, law=law: [float(_at(law, N[0]))], (0.0, side[-1]), [load], "DOP853",
                t_eval=side, rtol=1e-11, atol=1e-10 * load, max_step=abs(side[-1]) / 100,
            )  # fmt: skip
            np.testing.assert_allclose(_load(law, computed.t), computed.y[0], rtol=1e-6)
    # The source's law, whose K_n ends above P = 0, and a table too steep to open.
    scene = fj.brake_scene()
    for law in (scene.contact, power_law(1.2), fj.FixedContact(K_N, K_N, P)):
        assert law.load_curve(0.4, 0.3) is None
        with pytest.raises(ValueError, match="load needs a contact law with a load curve, got"):
            law.load(1e-6)
        assert not fj.Scene(law, scene.friction, scene.oscillator, True).follows_load_curve


@pytest.mark.slow
def test_derivatives():
    """By D, ln G, P, area and u in both modes, against differences of the load."""

    def load(x):
        law = persson(x[0], jnp.exp(x[1]), x[2], x[3])
        return law.load(x[4])[None]

    x = jnp.array([2.4, np.log(1.342e-10), P, 1e-3, -2e-7])
    steps = np.array([1e-5, 1e-4, 1e-2, 1e-8, 1e-11])
    program = jax.jit(lambda x: both_modes(load, x))
    _, forward, reverse = program(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    for i, step in enumerate(steps):
        ends = [float(program(x.at[i].add(sign * step))[0][0]) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(forward[0, i], expected, rtol=1e-6)


@pytest.mark.slow
def test_finite_everywhere():
    """From 1 N to 1e6 N, D = 2.05 to 2.95: rising loads, finite with their derivatives."""
    D, loads = jnp.array([2.05, 2.5, 2.95]), jnp.array([1.0, 1e3, 1e6])
    e = jnp.linspace(-20.0, 40.0, 61)

    def curve(D, load):
        law = persson(D, 1e-11, load, 1e-3)
        u = e * load / law.stiffness(0.4, 0.3)[0]
        return law.load(u) / load

    grid = jnp.meshgrid(D, loads)
    values, slopes = jax.jit(jax.vmap(lambda D, P: (curve(D, P), jax.jacfwd(curve, (0, 1))(D, P))))(
        *(x.ravel() for x in grid)
    )
    assert np.isfinite(values).all() and all(np.isfinite(x).all() for x in slopes)
    assert (np.diff(values, axis=1) >= 0).all() and (values >= 0).all()
