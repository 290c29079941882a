"""The front of two objectives against a fine grid, and its refusals."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design import constraints
from fractaljax._design.pareto import pareto
from fractaljax.plot.pareto import pareto as draw
from tools import refusals

BOUNDS = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}


def fineness(scene):
    """-ln Sq over the lengths of a profile: a rough surface is cheap."""
    return -jnp.log(constraints.root_mean_square(scene.contact.surface, 1e-3, 1e-6))


@pytest.fixture(scope="module")
def front():
    names = "growth rate [1/s]", "fineness -ln(Sq/m) [-]"
    return pareto(
        fj.brake_scene(),
        fj.growth_rate,
        fineness,
        points=9,
        bounds=BOUNDS,
        names=names,
        progress=False,
    )


@jax.jit
def on_grid(Ds, Gs):
    def one(D, G):
        moved = fj.brake_scene().replace(D=D, G=G)
        state = moved.contact.state(moved.friction.mu_s, moved.friction.mu_m)
        meets = (fj.growth_rate(moved) <= -math.pi) & (state.log_area_ratio >= math.log(2))
        meets &= (state.K_n >= fj.stiffness(fj.brake_scene())[0]) & (state.slip_ratio <= 0.9)
        return meets, fj.growth_rate(moved), fineness(moved)

    return jax.vmap(lambda D: jax.vmap(lambda G: one(D, G))(Gs))(Ds)


@pytest.mark.slow
def test_front_is_that_of_a_grid_and_drawn_whole(front):
    """No grid point that meets the requirements beats a member in both objectives."""
    Ds, Gs = jnp.linspace(*BOUNDS["D"], 300), jnp.geomspace(*BOUNDS["G"], 300)
    meets, first, second = (np.asarray(x) for x in on_grid(Ds, Gs))
    first, second = first[meets], second[meets]
    for f, s in zip(front.first, front.second, strict=True):
        assert not ((first < f - 1e-3 * abs(f)) & (second < s - 1e-3)).any()
    assert front.first.min() <= first.min() + 1e-6 and front.second.min() <= second.min() + 1e-6
    # In order, none dominated, and each worth what it says.
    assert len(front.first) == 9 and front.failed == 0  # as many points as were asked for
    assert (np.diff(front.first) > 0).all() and (np.diff(front.second) < 0).all()
    for i in range(len(front.first)):
        scene = front.scene(i)
        assert fj.growth_rate(scene) <= -math.pi
        assert scene.contact.state(0.4, 0.25).slip_ratio <= 0.9
        assert float(fj.growth_rate(scene)) == pytest.approx(front.first[i], rel=1e-9)
        assert float(fineness(scene)) == pytest.approx(front.second[i], rel=1e-9)
    # Every member, with the names of the objectives at the axes.
    ax = draw(front)
    assert (ax.get_xlabel(), ax.get_ylabel()) == front.names
    assert len(np.asarray(ax.collections[0].get_offsets())) == np.size(front.first)


test_refusals = refusals(
    [
        ({"points": 2}, "points must be a whole number of at least 3, got 2"),
        ({"envelope": {"P": (1.0, 2.0)}}, "pareto does not take envelope"),
        ({"bounds": {"D": (2.5, 2.3)}}, "bounds on D must be (lower, upper)"),
        pytest.param(
            ({"K_n_min": 1e14}, "no design meets every requirement"), marks=pytest.mark.slow
        ),
    ],
    lambda options: pareto(
        fj.brake_scene(), fj.growth_rate, fineness, progress=False, **{"bounds": BOUNDS} | options
    ),
    plain=True,
)


@pytest.mark.parametrize(
    "second", [lambda x: 2 * fj.growth_rate(x) + 5.0, lambda x: jnp.exp(fj.growth_rate(x) / 1e4)]
)
def test_objectives_without_a_trade_off_are_refused(second):
    """Both are least at one design, which the solver finds twice to its tolerance."""
    bounds = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}
    with pytest.raises(ValueError, match=r"first objective and the least second .* are one design"):
        fj.pareto(
            fj.brake_scene(), fj.growth_rate, second, bounds=bounds, target=1e5, progress=False
        )
