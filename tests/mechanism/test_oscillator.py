"""Equilibrium and linearisation of the mass on a belt, against the nonlinear equations."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._mechanism.oscillator import linearise

STRIBECK = {"mu_s": 0.4, "mu_m": 0.25, "v_m": 0.5}
OSCILLATOR = {
    **{"m": 1.7, "omega_1": 6283.2, "omega_2": 5026.5},
    **{"xi_1": 0.003, "xi_2": 0.02, "F": 500.0, "V": 0.15},
}
CASES = [
    STRIBECK | OSCILLATOR | changes
    for changes in (
        {"K_n": 4e8, "K_t": 2e8},
        {"K_n": 4e8, "K_t": 2e8, "V": 0.7},  # beyond v_m the slope is positive
        {"K_n": 3e3, "K_t": 7e2, "F": -20.0},
        {"K_n": 1e12, "K_t": 5e11, "mu_s": 0.9, "mu_m": 0.0},
        {"K_n": 0.0, "K_t": 0.0},
        {"K_n": 4e8, "K_t": 0.0},
    )
]
ALL = pytest.mark.parametrize("x", CASES)


def parts(x):
    oscillator = fj.Oscillator(**{name: x[name] for name in OSCILLATOR})
    return oscillator, fj.Stribeck(**{name: x[name] for name in STRIBECK})


@pytest.fixture(autouse=True)
def _sixty_digits():
    with mp.workdps(60):
        yield


def exact(x):
    return {name: mp.mpf(value) for name, value in x.items()}


def friction_coefficient(x, v):
    """Eq. 38, as the source prints it."""
    drop = x["mu_s"] - x["mu_m"]
    falling = 3 * drop / (2 * x["v_m"]) * v
    return x["mu_s"] * mp.sign(v) - falling + drop / (2 * x["v_m"] ** 3) * v**3


def acceleration(x, state):
    """Eq. 39 solved for the accelerations, at [x_1, x_2, v_1, v_2]; mpmath."""
    x_1, x_2, v_1, v_2 = state
    m, f = x["m"], x["F"] / mp.sqrt(2)
    forces = [
        f
        + friction_coefficient(x, x["V"] - v_1) * x["K_n"] * x_2
        - 2 * x["xi_1"] * x["omega_1"] * m * v_1
        - (m * x["omega_1"] ** 2 + x["K_t"]) * x_1,
        -f
        - friction_coefficient(x, x["V"] - v_2) * x["K_t"] * x_1
        - 2 * x["xi_2"] * x["omega_2"] * m * v_2
        - (m * x["omega_2"] ** 2 + x["K_n"]) * x_2,
    ]
    return mp.matrix(forces) / m


def exact_equilibrium(x):
    """The equilibrium of Eq. 39: without motion it is linear in the displacements."""
    origin, *units = (acceleration(x, state) for state in ([0] * 4, [1, 0, 0, 0], [0, 1, 0, 0]))
    return mp.lu_solve(mp.matrix([[u[i] - origin[i] for u in units] for i in (0, 1)]), -origin)


@ALL
def test_equilibrium_solves_the_nonlinear_equations(x):
    """To rounding; its signs and couplings are those of Eq. 39, not only of Eq. 40."""
    oscillator, friction = parts(x)
    found = fj.equilibrium(oscillator, x["K_n"], x["K_t"], friction.mu(x["V"]))
    for own, wanted in zip(found, exact_equilibrium(exact(x)), strict=True):
        assert float(own) == pytest.approx(float(wanted), rel=1e-14)


@pytest.mark.parametrize("slope", [True, False])
@ALL
def test_linearise_is_the_jacobian_of_the_nonlinear_equations(x, slope):
    """Stiffness, coupling and damping, with the signs of both slope terms.

    By differences in 60 digits. Without the slope it is that of friction frozen at mu(V).
    """
    lin = linearise(*parts(x), x["K_n"], x["K_t"], slope)
    x = exact(x)
    state, h = [*exact_equilibrium(x), mp.mpf(0), mp.mpf(0)], mp.mpf(10) ** -20
    columns = []
    for j in range(4):
        up, down = ([*state[:j], state[j] + s * h, *state[j + 1 :]] for s in (1, -1))
        columns.append((acceleration(x, up) - acceleration(x, down)) / (2 * h))
    x_1, x_2, v_1, v_2 = columns
    c_1, c_2 = -v_1[0], -v_2[1]
    if not slope:
        c_1, c_2 = 2 * x["xi_1"] * x["omega_1"], 2 * x["xi_2"] * x["omega_2"]
    wanted = {"a": -x_1[0], "b": -x_2[1], "c_1": c_1, "c_2": c_2, "g": -x_2[0] * x_1[1]}
    assert abs(v_1[1]) < 1e-30 and abs(v_2[0]) < 1e-30
    for name, value in wanted.items():
        # The damping is a sum of two terms: rounding is beside the larger.
        damping = 2 * (x["xi_1"] * x["omega_1"] + x["xi_2"] * x["omega_2"])
        size = max(abs(value), damping) if name.startswith("c") else abs(value)
        assert abs(float(getattr(lin, name)) - value) <= 1e-14 * size, name


@pytest.mark.parametrize("slope", [True, False])
def test_coulomb_friction_has_no_slope(slope):
    """Its linearisation is that of Stribeck friction without a fall."""
    oscillator, _ = parts(CASES[0])
    laws = fj.Coulomb(0.3), fj.Stribeck(0.3, 0.3, 0.5)
    own, other = (jax.tree.leaves(linearise(oscillator, law, 4e8, 2e8, slope)) for law in laws)
    np.testing.assert_array_equal(own, other)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_equilibrium_gradients(mode):
    """Against central differences."""
    oscillator, _ = parts(CASES[0])

    def displacements(x):
        return jnp.stack(fj.equilibrium(oscillator, *x))

    point = np.array([4e8, 2e8, 0.3])
    found = mode(displacements)(jnp.asarray(point))
    for i, h in enumerate(1e-5 * point):
        step = h * np.eye(3)[i]
        difference = (displacements(point + step) - displacements(point - step)) / (2 * h)
        np.testing.assert_allclose(found[:, i], difference, rtol=1e-8)


def test_vmapped_is_looped():
    oscillator, friction = parts(CASES[0])
    K_n = np.geomspace(1e3, 1e12, 7)
    many = jax.vmap(lambda K: linearise(oscillator, friction, K, K / 2))(K_n)
    for i, K in enumerate(K_n):
        one = linearise(oscillator, friction, K, K / 2)
        for own, other in zip(jax.tree.leaves(many), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(own[i], other, 1e-14)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *((name, 0.0, "must be above 0, got 0.0") for name in ("m", "omega_1", "omega_2")),
        ("xi_1", -1e-9, "must be at least 0, got -1e-09"),
        ("V", np.array([0.1, -0.2]), "must be at least 0, got -0.2"),
    ],
)
def test_values_outside_the_domain_are_refused(name, value, message):
    """The message names the argument, the bound and the value."""
    with pytest.raises((ValueError, TypeError), match=f"^{name} {message}"):
        fj.Oscillator(**(OSCILLATOR | {name: value}))
    with pytest.raises(TypeError, match="oscillator must be an Oscillator, got 1"):
        fj.equilibrium(1, 1e8, 1e8, 0.3)  # pyright: ignore[reportArgumentType]


def test_what_is_inside_the_domain_and_nan_outside():
    oscillator = fj.Oscillator(**(OSCILLATOR | {"xi_1": 0.0, "xi_2": 0, "F": -3.0}))
    assert [float(x) for x in (oscillator.xi_1, oscillator.xi_2, oscillator.F)] == [0, 0, -3]
    run = jax.jit(lambda m: fj.Oscillator(**(OSCILLATOR | {"m": m})).m)
    assert float(run(2.0)) == 2.0
    assert np.isnan(run(-1.0))
