"""Pictures: what is on them, and that they leave no global state."""

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

import fractaljax as fj


@pytest.fixture(scope="module")
def best():
    return fj.design(fj.brake_scene(), progress=False)


def labels(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


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
    ax.figure.canvas.draw()
    whole = ax.figure.bbox
    for artist in [ax, bar, ax.get_legend()]:
        box = artist.get_tightbbox()
        assert whole.x0 <= box.x0 and box.x1 <= whole.x1
        assert whole.y0 <= box.y0 and box.y1 <= whole.y1


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
