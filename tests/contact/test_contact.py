"""The fractal joint: against quadrature in 80 digits, over a very wide domain, its identities."""

import functools
import random
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from joint_table import (
    ABSOLUTE,
    BRAKE,
    COLUMNS_OF_TABLED,
    INPUT,
    INPUTS,
    LOG_SLOPE,
    MATERIAL,
    REGIME,
    ROWS,
    VALUE,
    everything,
    reference_joints,
)
from mpmath import mp, mpf

import fractaljax as fj
from benchmarks.exact_joint import exact_joint
from fractaljax._base.parts import substitute
from fractaljax._contact import fractal, load_balance
from reference import make_contact
from tools import both_modes, primitives, refusals

EPS = float(np.finfo(float).eps)
EPS32 = float(np.finfo(np.float32).eps)
MODES = pytest.mark.parametrize("mode", ["forward", "reverse"])
DTYPES = pytest.mark.parametrize(
    "dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)]
)


# --- the table -------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_table_can_be_derived_again():
    """Rows of each regime by quadrature, digit for digit."""
    rng = random.Random(7)
    for regime in make_contact.REGIMES:
        for row in rng.sample([row for row in ROWS if row["regime"] == regime], 4):
            assert make_contact.joint(row) == row


# --- the library against the table; in 32 bits against 64 at the rounded inputs ---------------


@functools.cache
def case(dtype):
    """What is found in a precision, the truth, its slopes by D, ln G, ln P, and one rounding."""
    x, truth, log_slopes = INPUT, VALUE, LOG_SLOPE
    state, forward, reverse = everything(x, dtype)
    full, slopes = state, forward
    if dtype == "float32":
        x = INPUT.astype(np.float32).astype(float)
        # float32(0.3) is above 0.3, where Eq. 19 has its step.
        x[:, 9] = np.where(INPUT[:, 9] == 0.3, 0.3, x[:, 9])
        full, slopes, _ = everything(x)
        truth = vars(full)
        log_slopes = {name: log_slope(truth[name], slopes[name]) for name in LOG_SLOPE}
    computed = {"state": state, "forward": forward, "reverse": reverse}
    # Not in the table. Only their size matters, and the values test what they rest on.
    rest = ("A_r", "Q_e", "plastic_share", "slip_ratio")
    sizes = {name: log_slope(truth[name], slopes[name]) for name in rest} | log_slopes
    return computed, truth, sizes, x[:, 0]


def log_slope(value, slope):
    """d ln(value) by D, ln G, ln P from d value (rows, 10); 0 where the value is 0."""
    return slope[:, COLUMNS_OF_TABLED] / np.where(value == 0, 1, value)[:, None]


def condition(D, slopes):
    """Relative change of a quantity by a relative change of 1 of D, G, P and of itself."""
    return 1 + np.abs(D * slopes[:, 0]) + np.abs(slopes[:, 1]) + np.abs(slopes[:, 2])


def slip_condition(slip):
    """What (1 - slip)^(1/3) adds: its relative change by one of slip."""
    return np.where(slip == 1, 0, slip / (3 * np.abs(1 - slip)))


def assert_within(error, allowed, rows=None):
    """Show the worst row where an error exceeds what is allowed."""
    ratio = np.asarray(error) / allowed
    ratio = ratio if rows is None else np.where(rows, ratio, 0)
    worst = int(np.argmax(np.where(np.isnan(ratio), np.inf, ratio)))
    assert ratio[worst] <= 1, f"row {worst}: {ratio[worst]:.3g} times what is allowed"


@DTYPES
def test_regimes(dtype):
    """Exact up to 1e-6 beside the boundaries; float32 can tell from 1e-4 on."""
    computed, truth, *_ = case(dtype)
    clear = np.ones(len(ROWS), bool)
    if dtype == "float32":
        clear = np.abs(truth["log_area_ratio"]) > 1e-4
        clear &= np.abs(truth["slip_ratio"] - 1) > 1e-4
        assert clear.mean() > 0.96
    for name in make_contact.REGIMES:
        mine = np.asarray(computed["state"].regime == getattr(fj.Regime, name))
        np.testing.assert_array_equal(mine[clear], np.equal(REGIME, name)[clear])


@DTYPES
def test_values(dtype):
    """Areas, stiffnesses, load and shares to 1e-13 (16 roundings of float32) of their condition."""
    computed, truth, slopes, D = case(dtype)
    tolerance = 1e-13 if dtype == "float64" else 16 * EPS32
    for name, by_input in slopes.items():
        value, rows = getattr(computed["state"], name), truth[name] != 0
        assert value.dtype == dtype
        extra = slip_condition(truth["slip_ratio"]) if name == "K_t" else 0
        error = np.abs(value / np.where(rows, truth[name], 1) - 1)
        assert_within(error, tolerance * (condition(D, by_input) + extra), rows)


@DTYPES
@MODES
def test_derivatives(dtype, mode):
    """dln a_l, dln K_n, dln K_t by D, ln G, ln P in both modes."""
    computed, truth, slopes, D = case(dtype)
    tolerance = 1e-13 if dtype == "float64" else 64 * EPS32
    # A derivative that is large because a_l is near a_e is as ill-conditioned as it is large.
    by_a_l, by_K_n, by_K_t = (slopes[name] for name in LOG_SLOPE)
    from_K_n = condition(D, by_K_n)[:, None]
    # 1 - slip magnifies the error of slip, which is that of K_n; and dln K_t is dln K_n less a
    # part by slip, either of which may be far larger than the difference.
    from_slip = from_K_n * (1 + 3 * slip_condition(truth["slip_ratio"]))[:, None]
    allowed = {
        "a_l": condition(D, by_a_l)[:, None] * (1 + np.abs(by_a_l)),
        "K_n": from_K_n * (1 + np.abs(by_K_n)),
        "K_t": from_slip * (1 + np.abs(by_K_n) + np.abs(by_K_t - by_K_n)),
    }
    edge = np.abs(VALUE["ln_a_l"] - VALUE["ln_a_e"]) < 1e-4
    edge |= np.abs(1 - VALUE["slip_ratio"]) < 1e-4
    for name, bound in allowed.items():
        rows = truth[name] != 0
        assert computed[mode][name].dtype == dtype
        slope = log_slope(getattr(computed["state"], name).astype(float), computed[mode][name])
        error = np.abs(slope - slopes[name])
        for i in range(3):
            assert_within(error[:, i], tolerance * bound[:, i], rows)
            if dtype == "float64":  # away from the edges, 1e-9 whatever the condition
                assert_within(error[:, i], 1e-9 * (1 + np.abs(slopes[name][:, i])), rows & ~edge)


@DTYPES
@MODES
def test_zeros_are_exact(dtype, mode):
    """K_n, K_t, Q_e and slip are 0.0 where the regime says so, and so is every derivative."""
    computed, *_ = case(dtype)
    state, slopes = computed["state"], computed[mode]
    plastic = np.asarray(state.regime == fj.Regime.fully_plastic)
    sticks = np.asarray(state.regime == fj.Regime.elastic_plastic)
    for name, rows in {
        "K_n": plastic,
        "K_t": ~sticks,
        "Q_e": plastic,
        "slip_ratio": plastic,
    }.items():
        np.testing.assert_array_equal(getattr(state, name) == 0, rows)
        np.testing.assert_array_equal(slopes[name][rows], 0.0)
    np.testing.assert_array_equal(state.plastic_share[plastic], 1.0)
    np.testing.assert_array_equal(slopes["plastic_share"][plastic], 0.0)


@DTYPES
@MODES
def test_finite(dtype, mode):
    """No NaN or infinity but in a_e as D -> 2, and only where its true derivative overflows."""
    computed, *_ = case(dtype)
    state, slopes = computed["state"], computed[mode]
    # dD brings (D-2)^-2, dG brings 1/G.
    divisor = np.minimum(2 * np.log(INPUT[:, 0] - 2), np.log(INPUT[:, 1]))
    largest = VALUE["ln_a_e"] - divisor
    overflow = largest > {"float64": 700, "float32": 80}[dtype]
    assert overflow.sum() < {"float64": 5, "float32": 40}[dtype]
    assert (state.a_e > 0).all() and not np.isnan(slopes["a_e"]).any()
    for name, slope in slopes.items():
        rows = ~overflow if name == "a_e" else slice(None)
        assert np.isfinite(getattr(state, name)[rows]).all(), name
        assert np.isfinite(slope[rows]).all(), name


def test_log_areas_and_their_loads():
    """ln a_l, ln a_e and their difference, up to 700 decades apart, to 1e-14 of their size."""
    state, a_l, a_e = case("float64")[0]["state"], VALUE["ln_a_l"], VALUE["ln_a_e"]
    # ln a_e is a number of order 10, known to rounding, over 2 - D; and a sum with 2 ln G.
    size = 2 * np.abs(np.log(INPUT[:, 1])) + 20 / (INPUT[:, 0] - 2)
    assert_within(np.abs(np.log(state.a_e) - a_e), 1e-15 * size)
    assert_within(np.abs(np.log(state.a_l) - a_l), 1e-13 * condition(1, LOG_SLOPE["a_l"]))
    assert_within(np.abs(state.log_area_ratio - (a_l - a_e)), 1e-15 * size)
    # P of the table's areas and its derivatives at constant A_r, plastic rows included.
    D, slopes = INPUT[:, 0], LOG_SLOPE["a_l"].copy()
    A_r = (D - 1) / (3 - D) * VALUE["a_l"]
    slopes[:, 0] += 1 / (D - 1) + 1 / (3 - D)
    P, forward, reverse = loads(INPUT, A_r)
    expected = np.stack([-slopes[:, 0], -slopes[:, 1], np.ones_like(D)], axis=1) / slopes[:, 2:]
    scale = condition(D, expected)
    assert_within(np.abs(P / INPUT[:, 7] - 1), 1e-14 * scale * (1 + np.abs(VALUE["ln_a_l"])))
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-11)
    assert_within(np.abs(forward - expected).max(axis=1), 1e-11 * scale)


@pytest.mark.parametrize("nominal", [1.0, 0.037])
def test_dimensionless_stiffness_of_every_row(nominal):
    """Eqs. 31 and 37: K_n/(E sqrt(A_a)) and K_t/(E sqrt(A_a)), for any A_a."""
    state, (D, nu, E) = case("float64")[0]["state"], INPUT[:, [0, 4, 3]].T
    areas = state.A_r / nominal, state.a_e / nominal
    # Near a_l = a_e the ratio of the areas is all that is left of their logarithms.
    allowed = 1e-13 * (1 + 1 / np.maximum(np.abs(state.log_area_ratio), 1e-300))
    for star, K in [
        (fj.dimensionless_normal_stiffness(D, *areas), state.K_n),
        (fj.dimensionless_tangential_stiffness(D, nu, *areas, state.slip_ratio), state.K_t),
    ]:
        error = np.abs(np.asarray(star) * E * np.sqrt(nominal) - K)
        assert_within(error, allowed * np.where(K == 0, 1, K))
        np.testing.assert_array_equal(np.asarray(star) == 0, K == 0)


@jax.jit
@jax.vmap
def loads(x, A_r):
    """P, and d ln P by D, ln G, ln A_r, forward and reverse."""
    material = substitute(MATERIAL, dict(zip(INPUTS[3:7], x[3:7], strict=True)))

    def log_P(move):
        D, G, A = x[0] + move[0], x[1] * jnp.exp(move[1]), A_r * jnp.exp(move[2])
        surface = substitute(BRAKE.surface, {"D": D, "G": G, "gamma": x[2]})
        return jnp.log(fj.contact_load(surface, material, A, mu_m=x[9]))

    computed, *slopes = both_modes(log_P, jnp.zeros(3, x.dtype))
    return jnp.exp(computed), *slopes


# --- a domain far beyond any brake's ----------------------------------------------------------

# So elastic (sigma_y/E = 1, gamma near 1) that (a_l/a_e)^(1/2) once overflowed.
RUBBER = [2.000455408473626, 2.709781322266324e-13, 1.001784768917085, 1.2054967571236494e11]
RUBBER += [0.04388394337974338, 1.2054967571236494e11, 9.009250811440607e11, 1e-6, 50.6, 0.255]


def wide_joints(seed):
    """As many joints as the table has, a third with D near 2 and near 3 each, many at corners."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(size=(len(ROWS), 10))
    at_corner = rng.uniform(size=u.shape) < rng.choice([0.0, 0.2, 0.6], size=(len(u), 1))
    u = np.where(at_corner, rng.choice([0.0, 0.5, 1.0], size=u.shape), u).T

    def log(low, high, u):
        return np.clip(low * (high / low) ** u, low, high)

    near = log(1e-6, 0.1, u[0])
    D = np.choose(rng.integers(3, size=len(near)), [2 + near, 3 - near, 2.1 + 0.8 * u[0]])
    E = log(1e6, 1e13, u[3])
    sigma_y = E * log(1e-6, 1, u[5])
    H = sigma_y * log(1, 10, u[6])
    mu_m = np.where(u[8] < 0.05, 0, log(1e-6, 0.9, u[8]))
    mu_s = np.maximum(mu_m, 1e-6) * log(1, 1e3, u[9])
    columns = [D, log(1e-18, 1e-4, u[1]), 1 + log(1e-3, 10, u[2]), E, u[4] / 2]
    x = np.stack([*columns, sigma_y, H, log(1e-6, 1e12, u[7]), mu_s, mu_m], axis=1)
    x[0] = RUBBER
    return x


def lost(x):
    """Roundings in ln a_e, which is of the order 1/(D - 2), and in what hangs on it."""
    return EPS * (100 + 50 / (x[:, 0] - 2))


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 20), marks=pytest.mark.slow)])
def test_wide_domain(seeds):
    for seed in seeds:
        x = wide_joints(seed)
        state, forward, reverse = everything(x)
        computed = {name: value for name, value in vars(state).items() if name != "regime"}
        # In range; only a_e overflows, as D -> 2.
        for name, values in computed.items():
            assert np.isfinite(values).all() or name == "a_e", name
        for name in ("K_n", "K_t", "a_l", "A_r", "a_e", "plastic_share"):
            assert (computed[name] >= 0).all(), name
        assert (state.plastic_share <= 1).all() and computed["plastic_share"][0] < 1e-7
        plastic, slips = state.log_area_ratio <= 0, state.slip_ratio >= 1
        np.testing.assert_array_equal(state.K_n == 0, plastic)
        np.testing.assert_array_equal(state.K_t == 0, plastic | slips)
        slipping = np.asarray(state.regime == fj.Regime.gross_slip)
        np.testing.assert_array_equal(slipping, ~plastic & slips)
        # Its load is that of its area.
        P = np.asarray(loads(x, computed["A_r"])[0])
        assert_within(np.abs(P / x[:, 7] - 1), 4 * lost(x))
        # More load, more stiffness.
        slope = forward["K_n"][:, INPUTS.index("P")]
        np.testing.assert_array_equal(slope > 0, ~plastic)
        # Both modes agree. Those of a_e and of a_l/a_e cancel in a_l, each of order 1/(D - 2)^2;
        # towards D = 3, those of 1/(3 - D).
        D = x[:, 0]
        rounding = EPS * (100 + 50 / (D - 2) ** 2 + 100 / (3 - D))
        for name in ("a_l", "A_r", "K_n", "K_t", "Q_e", "plastic_share"):
            a, b = (np.where(ABSOLUTE, x, 1) * slopes[name] for slopes in (forward, reverse))
            assert np.isfinite(a).all() and np.isfinite(b).all(), name
            size = np.abs(computed[name]) + np.abs(a).max(axis=1)
            assert_within(np.abs(a - b).max(axis=1), rounding * np.where(size == 0, 1, size))


@MODES
def test_units_do_not_matter(mode):
    """Another unit of force leaves a_l and scales K; a larger copy, G by 2, has P by 4, K by 2."""
    x = np.concatenate([INPUT[:560], wide_joints(3)[:560]])
    state, *slopes = everything(x)
    by = dict(zip(("forward", "reverse"), slopes, strict=True))[mode]
    index = {name: INPUTS.index(name) for name in INPUTS}
    for name, force, copy in (("a_l", 0, 2), ("K_n", 1, 1), ("K_t", 1, 1)):
        value = getattr(state, name)
        terms = by[name] / np.where(value == 0, 1, value)[:, None]
        for inputs, weights, total in (
            (("E", "sigma_y", "H", "P"), (1, 1, 1, 1), force),
            (("G", "P"), (1, 2), copy),
        ):
            parts = terms[:, [index[i] for i in inputs]] * weights
            size = 1 + np.abs(parts).max(axis=1)
            error = np.abs(parts.sum(axis=1) - np.where(value == 0, 0, total))
            assert_within(error, 1e5 * EPS * size * (1 + lost(x) / EPS / 1e3))


@pytest.mark.parametrize("rows", [100, pytest.param(1120, marks=pytest.mark.slow)])
def test_closed_forms_in_60_digits(rows):
    """The load balance at wide joints, at the a_l and the a_e of the same row."""
    x = wide_joints(4)[:rows]
    state, *_ = everything(x)
    for i, row in enumerate(x.tolist()):
        exact = exact_joint(*row)
        allowed, t = 4 * lost(x)[i], float(exact["log_area_ratio"])
        assert abs(state.log_area_ratio[i] - t) <= allowed * max(1, abs(t) * EPS), row
        # Near fully plastic K_n is proportional to the small log_area_ratio.
        near = 2 * allowed * (1 + 1 / max(abs(t), 1e-300))
        assert state.K_n[i] == pytest.approx(float(exact["K_n"]), rel=near), row
        assert state.a_l[i] == pytest.approx(np.exp(float(exact["log_a_l"])), rel=near), row


def test_the_closed_forms_are_the_quadrature():
    for row in ROWS[::40]:
        exact = exact_joint(*(row[name] for name in INPUTS))
        for name in ("K_n", "K_t", "A_r", "Q_e"):
            assert float(exact[name]) == pytest.approx(float(row[name]), rel=1e-15)


@pytest.mark.slow
def test_wide_domain_in_single_precision():
    x, ends = wide_joints(5).astype(np.float32), np.array([2, 3], np.float32)
    x[:, 0] = np.clip(x[:, 0], *np.nextafter(ends, ends[::-1]))
    state, forward, reverse = everything(x, np.float32)
    for name in forward.keys() - {"a_e"}:
        assert np.isfinite(getattr(state, name)).all(), name
    for slopes in (forward, reverse):
        assert np.isfinite(slopes["K_n"][0]).all() and np.isfinite(slopes["K_t"][0]).all()


# --- second derivatives -----------------------------------------------------------------------


@jax.jit
def hessians(D, P, mu_s):
    """Hessians of ln K_n and ln K_t of the brake by D, ln G, ln P."""

    def logs(move):
        G = BRAKE.surface.G * jnp.exp(move[1])
        joint = substitute(BRAKE, {"D": D + move[0], "G": G, "P": P * jnp.exp(move[2])})
        return jnp.log(jnp.stack(joint.stiffness(mu_s, jnp.array(0.25))))

    return jax.jacfwd(jax.jacrev(logs))(jnp.zeros(3))


def exact_hessians(D, P):
    """The same by differences of closed forms in 60 digits."""
    h = mpf("1e-15")  # truncation and rounding are both below 1e-25

    def logs(move):
        row = dict(zip(INPUTS, INPUT[0].tolist(), strict=True)) | {"mu_s": 2.0}
        row |= {"D": D + move[0], "G": mpf(row["G"]) * mp.exp(move[1]), "P": P * mp.exp(move[2])}
        state = exact_joint(**row)
        return np.array([mpmath.log(state["K_n"]), mpmath.log(state["K_t"])])

    with mp.workdps(60):
        steps = h * np.array([[mpf(i == j) for j in range(3)] for i in range(3)])
        cells = [
            [(logs(a + b) - logs(a - b) - logs(b - a) + logs(-a - b)) / (4 * h**2) for a in steps]
            for b in steps
        ]
        return np.array(cells, dtype=float).transpose(2, 0, 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("D", "P"), [(2.4, 1907.3), (2.5, 1907.3), (2.5 + 1e-10, 1907.3), (2.7, 100.0)]
)
def test_hessians(D, P):
    """The implicit derivative of the root holds at every order."""
    truth = exact_hessians(D, P)
    # Slopes are known to rounding times their own size; those by D are the largest.
    allowed = 1e-13 * np.abs(truth).max(axis=(1, 2), keepdims=True)
    assert (np.abs(np.asarray(hessians(D, P, 2.0)) - truth) < allowed).all()


# --- the root, and what is traced -------------------------------------------------------------


def worst_residual(**options):
    """Largest |s(t) - s|, in roundings of 1 + s, over the whole domain of the root."""
    rng = np.random.default_rng(5)
    n = 100_000
    s = np.exp(rng.uniform(np.log(1e-8), np.log(150), n))
    edge = np.exp(rng.uniform(np.log(1e-6), np.log(0.5), n))
    D = np.choose(rng.integers(3, size=n), [2 + edge, 3 - edge, rng.uniform(2 + 1e-6, 3 - 1e-6, n)])
    beta = np.exp(rng.uniform(np.log(0.02), np.log(1.1), n))

    def residual(s, D, beta):
        t = load_balance.log_area_ratio(s, D, beta, **options)
        return jnp.max(jnp.abs(load_balance.log_load(t, D, beta) - s) / (1 + s))

    return float(jax.jit(residual)(s, D, beta)) / EPS


def test_halley_steps_are_the_fewest_that_work():
    assert worst_residual() < 4
    assert worst_residual(steps=2) > 1000


def test_only_what_is_needed_is_traced():
    """No loop; a given ratio traces no tangential law, a fixed stiffness nothing at all."""

    def traced(contact, transform=lambda f: f):
        f = transform(lambda x: x.stiffness(0.4, 0.25)[1])
        return primitives(jax.make_jaxpr(f)(contact).jaxpr)

    whole = traced(BRAKE)
    fixed_ratio = traced(fj.FractalContact(BRAKE.surface, MATERIAL, 1907.3, stiffness_ratio=0.5))
    assert "cbrt" in whole and "cbrt" not in fixed_ratio
    assert fixed_ratio.total() < 0.9 * whole.total()
    assert not traced(fj.FixedContact(4e8, 2e8))
    assert not {"while", "scan"} & set(whole + traced(BRAKE, jax.grad))


# --- the reference joint ----------------------------------------------------------------------


def brake_joint(D=2.4, G=1.342e-10, P=1907.3, mu_s=0.4, mu_m=0.25):
    return fj.contact_state(fj.Surface(D, G), MATERIAL, P, mu_s=mu_s, mu_m=mu_m)


def test_load_and_area_are_inverse_and_regimes_are_outcomes():
    """`contact_state` under the load of an area has this area; H A_r where all is plastic."""
    for G, A_r in ((1.342e-10, 3e-6), (1e-12, 1e-4), (1e-6, 3e-6)):
        P = fj.contact_load(fj.Surface(2.4, G), MATERIAL, A_r, mu_m=0.25)
        np.testing.assert_allclose(brake_joint(G=G, P=float(P)).A_r, A_r, rtol=1e-13)
    np.testing.assert_allclose(P, 9.94e8 * A_r, rtol=1e-15)
    # Returned with a message, never raised.
    assert brake_joint(G=1.342e-8).regime == fj.Regime.fully_plastic
    assert brake_joint(mu_s=0.05, mu_m=0.05).regime == fj.Regime.gross_slip
    assert "K_n = K_t = 0" in fj.Regime[fj.Regime.fully_plastic]
    assert "K_t = 0" in fj.Regime[fj.Regime.gross_slip]


def test_given_ratio_and_friction_correction():
    """stiffness_ratio: K_t is that times K_n, K_n as by the full law, and nothing slips."""
    joint = fj.FractalContact(fj.Surface(2.4, 1.342e-10), MATERIAL, 1907.3, stiffness_ratio=0.25)
    state = joint.state(1e-9, 0.25)
    np.testing.assert_allclose(state.K_n, brake_joint().K_n, rtol=1e-13)
    assert state.K_t == 0.25 * state.K_n
    assert state.Q_e is None and state.slip_ratio is None
    assert state.regime == fj.Regime.elastic_plastic
    np.testing.assert_allclose(joint.stiffness(0.4, 0.25), (state.K_n, state.K_t), rtol=1e-13)
    # Eq. 19 on both sides of 0.3, its step there included.
    mu_m = np.array([0.0, 0.15, 0.3, np.nextafter(0.3, 1), 0.5, 0.9])
    truth = [1, 0.9658, 0.9316, 0.932, 0.932 * np.exp(-0.316), 0.932 * np.exp(-0.948)]
    np.testing.assert_allclose(fractal.friction_correction(jnp.array(mu_m)), truth, rtol=1e-15)


# --- boundaries of the regimes ----------------------------------------------------------------

GAP = np.array([1e-3, 1e-6, 1e-9, 1e-12])


def test_continuous_at_yield():
    """K_n falls to 0 in proportion to the load's excess, and is exactly 0 below it."""
    k_mu = fractal.friction_correction(jnp.array(0.25))
    a_e = jnp.exp(fractal.log_critical_area(BRAKE.surface, MATERIAL, k_mu))
    P = float(1.4 / 0.6 * MATERIAL.H * a_e)
    state, *both_modes = everything(reference_joints(P=np.append(P * (1 + GAP), P * (1 - GAP))))
    above, below = state.K_n[:4], state.K_n[4:]
    np.testing.assert_array_equal(below, 0)
    slopes = above / GAP
    np.testing.assert_allclose(slopes[1:3], slopes[0], rtol=2e-3)
    assert 0.5 < slopes[3] / slopes[0] < 2  # 1e-12 is a few thousand roundings
    np.testing.assert_allclose(state.a_l[:4], state.a_l[4:], rtol=3e-3)
    for by_input in both_modes:
        # A kink: dK_n/dln P has the slope of the elastic side up to the boundary.
        by_P = by_input["K_n"][:, INPUTS.index("P")]
        np.testing.assert_array_equal(by_P[4:], 0)
        np.testing.assert_allclose(by_P[1:4], slopes[1], rtol=1e-5)


def test_gross_slip_of_a_joint():
    """The joint slips where mu_s P falls below Q_e: K_t vanishes, K_n does not notice."""
    before = brake_joint()
    assert before.Q_e is not None and before.slip_ratio is not None
    mu_s = float(before.Q_e) / 1907.3
    mu_s = np.append(mu_s * (1 + GAP), mu_s * (1 - GAP))
    state, *both_modes = everything(reference_joints(mu_s=mu_s))
    np.testing.assert_array_equal(state.K_t[4:], 0)
    np.testing.assert_allclose(state.K_n, before.K_n, rtol=1e-13)
    root = state.K_t[:4] / np.cbrt(1 - state.slip_ratio[:4])
    np.testing.assert_allclose(root, before.K_t / np.cbrt(1 - before.slip_ratio), rtol=1e-13)
    for by_input in both_modes:
        np.testing.assert_array_equal(by_input["K_t"][4:], 0)
        # The factor (1 - slip)^(1/3): each thousandth of the distance, a hundredfold slope.
        slope = np.abs(by_input["K_t"][:4, 1])
        np.testing.assert_allclose(slope[1:] / slope[:-1], 100, rtol=0.02)


def test_a_critical_area_beyond_doubles():
    """As D -> 2, a_e is infinite in any dtype; everything else and its derivatives are not."""
    D = np.array([2 + 1e-9, 2.0001, 2.01])
    state, *both_modes = everything(reference_joints(D=D))
    np.testing.assert_array_equal(state.a_e, np.inf)
    # All plastic: a_l = P/H (3-D)/(D-1), and A_r = P/H whatever D is.
    by_D = -1907.3 / 9.94e8 * 2 / (D - 1) ** 2
    for slopes in both_modes:
        np.testing.assert_allclose(slopes["a_l"][:, 0], by_D, rtol=1e-14)
        np.testing.assert_allclose(slopes["A_r"][:, 0], 0, atol=1e-14 * 1907.3 / 9.94e8)
        for name in ("K_n", "K_t", "Q_e", "slip_ratio", "plastic_share"):
            np.testing.assert_array_equal(slopes[name], 0)
        assert not np.isnan(slopes["a_e"]).any()


# --- refusals ---------------------------------------------------------------------------------

SURFACE, STAR = BRAKE.surface, {"D": 2.4, "A_r": 1e-3, "a_e": 1e-5}
tangential = fj.dimensionless_tangential_stiffness


def state_of(P: Any = 1907.3, mu_s: Any = 0.4, mu_m: Any = 0.25):
    return fj.contact_state(SURFACE, MATERIAL, P, mu_s=mu_s, mu_m=mu_m)


test_refusals = refusals(
    [
        (lambda: state_of(P=0), r"^P must be above 0, got 0\.0$"),
        (lambda: state_of(mu_s=-0.4), r"^mu_s must be above 0, got -0\.4$"),
        (lambda: state_of(mu_m=np.nextafter(0.9, 1)), "^mu_m must be at least 0 and at most 0.9"),
        (lambda: state_of(mu_m=0.3, mu_s=0.25), r"^mu_s must be at least mu_m = 0\.3, got 0\.25$"),
        (lambda: state_of(P=np.array([1.0, 2.0])), r"^P must be a scalar, .*jax\.vmap"),
        (lambda: state_of(mu_s=np.array([0.5, 0.6])), "^mu_s must be a single number"),
        (lambda: jax.grad(lambda P: state_of(P).K_n)(-1.0), r"^P must be above 0, got -1\.0"),
        (lambda: fj.contact_load(SURFACE, MATERIAL, 0.0, mu_m=0.2), "^A_r must be above 0"),
        (lambda: fj.contact_load(SURFACE, MATERIAL, 1e-6, mu_m=1.0), "^mu_m must be"),
        (
            lambda: fj.FractalContact(SURFACE, MATERIAL, 1, -0.5),
            "^stiffness_ratio must be at least",
        ),
        (lambda: fj.FixedContact(-1.0, 1e8), "^K_n must be at least 0, got -1.0$"),
        (lambda: fj.dimensionless_normal_stiffness(**STAR | {"D": 3.0}), "^D must be above 2"),
        (lambda: fj.dimensionless_normal_stiffness(**STAR | {"A_r": -1.0}), "^A_r must be above"),
        (lambda: fj.dimensionless_normal_stiffness(**STAR | {"a_e": 0.0}), "^a_e must be above 0"),
        (lambda: tangential(2.4, 0.6, 1e-3, 1e-5, 0.2), "^nu must be at least 0 and at most 0.5"),
        (lambda: fj.Contact(), "abstract"),  # pyright: ignore[reportAbstractUsage]
    ],
    kind=(ValueError, TypeError),
)


def test_beyond_the_domain_under_a_trace_and_at_its_closed_ends():
    """Also where a law of 0 or a limit would hide it."""
    state = jax.vmap(state_of)(jnp.array([-1.0, 1907.3, jnp.inf]))
    for value in (state.K_n, state.K_t, state.a_l, state.Q_e, state.plastic_share):
        np.testing.assert_array_equal(np.isnan(np.asarray(value)), [True, False, True])
    assert np.isnan(jax.jit(lambda mu: state_of(mu_m=mu).K_n)(0.95))
    load = jax.jit(lambda A_r: fj.contact_load(SURFACE, MATERIAL, A_r, mu_m=0.2))
    assert np.isnan(load(-1e-6)) and load(1e-6) > 0
    fixed = jax.jit(fj.FixedContact)(1e8, -1.0)
    assert fixed.K_n == 1e8 and np.isnan(fixed.K_t)
    # mu_m = 0 and mu_m = 0.9 belong to the domain, in both dtypes; so does mu_m = mu_s.
    for mu_m in (0.0, 0.9, jnp.float32(0.9)):
        assert np.isfinite(state_of(mu_m=mu_m, mu_s=0.9).K_n)
