"""Quadrature, quantiles and draws of scatter against the normal distribution."""

import dataclasses
import math
import re
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm, truncnorm

import fractaljax as fj
from fractaljax._design.statement import DEFAULT_BOUNDS
from fractaljax._design.tolerance import Tolerance, low_discrepancy, nodes, proportion, quantile
from tools import both_modes, refusals

NORMAL = NormalDist()


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_nodes_are_standard_normal(dimensions):
    """Weights sum to one; mean, covariance and fourth moment are those of the normal."""
    z, weights = nodes(dimensions)
    assert z.shape == (55 * 2 ** max(dimensions - 2, 0), dimensions) and (weights > 0).all()
    assert weights.sum() == pytest.approx(1, rel=1e-14)
    np.testing.assert_allclose(weights @ z, 0, atol=0.02)
    accuracy = 0.03 if dimensions < 3 else 0.06
    np.testing.assert_allclose((z * weights[:, None]).T @ z, np.eye(dimensions), atol=accuracy)
    np.testing.assert_allclose(weights @ z**4, 3, rtol=0.1)


@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_quantile_of_linear_functions(level):
    """In every direction of the plane: the level that is reached is the one asked for."""
    z, weights = nodes(2)
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    values = jnp.asarray(z @ np.stack([np.cos(angles), np.sin(angles)]))
    found = np.asarray(quantile(values, jnp.asarray(weights), level))
    reached = np.array([NORMAL.cdf(x) for x in found])
    assert np.abs(reached - level).max() < (1 - level) / 2


def test_quantile_of_a_radius_and_in_one_dimension():
    """A curved function, and one deviate alone."""
    z, weights = nodes(2)
    squared = quantile(jnp.asarray((z**2).sum(axis=1)), jnp.asarray(weights), 0.95)
    assert 1 - math.exp(-float(squared) / 2) == pytest.approx(0.95, abs=0.012)
    z, weights = nodes(1)
    assert quantile(jnp.asarray(z[:, 0]), jnp.asarray(weights), 0.95) == pytest.approx(
        NORMAL.inv_cdf(0.95), abs=0.03
    )
    # Equal weights: the mean of the order statistics around the level, whatever the order.
    values = np.random.default_rng(3).permutation(np.arange(100.0))
    found = quantile(jnp.asarray(values), jnp.full(100, 0.01), 0.9)
    assert found == pytest.approx(np.arange(85, 95).mean(), rel=1e-12)


def test_quantile_is_continuous_with_the_derivative_of_its_nodes():
    """Forward and reverse mode against differences, also where two nodes change places."""
    z, weights = (jnp.asarray(x) for x in nodes(2))

    def at(x):
        return quantile(z[:, 0] * x + jnp.sin(3 * z[:, 1]) * (1 - x), weights, 0.95)

    xs = jnp.linspace(0.2, 0.9, 401)
    found = jax.jit(jax.vmap(lambda x: both_modes(lambda x: at(x[0]), x)))
    values, forward, reverse = (np.asarray(part).ravel() for part in found(xs[:, None]))
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    assert np.abs(np.diff(values)).max() < 0.01
    difference = np.asarray((jax.vmap(at)(xs + 1e-7) - jax.vmap(at)(xs - 1e-7)) / 2e-7)
    assert (np.abs(difference - forward) < 1e-5).mean() > 0.99


def test_lattice_proportion_and_what_does_not_scatter():
    i = np.arange(55)
    expected = np.stack([(i + 0.5) / 55, (34 * i % 55 + 0.5) / 55], axis=1)
    np.testing.assert_array_equal(low_discrepancy(55, 2), expected)
    assert Tolerance.of({"ln G": 0.05, "D": 0.0}).names == ("ln G",)
    # The usual one in the middle, one over n at nothing and at all.
    assert proportion(3000, 10000)[:2] == (0.3, pytest.approx(math.sqrt(0.21 / 10000), rel=1e-3))
    assert proportion(0, 10000)[:2] == (0.0, pytest.approx(1e-4, rel=1e-3))
    assert proportion(10000, 10000)[:2] == (1.0, pytest.approx(1e-4, rel=1e-3))


CORRELATED = np.array([[1.0, 0.985 * 15], [0.985 * 15, 15**2]]) * 6e-3**2


@pytest.mark.parametrize(
    "covariance",
    [np.diag([0.005**2, 0.05**2]), CORRELATED, np.outer([0.002, 0.03], [0.002, 0.03])],
    ids=["independent", "correlated", "singular"],
)
def test_draws_have_the_covariance(covariance):
    """Also where the correlation is 1, and of a mapping the standard deviations."""
    tolerance = Tolerance(("D", "ln G"), covariance)
    drawn = tolerance.shifts(np.random.default_rng(4).standard_normal((20000, 2)))
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.02 * np.abs(covariance).max())
    sigma = dict(zip(("D", "ln G"), np.sqrt(np.diagonal(covariance)), strict=True))
    assert tolerance.standard_deviations == pytest.approx(sigma)
    mapped = Tolerance.of(sigma)
    np.testing.assert_allclose(mapped.covariance, np.diag(np.diagonal(covariance)))
    values = tolerance.scattered(fj.brake_scene(), {"D": 2.4, "G": 1e-10, "P": 1.0}, drawn.T)
    assert set(values) == {"D", "G"}
    np.testing.assert_allclose(np.log(values["G"] / 1e-10), drawn[:, 1], rtol=1e-9, atol=1e-12)


class Identified:
    """As an `Identification` has it: D and ln G correlated 0.985."""

    D_standard_error, ln_G_standard_error, covariance = 0.006, 0.09, CORRELATED


@pytest.mark.slow
def test_a_correlation_counts_in_the_probability_of_squeal():
    """Of a surface on the quiet side; as independent they gave many times too much."""
    scene = fj.brake_scene().replace(D=2.43, G=1.234e-10)
    found = fj.squeal_probability(scene, Identified())
    alone = fj.squeal_probability(scene, Tolerance.of(Identified()).standard_deviations)
    random = np.random.default_rng(9).multivariate_normal([0, 0], CORRELATED, 20000)
    growth = jax.jit(jax.vmap(lambda D, G: fj.growth_rate(scene.replace(D=D, G=G))))(
        2.43 + random[:, 0], 1.234e-10 * np.exp(random[:, 1])
    )
    share = float((growth > 0).mean())
    spread = 4 * math.hypot(found.standard_error, math.sqrt(share * (1 - share) / 20000))
    assert found.value == pytest.approx(share, abs=spread)
    assert alone.value > 20 * found.value


def pulled_open():
    """A damped brake whose force nearly opens the joint."""
    brake = fj.brake_scene()
    scene = fj.Scene(brake.contact, brake.friction, brake.oscillator, preload="linear")
    return scene.replace(F=2000.0, xi_1=0.3, xi_2=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "over", [{}] + [{"envelope": {"V": (0.1, 0.2)}, "risk": r} for r in ("smooth", ("cvar", 0.5))]
)
def test_a_design_names_draws_without_an_equilibrium(over):
    """Neither quiet nor squealing: no promise, no limit of a growth rate, no warning."""
    scene, bounds, sigma = pulled_open(), {"xi_1": (0.2, 0.6)}, {"F": 600.0}
    quick: Any = {"starts": 2, "lattice": 4, "progress": False}
    best = fj.design(scene, bounds, target=-1.0, tolerance=sigma, **over, **quick)
    found = fj.squeal_probability(scene, sigma, over.get("envelope"))
    assert best.initial_undetermined == found.undetermined > 0.2
    assert best.undetermined is not None and best.undetermined > 0.2
    assert best.result == fj.DesignResult.infeasible and best.least_growth is None
    rows = {name: cells for name, *cells in (re.split("  +", x) for x in repr(best).splitlines())}
    shares = [f"{x:.3g}" for x in (best.initial_undetermined, best.undetermined)]
    assert rows["undetermined: no sliding equilibrium"] == shares
    assert rows["growth rate as required [1/s]"] == ["no closed equilibrium"] * 2
    assert repr(best).splitlines()[-1] == "undetermined: no closed equilibrium"
    closed = dataclasses.replace(best, undetermined=0.0, initial_undetermined=0.0)
    assert "no sliding equilibrium" not in repr(closed)


def test_draws_without_an_equilibrium_are_neither_quiet_nor_squeal():
    """A force that scatters opens the joint beyond a limit: they are its normal tail."""
    scene = pulled_open()
    rate = jax.jit(lambda F: fj.growth_rate(scene.replace(F=F)))
    low, high = 2000.0, 4000.0
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (low, middle) if np.isnan(rate(middle)) else (middle, high)
    found = fj.squeal_probability(scene, {"F": 600.0}, samples=20_000)
    tail = 0.5 * math.erfc((low - 2000.0) / 600.0 / math.sqrt(2))
    assert 0.2 < tail < 0.5 and found.value == 0
    assert found.undetermined == pytest.approx(tail, abs=4 * math.sqrt(tail * (1 - tail) / 20_000))
    verdict = fj.verdict(scene, tolerance={"F": 600.0}, progress=False)
    question = next(q for q in verdict.questions if q.name == "F scatter")
    assert not question.quiet and question.undetermined and not verdict.quiet
    assert "undetermined" in repr(verdict) and "has no sliding equilibrium with 0." in repr(verdict)


@pytest.mark.slow
def test_squeal_probability_under_an_envelope_and_by_seed():
    scene, sigma = fj.brake_scene().replace(D=2.436), {"ln P": 0.1, "D": 0.001}
    asked: dict[str, Any] = dict(envelope={"mu_s": (0.3, 0.5)}, samples=2000)
    first, again = (fj.squeal_probability(scene, sigma, seed=1, **asked) for _ in range(2))
    assert first == again != fj.squeal_probability(scene, sigma, seed=2, **asked)
    assert 0.05 < first.value < 0.95
    structure = fj.Structure.from_scene(scene)
    same = fj.squeal_probability(structure, sigma, seed=1, **asked)
    assert same.value == pytest.approx(first.value, abs=1e-3)


@pytest.mark.parametrize(
    ("D", "sigma"), [(2.05, 0.02), (2.05, 0.3), (2.97, 0.01), (2.5, 0.1), (2.4, 5.0), (2.01, 1.0)]
)
def test_a_wide_D_is_a_truncated_normal(D, sigma):
    """Against SciPy's, quantile by quantile, with finite derivatives; ln G follows D."""
    z = np.linspace(-5, 5, 101)
    slope, rest = -20.0, 0.03
    covariance = np.array([[1, slope], [slope, slope**2]]) * sigma**2 + np.diag([0, rest**2])
    tolerance, x = Tolerance(("ln G", "D"), covariance[::-1, ::-1]), fj.brake_scene().replace(D=D)
    tolerance.check(x, {})
    given = np.stack([slope * sigma * z + rest, sigma * z])

    def scattered(D):
        return tolerance.scattered(x, {"D": D, "G": jnp.asarray(1e-10)}, given)

    found = {name: np.asarray(value) for name, value in scattered(jnp.asarray(D)).items()}
    wanted = truncnorm((2 - D) / sigma, (3 - D) / sigma, D, sigma)
    assert found["D"].min() > 2 and found["D"].max() < 3
    # But for 1e-9 of mass beyond six deviations, and 1e-6 in D from either end.
    most = 2e-9 + max(wanted.cdf(2 + 1e-6), wanted.sf(3 - 1e-6))
    np.testing.assert_allclose(wanted.cdf(found["D"]), norm.cdf(z), rtol=0, atol=most)
    np.testing.assert_allclose(found["D"], wanted.ppf(norm.cdf(z)), rtol=0, atol=5e-5)
    by = np.clip(slope * (found["D"] - D) + rest, -354, 354)
    np.testing.assert_allclose(np.log(found["G"] / 1e-10), by, rtol=1e-6, atol=1e-9)
    derivative = jax.jacfwd(lambda D: scattered(D)["D"])(jnp.asarray(D))
    h = 1e-6
    difference = (scattered(D + h)["D"] - scattered(D - h)["D"]) / (2 * h)
    np.testing.assert_allclose(derivative, difference, rtol=1e-3, atol=1e-3)


def test_a_D_inside_six_deviations_is_not_changed():
    """To the last digit; and there is no step where it begins to be."""
    tolerance, x = Tolerance.of({"D": 0.01, "P": 10.0}), fj.brake_scene()
    shift = tolerance.shifts(np.random.default_rng(0).standard_normal((1000, 2))).T
    base = tolerance.base(x) | {"D": jnp.asarray(2.06 + 1e-12)}
    found = tolerance.scattered(x, base, shift)
    np.testing.assert_array_equal(found["D"], 2.06 + 1e-12 + shift[0])
    np.testing.assert_array_equal(found["P"], base["P"] + shift[1])
    beyond = tolerance.scattered(x, base | {"D": jnp.asarray(2.06 - 1e-9)}, shift)
    np.testing.assert_allclose(beyond["D"], found["D"], rtol=0, atol=1e-8)


@pytest.mark.parametrize("sigma", [0.02, 0.5])
def test_any_identified_surface_has_a_probability_and_a_verdict(sigma):
    """The share of squeal of a wide D by SciPy's truncated normal; ln G may be very wide too."""
    x = fj.brake_scene().replace(D=2.435)
    found = fj.squeal_probability(x, {"D": sigma}, samples=20_000)
    D = truncnorm(-0.435 / sigma, 0.565 / sigma, 2.435, sigma).ppf((np.arange(2000) + 0.5) / 2000)
    growth = jax.jit(jax.vmap(lambda D: fj.growth_rate(x.replace(D=D))))(D)
    share = float((growth > 0).mean())
    assert 0.02 < share < 0.98
    assert found.value == pytest.approx(share, abs=5 * found.standard_error)
    wide = Tolerance(("D", "ln G"), np.outer([sigma, -400.0], [sigma, -400.0]))
    assert "squeals with probability" in repr(fj.verdict(x, tolerance=wide, progress=False))


@pytest.mark.slow
def test_a_design_of_a_surface_close_to_2():
    """What it says of squeal is what draws of the truncated distribution say."""
    x, (var_D, cov, var_G) = fj.brake_scene().replace(D=2.06), (4e-4, -0.0152, 0.64)
    tolerance = Tolerance(("D", "ln G"), np.array([[var_D, cov], [cov, var_G]]))
    found = fj.design(
        x,
        bounds={"D": (2.04, 2.2), "G": (1e-12, 1e-9)},
        K_n_min=0.0,
        target=0.0,
        tolerance=tolerance,
        starts=2,
        lattice=8,
        progress=False,
    )
    surface, sigma = found.scene.contact.surface, math.sqrt(var_D)
    D_0, rng = float(surface.D), np.random.default_rng(3)
    D = truncnorm.rvs((2 - D_0) / sigma, (3 - D_0) / sigma, D_0, sigma, 4000, random_state=rng)
    ln_G = math.log(surface.G) + cov / var_D * (D - D_0)
    ln_G += math.sqrt(var_G - cov**2 / var_D) * rng.standard_normal(4000)

    def growth(D, ln_G):
        return fj.growth_rate(found.scene.replace(D=D, G=jnp.exp(ln_G)))

    share = float((np.asarray(jax.jit(jax.vmap(growth))(D, ln_G)) > 0).mean())
    error = math.sqrt(share * (1 - share) / 4000) + (found.squeal_probability_error or 0)
    assert found.squeal_probability == pytest.approx(share, abs=4 * error)
    # Not one in twenty may squeal.
    meets = found.growth_rates is not None and found.growth_rates[1] <= 0
    assert meets == (share < 0.05)


test_refusals = refusals(
    [
        ({"D": -0.1}, "tolerance of D must be at least 0, got -0.1"),
        ({"D": math.nan}, "tolerance of D must be at least 0, got nan"),
        ({"K": 0.1}, "tolerance names 'K'; there are D, G"),
        ({}, "tolerance must name a quantity, got none"),
        ({"D": 0.0}, "tolerance must be above 0 for some quantity, got 0 for all"),
        (
            {"P": 400.0},
            "tolerance of P leaves its domain within 6 deviations: P must be above 0, got",
        ),
        ({"D": 0.02, "mu_s": 0.1}, "tolerance of mu_s leaves its domain within 6 deviations: mu_s"),
        (0.1, "tolerance must be a mapping, a Tolerance or an Identification, got 0.1"),
        ({"D": "small"}, "tolerance of D must be a number, got 'small'"),
    ],
    lambda tolerance: Tolerance.of(tolerance).check(fj.brake_scene(), DEFAULT_BOUNDS),
    kind=(ValueError, TypeError),
    plain=True,
)


@pytest.mark.parametrize(
    "covariance", [[[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]], [[1.0]]]
)
def test_what_is_no_covariance(covariance):
    with pytest.raises(ValueError, match=r"^tolerance must (have a symmetric|name the rows)"):
        Tolerance(("D", "ln G"), covariance)


def test_a_plain_name_moves_all_joints_by_the_same_amount():
    """Also where they differ, and where one of them is designed by itself."""
    from structures import fractal_joints

    x = fractal_joints().replace(**{"left.D": 2.3, "right.D": 2.5})
    tolerance = Tolerance.of({"D": 0.01, "ln G": 0.1})
    shift = np.array([0.02, 0.3])
    found = tolerance.scattered(x, tolerance.base(x) | {"left.D": 2.35}, shift)
    G = float(x.joints[0].contact.surface.G)
    wanted = {
        "left.D": 2.37,
        "right.D": 2.52,
        "left.G": G * np.exp(0.3),
        "right.G": G * np.exp(0.3),
    }
    assert {name: float(value) for name, value in found.items()} == pytest.approx(wanted)
    moved = tolerance.scattered(x, tolerance.base(x) | {"D": 2.6}, shift)
    assert float(moved["left.D"]) == float(moved["right.D"]) == pytest.approx(2.62)
    with pytest.raises(ValueError, match=r"independent, got left\.D and D"):
        Tolerance.of({"left.D": 0.01, "D": 0.01}).check(x, {})


@pytest.mark.slow
def test_probability_of_squeal_of_a_structure_by_a_loop():
    """The draws of `squeal_probability`, one replace and one growth rate each."""
    from structures import fractal_joints

    x = fractal_joints().replace(**{"left.D": 2.2, "right.D": 2.4})
    tolerance = Tolerance.of({"D": 0.03})
    found = fj.squeal_probability(x, tolerance, samples=200)
    shifts = tolerance.shifts(np.random.default_rng([0, 0]).standard_normal((200, 1)))[:, 0]

    @jax.jit
    def growth(by):
        return fj.growth_rate(x.replace(**{"left.D": 2.2 + by, "right.D": 2.4 + by}))

    assert found.value == np.mean([float(growth(by)) > 0 for by in shifts])
    assert 0.1 < found.value < 0.9


@pytest.mark.parametrize(("D", "sigma"), [(2.4, 0.02), (2.1, 0.15), (2.9, 0.3)])
def test_heights_at_one_wavenumber(D, sigma):
    """D is the truncated normal of SciPy, ln m(q) normal and independent of it, at every draw."""
    q, log_error, G = 1e5, 0.2, 1e-9
    scene = fj.brake_scene().replace(D=D, G=G)
    tolerance = Tolerance(("D", "ln m(q)"), np.diag([sigma**2, log_error**2]), q)
    tolerance.check(scene, {"D": (2.001, 2.999)})
    shifts = tolerance.shifts(np.random.default_rng(5).standard_normal((20000, 2)))
    values = tolerance.scattered(scene, tolerance.base(scene), shifts.T)
    drawn, log_G = np.asarray(values["D"]), np.log(np.asarray(values["G"]))
    expected = truncnorm((2 - D) / sigma, (3 - D) / sigma, D, sigma)
    assert drawn.mean() == pytest.approx(expected.mean(), abs=0.02 * sigma)
    assert drawn.std() == pytest.approx(expected.std(), rel=0.03)
    log_f = math.log(q / (2 * math.pi))

    def log_m(D, log_G):
        return (2 * D - 4) * log_G + (2 * D - 6) * log_f - math.log(2)

    by = log_m(drawn, log_G) - log_m(D, math.log(G))
    np.testing.assert_allclose(by, shifts[:, 1], atol=1e-9)
    assert abs(np.corrcoef(drawn, by)[0, 1]) < 0.02
    q_of = fj.Surface(D, G)
    assert log_m(D, math.log(G)) == pytest.approx(float(jnp.log(q_of.m(q))), rel=1e-12)


def test_a_hurst_exponent_and_a_roll_off_stay_inside():
    """Their distributions are cut off, at any error; q belongs to ln m(q)."""
    material = fj.brake_scene().contact.material
    ground = fj.SelfAffine(1e-6, 0.9, 2e-6, 1e-6, longest=1e-3)
    scene = fj.brake_scene().replace(contact=fj.PerssonContact(ground, material, 2e3, 1e-4))
    tolerance = Tolerance.of({"ln Sq": 0.3, "hurst": 0.3, "ln rolloff": 1.0})
    tolerance.check(scene, {})
    shifts = tolerance.shifts(np.random.default_rng(6).standard_normal((20000, 3)))
    values = tolerance.scattered(scene, tolerance.base(scene), shifts.T)
    expected = truncnorm(-3, 1 / 3, 0.9, 0.3)
    H, rolloff = np.asarray(values["hurst"]), np.asarray(values["rolloff"])
    assert H.mean() == pytest.approx(expected.mean(), abs=0.01) and 0 < H.min() < H.max() < 1
    assert 1e-6 < rolloff.min() < rolloff.max() <= 1e-3
    with pytest.raises(ValueError, match=r"^tolerance takes q with .ln m\(q\)"):
        Tolerance(("D",), np.eye(1), 1e5)
    with pytest.raises(ValueError, match="q = None"):
        Tolerance(("ln m(q)",), np.eye(1))
