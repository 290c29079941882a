"""The solver on known problems, starts, averages, and the exchange of conditions."""

import threading
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design import search as searches, starts as starting
from fractaljax._design.evaluator import averaged, expected_shortfall
from fractaljax._design.functions import Functions
from fractaljax._design.lockstep import run_in_lockstep
from fractaljax._design.search import Search
from fractaljax._design.solvers import slsqp
from fractaljax._design.starts import choose_starts, renew_starts, spread_designs
from minima import MINIMA
from tools import reference_scene


def functions_of(f, c, slack=0.0):
    """Values and Jacobians of functions of one point, by complex step, as a solver asks them."""

    def rows_at(u):
        at = [np.append(f(z), c(z)) for z in (u, *(u + 1e-30j * np.eye(len(u))))]
        return np.real(at[:1]), np.imag(at[1:]).T[None] / 1e-30

    k = 1 + len(c(np.zeros(2)))
    return Functions(rows_at, np.arange(k) == 0, np.arange(k) > 0, slack, 1.0, extra=False)


@pytest.mark.parametrize(("f", "c", "solution"), MINIMA)
def test_known_solutions(f, c, solution):
    """Curved, cornered, bounded and free minima, with as few evaluations as a solver asks for."""
    bounds, ends = np.tile([0.0, 1.0], (2, 1)), []
    for start in np.random.default_rng(0).uniform(size=(6, 2)):
        functions = functions_of(f, c)
        u = slsqp(functions.objective, functions.constraints, start, bounds)
        if (np.array(c(u)) <= 1e-6).all():
            ends.append((f(u), *u))
            assert len(functions.evaluated) == len(np.unique(functions.evaluated, axis=0)) < 200
    np.testing.assert_allclose(min(ends)[1:], solution, atol=1e-6)


def test_residuals_without_a_number_are_finite_and_unmet():
    functions = functions_of(lambda u: u[0], lambda u: np.array([np.nan, -np.inf, 0.5 + 0 * u[0]]))
    c, slopes = functions.constraints(np.array([0.5, 0.5]))
    assert np.isfinite(c).all() and np.isfinite(slopes).all()
    assert c[0] > 1 and c[1] < -1 and c[2] == 0.5


def test_tasks_in_lockstep_are_answered_together_and_in_this_thread():
    asked, here = [], threading.get_ident()

    def task(count):
        return lambda ask: sum(ask(count) for _ in range(count))

    def answer(questions):
        assert threading.get_ident() == here
        asked.append(dict(questions))
        # What has an even number waits for those without.
        odd = {i: n for i, n in questions.items() if n % 2} or questions
        return {i: 10 * n for i, n in odd.items()}

    assert run_in_lockstep([task(count) for count in (3, 1, 2)], answer) == [90, 10, 40]
    assert asked == [{0: 3, 1: 1, 2: 2}, {0: 3, 2: 2}, {0: 3, 2: 2}, {2: 2}, {2: 2}]

    def interrupt(questions):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_in_lockstep([task(2), task(3)], interrupt)
    with pytest.raises(ZeroDivisionError):
        run_in_lockstep([task(2), lambda ask: 1 / 0], answer)


@pytest.mark.parametrize("variables", [1, 2, 3, 5])
def test_screened_designs_fill_the_bounds(variables):
    """Every half of every variable holds half of them, every quadrant a quarter."""
    designs = spread_designs(16, variables)
    assert designs.shape == (16 if variables == 1 else 256, variables)
    upper = designs > 0.5
    np.testing.assert_allclose(upper.mean(axis=0), 0.5, atol=0.01)
    if variables > 1:
        quadrants = (upper.T @ upper.astype(float)) / len(designs)
        np.testing.assert_allclose(quadrants[~np.eye(variables, dtype=bool)], 0.25, atol=0.05)


def test_starts_are_those_given_and_one_in_every_basin():
    designs = spread_designs(24, 2)
    deep, shallow = np.array([0.2, 0.3]), np.array([0.8, 0.7])
    values = np.minimum(
        *(((designs - at) ** 2).sum(axis=1) + level for at, level in ((deep, 0), (shallow, 0.01)))
    )
    rows = np.column_stack([values, np.full(len(values), -1.0)])
    own = np.array([0.51, 0.52])
    us, scale = choose_starts(own, designs, rows, 6)
    np.testing.assert_array_equal(us[0], own)
    for basin in (deep, shallow):
        assert np.abs(us[1:3] - basin).max(axis=1).min() < 1 / 24
    assert len(us) == 6 and scale == pytest.approx(np.ptp(np.quantile(values, [0.1, 0.9])))


def test_new_starts_are_near_the_best_and_every_other_round_on_the_way_back(monkeypatch):
    """Back to the given design only where the distance from it is the objective."""
    monkeypatch.setattr(starting, "restore_joint_limits", lambda problem, us, conditions: us)
    own, best = np.full(18, 0.5), np.full(18, 0.5) + 0.1 * np.cos(np.arange(18.0))
    stated: Any = SimpleNamespace(objective=None, start=own, nominal_condition=np.zeros(0))
    distance = np.linalg.norm(best - own)
    near, back = (renew_starts(stated, best, 12, again) for again in (2, 3))
    assert (np.abs(near - best).max(axis=1) <= 8 * [0.06] + 4 * [0.15]).all()
    along = (back - own) @ (best - own) / distance**2
    np.testing.assert_allclose(along, [0.8, 0.6, 0.4] * 4, atol=0.2)
    assert (np.linalg.norm(back - own, axis=1) < distance).all()
    assert len(np.unique(np.concatenate([near, back]), axis=0)) == 24
    stated.objective = len
    assert (np.abs(renew_starts(stated, best, 12, 3) - best).max(axis=1) <= 0.15).all()


@pytest.mark.parametrize(
    ("rounds", "count", "end"),
    [
        # All that gains goes on; three rounds that do not are the last.
        ([[5], [4], [4.1], [3], [3.1], [3.2], [3.3], [1]], 7, 3),
        # Several ends as good as the best count twice.
        ([[5], [4], [4.002, 4.003], [4.1], [1]], 4, 4),
        # Too small a gain is none, but is kept.
        ([[5], [4.999], [4.998], [4.997], [1]], 4, 4.997),
        # Nothing is met: the given end stays.
        ([[np.inf], [np.inf], [np.inf], [1]], 3, 7),
    ],
)
def test_rounds_near_the_best_end_when_they_cease_to_gain(monkeypatch, rounds, count, end):
    """Ends are designs of one variable, which is the objective."""
    asked = []

    class Scripted(Search):
        def _minimise(self, paths, *_, **__):
            asked.append(paths)
            ends = rounds[len(asked) - 1]
            return [np.append(path, [[z]], axis=0) for path, z in zip(paths, ends, strict=False)]

    def evaluate(us):
        met = np.isfinite(us[:, 0])
        return SimpleNamespace(worst=np.where(met, -1.0, 1.0), values=np.where(met, us[:, 0], 9.0))

    monkeypatch.setattr(searches, "renew_starts", lambda problem, best, *_: np.tile(best, (12, 1)))
    evaluator: Any = SimpleNamespace(problem=None, evaluate=evaluate)
    found = Scripted(evaluator, None)._renew(np.array([7.0]))
    assert len(asked) == count and found[0] == [end] and len(found) <= 2
    assert asked[0][0] == [[7.0]] and len(asked[0]) == 13 and len(asked[1]) == 12
    ended = [min(ends) for ends in rounds[: count - 1]]
    assert asked[-1][0] == [[min([7.0, *ended]) if np.isfinite(ended).all() else 7.0]]
    # No more rounds than the options say.
    asked.clear()
    Scripted(evaluator, None, options=fj.DesignSearch(renewals=2))._renew(np.array([7.0]))
    assert len(asked) == 2


@pytest.mark.parametrize(("count", "alpha"), [(10, 0.9), (10, 0.85), (7, 0.0), (4, 0.99)])
def test_expected_shortfall_is_the_mean_of_the_worst(count, alpha):
    """Against the integral of the quantile function over the tail."""
    values = np.sort(np.random.default_rng(count).normal(size=count))
    levels = np.linspace(alpha, 1, 200001)[:-1] + (1 - alpha) / 400000
    tail = values[np.minimum((levels * count).astype(int), count - 1)]
    assert expected_shortfall(count, alpha) @ values == pytest.approx(tail.mean(), abs=1e-4)
    assert expected_shortfall(count, alpha).sum() == pytest.approx(1, rel=1e-14)


@pytest.mark.parametrize("risk", [0.02, expected_shortfall(10, 0.8)])
def test_averages_and_their_derivatives(risk):
    rows = np.random.default_rng(0).normal(size=(10, 3))
    found, weights = averaged(rows, risk)
    if np.ndim(risk):
        np.testing.assert_allclose(found, np.sort(rows, axis=0)[-2:].mean(axis=0))
    else:
        assert (found >= rows.max(axis=0)).all()
        assert (found <= rows.max(axis=0) + risk * np.log(10)).all()
    moved = rows + 1e-7 * (direction := np.random.default_rng(1).normal(size=rows.shape))
    change = (averaged(moved, risk)[0] - found) / 1e-7
    np.testing.assert_allclose(change, (weights * direction).sum(axis=0), atol=1e-5)
    # What has no number at one condition is not met, and the rest is as before.
    rows[4, 1], rows[0] = np.inf, -1e6
    lost, weights = averaged(rows, risk)
    assert lost[1] == np.inf and np.isfinite(lost[[0, 2]]).all() and np.isfinite(weights).all()


def outside_disc(scene):
    """Stay outside a disc that travels along a curve with the condition F in [0, 1]."""
    o = scene.oscillator
    return 0.2 - jnp.hypot(o.xi_1 - o.F, o.xi_2 - 0.5 - 0.15 * jnp.sin(jnp.pi * o.F))


def from_centre(scene):
    return (scene.oscillator.xi_1 - 0.5) ** 2 + (scene.oscillator.xi_2 - 0.55) ** 2


@pytest.mark.slow
def test_exchange_finds_the_worst_between_all_points():
    """The nearest point of the envelope's edge, which no condition of the first guess touches."""
    best = fj.design(
        reference_scene().replace(xi_1=0.3, xi_2=0.4, F=0.5),
        {"xi_1": (0.0, 1.0), "xi_2": (0.0, 1.0)},
        from_centre,
        target=1e6,
        constraints=[outside_disc],
        envelope={"F": (0.0, 1.0)},
        progress=False,
    )
    assert best.violated == () and best.active == ("outside_disc",)
    side, s = np.linspace(0, 1, 401), np.linspace(0, 1, 801)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))

    def clear(x, y):
        curve = 0.5 + 0.15 * np.sin(np.pi * s)
        return np.min([np.hypot(x - a, y - b) for a, b in zip(s, curve, strict=True)], axis=0)

    xi = best.scene.oscillator
    assert clear(float(xi.xi_1), float(xi.xi_2)) >= 0.2 - 1e-9
    nearest = ((x - 0.5) ** 2 + (y - 0.55) ** 2)[clear(x, y) >= 0.2].min()
    assert 0.97 * nearest < best.value < 1.0001 * nearest
