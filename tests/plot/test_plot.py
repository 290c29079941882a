"""Pictures: what is on them, and that they leave no global state."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot
import numpy as np
import pytest
from matplotlib.figure import Figure

import fractaljax as fj
from tools import assert_whole, labels, motionless_scene, reference_cycle, reference_scene


@pytest.fixture(scope="module")
def best():
    return fj.design(fj.brake_scene(), progress=False)


def test_design_picture(best):
    """Units on the axes, boundary, three regimes, path and both surfaces, nothing cut off."""
    ax = fj.plot.design(best)
    assert ax.get_xlabel() == "fractal dimension D [-]"
    assert ax.get_ylabel() == "fractal roughness G [m]" and ax.get_yscale() == "log"
    assert labels(ax) == [
        "fully plastic",
        "gross slip",
        "elastic-plastic, stable",
        "stability boundary",
        "growth rate -3.14 1/s",
        "K_n = 4.03e+08 N/m",
        "path of the best start",
        "given surface",
        "designed surface",
    ]
    walk = next(line for line in ax.lines if line.get_label() == "path of the best start")
    np.testing.assert_array_equal(walk.get_xdata(), best.history["D"])
    bar = ax.figure.axes[1]
    assert bar.get_ylabel() == "growth rate where it squeals [1/s]"
    assert_whole(ax.figure, [ax, bar, ax.get_legend()])


def test_boundary_is_where_growth_changes_sign(best):
    """The contour drawn as the boundary is the zero of the growth rate."""
    scene = best.initial
    ax = fj.plot.stability_map(scene)
    contour = next(
        c for c in ax.collections if getattr(c, "levels", None) is not None and 0.0 in c.levels
    )
    points = np.concatenate([path.vertices for path in contour.get_paths()])[::10]
    growth = jax.vmap(lambda p: fj.growth_rate(scene.replace(D=p[0], G=p[1])))
    aside = np.array([[0.004, 0.0]])
    # The first crosses towards high D; near the plastic joint there is a second one.
    signs = np.sign(growth(points + aside)) * np.sign(growth(points - aside))
    assert (signs < 0).mean() > 0.95


def test_given_axes_and_bounds(best):
    """It draws where it is told, over the bounds it is told."""
    ax = Figure().add_subplot()
    assert fj.plot.stability_map(best.initial, {"D": (2.3, 2.5)}, ax) is ax
    assert ax.get_xlim() == (2.3, 2.5) and ax.get_ylim() == pytest.approx((1e-12, 1e-8))


def test_infeasible_design_says_so():
    """The end of the path is not called designed if it is no solution."""
    best = fj.design(fj.brake_scene(), K_n_min=1e14, progress=False)
    assert labels(fj.plot.design(best))[-1] == "best found, not a solution"


def test_scene_that_never_squeals(best):
    """No unstable region: no colour bar, no boundary, and no warning."""
    ax = fj.plot.stability_map(best.initial.replace(mu_s=0.01, mu_m=0.01))
    assert len(ax.figure.axes) == 1 and "stability boundary" not in labels(ax)


def test_given_stiffness_ratio_has_no_gross_slip(best):
    """Without a tangential law there are two regimes."""
    ax = fj.plot.stability_map(best.initial.replace(stiffness_ratio=0.5))
    assert "gross slip" not in labels(ax) and "fully plastic" in labels(ax)


def test_fixed_contact_is_refused():
    """A joint without a surface has no map over D and G."""
    scene = fj.brake_scene().replace(contact=fj.FixedContact(4e8, 2e8))
    with pytest.raises(ValueError, match="needs a FractalContact"):
        fj.plot.stability_map(scene)


@pytest.fixture(scope="module")
def both_stick():
    """A limit cycle in which both directions stick."""
    return fj.limit_cycle(reference_scene().replace(mu_s=0.9))


def drawn(ax, label):
    """The lines of a label, as arrays (2, points)."""
    return [np.array(line.get_data()) for line in ax.lines if line.get_label().startswith(label)]


@pytest.mark.parametrize("direction", [1, 2])
def test_phase_portrait_has_the_extent_of_the_cycle(direction):
    """A closed curve, as wide as the amplitude and as high as the velocity range; V dashed."""
    cycle, i = reference_cycle(), direction - 1
    ax = fj.plot.phase_portrait(cycle, direction=direction)
    ((x, v),) = drawn(ax, "limit cycle")
    assert np.ptp(x) == pytest.approx(1e6 * float(cycle.amplitude[i]), rel=1e-4)
    ends = [cycle.velocity_min[i], cycle.velocity_max[i]]
    np.testing.assert_allclose([v.min(), v.max()], ends, rtol=1e-4)
    assert (x[0], v[0]) == (x[-1], v[-1])
    (belt,) = (line for line in ax.lines if line.get_linestyle() == "--")
    assert list(belt.get_ydata()) == [0.15, 0.15]
    where = ["along the belt", "normal to the belt"][i]
    assert ax.get_xlabel() == f"x{direction}, {where} [µm]"
    assert ax.get_ylabel() == f"dx{direction}/dt [m/s]"
    stuck = ["sticks, 9.7% of the period"] if direction == 1 else []
    assert labels(ax) == ["limit cycle", "belt velocity 0.15 m/s", *stuck]


@pytest.mark.parametrize("direction", [1, 2])
def test_sticking_is_drawn_where_it_is(both_stick, direction):
    """At the belt's velocity, over the way that the belt goes meanwhile, along the orbit."""
    ax = fj.plot.phase_portrait(both_stick, direction=direction)
    ((x, v),) = drawn(ax, "sticks")
    np.testing.assert_array_equal(v, 0.15)
    time = both_stick.stick_fraction[direction - 1] * both_stick.period
    assert x[1] - x[0] == pytest.approx(1e6 * 0.15 * float(time), rel=1e-3)
    ((orbit_x, orbit_v),) = drawn(ax, "limit cycle")
    inside = (orbit_x > x[0]) & (orbit_x < x[1]) & (orbit_v > 0)
    assert inside.sum() > 5
    np.testing.assert_allclose(orbit_v[inside], 0.15, rtol=1e-9)


def test_regularised_cycle_has_no_sticking_part():
    """The regularised law creeps where the exact one sticks; its orbit is drawn all the same."""
    creeps = eqx.tree_at(lambda cycle: cycle.regularisation_error, reference_cycle(), 0.0123)
    ax = fj.plot.phase_portrait(creeps)
    assert labels(ax) == ["limit cycle", "belt velocity 0.15 m/s"]


@pytest.mark.parametrize("direction", [1, 2])
def test_spectrum_shows_the_harmonics(direction):
    """Stems at the multiples of 1/period, as high as `LimitCycle.spectrum` says."""
    cycle = reference_cycle()
    ax = fj.plot.spectrum(cycle, direction=direction)
    (first,), (rest,) = drawn(ax, "fundamental 3.092 kHz"), drawn(ax, "harmonics")
    f, a = np.hstack([first, rest])
    np.testing.assert_allclose(f, np.arange(1, 21) / float(cycle.period) / 1e3, rtol=1e-12)
    np.testing.assert_allclose(a, 1e6 * cycle.spectrum()[1][:20, direction - 1], rtol=1e-12)
    stems = np.array(ax.collections[0].get_segments())
    np.testing.assert_array_equal(stems[:, :, 0], np.stack([f, f], axis=1))
    np.testing.assert_array_equal(stems[:, 1, 1], a)
    assert ax.get_yscale() == "log" and ax.get_ylim()[0] == stems[0, 0, 1] < a.min()
    assert ax.get_xlim()[1] > f[-1] and ax.get_ylim()[1] > a.max()
    assert ax.get_xlabel() == "frequency [kHz]"
    assert ax.get_ylabel() == f"peak amplitude of x{direction} [µm]"


def test_spectrum_reaches_as_far_for_a_longer_period():
    """A period of two turns has two lines for each one of a period of one turn."""
    twice = eqx.tree_at(lambda cycle: cycle.turns, reference_cycle(), jnp.array(2))
    (rest,) = drawn(fj.plot.spectrum(twice), "harmonics")
    assert rest.shape == (2, 39)


def test_cycle_picture():
    """A row for each direction, nothing cut off or overlapping, nothing left in pyplot."""
    figure = fj.plot.cycle(reference_cycle())
    words = ["x1, along", "frequency", "x2, normal", "frequency"]
    assert len(figure.axes) == 4
    for ax, word in zip(figure.axes, words, strict=True):
        assert ax.get_xlabel().startswith(word)
    assert_whole(figure, figure.axes)
    boxes = [ax.get_tightbbox() for ax in figure.axes]  # with labels and legend
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    assert matplotlib.pyplot.get_fignums() == []


@pytest.mark.parametrize("draw", [fj.plot.phase_portrait, fj.plot.spectrum])
def test_cycle_pictures_take_axes_and_refuse_the_rest(draw):
    """They draw where they are told; no direction 3, no picture of a batch or of no cycle."""
    ax = Figure().add_subplot()
    assert draw(reference_cycle(), ax) is ax
    with pytest.raises(ValueError, match="direction must be 1 or 2, got 3"):
        draw(reference_cycle(), direction=3)
    batch = jax.tree.map(lambda leaf: leaf[None], reference_cycle())
    with pytest.raises(ValueError, match="index the batch first"):
        draw(batch)
    nothing = fj.limit_cycle(motionless_scene(), throw=False)
    with pytest.raises(ValueError, match="no limit cycle to draw: the motion dies out"):
        draw(nothing)
