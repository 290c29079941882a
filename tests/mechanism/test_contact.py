"""The joint: against quadrature in 80 digits, its identities, its regimes, its refusals."""

import random

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.integrate import quad

import fractaljax as fj
from fractaljax.base.parts import substitute
from fractaljax.mechanism import contact
from reference import make_contact
from tools import INPUTS, MEMBERS, contact_columns, contact_rows, every_joint, joints, primitives

COLUMNS = contact_columns()
PLASTIC, ELASTIC, SLIPS = (COLUMNS["regime"] == name for name in MEMBERS)
REFERENCE = contact_rows()[0]
MATERIAL = fj.Material(1.154e11, 0.3, 3.55e8, 9.94e8)
ZEROS = {"K_n": PLASTIC, "K_t": ~ELASTIC, "Q_e": PLASTIC, "slip_ratio": PLASTIC}
MODES = pytest.mark.parametrize("mode", ["forward", "reverse"])


def brake_joint(D=2.4, G=1.342e-10, P=1907.3, mu_s=0.4, mu_m=0.25):
    """The state of the reference joint, with some of its numbers changed."""
    return fj.contact_state(fj.Surface(D, G), MATERIAL, P, mu_s=mu_s, mu_m=mu_m)


def log_slope(value, slope):
    """d ln(value) from d value, shape (rows, 3); 0 where the value is 0."""
    value, slope = np.asarray(value, float), np.asarray(slope, float)
    return slope / np.where(value == 0, 1, value)[:, None]


def condition(D, slopes):
    """Relative change of a quantity by a relative change of 1 of D, G, P and of itself."""
    return 1 + np.abs(D * slopes[:, 0]) + np.abs(slopes[:, 1]) + np.abs(slopes[:, 2])


def slip_condition(slip):
    """What (1 - slip)^(1/3) adds: the relative change of it by one of slip."""
    return np.where(slip == 1, 0, slip / (3 * np.abs(1 - slip)))


def assert_within(error, allowed, rows=None):
    """Show the worst row where an error exceeds what is allowed."""
    ratio = np.asarray(error) / allowed
    ratio = ratio if rows is None else np.where(rows, ratio, 0)
    worst = int(np.argmax(np.where(np.isnan(ratio), np.inf, ratio)))
    assert ratio[worst] <= 1, f"row {worst}: {ratio[worst]:.3g} times what is allowed"


# ---------------------------------------------------------------------------------------------
# The table
# ---------------------------------------------------------------------------------------------


def _rows_of_every_regime(count):
    rng = random.Random(7)
    by_regime = [[row for row in contact_rows() if row["regime"] == name] for name in MEMBERS]
    return [row for rows in by_regime for row in rng.sample(rows, count)]


def test_table_has_not_drifted():
    """Two rows of each regime, derived again by quadrature, digit for digit."""
    for row in _rows_of_every_regime(2):
        assert make_contact.joint(row) == row


@pytest.mark.slow
def test_table_has_not_drifted_in_more_rows():
    """Twelve rows of each regime, derived again by quadrature, digit for digit."""
    for row in _rows_of_every_regime(12):
        assert make_contact.joint(row) == row


# ---------------------------------------------------------------------------------------------
# The library against the table, in 64 bits
# ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found():
    """State, forward and reverse derivatives of every row."""
    state, forward, reverse = every_joint(jnp.float64)
    return {"state": state, "forward": forward, "reverse": reverse}


def test_regimes(found):
    """The regime of every row, exactly, up to 1e-6 beside the boundaries."""
    for name, member in MEMBERS.items():
        np.testing.assert_array_equal(found["state"].regime == member, COLUMNS["regime"] == name)


def test_values(found):
    """Areas, stiffnesses, load and shares to 1e-13 of their own condition."""
    state, forward, D = found["state"], found["forward"], COLUMNS["D"]
    slopes = {
        "a_l": COLUMNS["dln_a_l"],
        "K_n": COLUMNS["dln_K_n"],
        "K_t": COLUMNS["dln_K_t"],
        # Not in the table. Only their size matters here, and the values test what they rest on.
        **{x: log_slope(getattr(state, x), forward[x]) for x in ("A_r", "Q_e", "plastic_share")},
    }
    slopes["slip_ratio"] = slopes["Q_e"]
    truth = {**COLUMNS, "a_l": np.exp(COLUMNS["ln_a_l"]), "slip_ratio": COLUMNS["slip"]}
    for name, by_input in slopes.items():
        rows = ~ZEROS.get(name, np.zeros_like(PLASTIC))
        extra = slip_condition(COLUMNS["slip"]) if name == "K_t" else 0
        error = np.abs(np.asarray(getattr(state, name)) / np.where(rows, truth[name], 1) - 1)
        assert_within(error, 1e-13 * (condition(D, by_input) + extra), rows)


def test_log_areas(found):
    """ln a_l, ln a_e and their difference, up to 700 decades apart, to 1e-14 of their size."""
    state = found["state"]
    ln_a_l, ln_a_e = COLUMNS["ln_a_l"], COLUMNS["ln_a_e"]
    # ln a_e is a number of order 10, known to rounding, over 2 - D; and a sum with 2 ln G.
    size = 2 * np.abs(np.log(COLUMNS["G"])) + 20 / (COLUMNS["D"] - 2)
    assert_within(np.abs(np.log(state.a_e) - ln_a_e), 1e-15 * size)
    assert_within(np.abs(np.log(state.a_l) - ln_a_l), 1e-13 * condition(1, COLUMNS["dln_a_l"]))
    assert_within(np.abs(state.log_area_ratio - (ln_a_l - ln_a_e)), 1e-15 * size)


@MODES
def test_zeros_are_exact(found, mode):
    """K_n, K_t, Q_e and slip are 0.0 where the regime says so, and so is every derivative."""
    for name, rows in ZEROS.items():
        np.testing.assert_array_equal(getattr(found["state"], name)[rows], 0.0)
        np.testing.assert_array_equal(found[mode][name][rows], 0.0)
        assert (np.asarray(getattr(found["state"], name))[~rows] != 0).all()
    np.testing.assert_array_equal(found["state"].plastic_share[PLASTIC], 1.0)
    np.testing.assert_array_equal(found[mode]["plastic_share"][PLASTIC], 0.0)


def allowed_slope_error(D, slip, slopes, rounding):
    """For a_l and each stiffness: the error of its true `slopes` that rounding excuses."""
    # A derivative that is large because a_l is near a_e is as ill-conditioned as it is large: the
    # factor `condition`. Where that is below 1e4 these bounds are below 1e-9.
    by_a_l, by_K_n, by_K_t = (slopes[name] for name in ("a_l", "K_n", "K_t"))
    from_K_n = condition(D, by_K_n)[:, None]
    # 1 - slip magnifies the error of slip, which is that of K_n; and dln K_t is dln K_n less a
    # part by slip, either of which may be far larger than the difference.
    from_slip = (1 + 3 * slip_condition(slip))[:, None]
    parts = np.abs(by_K_n) + np.abs(by_K_t - by_K_n)
    return {
        "a_l": rounding * condition(D, by_a_l)[:, None] * (1 + np.abs(by_a_l)),
        "K_n": rounding * from_K_n * (1 + np.abs(by_K_n)),
        "K_t": rounding * from_K_n * from_slip * (1 + parts),
    }


@MODES
def test_first_derivatives(found, mode):
    """dln a_l, dln K_n, dln K_t by D, ln G, ln P, in both modes."""
    slopes = {name: COLUMNS[f"dln_{name}"] for name in ("a_l", "K_n", "K_t")}
    allowed = allowed_slope_error(COLUMNS["D"], COLUMNS["slip"], slopes, 1e-13)
    edge = np.abs(COLUMNS["ln_a_l"] - COLUMNS["ln_a_e"]) < 1e-4
    edge |= np.abs(1 - COLUMNS["slip"]) < 1e-4
    for name, truth in slopes.items():
        rows = ~ZEROS.get(name, np.zeros_like(PLASTIC))
        slope = log_slope(getattr(found["state"], name), found[mode][name])
        for i in range(3):
            error = np.abs(slope - truth)[:, i]
            assert_within(error, allowed[name][:, i], rows)
            # Away from the edges, 1e-9 whatever the condition.
            assert_within(error, 1e-9 * (1 + np.abs(truth[:, i])), rows & ~edge)


def largest_divisor(D):
    """ln of what a_e is divided by in its derivatives: dD brings (D-2)^-2, dG brings 1/G."""
    return np.minimum(2 * np.log(D - 2), np.log(COLUMNS["G"]))


def assert_finite(state, slopes, a_e_may_overflow):
    for name, slope in slopes.items():
        if name != "a_e":
            assert np.isfinite(getattr(state, name)).all(), name
            assert np.isfinite(slope).all(), name
    # Only a_e leaves the range of the dtype, and only where its true derivative does.
    a_e, slope = np.asarray(state.a_e), np.asarray(slopes["a_e"])
    assert (a_e > 0).all()
    assert np.isfinite(a_e[~a_e_may_overflow]).all()
    assert np.isfinite(slope[~a_e_may_overflow]).all()


@MODES
def test_finite(found, mode):
    """No NaN or infinity in any output or derivative, but where da_e/d(D, G) exceed a double."""
    overflow = COLUMNS["ln_a_e"] - largest_divisor(COLUMNS["D"]) > 700
    assert np.isfinite(found["state"].a_e).all()
    assert overflow.sum() < 5
    assert_finite(found["state"], found[mode], overflow)


# ---------------------------------------------------------------------------------------------
# The same in 32 bits, against 64 bits at the rounded inputs
# ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found32():
    state, forward, reverse = every_joint(jnp.float32)
    rounded = {name: COLUMNS[name].astype(np.float32).astype(float) for name in INPUTS}
    # float32(0.3) is above 0.3, where Eq. 19 has its step; 0.3 is meant in both.
    rounded["mu_m"] = np.where(COLUMNS["mu_m"] == 0.3, 0.3, rounded["mu_m"])
    truth, slopes, _ = every_joint(jnp.float64, rounded)
    return {
        "state": state,
        "forward": forward,
        "reverse": reverse,
        "truth": truth,
        "slopes": slopes,
        "D": rounded["D"],
    }


EPS32 = float(np.finfo(np.float32).eps)


def test_float32_values(found32):
    """Everything stays float32 and exact to 16 roundings of its own condition."""
    state, truth = found32["state"], found32["truth"]
    assert all(x.dtype == np.float32 for name, x in vars(state).items() if name != "regime")
    # Beside a boundary, 1e-6 away, no digit of K_n is left: its condition is 1e6 and more.
    slip = np.asarray(truth.slip_ratio)
    for name in ("a_l", "A_r", "K_n", "K_t", "Q_e", "slip_ratio", "plastic_share"):
        rows = np.asarray(getattr(truth, name)) != 0
        cond = condition(found32["D"], log_slope(getattr(truth, name), found32["slopes"][name]))
        cond = cond + (slip_condition(slip) if name == "K_t" else 0)
        error = np.asarray(getattr(state, name), float) / np.where(rows, getattr(truth, name), 1)
        assert_within(np.abs(error - 1), 16 * EPS32 * cond, rows)


def test_float32_regimes(found32):
    """The regime is the true one wherever float32 can tell: 1e-4 from a boundary and further."""
    state, truth = found32["state"], found32["truth"]
    t, slip = np.asarray(truth.log_area_ratio), np.asarray(truth.slip_ratio)
    clear = (np.abs(t) > 1e-4) & (np.abs(slip - 1) > 1e-4)
    assert clear.mean() > 0.96
    np.testing.assert_array_equal((state.regime == truth.regime)[clear], True)
    plastic = np.asarray(state.regime == fj.Regime.fully_plastic)
    stuck = np.asarray(state.regime == fj.Regime.elastic_plastic)
    for name, rows in [("K_n", plastic), ("Q_e", plastic), ("K_t", ~stuck)]:
        for values in (getattr(state, name), found32["forward"][name], found32["reverse"][name]):
            np.testing.assert_array_equal(values[rows], 0.0)


@MODES
def test_float32_derivatives(found32, mode):
    """dln a_l, dln K_n, dln K_t in both modes, to 64 roundings of their condition."""
    state, truth, slopes = found32["state"], found32["truth"], found32["slopes"]
    assert all(x.dtype == np.float32 for x in found32[mode].values())
    true = {x: log_slope(getattr(truth, x), slopes[x]) for x in ("a_l", "K_n", "K_t")}
    slip = np.asarray(truth.slip_ratio)
    allowed = allowed_slope_error(found32["D"], slip, true, 64 * EPS32)
    for name in true:
        rows = np.asarray(getattr(truth, name)) != 0
        slope = log_slope(getattr(state, name), found32[mode][name])
        for i in range(3):
            assert_within(np.abs(slope - true[name])[:, i], allowed[name][:, i], rows)


@MODES
def test_float32_is_finite(found32, mode):
    """As D -> 2, a_e exceeds a float32 (it is inf, its derivative 0 or inf); nothing else does."""
    D, a_e = found32["D"], np.asarray(found32["truth"].a_e)
    overflow = np.log(a_e) - largest_divisor(D) > 80
    assert 5 < overflow.sum() < 40
    assert_finite(found32["state"], found32[mode], overflow)


# ---------------------------------------------------------------------------------------------
# D = 2.5, and second derivatives
# ---------------------------------------------------------------------------------------------


def test_table_covers_both_sides_of_two_and_a_half():
    """The rows above hold D = 2.5 itself and both sides of it from 1e-14 to 1e-2."""
    distance = COLUMNS["D"] - 2.5
    for rows in (PLASTIC, ELASTIC, SLIPS):
        assert (distance[rows] == 0).sum() >= 2
        for sign in (1, -1):
            decades = np.floor(np.log10(np.abs(distance[rows & (sign * distance > 0)])))
            assert {-14, -12, -10, -8, -6, -4, -3} <= set(decades.astype(int))


def test_smooth_through_two_and_a_half():
    """Values and slopes at 2.5 + h continue those at 2.5 as a Taylor series, for tiny h."""
    h = np.array([0, *(sign * 10.0**k for k in (-14, -12, -10, -8, -6) for sign in (1, -1))])
    D = 2.5 + h
    h = (D - 2.5)[:, None]
    state, *both_modes = joints(D=D, mu_s=2.0)
    curvature = np.asarray(_hessians(jnp.array([2.5, *AT[1:]]), 2.0))[:, 0]
    for i, name in enumerate(("K_n", "K_t")):
        values = np.log(getattr(state, name))[:, None]
        for slopes in both_modes:
            slopes = log_slope(getattr(state, name), slopes[name])
            # The third derivatives are below 1e4.
            step = h * slopes[0, :1] + h**2 / 2 * curvature[i, :1]
            assert (np.abs(values - values[0] - step) < 2e-14 + 1e4 * np.abs(h) ** 3).all()
            error = np.abs(slopes - slopes[0] - h * curvature[i])
            assert (error < 2e-13 * np.abs(slopes[0]) + 1e4 * h**2).all()


def quadrature_hessian(row):
    """Hessians of ln K_n and ln K_t by D, ln G, ln P: differences of quadratures in 80 digits."""
    h = "1e-16"  # truncation and rounding are both below 1e-30

    def logs(*move):
        D, G, P = (mpf(h) * m for m in move)
        s = origin._replace(D=origin.D + D, ln_G=origin.ln_G + G, P=origin.P * mp.exp(P))
        state = make_contact.solve(s, start)
        return mpmath.log(state.K_n), mpmath.log(state.K_t)

    def second(i, j):
        corners = []
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            move = [0, 0, 0]
            move[i] += a
            move[j] += b
            corners.append(logs(*move))
        return [
            (both - first - last + neither) / (4 * mpf(h) ** 2)
            for both, first, last, neither in zip(*corners, strict=True)
        ]

    with mp.workdps(make_contact.DIGITS):
        origin = make_contact.inputs_of(row)
        start = make_contact.solve(origin).ln_a_l
        upper = {(i, j): second(i, j) for i in range(3) for j in range(i, 3)}
        cells = [[upper[min(i, j), max(i, j)] for j in range(3)] for i in range(3)]
        return np.array(cells, dtype=float).transpose(2, 0, 1)


AT = tuple(REFERENCE[name] for name in ("D", "G", "P"))
JOINT = fj.FractalContact(fj.Surface(2.4, 1.342e-10), MATERIAL, 1907.3)


@jax.jit
def _hessians(at, mu_s):
    """Hessians of ln K_n and ln K_t by D, ln G, ln P at D, G, P."""

    def logs(move):
        D, G, P = at * jnp.array([1.0, jnp.exp(move[1]), jnp.exp(move[2])])
        joint = substitute(JOINT, {"D": D + move[0], "G": G, "P": P})
        return jnp.log(jnp.stack(joint.stiffness(mu_s, jnp.array(0.25))))

    return jax.jacfwd(jax.jacrev(logs))(jnp.zeros(3))


@pytest.mark.parametrize("change", [{}, {"D": 2.5}, {"D": 2.5 + 1e-10}, {"D": 2.7, "P": 100.0}])
def test_hessian(change):
    """Second derivatives of ln K_n and ln K_t: the root's implicit rule holds at every order."""
    row = {**REFERENCE, "mu_s": 2.0, **change}
    truth = quadrature_hessian(row)
    hessian = np.asarray(_hessians(jnp.array([row[name] for name in ("D", "G", "P")]), 2.0))
    # Slopes are known to rounding times their own size; those by D are the largest.
    allowed = 1e-13 * np.abs(truth).max(axis=(1, 2), keepdims=True)
    assert (np.abs(hessian - truth) < allowed).all()


# ---------------------------------------------------------------------------------------------
# The root, and what is traced
# ---------------------------------------------------------------------------------------------


def _worst_residual():
    """Largest |log_load(t) - s|, in roundings of 1 + s, over the whole domain of the root."""
    rng = np.random.default_rng(5)
    n = 200_000
    s = np.exp(rng.uniform(np.log(1e-8), np.log(150), n))
    edge = np.exp(rng.uniform(np.log(1e-6), np.log(0.5), n))
    D = np.choose(rng.integers(3, size=n), [2 + edge, 3 - edge, rng.uniform(2 + 1e-6, 3 - 1e-6, n)])
    beta = np.exp(rng.uniform(np.log(0.02), np.log(1.1), n))

    def residual(s, D, beta):
        t = contact._elastic_log_area_ratio(s, D, beta)
        return jnp.max(jnp.abs(contact.log_load(t, D, beta) - s) / (1 + s))

    return float(jax.jit(residual)(s, D, beta)) / np.finfo(float).eps


def test_newton_count_is_the_least_that_works(monkeypatch):
    """The load balance holds to rounding over the whole domain; one step fewer leaves a gap."""
    assert _worst_residual() < 4
    monkeypatch.setattr(contact, "_HALLEY_STEPS", contact._HALLEY_STEPS - 1)
    assert _worst_residual() > 1000


def traced(f, *arguments):
    return list(primitives(jax.make_jaxpr(f)(*arguments).jaxpr).elements())


def test_no_loop_is_traced():
    """The root is a fixed handful of steps, in the gradient too."""
    for f in (lambda D: brake_joint(D).K_t, jax.grad(lambda D: brake_joint(D).K_t)):
        names = traced(f, 2.4)
        assert "cbrt" in names  # the walk reaches the innermost jaxpr
        assert not {"while", "scan"} & set(names)


def test_what_is_not_needed_is_not_traced():
    """A given ratio traces no tangential law, a fixed stiffness nothing at all."""

    def stiffness(contact):
        return contact.stiffness(0.4, 0.25)

    surface = fj.Surface(2.4, 1.342e-10)
    whole = traced(stiffness, fj.FractalContact(surface, MATERIAL, 1907.3))
    given = traced(stiffness, fj.FractalContact(surface, MATERIAL, 1907.3, stiffness_ratio=0.5))
    assert "cbrt" in whole
    assert "cbrt" not in given
    assert len(given) < 0.9 * len(whole)
    assert traced(stiffness, fj.FixedContact(4e8, 2e8)) == []


# ---------------------------------------------------------------------------------------------
# Identities
# ---------------------------------------------------------------------------------------------


def test_reference_scene():
    """The reference brake to the 14 and 15 digits known of it."""
    state = brake_joint()
    truth = {
        "a_l": 1.1765673964468e-6,
        "a_e": 1.7849797376094e-7,
        "A_r": 2.74532392504253e-6,
        "K_n": 402628934.268313,
        "K_t": 191682502.096783,
        "slip_ratio": 0.182002986014594,
        "plastic_share": 0.812579599496363,
    }
    for name, value in truth.items():
        np.testing.assert_allclose(getattr(state, name), value, rtol=5e-14, err_msg=name)
    assert state.regime == fj.Regime.elastic_plastic


def test_load_is_the_sum_of_its_asperities():
    """H a below a_e and 4/3 E sqrt(R) delta^(3/2) above it, integrated over n(a), carry P."""
    state = brake_joint()
    D, G, E, a_l = 2.4, 1.342e-10, 1.154e11, float(state.a_l)

    def per_log_area(load):
        # n(a) da (Eq. 25) per unit of ln a
        return lambda x: load(np.exp(x)) * (D - 1) / 2 * np.exp((D - 1) / 2 * (np.log(a_l) - x))

    def elastic(a):
        delta = 2 ** ((11 - 3 * D) / 2) * G ** (D - 2) * np.log(1.5) ** 0.5
        delta *= np.pi ** ((D - 3) / 2) * a ** ((3 - D) / 2)
        return 4 / 3 * E * np.sqrt(a / (np.pi * delta)) * delta**1.5

    low, high = np.log(float(state.a_e)), np.log(a_l)
    options = {"epsabs": 0, "epsrel": 1e-13}
    plastic = quad(per_log_area(lambda a: 9.94e8 * a), low - 150, low, limit=200, **options)[0]
    carried = quad(per_log_area(elastic), low, high, **options)[0]
    np.testing.assert_allclose(plastic + carried, 1907.3, rtol=1e-13)
    np.testing.assert_allclose(plastic / 1907.3, state.plastic_share, rtol=1e-13)
    area = quad(per_log_area(lambda a: a), low - 150, high, limit=200, **options)[0]
    np.testing.assert_allclose(area, state.A_r, rtol=1e-13)


@jax.jit
@jax.vmap
def _load_and_slopes(x, A_r):
    """P, and d ln P by [D, ln G, ln A_r], forward and reverse."""
    material = fj.Material(x["E"], x["nu"], x["sigma_y"], x["H"])

    def log_P(D, log_G, log_A_r):
        surface = fj.Surface(D, x["G"] * jnp.exp(log_G), x["gamma"])
        return jnp.log(fj.contact_load(surface, material, A_r * jnp.exp(log_A_r), mu_m=x["mu_m"]))

    at = x["D"], jnp.zeros_like(A_r), jnp.zeros_like(A_r)
    slopes = [mode(log_P, argnums=(0, 1, 2))(*at) for mode in (jax.jacfwd, jax.jacrev)]
    return jnp.exp(log_P(*at)), *(jnp.stack(slope) for slope in slopes)


def test_load_of_an_area():
    """P of the table's areas and its derivatives at constant A_r, plastic rows included."""
    D, slopes = COLUMNS["D"], COLUMNS["dln_a_l"].copy()
    A_r = (D - 1) / (3 - D) * np.exp(COLUMNS["ln_a_l"])
    slopes[:, 0] += 1 / (D - 1) + 1 / (3 - D)
    known = {name: jnp.asarray(COLUMNS[name]) for name in INPUTS}
    P, forward, reverse = _load_and_slopes(known, jnp.asarray(A_r))
    wanted = np.stack([-slopes[:, 0], -slopes[:, 1], np.ones_like(D)], axis=1) / slopes[:, 2:]
    scale = 1 + np.abs(D * wanted[:, 0]) + np.abs(wanted[:, 1]) + np.abs(wanted[:, 2])
    rounding = scale * (1 + np.abs(COLUMNS["ln_a_l"]))
    assert_within(np.abs(P / COLUMNS["P"] - 1), 1e-14 * rounding)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-11)
    assert_within(np.abs(forward - wanted).max(axis=1), 1e-11 * scale)


def test_area_of_a_load_and_back():
    """`contact_state` under the load of an area has this area; H A_r where all is plastic."""
    for G, A_r in ((1.342e-10, 3e-6), (1e-12, 1e-4), (1e-6, 3e-6)):
        P = fj.contact_load(fj.Surface(2.4, G), MATERIAL, A_r, mu_m=0.25)
        np.testing.assert_allclose(brake_joint(G=G, P=float(P)).A_r, A_r, rtol=1e-13)
    np.testing.assert_allclose(P, 9.94e8 * A_r, rtol=1e-15)


def test_ratio_of_the_stiffnesses(found):
    """K_t/K_n = 3 (3-D)/((1+nu)(2-nu)(4-D)) (1 - slip)^(1/3), in every row."""
    state, D, nu = found["state"], COLUMNS["D"], COLUMNS["nu"]
    ceiling = 3 * (3 - D) / ((1 + nu) * (2 - nu) * (4 - D))
    expected = ceiling * np.cbrt(np.maximum(1 - np.asarray(state.slip_ratio), 0)) * state.K_n
    np.testing.assert_allclose(state.K_t, expected, rtol=4e-15)


def test_given_ratio():
    """stiffness_ratio: K_t is that times K_n, K_n as by the full law, and nothing slips."""
    joint = fj.FractalContact(fj.Surface(2.4, 1.342e-10), MATERIAL, 1907.3, stiffness_ratio=0.25)
    state = joint.state(0.4, 0.25)
    np.testing.assert_allclose(state.K_n, brake_joint().K_n, rtol=1e-13)
    assert state.K_t == 0.25 * state.K_n
    assert state.Q_e is None
    assert state.slip_ratio is None
    assert state.regime == fj.Regime.elastic_plastic
    assert joint.state(1e-9, 0.25).regime == fj.Regime.elastic_plastic
    np.testing.assert_allclose(joint.stiffness(0.4, 0.25), (state.K_n, state.K_t), rtol=1e-13)


@pytest.mark.parametrize("apparent", [1.0, 1e-4, 0.037])
def test_dimensionless_stiffness_is_scaled_stiffness(found, apparent):
    """Eqs. 31 and 37: K_n/(E sqrt(A_a)) and K_t/(E sqrt(A_a)) of every row, for any A_a."""
    state, D, nu = found["state"], COLUMNS["D"], COLUMNS["nu"]
    areas = state.A_r / apparent, state.a_e / apparent
    scale = COLUMNS["E"] * np.sqrt(apparent)
    slips = np.asarray(state.slip_ratio)
    cond = 1 / np.maximum(np.abs(state.log_area_ratio), 1e-300)
    for star, K in [
        (fj.dimensionless_normal_stiffness(D, *areas), state.K_n),
        (fj.dimensionless_tangential_stiffness(D, nu, *areas, slips), state.K_t),
    ]:
        # Near a_l = a_e the ratio of the areas is all that is left of their logarithms.
        error = np.abs(np.asarray(star) * scale - K)
        assert_within(error, 1e-13 * (1 + cond) * np.where(K == 0, 1, K))
        np.testing.assert_array_equal((np.asarray(star) == 0)[np.asarray(K) == 0], True)


@pytest.mark.parametrize("D", [2.001, 2.4, 2.5, 2.97])
def test_dimensionless_stiffness_as_printed(D):
    """Eqs. 31 and 37 as the source prints them, in 40 digits."""
    A_r, a_e, nu, slip = 2.7e-3, 1.8e-6, 0.3, 0.4
    with mp.workdps(40):
        d, A, a, n, q = (mpf(x) for x in (D, A_r, a_e, nu, slip))
        bracket = ((3 - d) / (d - 1) * A) ** ((2 - d) / 2) - a ** ((2 - d) / 2)
        bracket *= A ** ((d - 1) / 2)
        normal = mpf(4) / 3 * (4 - d) / (2 - d) * ((d - 1) / (3 - d)) ** ((3 - d) / 2)
        normal *= bracket / mp.sqrt(mp.pi)
        powers = (d - 1) ** ((3 - d) / 2) * (3 - d) ** ((d - 1) / 2)
        tangential = 8 / (mp.sqrt(mp.pi) * (2 - n) * (2 + 2 * n)) * powers / (2 - d)
        tangential *= mp.cbrt(1 - q) * bracket
    found_normal = fj.dimensionless_normal_stiffness(D, A_r, a_e)
    found_tangential = fj.dimensionless_tangential_stiffness(D, nu, A_r, a_e, slip)
    np.testing.assert_allclose(found_normal, float(normal), rtol=2e-15)
    np.testing.assert_allclose(found_tangential, float(tangential), rtol=2e-15)


def test_equation_34():
    """Q_e at D = 2.5 as printed, with the plus sign that the print lost."""
    state = brake_joint(D=2.5, mu_s=0.9)
    sigma_y, nu, E, G = 3.55e8, 0.3, 1.154e11, 1.342e-10
    a_l, a_e = float(state.a_l), float(state.a_e)
    plastic = 24 * sigma_y / (np.pi * (6 - 3 * nu)) * a_l**0.75 * (a_l**0.25 - a_e**0.25)
    elastic = (2 * nu - 1) * E / (6 - 3 * nu) * 2 ** (19 / 4) * np.pi ** (-7 / 4)
    elastic *= (np.log(1.5) * G) ** 0.5 * a_l**0.75 * (np.log(a_l) - np.log(a_e))
    assert state.regime == fj.Regime.elastic_plastic
    np.testing.assert_allclose(np.asarray(state.Q_e), plastic + elastic, rtol=1e-13)


def test_friction_correction():
    """Eq. 19 on both sides of 0.3, its step there included."""
    mu_m = np.array([0.0, 0.15, 0.3, np.nextafter(0.3, 1), 0.5, 0.9])
    truth = [1, 0.9658, 0.9316, 0.932, 0.932 * np.exp(-0.316), 0.932 * np.exp(-0.948)]
    np.testing.assert_allclose(contact.friction_correction(jnp.array(mu_m)), truth, rtol=1e-15)


# ---------------------------------------------------------------------------------------------
# Boundaries of the regimes
# ---------------------------------------------------------------------------------------------


def _yield_load():
    """The load at which a_l = a_e in the reference joint."""
    surface, k_mu = fj.Surface(2.4, 1.342e-10), contact.friction_correction(jnp.array(0.25))
    a_e = jnp.exp(contact.log_critical_area(surface, MATERIAL, k_mu))
    return float(1.4 / 0.6 * MATERIAL.H * a_e)


def test_continuous_at_yield():
    """K_n falls to 0 in proportion to the load's excess, and is exactly 0 below it."""
    P = _yield_load()
    excess = np.array([1e-3, 1e-6, 1e-9, 1e-12])
    state, *both_modes = joints(P=np.append(P * (1 + excess), P * (1 - excess)))
    above, below = jax.tree.map(lambda x: x[:4], state), jax.tree.map(lambda x: x[4:], state)
    np.testing.assert_array_equal(below.K_n, 0)
    np.testing.assert_array_equal(below.regime == fj.Regime.fully_plastic, True)
    np.testing.assert_array_equal(above.regime == fj.Regime.elastic_plastic, True)
    slopes = np.asarray(above.K_n) / excess
    np.testing.assert_allclose(slopes[1:3], slopes[0], rtol=2e-3)
    assert 0.5 < slopes[3] / slopes[0] < 2  # 1e-12 is a few thousand roundings
    np.testing.assert_allclose(above.a_l, below.a_l, rtol=3e-3)
    for by_input in both_modes:
        np.testing.assert_array_equal(by_input["K_n"][4:], 0)
        # dK_n/dln P does not vanish at the boundary: a kink, with the slope of the elastic side.
        np.testing.assert_allclose(by_input["K_n"][1:4, 2], slopes[1], rtol=1e-5)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_edge_of_gross_slip(mode):
    """K_t is 0 with slope 0 exactly at slip 1 and past it; before, huge slopes but finite ones."""

    def K_t(slip):
        return contact.tangential_stiffness(1.154e11, 0.3, slip, jnp.array(1e-3))

    stuck = float(K_t(0.0))
    for slip in (1.0, np.nextafter(1, 2), 1.1, 1e6):
        assert K_t(slip) == 0.0
        assert mode(K_t)(slip) == 0.0
    for gap in (2.0**-53, 2.0**-40, 2.0**-20):
        np.testing.assert_allclose(K_t(1 - gap), stuck * np.cbrt(gap), rtol=1e-14)
        np.testing.assert_allclose(mode(K_t)(1 - gap), -stuck / 3 * gap ** (-2 / 3), rtol=1e-14)


def test_gross_slip_of_a_joint():
    """The joint slips where mu_s P falls below Q_e: K_t vanishes, K_n does not notice."""
    before = brake_joint()
    assert before.Q_e is not None and before.slip_ratio is not None
    mu_s = float(before.Q_e) / 1907.3
    gap = np.array([1e-3, 1e-6, 1e-9, 1e-12])
    state, *both_modes = joints(mu_s=np.append(mu_s * (1 + gap), mu_s * (1 - gap)))
    sticks, slips = jax.tree.map(lambda x: x[:4], state), jax.tree.map(lambda x: x[4:], state)
    np.testing.assert_array_equal(sticks.regime == fj.Regime.elastic_plastic, True)
    np.testing.assert_array_equal(slips.regime == fj.Regime.gross_slip, True)
    np.testing.assert_array_equal(slips.K_t, 0)
    np.testing.assert_allclose(state.K_n, before.K_n, rtol=1e-13)
    root = sticks.K_t / np.cbrt(1 - np.asarray(sticks.slip_ratio))
    np.testing.assert_allclose(root, before.K_t / np.cbrt(1 - before.slip_ratio), rtol=1e-13)
    for by_input in both_modes:
        np.testing.assert_array_equal(by_input["K_t"][4:], 0)
        # Of (1 - slip)^(1/3): each thousandth of the distance, a hundredfold slope.
        slope = np.abs(by_input["K_t"][:4, 1])
        np.testing.assert_allclose(slope[1:] / slope[:-1], 100, rtol=0.02)


@pytest.mark.parametrize("mode", [0, 1], ids=["forward", "reverse"])
def test_a_critical_area_beyond_doubles(mode):
    """As D -> 2, a_e is infinite in any dtype; everything else and its derivatives are not."""
    D = np.array([2 + 1e-9, 2.0001, 2.01])
    state, *both_modes = joints(D=D)
    np.testing.assert_array_equal(state.a_e, np.inf)
    slopes = both_modes[mode]
    # All plastic: a_l = P/H (3-D)/(D-1), and A_r = P/H whatever D is.
    by_D = -1907.3 / 9.94e8 * 2 / (D - 1) ** 2
    np.testing.assert_allclose(slopes["a_l"][:, 0], by_D, rtol=1e-14)
    np.testing.assert_allclose(slopes["A_r"][:, 0], 0, atol=1e-14 * 1907.3 / 9.94e8)
    for name in ("K_n", "K_t", "Q_e", "slip_ratio", "plastic_share"):
        np.testing.assert_array_equal(slopes[name], 0)
    np.testing.assert_array_equal(np.isnan(slopes["a_e"]), False)


# ---------------------------------------------------------------------------------------------
# Refusals
# ---------------------------------------------------------------------------------------------

SURFACE = fj.Surface(2.4, 1.342e-10)
LOADED = {"P": 1907.3, "mu_s": 0.4, "mu_m": 0.25}


def _state(P, mu_s, mu_m):
    return fj.contact_state(SURFACE, MATERIAL, P, mu_s=mu_s, mu_m=mu_m)


@pytest.mark.parametrize(
    ("name", "bad", "bound"),
    [
        *(("P", x, "above 0") for x in (0, -1, np.nan, np.inf)),
        *(("mu_s", x, "above 0") for x in (0, -0.4, np.nan, np.inf)),
        *(("mu_m", x, "at least 0 and at most 0.9") for x in (-0.1, 0.91, np.nan, np.inf)),
        ("mu_m", np.nextafter(0.9, 1), "at least 0 and at most 0.9"),
    ],
)
def test_state_refusals(name, bad, bound):
    """The message holds the argument, the bound and the value."""
    with pytest.raises(ValueError, match=f"^{name} must be {bound}, got {float(bad)!r}$"):
        _state(**LOADED | {name: bad})
    if name == "P":
        with pytest.raises(ValueError, match=f"^P must be {bound}, got {float(bad)!r}$"):
            fj.FractalContact(SURFACE, MATERIAL, bad)


def test_load_refusals():
    for A_r, mu_m, message in (
        (0.0, 0.2, "A_r must be above 0, got 0.0"),
        (1e-6, 1.0, "mu_m must"),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            fj.contact_load(SURFACE, MATERIAL, A_r, mu_m=mu_m)


def test_the_closed_ends():
    """mu_m = 0 and mu_m = 0.9 belong to the domain, in both dtypes."""
    for mu_m in (0.0, 0.9, jnp.float32(0.9)):
        assert np.isfinite(_state(**LOADED | {"mu_m": mu_m, "mu_s": 0.9}).K_n)


def test_static_friction_is_the_largest():
    """As in a friction law: mu_m beyond mu_s is refused, and the two may be equal."""
    assert _state(1907.3, 0.25, 0.25).K_n == _state(1907.3, 0.4, 0.25).K_n
    with pytest.raises(ValueError, match=r"^mu_s must be at least mu_m = 0.3, got 0.25$"):
        _state(1907.3, 0.25, 0.3)


def test_one_joint_at_a_time():
    """Arrays are refused by name, where JAX would speak of a predicate."""
    for name in LOADED:
        with pytest.raises(ValueError, match=f"^{name} must be a s"):
            _state(**LOADED | {name: np.array([0.5, 0.6])})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"D": 2.0}, "D must be above 2 and below 3"),
        ({"D": 3.0}, "D must be above 2 and below 3"),
        ({"A_r": -1e-3}, "A_r must be above 0"),
        ({"a_e": 0.0}, "a_e must be above 0"),
        ({"nu": 0.6}, "nu must be at least 0 and at most 0.5"),
        ({"slip_ratio": np.nan}, "slip_ratio must be finite"),
    ],
)
def test_dimensionless_stiffness_refusals(changed, message):
    given = {"D": 2.4, "nu": 0.3, "A_r": 1e-3, "a_e": 1e-5, "slip_ratio": 0.2} | changed
    with pytest.raises(ValueError, match=f"^{message}, got"):
        fj.dimensionless_tangential_stiffness(**given)
    normal = {name: given[name] for name in ("D", "A_r", "a_e")}
    if normal.keys() & changed.keys():
        with pytest.raises(ValueError, match=f"^{message}, got"):
            fj.dimensionless_normal_stiffness(**normal)


@pytest.mark.parametrize(
    ("build", "bad", "message"),
    [
        (lambda x: fj.FractalContact(SURFACE, MATERIAL, 1, x), -0.5, "stiffness_ratio .* least 0"),
        (lambda x: fj.FixedContact(x, 1e8), -1.0, "K_n must be at least 0"),
        (lambda x: fj.FixedContact(1e8, x), -1.0, "K_t must be at least 0"),
        (lambda x: fj.FixedContact(x, 1e8), np.nan, "K_n must be at least 0"),
        (lambda x: fj.FixedContact(1e8, x), np.inf, "K_t must be at least 0"),
    ],
)
def test_contact_refusals(build, bad, message):
    """What a contact refuses, concrete with the value and traced without."""
    with pytest.raises(ValueError, match=f"^{message}, got {bad!r}$"):
        build(bad)
    with pytest.raises((RuntimeError, ValueError), match=message):
        jax.block_until_ready(eqx.filter_jit(build)(jnp.array(bad)))


@pytest.mark.parametrize("bad", ["1", None, True, 1j])
def test_not_a_number(bad):
    """Anything but a real number is a TypeError that names the argument."""
    for name in LOADED:
        with pytest.raises(TypeError, match=f"^{name} must be a"):
            _state(**LOADED | {name: bad})
    for K in ({"K_n": bad, "K_t": 1.0}, {"K_n": 1.0, "K_t": bad}):
        with pytest.raises(TypeError, match=r"^K_[nt] must be a"):
            fj.FixedContact(**K)


def test_wrong_parts():
    """A part of another kind is a TypeError that shows it."""
    with pytest.raises(TypeError, match=r"^surface must be a Surface, got Material\(E="):
        fj.contact_state(MATERIAL, MATERIAL, 1.0, mu_s=0.4, mu_m=0.25)  # pyright: ignore
    with pytest.raises(TypeError, match=r"^material must be a Material, got 3"):
        fj.FractalContact(SURFACE, 3, 1.0)


@pytest.mark.parametrize(
    ("name", "bad", "message"),
    [
        ("P", -1.0, "P must be above 0"),
        ("mu_s", 0.0, "mu_s must be above 0"),
        ("mu_m", 0.95, "mu_m must be at least 0 and at most 0.9"),
    ],
)
def test_traced_refusal(name, bad, message):
    """Under jit the compiled program raises; inside an eager jax.grad the value is shown."""
    arguments = {key: jnp.array(value) for key, value in LOADED.items()}
    compiled = eqx.filter_jit(_state)
    assert compiled(**arguments).K_n > 0
    with pytest.raises((RuntimeError, ValueError), match=message):
        jax.block_until_ready(compiled(**arguments | {name: jnp.array(bad)}))
    with pytest.raises(ValueError, match=f"^{message}, got {bad!r}"):
        jax.grad(lambda x: _state(**LOADED | {name: x}).K_n)(bad)


def test_outcomes_are_not_errors():
    """Every regime of `Regime` is returned with a message that says what it means."""
    assert brake_joint(G=1.342e-8).regime == fj.Regime.fully_plastic
    assert brake_joint(mu_s=0.05, mu_m=0.05).regime == fj.Regime.gross_slip
    assert "K_n = K_t = 0" in fj.Regime[fj.Regime.fully_plastic]
    assert "K_t = 0" in fj.Regime[fj.Regime.gross_slip]
