"""Steps in a trust region on problems whose solutions are known."""

import numpy as np
import pytest

from fractaljax._design.trust_region import Local, Stages, minimise_in_trust_region

ROUGH, SETTLED, FINE = Stages.rough, Stages.settled, Stages.fine


def by_complex_step(f):
    """A function of u (v,) with values (k,), and its Jacobian (k, v)."""

    def both(u):
        at = [np.atleast_1d(f(z)) for z in (u, *(u + 1e-30j * np.eye(len(u))))]
        return np.real(at[0]), np.imag(at[1:]).T / 1e-30

    return both


def asked(f, c, aims=None):
    """What is asked at a design, and a list of the designs it was asked at."""
    seen = []

    def at(u):
        seen.append(u)
        (value,), (slope,) = by_complex_step(f)(u)
        aimed = by_complex_step(aims)(u) if aims else (np.zeros(0), np.zeros((0, len(u))))
        return Local(value, slope, *aimed, *by_complex_step(c)(u))

    return at, seen


def free(u):
    return np.zeros(0), np.zeros((0, len(u)))


@pytest.mark.parametrize(
    ("f", "c", "solution"),
    [
        # Outside a circle, nearest to a point inside it: along the radius.
        (
            lambda u: (u[0] - 0.6) ** 2 + (u[1] - 0.5) ** 2,
            lambda u: 0.09 - (u[0] - 0.5) ** 2 - (u[1] - 0.5) ** 2,
            (0.8, 0.5),
        ),
        # Two curves meet in a corner.
        (
            lambda u: u[0] + 2 * u[1],
            lambda u: np.array([0.25 - u[0] * u[1], u[0] ** 2 - 0.36]),
            (0.6, 0.25 / 0.6),
        ),
        # The first penalty is too small.
        (lambda u: 100 * u[0] + (u[1] - 0.5) ** 2, lambda u: 0.5 - u[0], (0.5, 0.5)),
        # The bounds alone decide.
        (lambda u: u[0] - u[1], lambda u: -1 + 0 * u[0], (0.0, 1.0)),
        # Nothing decides: a smooth minimum inside.
        (
            lambda u: (u[0] - 0.3) ** 2 + 5 * (u[1] - 0.7 - u[0] ** 2 / 2) ** 2,
            lambda u: -1 + 0 * u[0],
            (0.3, 0.745),
        ),
    ],
)
@pytest.mark.parametrize("as_limits", [False, True])
def test_known_solutions(f, c, solution, as_limits):
    """Curved, cornered, bounded and free minima; what is asked as a limit, or as the rest is."""
    ends = []
    for start in np.random.default_rng(0).uniform(size=(6, 2)):
        if as_limits:
            at, seen = asked(f, lambda u: -1 + 0 * u[0])
            start = start if (c(start) < 0).all() else np.array([0.59, 0.9])
            u = minimise_in_trust_region(at, by_complex_step(c), start, 0.0, FINE, 10.0)
            assert all((c(v) <= 0).all() for v in seen)
        else:
            at, seen = asked(f, c)
            u = minimise_in_trust_region(at, free, start, 0.0, FINE, 10.0, 1e-9)
        assert len(seen) < 100
        if (c(u) <= 1e-9).all():
            ends.append((f(u), *u))
    np.testing.assert_allclose(min(ends)[1:], solution, atol=2e-4)


def test_the_largest_of_several_is_minimised_where_they_meet():
    """Parabolas about three corners: the largest is least in the middle of the triangle."""
    corners = np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.8]])
    at, _ = asked(
        lambda u: 0 * u[0],
        lambda u: -1 + 0 * u[0],
        lambda u: np.stack([((u - corner) ** 2).sum() for corner in corners]),
    )
    u = minimise_in_trust_region(at, free, np.array([0.2, 0.7]), 0.0, FINE, 10.0)
    # Of a circle through all three.
    height = (0.7**2 - 0.4**2) / (2 * 0.7)
    np.testing.assert_allclose(u, [0.5, 0.1 + height], atol=1e-4)


def test_it_comes_back_from_a_cliff_without_a_slope():
    """Behind a slope that promises nothing bad, as of a plastic joint."""

    def c(u):
        beyond = np.real(u[0]) > 0.75
        return 0.5 + 0 * u[0] if beyond else u[0] ** 4 - 0.6**4

    at, _ = asked(lambda u: -10 * u[0] + u[1] ** 2, c)
    u = minimise_in_trust_region(at, free, np.array([0.05, 0.5]), 0.0, FINE, 10.0, 1e-9)
    np.testing.assert_allclose(u, [0.6, 0.0], atol=1e-4)


def test_along_a_sharply_bent_edge():
    """Steps along its tangent leave it at once: they are corrected to second order."""

    def c(u):
        return 3e4 * ((u - 0.5) @ (u - 0.5) - 0.16)

    at, _ = asked(lambda u: u[0] + 0.05 * u[1], c)
    u = minimise_in_trust_region(at, free, np.array([0.7, 0.8]), 0.0, FINE, 10.0, 1e-9)
    down = np.array([1, 0.05]) / np.hypot(1, 0.05)
    np.testing.assert_allclose(u, 0.5 - 0.4 * down, atol=1e-4)


def test_a_rough_way_takes_fewer_steps_and_ends_near():
    """Rosenbrock's valley, scaled to the bounds."""

    def f(u):
        x, y = 2 * u[0] - 0.5, 2 * u[1] - 0.5
        return (1 - x) ** 2 + 10 * (y - x**2) ** 2

    steps = {}
    for accuracy in (ROUGH, SETTLED, FINE):
        at, seen = asked(f, lambda u: -1 + 0 * u[0])
        u = minimise_in_trust_region(at, free, np.array([0.1, 0.8]), 0.0, accuracy, 10.0)
        near = {ROUGH: 0.1, SETTLED: 0.02, FINE: 1e-3}[accuracy]
        np.testing.assert_allclose(u, [0.75, 0.75], atol=near)
        steps[accuracy] = len(seen)
    assert steps[ROUGH] < steps[SETTLED] <= steps[FINE]


@pytest.mark.parametrize("accuracy", [ROUGH, SETTLED])
def test_a_settled_way_meets_what_a_rough_one_leaves_unmet(accuracy):
    """The first penalty is too small."""
    at, _ = asked(lambda u: 100 * u[0] + (u[1] - 0.5) ** 2, lambda u: 0.5 - u[0])
    u = minimise_in_trust_region(at, free, np.array([0.6, 0.2]), 0.0, accuracy, 10.0)
    assert (abs(u[0] - 0.5) < 1e-6) == (accuracy is SETTLED)
