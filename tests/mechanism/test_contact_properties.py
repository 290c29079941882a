"""What holds for every joint, over ranges far beyond any brake's; searched by hypothesis."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

import fractaljax as fj
from benchmarks.exact_joint import exact_joint
from benchmarks.extreme import programs
from benchmarks.extreme.points import JOINT_COLUMNS, joints, places as wide_places, single
from properties import QUICK, places
from tools import INPUTS, contact_rows

EPS = float(jnp.finfo(float).eps)
STATE, ALL_FORWARD, ALL_REVERSE = programs.of_rows(programs.state)
_, FORWARD, REVERSE = programs.of_rows(programs.contact_stiffness)
REGIME = jax.jit(jax.vmap(programs.regime))
BACK = jax.jit(jax.vmap(programs.load_there_and_back))


def digits_lost(x):
    """Roundings in ln a_e, which is of the order 1/(D - 2), and in what hangs on it."""
    return 100 + 50 / (x[:, 0] - 2)


def check_finite_and_in_range(u):
    x = joints(u)
    found = {name: np.asarray(value) for name, value in STATE(x).items()}
    for name, values in found.items():
        # The critical area alone overflows, as D -> 2: its logarithm does not.
        assert np.isfinite(values).all() or name == "a_e", name
    K_n, K_t, a_l, A_r = (found[name] for name in ("K_n", "K_t", "a_l", "A_r"))
    assert ((K_n >= 0) & (K_t >= 0) & (a_l > 0) & (A_r > 0)).all()
    assert ((found["plastic_share"] >= 0) & (found["plastic_share"] <= 1)).all()
    plastic, slipping = found["log_area_ratio"] <= 0, found["slip_ratio"] >= 1
    assert np.array_equal(K_n == 0, plastic)
    assert np.array_equal(K_t == 0, plastic | slipping)
    members = np.asarray(REGIME(x)._value)
    wanted = (fj.Regime.fully_plastic, fj.Regime.gross_slip, fj.Regime.elastic_plastic)
    for member, rows in zip(
        wanted, (plastic, ~plastic & slipping, ~plastic & ~slipping), strict=True
    ):
        assert (members[rows] == member._value).all()


def check_gradients(u):
    x = joints(u)
    compare_gradients(x, FORWARD(x), REVERSE(x))


def compare_gradients(x, forward, reverse):
    for name in forward.keys() - {"a_e"}:
        a, b = (np.asarray(g[name]) * x for g in (forward, reverse))
        assert np.isfinite(a).all() and np.isfinite(b).all(), name
        # Those of a_e and of a_l/a_e cancel in a_l, each being of the order 1/(D - 2)^2; towards
        # D = 3, those of 1/(3 - D).
        roundings = (100 + 50 / (x[:, 0] - 2) ** 2 + 100 / (3 - x[:, 0]))[:, None]
        size = np.abs(np.asarray(STATE(x)[name]))[:, None] + np.abs(a).max(axis=1)[:, None]
        bad = (np.abs(a - b) > EPS * roundings * size).any(axis=1)
        assert not bad.any(), (name, x[bad][0].tolist())


def check_load_balance(u):
    """Against the closed form with 60 digits, at the a_l and the a_e of the same row."""
    x = joints(u)
    found = {name: np.asarray(value) for name, value in STATE(x).items()}
    allowed = EPS * digits_lost(x) * 4
    assert allowed[x[:, 0] > 2.05].max(initial=0) < 2e-12
    for i, row in enumerate(x.tolist()):
        exact = exact_joint(*row)
        lost = float(abs(exact["log_area_ratio"] - float(found["log_area_ratio"][i])))
        assert lost <= allowed[i], row
        for name in ("K_n", "a_l"):
            truth = exact["log_a_l"] if name == "a_l" else exact[name]
            if name == "a_l":
                truth = np.exp(float(truth))
            # Near fully plastic K_n is proportional to the small log_area_ratio.
            of = allowed[i] * (1 + 1 / max(abs(float(exact["log_area_ratio"])), 1e-300))
            assert abs(float(found[name][i]) - float(truth)) <= of * float(truth) * 2, (name, row)


def check_load_of_its_area(u):
    x = joints(u)
    back = np.asarray(BACK(x)["P"])
    np.testing.assert_array_less(np.abs(back / x[:, 7] - 1), EPS * digits_lost(x) * 4)


def check_stiffness_rises_with_load(u):
    x = joints(u)
    more = x.copy()
    more[:, 7] *= 1.5
    K_n, K_more = (np.asarray(STATE(y)["K_n"]) for y in (x, more))
    assert (K_more >= K_n).all()
    assert (K_more[K_n > 0] > K_n[K_n > 0]).all()


def scaled(x, **powers):
    y = x.copy()
    for column, factor in powers.items():
        y[:, INPUTS.index(column)] *= factor
    return y


@pytest.mark.parametrize(
    ("powers", "stiffness", "area"),
    [
        ({"E": 8.0, "sigma_y": 8.0, "H": 8.0, "P": 8.0}, 8.0, 1.0),  # another unit of force
        ({"G": 4.0, "P": 16.0}, 4.0, 16.0),  # a larger copy
    ],
)
@QUICK
@given(u=places(JOINT_COLUMNS))
def test_units_do_not_matter(powers, stiffness, area, u):
    x = joints(u)
    before, after = STATE(x), STATE(scaled(x, **powers))
    t = np.abs(np.asarray(before["log_area_ratio"]))
    # Beside a_l = a_e and beside gross slip a rounding counts for more.
    near = 1 + 1 / np.maximum(t, 1e-300)
    near += 1 / np.maximum(np.abs(1 - np.asarray(before["slip_ratio"])), 1e-300)
    for name, factor in (("K_n", stiffness), ("K_t", stiffness), ("a_l", area)):
        a, b = factor * np.asarray(before[name]), np.asarray(after[name])
        room = EPS * digits_lost(x) * 8 * near
        same = np.abs(a - b) <= room * np.maximum(a, b)
        # At an edge itself one of the two may be beyond it.
        assert (same | (room > 1e-2)).all(), name


CHECKS = [
    check_finite_and_in_range,
    check_gradients,
    check_load_balance,
    check_load_of_its_area,
    check_stiffness_rises_with_load,
]


@pytest.mark.parametrize("check", CHECKS)
@QUICK
@given(u=places(JOINT_COLUMNS))
def test_every_joint(check: Callable, u):
    check(u)


@pytest.mark.slow
@pytest.mark.parametrize("check", CHECKS)
def test_a_hundred_thousand_joints(check: Callable):
    count = 4_000 if check is check_load_balance else 100_000  # mpmath takes its time
    check(wide_places(np.random.default_rng(7), count, JOINT_COLUMNS))


@pytest.mark.slow
def test_gradients_of_a_hundred_thousand_states():
    x = joints(wide_places(np.random.default_rng(9), 100_000, JOINT_COLUMNS))
    compare_gradients(x, ALL_FORWARD(x), ALL_REVERSE(x))


@pytest.mark.slow  # compiles once more
def test_single_precision_is_finite():
    x = single(joints(wide_places(np.random.default_rng(8), 4_000, JOINT_COLUMNS)))
    for name, values in STATE(x).items():
        assert np.isfinite(values).all() or name == "a_e", name


def test_exact_joint_is_that_of_quadrature():
    """The truth used here, closed forms in 60 digits, against the table, which has none."""
    for row in contact_rows()[::40]:
        exact = exact_joint(*(row[name] for name in INPUTS))
        for name in ("K_n", "K_t", "A_r", "Q_e"):
            assert float(exact[name]) == pytest.approx(float(row[name]), rel=1e-15)


# Found by the search: a joint so elastic, sigma_y/E = 1 and gamma near 1, that (a_l/a_e)^(1/2)
# itself overflowed, and every area with it.
RUBBER = [2.000455408473626, 2.709781322266324e-13, 1.001784768917085, 1.2054967571236494e11]
RUBBER += [0.04388394337974338, 1.2054967571236494e11, 9.009250811440607e11, 1e-6, 50.6, 0.255]


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_a_joint_of_almost_elastic_contacts_alone(dtype):
    x = jnp.asarray(np.repeat([RUBBER], 16, axis=0), dtype)
    exact = exact_joint(*np.asarray(x[0], float).tolist())
    found = STATE(x)
    for name in ("K_n", "K_t", "A_r", "log_area_ratio"):
        # ln a_e is -8e3 here.
        allowed = 2e4 * float(jnp.finfo(dtype).eps)
        assert float(found[name][0]) == pytest.approx(float(exact[name]), rel=allowed)
    for gradient in (FORWARD(x), REVERSE(x)):
        assert np.isfinite(gradient["K_n"]).all() and np.isfinite(gradient["K_t"]).all()
    assert 0 <= float(found["plastic_share"][0]) < 1e-7
