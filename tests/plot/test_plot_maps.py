"""Pictures of modes: what is on them, that the boundary is one, and what they refuse."""

import jax.numpy as jnp
import matplotlib.pyplot
import numpy as np
import pytest
from matplotlib.figure import Figure

import fractaljax as fj
from fractaljax.modes.maps import source_modes
from tools import assert_whole, labels


@pytest.fixture(scope="module")
def modes():
    return source_modes("7", 60)


def boundary_of(ax):
    """Vertices of the contour at 0."""
    (zero,) = (c for c in ax.collections if list(getattr(c, "levels", ())) == [0.0])
    return np.concatenate([path.vertices for path in zero.get_paths()])


def test_growth_map(modes):
    """Names and units on the axes, the boundary where the growth rate is 0."""
    ax = fj.plot.growth_map(modes)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("mu [-]", "K_t/K_n [-]")
    assert ax.get_title(loc="left") == "growth rate [1/s]"
    assert labels(ax) == ["stability boundary"]
    assert_whole(ax.figure)
    scene = fj.Scene(fj.FixedContact(4e8, 2e8), fj.Coulomb(0.4), fj.brake_scene().oscillator)
    for mu, kappa in boundary_of(ax)[20:-5:15]:
        sides = [
            fj.growth_rate(scene.replace(mu=mu + off, K_t=kappa * 4e8)) for off in (-0.02, 0.02)
        ]
        assert sides[0] < 0 < sides[1]


@pytest.mark.parametrize("mode", [1, 2])
def test_frequency_map(modes, mode):
    """The levels span what there is of this mode, in kHz."""
    ax = fj.plot.frequency_map(modes, mode=mode)
    assert ax.get_title(loc="left") == f"frequency of mode {mode} [kHz]"
    filled = ax.collections[0]
    frequency = np.asarray(modes.frequency[..., mode - 1]) / 1e3
    assert filled.levels[0] <= frequency.min() and frequency.max() <= filled.levels[-1]
    assert_whole(ax.figure)


@pytest.mark.parametrize("quantity", ["real", "frequency"])
def test_mode_lines(modes, quantity):
    """Both modes at the nearest values there are."""
    ax = fj.plot.mode_lines(modes, quantity=quantity, at=[0.3, 0.8])
    assert labels(ax) == ["mu = 0.307", "mu = 0.797"]
    column = int(np.abs(np.asarray(modes.x) - 0.3).argmin())
    first, second = [line.get_ydata() for line in ax.lines if len(line.get_ydata()) == 60][:2]
    wanted = np.asarray(getattr(modes, quantity)[:, column])
    wanted = np.sort(wanted, axis=1) / (1e3 if quantity == "frequency" else 1)
    np.testing.assert_allclose(np.stack([first, second], axis=1), wanted)
    assert len(labels(fj.plot.mode_lines(modes))) == 4


def test_mode_surfaces(modes):
    ax = fj.plot.mode_surfaces(modes, quantity="frequency")
    assert ax.name == "3d" and ax.get_zlabel() == "frequency [kHz]"
    assert labels(ax) == ["mode 1", "mode 2"] and len(ax.collections) == 2


def test_whole_figures(monkeypatch):
    """Every panel of every figure, nothing cut off, nothing left in pyplot."""
    few = {panel: source_modes(panel, 12) for panel in ("7", "8", "9a", "9b", "9c", "9d")}
    monkeypatch.setattr("fractaljax.plot.maps.source_modes", few.__getitem__)
    for number, panels in ((7, 4), (8, 4), (9, 4), (10, 8)):
        figure = fj.plot.source_figure(number)
        assert len(figure.axes) == panels
        assert_whole(figure)
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles[:2] == ["(a) frequency of mode 1 [kHz]", "(a) frequency of mode 2 [kHz]"]
    assert matplotlib.pyplot.get_fignums() == []


def test_regimes_and_logarithmic_axes():
    """A fractal joint: hatched where it is not elastic, and geometric values on a log axis."""
    D, G = np.linspace(2.2, 2.8, 30), np.geomspace(1e-12, 1e-8, 31)
    ax = fj.plot.growth_map(fj.modes_over(fj.brake_scene(), ("D", D), ("G", G)))
    assert labels(ax) == ["stability boundary", "fully plastic", "gross slip"]
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "log")
    assert ax.get_ylabel() == "G [m]" and ax.get_ylim() == pytest.approx((1e-12, 1e-8))


def test_map_without_a_boundary(modes):
    """All stable or all alike: no boundary, no legend, no warning."""
    calm = fj.Modes(
        ("mu", "m"),
        ("-", "kg"),
        jnp.arange(1.0, 4.0),
        jnp.arange(1.0, 3.0),
        jnp.full((2, 3, 2), -1.0),
        jnp.full((2, 3, 2), 100.0),
        None,
    )
    for draw in (fj.plot.growth_map, fj.plot.frequency_map):
        figure = Figure()
        ax = figure.add_subplot()
        assert draw(calm, ax) is ax and ax.get_legend() is None
        figure.draw_without_rendering()


def test_refusals(modes):
    with pytest.raises(ValueError, match="mode must be 1 or 2, got 3"):
        fj.plot.frequency_map(modes, mode=3)
    for draw in (fj.plot.mode_lines, fj.plot.mode_surfaces):
        with pytest.raises(ValueError, match="quantity must be 'real' or 'frequency', got 'imag'"):
            draw(modes, quantity="imag")
    with pytest.raises(ValueError, match="number must be 7, 8, 9 or 10, got 6"):
        fj.plot.source_figure(6)
    line = fj.modes_over(fj.brake_scene(), ("D", [2.4]), ("G", [1e-10, 1e-9]))
    with pytest.raises(ValueError, match=r"two values a side at least, got a grid of shape \(2, 1"):
        fj.plot.growth_map(line)
