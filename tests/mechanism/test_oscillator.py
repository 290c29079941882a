"""Equilibrium and linearisation of the mass on a belt, against the nonlinear equations."""

import dataclasses

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.mechanism.oscillator import linearise

STRIBECK = {"mu_s": 0.4, "mu_m": 0.25, "v_m": 0.5}
OSCILLATOR = {
    "m": 1.7,
    "omega_1": 6283.2,
    "omega_2": 5026.5,
    "xi_1": 0.003,
    "xi_2": 0.02,
    "F": 500.0,
    "V": 0.15,
}
CASES = [
    {"K_n": 4e8, "K_t": 2e8},
    {"K_n": 4e8, "K_t": 2e8, "V": 0.7},  # beyond v_m the slope is positive
    {"K_n": 3e3, "K_t": 7e2, "F": -20.0},
    {"K_n": 1e12, "K_t": 5e11, "mu_s": 0.9, "mu_m": 0.0},
    {"K_n": 0.0, "K_t": 0.0},
    {"K_n": 4e8, "K_t": 0.0},
]


def numbers(**changes):
    return STRIBECK | OSCILLATOR | changes


def parts(x):
    oscillator = fj.Oscillator(**{name: x[name] for name in OSCILLATOR})
    return oscillator, fj.Stribeck(**{name: x[name] for name in STRIBECK})


def friction_coefficient(x, v):
    """Eq. 38, as the source prints it."""
    drop = x["mu_s"] - x["mu_m"]
    return (
        x["mu_s"] * mp.sign(v) - 3 * drop / (2 * x["v_m"]) * v + drop / (2 * x["v_m"] ** 3) * v**3
    )


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
    """Where Eq. 39 rests, by solving it: it is linear in the displacements."""
    at_rest = [acceleration(x, state) for state in ([0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0])]
    matrix = mp.matrix(2, 2)
    for j in range(2):
        for i in range(2):
            matrix[i, j] = at_rest[j + 1][i] - at_rest[0][i]
    return mp.lu_solve(matrix, -at_rest[0])


@pytest.mark.parametrize("changes", CASES)
def test_equilibrium_solves_eq_40(changes):
    """The residual of [[K1+Kt, -mu Kn], [mu Kt, K2+Kn]] x0 = [F, -F]/sqrt(2) is rounding."""
    x = numbers(**changes)
    oscillator, friction = parts(x)
    mu = float(friction.coefficient(x["V"]))
    found = np.stack(fj.equilibrium(oscillator, x["K_n"], x["K_t"], mu))
    matrix = np.array(
        [
            [x["m"] * x["omega_1"] ** 2 + x["K_t"], -mu * x["K_n"]],
            [mu * x["K_t"], x["m"] * x["omega_2"] ** 2 + x["K_n"]],
        ]
    )
    load = np.array([x["F"], -x["F"]]) / np.sqrt(2)
    assert np.abs(matrix @ found - load).max() <= 1e-15 * np.abs(matrix).max() * np.abs(found).max()
    np.testing.assert_allclose(found, np.linalg.solve(matrix, load), rtol=1e-13)


@pytest.mark.parametrize("changes", CASES)
def test_equilibrium_rests_in_the_nonlinear_equations(changes):
    """Its signs and couplings are those of Eq. 39, not only of Eq. 40."""
    with mp.workdps(40):
        x = numbers(**changes)
        oscillator, friction = parts(x)
        found = fj.equilibrium(oscillator, x["K_n"], x["K_t"], friction.coefficient(x["V"]))
        exact = exact_equilibrium({name: mp.mpf(value) for name, value in x.items()})
        for own, wanted in zip(found, exact, strict=True):
            assert float(own) == pytest.approx(float(wanted), rel=1e-14)


def jacobian(x):
    """d(accelerations)/d[x_1, x_2, v_1, v_2] of Eq. 39 at rest, by differences in 60 digits."""
    h = mp.mpf(10) ** -20
    rest = [*exact_equilibrium(x), mp.mpf(0), mp.mpf(0)]
    columns = []
    for j in range(4):
        up, down = list(rest), list(rest)
        up[j], down[j] = up[j] + h, down[j] - h
        columns.append((acceleration(x, up) - acceleration(x, down)) / (2 * h))
    return columns


@pytest.mark.parametrize("slope", [True, False])
@pytest.mark.parametrize("changes", CASES)
def test_linearise_is_the_jacobian_of_the_nonlinear_equations(changes, slope):
    """Stiffness, coupling and damping, with the signs of both slope terms.

    Without the slope the Jacobian is that of friction frozen at mu(V).
    """
    with mp.workdps(60):
        x = {name: mp.mpf(value) for name, value in numbers(**changes).items()}
        x_1, x_2, v_1, v_2 = jacobian(x)
        lin = linearise(*parts(numbers(**changes)), float(x["K_n"]), float(x["K_t"]), slope)
        c_1, c_2 = -v_1[0], -v_2[1]
        if not slope:
            c_1, c_2 = 2 * x["xi_1"] * x["omega_1"], 2 * x["xi_2"] * x["omega_2"]
        wanted = {"a": -x_1[0], "b": -x_2[1], "c_1": c_1, "c_2": c_2, "g": -x_2[0] * x_1[1]}
        assert abs(v_1[1]) < 1e-30
        assert abs(v_2[0]) < 1e-30
        for name, value in wanted.items():
            # The damping is a sum of two terms: rounding is beside the larger.
            damping = 2 * (x["xi_1"] * x["omega_1"] + x["xi_2"] * x["omega_2"])
            size = max(abs(value), damping) if name.startswith("c") else abs(value)
            assert abs(float(getattr(lin, name)) - value) <= 1e-14 * size, name


def test_slope_terms_have_the_known_signs():
    """Friction that falls with velocity drives direction 1, pressed on the belt (x_02 < 0 is a
    lift there), and damps or drives direction 2 with the sign of x_01."""
    x = numbers(K_n=4e8, K_t=2e8)
    oscillator, friction = parts(x)
    with_slope = linearise(oscillator, friction, 4e8, 2e8)
    without = linearise(oscillator, friction, 4e8, 2e8, friction_slope=False)
    x_01, x_02 = fj.equilibrium(oscillator, 4e8, 2e8, friction.coefficient(0.15))
    falling = friction.slope(0.15)
    assert falling < 0
    np.testing.assert_allclose(with_slope.c_1 - without.c_1, falling * 4e8 * x_02 / 1.7, rtol=1e-12)
    np.testing.assert_allclose(
        with_slope.c_2 - without.c_2, -falling * 2e8 * x_01 / 1.7, rtol=1e-12
    )


def test_coulomb_friction_has_no_slope():
    """Its linearisation is that of Stribeck friction without a fall, slope asked for or not."""
    oscillator, _ = parts(numbers())
    flat = fj.Stribeck(0.3, 0.3, 0.5)
    for slope in (True, False):
        for own, other in zip(
            jax.tree.leaves(linearise(oscillator, fj.Coulomb(0.3), 4e8, 2e8, slope)),
            jax.tree.leaves(linearise(oscillator, flat, 4e8, 2e8, slope)),
            strict=True,
        ):
            np.testing.assert_array_equal(own, other)


def test_equilibrium_gradients():
    """Both modes against central differences."""
    oscillator, _ = parts(numbers())

    def displacements(K_n, K_t, mu):
        return jnp.stack(fj.equilibrium(oscillator, K_n, K_t, mu))

    point = (4e8, 2e8, 0.3)
    for mode in (jax.jacfwd, jax.jacrev):
        for i, found in enumerate(mode(displacements, argnums=(0, 1, 2))(*point)):
            h = 1e-5 * point[i]
            up, down = (
                displacements(*(x + s * h * (i == j) for j, x in enumerate(point))) for s in (1, -1)
            )
            np.testing.assert_allclose(found, (up - down) / (2 * h), rtol=1e-8)


def test_vmapped_is_looped():
    oscillator, friction = parts(numbers())
    K_n = np.geomspace(1e3, 1e12, 7)
    many = jax.vmap(lambda K: linearise(oscillator, friction, K, K / 2))(K_n)
    for i, K in enumerate(K_n):
        one = linearise(oscillator, friction, K, K / 2)
        for field in dataclasses.fields(one):
            np.testing.assert_allclose(
                getattr(many, field.name)[i], getattr(one, field.name), 1e-14
            )


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("m", 0.0, "m must be above 0, got 0.0"),
        ("m", -1.0, "m must be above 0, got -1.0"),
        ("omega_1", 0.0, "omega_1 must be above 0, got 0.0"),
        ("omega_2", -5.0, "omega_2 must be above 0, got -5.0"),
        ("xi_1", -1e-9, "xi_1 must be at least 0, got -1e-09"),
        ("xi_2", np.nan, "xi_2 must be at least 0, got nan"),
        ("V", 0.0, "V must be above 0, got 0.0"),
        ("F", np.inf, "F must be finite, got inf"),
        ("V", [0.1, -0.2], "V must be"),
    ],
)
def test_values_outside_the_domain_are_refused(name, value, message):
    """The message names the argument, the bound and the value."""
    value = np.array(value) if isinstance(value, list) else value
    with pytest.raises(ValueError) as error:
        fj.Oscillator(**(OSCILLATOR | {name: value}))
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_bounds_that_are_inside():
    """No damping and no force are legal, and so is a force that lifts."""
    oscillator = fj.Oscillator(**(OSCILLATOR | {"xi_1": 0.0, "xi_2": 0, "F": -3.0}))
    assert float(oscillator.F) == -3.0


@pytest.mark.parametrize("value", ["1", None, True, 1j])
def test_what_is_not_a_number_is_refused(value):
    with pytest.raises(TypeError, match="m must be a"):
        fj.Oscillator(**(OSCILLATOR | {"m": value}))


def test_a_traced_value_outside_the_domain_raises_when_run():
    run = jax.jit(lambda m: fj.Oscillator(**(OSCILLATOR | {"m": m})).m)
    assert float(run(2.0)) == 2.0
    with pytest.raises(Exception, match="m must be above 0"):
        run(-1.0).block_until_ready()


def test_pytree_round_trip_and_frozen():
    oscillator, _ = parts(numbers())
    leaves, structure = jax.tree.flatten(oscillator)
    assert [float(x) for x in leaves] == list(OSCILLATOR.values())
    again = jax.tree.unflatten(structure, leaves)
    assert isinstance(again, fj.Oscillator)
    with pytest.raises(dataclasses.FrozenInstanceError):
        oscillator.m = 3.0  # pyright: ignore[reportAttributeAccessIssue]
