"""Pictures: their labels, the data on them, what they refuse, and no trace in pyplot."""

import dataclasses
import functools
import io
import itertools
import pickle
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.image
import matplotlib.pyplot
import numpy as np
import pytest
from IPython.core.formatters import DisplayFormatter
from matplotlib.contour import ContourSet

import fractaljax as fj
from fractaljax.plot.axes import coordinate
from fractaljax.plot.maps import vibration_modes
from structures import belt_cycle
from synthetic import DX, gaussian_map, gaussian_profile
from tools import (
    assert_whole,
    labels,
    motionless_scene,
    reference_cycle,
    reference_scene,
    refusals,
    state_matrix,
)

plot: Any = fj.plot
BRAKE = fj.brake_scene()
START, TIME = [1e-5, 0.0, 0.0, 0.0], 1.5e-3  # s, some five returns
Z = 1e-6 * np.add.outer(np.arange(6.0), 10 * np.arange(4.0))
SAMPLES = {"wide": np.array([3.0, -1.0, 0.5, 2.0]), "narrow": [0.1, 0.2]}
MU, KAPPA = np.linspace(0.02, 1, 41), np.linspace(0.0, 1.4, 30)


def test_a_png_and_a_notebook_are_given_the_picture():
    figure, other = (plot.topography(Z, 1e-6).figure for _ in range(2))  # layouts move on
    ours, expected, dpi = io.BytesIO(figure.png(60)), io.BytesIO(), figure.dpi
    other.savefig(expected, format="png", dpi=60)
    assert dpi == other.dpi != 60
    expected.seek(0)
    pixels = matplotlib.image.imread(ours)
    np.testing.assert_array_equal(pixels, matplotlib.image.imread(expected))
    # The size is as asked, and what is drawn is there: after more is drawn, also unpickled.
    ax = plot.new_figure().add_subplot()
    ax.set_axis_off()
    blank = picture(ax.figure)
    assert blank.shape[:2] == (640, 840) and np.all(blank == 1)
    ax.plot([0, 1], [0, 1], "k")
    assert picture(ax.figure).min() == 0
    again = pickle.loads(pickle.dumps(ax.figure))
    assert picture(again).shape == (640, 840, 4)


@functools.cache
def best():
    return fj.design(BRAKE, progress=False)


@functools.cache
def family():
    """Designs over load and friction, some of which are out of reach."""
    xs = BRAKE.replace(P=np.array([[1500.0], [2500.0]]), mu_s=np.array([0.4, 1.0, 3.0]))
    return fj.design_many(xs, {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}, progress=False)


@functools.cache
def no_cycle():
    return fj.limit_cycle(motionless_scene(), throw=False)


@functools.cache
def both_stick():
    """A limit cycle in which both directions stick."""
    return fj.limit_cycle(reference_scene().replace(mu_s=0.9))


@functools.cache
def batch():
    """Three cycles, the middle one without a result."""
    return jax.tree.map(lambda *x: jnp.stack(x), reference_cycle(), no_cycle(), both_stick())


@functools.cache
def motion():
    return fj.simulate(reference_scene(), START, TIME)


@functools.cache
def spectrum_of_profile():
    z = gaussian_profile(np.random.default_rng(0), 2.5, 2048)
    return fj.identify(z, DX, resolution=4e-6)


@functools.cache
def modes(xi_1=0.001, xi_2=0.007):
    scene = fj.Scene(fj.FixedContact(4e8, 2e8), fj.Coulomb(0.4), BRAKE.oscillator)
    axes: dict[str, Any] = {"mu": MU, "K_t/K_n": KAPPA}
    return fj.sweep(fj.stability, scene.replace(xi_1=xi_1, xi_2=xi_2), progress=False, **axes)


def state(scene):
    return scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)


@functools.cache
def states(low=2.35):
    """From fully plastic through elastic-plastic to gross slip, and one that does not slip."""
    D = np.linspace(low, low + 0.35, 60)
    return fj.sweep(state, BRAKE, progress=False, D=D, G=[1e-10, 1e-8])


@functools.cache
def rates():
    """Growth rates over a surface, geometric in G."""
    D, G = np.linspace(2.2, 2.8, 30), np.geomspace(1e-12, 1e-8, 31)
    return fj.sweep(fj.growth_rate, BRAKE, progress=False, D=D, G=G)


def cube():
    return fj.sweep(fj.growth_rate, BRAKE, progress=False, D=[2.4], G=[1e-10], P=[1e3])


MAP = "friction coefficient mu [-]", "stiffness ratio K_t/K_n [-]"
SURFACE = "fractal dimension D [-]", "fractal roughness G [m]"
HELD = "normal load P [N]", "static friction coefficient mu_s [-]"
BELT, NORMAL = "along the belt [µm]", "normal to the belt [µm]"
GROWTH, KHZ = "growth rate [1/s]", "frequency [kHz]"
LOADS: dict[str, Any] = {"P": [1e3, 2e3]}
# What draws on given axes, and the labels of x and y.
PICTURES: dict[str, tuple[Any, str, str]] = {
    "design": (lambda ax: plot.design(best(), ax), *SURFACE),
    "design map": (lambda ax: plot.design_map(family(), "P", "mu_s", ax), *HELD),
    "design line": (
        lambda ax: plot.design_map(family(), "mu_s", ax=ax, quantity="G"),
        HELD[1],
        SURFACE[1],
    ),
    "growth map": (lambda ax: plot.growth_map(modes(), ax), *MAP),
    "growth map of a surface": (lambda ax: plot.growth_map(rates(), ax), *SURFACE),
    "frequency map": (lambda ax: plot.frequency_map(modes(), ax, mode=2), *MAP),
    "mode lines": (lambda ax: plot.mode_lines(modes(), ax), MAP[1], "real part [1/s] of all modes"),
    "mode frequencies": (
        lambda ax: plot.mode_lines(modes(), ax, quantity="frequency"),
        MAP[1],
        f"{KHZ} of all modes",
    ),
    "curves": (
        lambda ax: plot.curves(
            fj.sweep(fj.growth_rate, BRAKE, progress=False, **LOADS), ax, label=GROWTH
        ),
        "normal load P [N]",
        GROWTH,
    ),
    "K_t": (
        lambda ax: plot.stiffness_curves(states(), ax, stiffness="K_t"),
        SURFACE[0],
        "tangential stiffness K_t [N/m]",
    ),
    "portrait": (
        lambda ax: plot.phase_portrait(reference_cycle(), ax, direction=2),
        f"x2, {NORMAL}",
        "dx2/dt [m/s]",
    ),
    "spectrum": (
        lambda ax: plot.spectrum(reference_cycle(), ax, direction=2),
        KHZ,
        "peak amplitude of x2 [µm]",
    ),
    "amplitudes": (
        lambda ax: plot.amplitudes(batch(), [1, 2, 5], ax, label="stiffness [N/m]"),
        "stiffness [N/m]",
        "peak-to-peak amplitude [µm]",
    ),
    "trajectory": (lambda ax: plot.trajectory(motion(), ax), "time [ms]", f"x1, {BELT}"),
    "distribution": (
        lambda ax: plot.distribution(SAMPLES, ax, label=GROWTH, limit=0.0),
        GROWTH,
        "share below [-]",
    ),
    "identification": (
        lambda ax: plot.identification(spectrum_of_profile(), ax),
        "frequency f [1/m]",
        "power spectral density of the profile [m³]",
    ),
    "topography": (lambda ax: plot.topography(Z, 2e-6, ax, dy=3e-6), "x [µm]", "y [µm]"),
}
FIGURES = {
    "modes": lambda: plot.modes(modes()),
    "stiffness": lambda: plot.stiffness(states()),
    "cycle": lambda: plot.cycle(reference_cycle()),
    "cycles": lambda: plot.cycles({"one": reference_cycle(), "two": both_stick()}),
    "topographies": lambda: plot.topographies(best(), n=32),
    "surfaces": lambda: plot.mode_surfaces(modes()).figure,
}


def drawn(ax, label):
    """The lines of a label, as arrays (2, points)."""
    return [np.array(line.get_data()) for line in ax.lines if line.get_label().startswith(label)]


@pytest.mark.parametrize("name", PICTURES)
def test_labels_with_units_on_given_axes(name):
    """Nothing is cut off."""
    draw, *expected = PICTURES[name]
    ax = plot.new_figure().add_subplot()
    assert draw(ax) is ax
    assert [ax.get_xlabel(), ax.get_ylabel()] == expected
    assert_whole(ax.figure)
    assert matplotlib.pyplot.get_fignums() == []


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_whole_figures(name):
    """Nothing is cut off, and no panel overlaps another."""
    figure = FIGURES[name]()
    assert_whole(figure)
    boxes = [ax.get_tightbbox() for ax in figure.axes]
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))


test_refusals = refusals(
    [
        (lambda: plot.phase_portrait(reference_cycle(), direction=3), "direction must be 1 or 2"),
        (lambda: plot.spectrum(batch()), "index the batch first"),
        (lambda: plot.spectrum(reference_cycle(), harmonics=0), "harmonics must be a whole number"),
        (lambda: plot.spectrum(no_cycle()), "no limit cycle to draw: the motion dies out"),
        (lambda: plot.cycles({}), "at least one limit cycle"),
        (lambda: plot.trajectory(motion(), direction=0), "direction must be 1 or 2"),
        (
            lambda: plot.trajectory(motion(), samples=1),
            "samples must be a whole number of at least",
        ),
        (lambda: plot.trajectory(jax.tree.map(lambda x: x[None], motion())), "index the batch"),
        (lambda: plot.amplitudes(batch(), [1, 2], label="x"), r"got \(2,\) and \(3,\)"),
        (
            lambda: plot.amplitudes(batch(), [1, 2, 3], label="x", slopes=[1, 2]),
            r"slopes must have shape \(3,\), got \(2,\)",
        ),
        (
            lambda: plot.design_map(family(), "P", quantity="H"),
            "quantity must be one of D, G, got H",
        ),
        (lambda: plot.design_map(family(), "Q"), "no quantity 'Q'"),
        (lambda: plot.distribution({}, label="x"), "at least one set of samples"),
        *(
            (lambda x=x: plot.distribution({"bad": x}, label="x"), "samples 'bad' must be finite")
            for x in ([], [[1.0]], [np.nan])
        ),
        *(
            (lambda z=z: plot.topography(z, 1e-6), r"z must be a map \(n, m\) of heights")
            for z in (np.zeros(5), np.full((3, 3), np.nan), np.zeros((0, 3)))
        ),
        (lambda: plot.topography(Z, np.nan), "dx and dy must be above 0"),
        (lambda: plot.frequency_map(modes(), mode=3), "mode must be from 1 to 2, got 3"),
        (lambda: plot.mode_lines(modes(), quantity="imag"), "quantity must be 'real' or"),
        (lambda: plot.stiffness_curves(states(), stiffness="K"), "stiffness must be 'K_n' or"),
        (lambda: plot.curves(cube(), label="x"), "curves need scalars over one or two axes"),
        (lambda: plot.growth_map(cube()), "a map needs two axes of two values or more"),
        (lambda: plot.stability_map(reference_scene()), "scene has no quantity 'D'"),
        (
            lambda: plot.stability_map(BRAKE, points=1),
            "points must be a whole number of at least 2",
        ),
        (lambda: plot.basin(section(1.0, 21)), "starts that differ in 2 coordinates, got 1"),
    ]
)


# --- maps ---------------------------------------------------------------------------------


def test_design_shows_its_path_and_whether_it_is_one():
    ax = plot.design(best())
    D, G = (best().history[name] for name in "DG")
    shown = drawn(ax, "path of the best start")[0]
    at = [np.flatnonzero((x == D) & (y == G))[0] for x, y in shown.T]
    assert at[0] == 0 and at == sorted(at) and (shown[:, -1] == [D[-1], G[-1]]).all()
    ends = best().bounds
    shares = (D - D[-1]) / np.ptp(ends["D"]), np.log(G / G[-1]) / np.ptp(np.log(ends["G"]))
    away = np.hypot(*shares)
    assert all(away[j] <= away[i] / 2 for i, j in itertools.pairwise(at))
    for i, j in itertools.pairwise(at):  # the first that does
        assert (away[i + 1 : j] > away[i] / 2).all()
    assert {"fully plastic", "gross slip", "stability boundary"} <= {*labels(ax)}
    assert ax.figure.axes[1].get_ylabel() == "growth rate where it squeals [1/s]"
    missed = dataclasses.replace(best(), violated=("K_n >= K_n_min",))
    assert labels(plot.design(missed))[-1] == "best found, not a solution"


@pytest.mark.slow
def test_boundary_is_where_the_growth_rate_changes_sign():
    for ax, vary, aside in (
        (plot.stability_map(BRAKE), lambda p: BRAKE.replace(D=p[0], G=p[1]), [0.004, 0]),
        (
            plot.growth_map(modes()),
            lambda p: modes().scene.replace(mu=p[0], K_t=p[1] * 4e8),
            [0.02, 0],
        ),
    ):
        (zero,) = (c for c in ax.collections if list(getattr(c, "levels", ())) == [0.0])
        points = np.concatenate([path.vertices for path in zero.get_paths()])
        points = points[points[:, 1] < 0.9][5:-5:7]
        growth = jax.vmap(lambda p, vary=vary: fj.growth_rate(vary(p)))
        sides = growth(points - np.array([aside])), growth(points + np.array([aside]))
        assert (sides[0] * sides[1] < 0).mean() > 0.95


@pytest.mark.parametrize("damping", [(0.001, 0.007), (0.0, 0.0), (6.0, 0.007), (5.0, 9.0)], ids=str)
def test_modes_are_those_of_the_state_matrix(damping):
    """Real part and frequency of both, also where a direction does not oscillate."""
    result = modes(*damping)
    real, frequency = vibration_modes(result)
    assert real.shape == (41, 30, 2) and (np.diff(frequency, axis=-1) >= 0).all()
    np.testing.assert_array_equal(real.max(axis=-1), result.values.growth_rate)
    omega = np.sqrt(4e8)
    for i, j in itertools.product(range(0, 41, 4), range(0, 30, 4)):
        A = state_matrix(result.scene.oscillator, MU[i], 4e8, KAPPA[j] * 4e8)
        s = sorted(np.linalg.eigvals(A), key=lambda s: -s.real)
        s = [*(z for z in s if z.imag > 0), *(z for z in s if z.imag == 0)][:2]
        # Undamped frequencies are equal where coupled: the order is rounding's there.
        exact = np.array(sorted((z.imag / (2 * np.pi), z.real) for z in s))
        if np.ptp(exact[:, 0]) < 1e-6 * omega:
            exact = np.sort(exact, axis=0)
            real[i, j] = np.sort(real[i, j])
        np.testing.assert_allclose(frequency[i, j], exact[:, 0], rtol=0, atol=1e-9 * omega)
        np.testing.assert_allclose(real[i, j], exact[:, 1], rtol=0, atol=1e-9 * omega)


def test_maps_and_lines_show_the_modes():
    real, frequency = vibration_modes(modes())
    for mode in (1, 2):
        levels = plot.frequency_map(modes(), mode=mode).collections[0].levels
        low, high = frequency[..., mode - 1].min() / 1e3, frequency[..., mode - 1].max() / 1e3
        assert levels[1] > low >= levels[0] and levels[-2] < high <= levels[-1]
    ax = plot.mode_lines(modes(), at=[0.3, 0.8])
    assert labels(ax) == ["mu = 0.29", "mu = 0.804"]  # the nearest there are
    lines = [line.get_ydata() for line in ax.lines if len(line.get_xdata()) == 30]
    np.testing.assert_array_equal(lines[0], real[11].min(axis=-1))
    np.testing.assert_array_equal(lines[3], real[32].max(axis=-1))
    surfaces = plot.mode_surfaces(modes(), quantity="frequency")
    assert surfaces.get_zlabel() == "frequency [kHz]" and labels(surfaces) == ["mode 1", "mode 2"]


@pytest.mark.parametrize("draw", [plot.growth_map, plot.frequency_map])
def test_all_that_is_a_number_is_drawn(draw):
    """NaN has its own hatch; everywhere else the map is as it was, but beside it."""
    whole, names = modes(), ("growth_rate", "eigenvalues")
    values = [np.array(getattr(whole.values, name)) for name in names]
    for array in values:
        array[2, 3] = np.nan

    def changed(x):
        return [getattr(x.values, name) for name in names]

    lacking = draw(eqx.tree_at(changed, whole, values))
    words = [text.get_text() for text in lacking.get_legend().get_texts()]
    assert "no steady sliding" in words
    (filled,), (hatch, *_) = (
        [x for x in ax.collections if isinstance(x, ContourSet) and x.filled and not any(x.hatches)]
        for ax in (draw(whole), lacking)
    )
    np.testing.assert_array_equal(hatch.levels, filled.levels)
    areas = [sum(np.shape(path.vertices)[0] for path in x.get_paths()) for x in (hatch, filled)]
    assert areas[0] > 0.8 * areas[1]


def test_stability_map_does_not_call_stable_what_does_not_slide():
    """A force that opens the joint leaves no growth rate: hatched, not white."""
    scene = fj.Scene(BRAKE.contact, BRAKE.friction, BRAKE.oscillator, preload="linear")
    ax = plot.stability_map(scene.replace(xi_1=0.3, xi_2=0.3), {"F": (1e3, 5e3), "P": (1e3, 3e3)})
    assert labels(ax) == ["no steady sliding", "stable"]


def test_map_without_a_boundary():
    """All stable and all alike: no boundary, no legend, no warning; other regimes are hatched."""
    same = eqx.tree_at(lambda s: s.values, modes(), jax.tree.map(np.ones_like, modes().values))
    calm = eqx.tree_at(lambda s: s.values.growth_rate, same, -np.ones(same.growth_rate.shape))
    for draw in (plot.growth_map, plot.frequency_map):
        ax = draw(calm)
        assert ax.get_legend() is None
        ax.figure.draw_without_rendering()
    ax = plot.growth_map(rates())
    assert labels(ax) == ["stability boundary", "fully plastic", "gross slip"]
    assert ax.get_yscale() == "log" and ax.get_ylim() == pytest.approx((1e-12, 1e-8))
    ax = plot.stability_map(BRAKE.replace(stiffness_ratio=0.5), {"D": (2.3, 2.5)})
    assert ax.get_xlim() == (2.3, 2.5) and "gross slip" not in labels(ax)
    coarse = plot.stability_map(BRAKE, points=30)
    assert coarse.collections[0].get_array().size == 30**2


def test_curves_of_stiffness_and_their_marks():
    """Marks at the last elastic point and the last before gross slip."""
    ax, x = plot.stiffness_curves(states()), states().points[0]
    K_n = states().values.K_n.T
    curves = np.stack([line.get_ydata() for line in ax.lines if len(line.get_xdata()) == 60])
    np.testing.assert_array_equal(curves, np.where(K_n > 0, K_n, np.nan))

    def marks(marker):
        return [np.ravel(line.get_xydata()) for line in ax.lines if line.get_marker() == marker]

    first = [np.flatnonzero(row > 0)[0] for row in K_n]
    elastic = [(x[k], row[k]) for k, row in zip(first, K_n, strict=True)]
    np.testing.assert_array_equal(marks("o"), elastic)
    slips = np.asarray(states().values.regime == fj.Regime.gross_slip).T
    last = np.flatnonzero(slips[0])[0] - 1
    assert not slips[1].any()
    np.testing.assert_array_equal(marks("X"), [(x[last], K_n[0, last])])
    pair = fj.sweep(fj.stiffness, BRAKE, progress=False, P=np.geomspace(1e3, 1e4, 5))
    alone = plot.stiffness_curves(pair, stiffness="K_t")
    assert alone.get_xscale() == "log" and alone.get_legend() is None
    np.testing.assert_array_equal(alone.lines[0].get_ydata(), pair[1])
    words = [ax.texts[0].get_text() for ax in plot.stiffness(states(2.01)).axes]
    assert words == ["K_n = 0 everywhere", "K_t = 0 everywhere"]


# --- motions ------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1, 2])
def test_phase_portrait_has_the_extent_of_the_cycle(direction):
    """A closed curve, as wide as the amplitude and as high as the velocity range; V dashed.

    Sticking is at the velocity of the belt, as far as it moves meanwhile, along the orbit.
    """
    cycle, i = reference_cycle(), direction - 1
    ax = plot.phase_portrait(cycle, direction=direction)
    ((x, v),) = drawn(ax, "limit cycle")
    assert np.ptp(x) == pytest.approx(1e6 * float(cycle.amplitude[i]), rel=1e-4)
    ends = [cycle.velocity_min[i], cycle.velocity_max[i]]
    np.testing.assert_allclose([v.min(), v.max()], ends, rtol=1e-4)
    assert (x[0], v[0]) == (x[-1], v[-1])
    assert list(drawn(ax, "belt velocity 0.15 m/s")[0][1]) == [0.15, 0.15]
    assert len(drawn(ax, "sticks, 9.7% of the period")) == 2 - direction
    creeps = eqx.tree_at(lambda cycle: cycle.regularisation_error, cycle, 0.0123)
    assert not drawn(plot.phase_portrait(creeps), "sticks")

    ax = plot.phase_portrait(both_stick(), direction=direction)
    ((x, v),) = drawn(ax, "sticks")
    np.testing.assert_array_equal(v, 0.15)
    time = both_stick().stick_fraction[i] * both_stick().period
    assert x[1] - x[0] == pytest.approx(1e6 * 0.15 * float(time), rel=1e-3)
    ((orbit_x, orbit_v),) = drawn(ax, "limit cycle")
    inside = (orbit_x > x[0]) & (orbit_x < x[1]) & (orbit_v > 0)
    assert inside.sum() > 5
    np.testing.assert_allclose(orbit_v[inside], 0.15, rtol=1e-9)


def test_spectrum_and_cycles_side_by_side():
    """Stems at the multiples of 1/period, as high as `LimitCycle.spectrum` says."""
    cycle = reference_cycle()
    ax = plot.spectrum(cycle, direction=2)
    f, a = np.hstack([*drawn(ax, "fundamental 3.092 kHz"), *drawn(ax, "harmonics")])
    np.testing.assert_allclose(f, np.arange(1, 21) / float(cycle.period) / 1e3, rtol=1e-12)
    np.testing.assert_allclose(a, 1e6 * cycle.spectrum()[1][:20, 1], rtol=1e-12)
    stems = np.array(ax.collections[0].get_segments())
    np.testing.assert_array_equal(stems[:, 1].T, [f, a])
    assert ax.get_ylim()[0] == stems[0, 0, 1] < a.min() and a.max() < ax.get_ylim()[1]
    assert drawn(plot.spectrum(cycle, harmonics=5), "harmonics")[0].shape == (2, 4)
    # A period of two returns has twice as many lines.
    twice = eqx.tree_at(lambda cycle: cycle.returns, cycle, jnp.array(2))
    assert drawn(plot.spectrum(twice), "harmonics")[0].shape == (2, 39)
    # Orbits and lines as they are alone, a named row each, stems on the common axis.
    shown = {"soft": reference_cycle(), "hard": both_stick()}
    figure = plot.cycles(shown, direction=2)
    assert [part.get_suptitle() for part in figure.subfigs] == ["soft", "hard"]
    rows = [part.axes for part in figure.subfigs]
    for (portrait, spectrum), cycle in zip(rows, shown.values(), strict=True):
        alone = plot.phase_portrait(cycle, direction=2)
        np.testing.assert_array_equal(drawn(portrait, "limit cycle"), drawn(alone, "limit cycle"))
        stems = np.array(spectrum.collections[0].get_segments())
        assert (stems[:, 0, 1] == spectrum.get_ylim()[0]).all()
        np.testing.assert_allclose(stems[1:, 1], drawn(spectrum, "harmonics")[0].T)
    for column in zip(*rows, strict=True):
        assert len({(ax.get_xlim(), ax.get_ylim()) for ax in column}) == 1


@pytest.mark.slow
def test_cycle_of_a_structure():
    """A joint's t.x and a degree of freedom, scaled; a row for each joint."""
    belt, cycle = belt_cycle()
    (row,) = (figure := plot.cycle(cycle)).subfigs or [figure.axes]
    assert [ax.get_xlabel() for ax in row] == ["t.x of joint 1 [µm]", KHZ]
    assert row[0].get_ylabel() == "t.dx/dt of joint 1 [m/s]"
    assert_whole(figure)
    ((x, v),) = drawn(row[0], "limit cycle")
    assert np.ptp(x) == pytest.approx(1e6 * float(cycle.amplitude[0]), rel=1e-3)
    assert drawn(row[0], f"sticks, {cycle.stick_fraction[0]:.1%} of the period")
    along = plot.phase_portrait(cycle)
    assert along.get_xlabel() == f"x1, {BELT}"
    np.testing.assert_array_equal(drawn(along, "limit cycle")[0], [x, v])
    _, lines = cycle.spectrum()
    assert lines.shape == (256, 1) and cycle.orbit(8)[1].shape == (8, 2)
    stems = drawn(plot.spectrum(cycle, joint=1), "harmonics")[0]
    np.testing.assert_allclose(1e6 * lines[1:20, 0], stems[1], rtol=1e-12)
    np.testing.assert_allclose(cycle.harmonics([[-2.0]])[1], 2 * lines, rtol=1e-12)
    # A joint along minus two times the degree of freedom.
    lever = eqx.tree_at(lambda system: system.T, cycle._system, jnp.array([[-2.0]]))
    shown = [coordinate(lever, 1, joint, cycle.period, batch=0) for joint in (1, None)]
    assert [(*c.row, c.face) for c in shown] == [(-2.0, 0), (1.0, None)]
    simulated = fj.simulate(belt, cycle.state, 10.0)
    for ax in (plot.trajectory(simulated, joint=1), plot.trajectory(simulated)):
        assert drawn(ax, "sticks")
    with pytest.raises(ValueError, match="joint must be 1, got 2"):
        plot.phase_portrait(cycle, joint=2)
    with pytest.raises(ValueError, match="direction must be 1, got 2"):
        plot.spectrum(cycle, direction=2)


def test_amplitudes_with_gaps_and_tangents():
    over, slopes = np.array([1.0, 2.0, 5.0]), np.array([-2e-6, np.nan, 1e-6])
    ax = plot.amplitudes(batch(), over, label="x", slopes=slopes)
    for i in (0, 1):
        ((x, y),) = drawn(ax, f"direction {i + 1}")
        np.testing.assert_array_equal(x, over)
        np.testing.assert_allclose(y, 1e6 * batch().amplitude[:, i])
    tangents = [np.array(line.get_data()) for line in ax.lines[2:]]
    for (x, y), k in zip(tangents, range(3), strict=True):
        assert x.mean() == pytest.approx(over[k])
        if k != 1:
            assert np.diff(y) / np.diff(x) == pytest.approx(1e6 * slopes[k])
            assert y.mean() == pytest.approx(1e6 * float(batch().amplitude[k, 0]))
    assert labels(ax) == ["direction 1", "direction 2", "derivative of direction 1"]


@pytest.mark.parametrize("direction", [1, 2])
def test_motion_is_drawn_as_it_is(direction):
    """From the start to the end, every step among them.

    Sticking is marked as long as the contact states say, at the velocity of the belt.
    """
    ax, i = plot.trajectory(motion(), direction=direction), direction - 1
    ((t, x),) = drawn(ax, "motion")
    assert t[0] == 0 and t[-1] == pytest.approx(1e3 * TIME) and (np.diff(t) >= 0).all()
    ends = 1e6 * START[i], 1e6 * float(motion().end[i])
    assert (x[0], x[-1]) == pytest.approx(ends)
    at_steps = np.interp(1e3 * motion().times, t, x)
    np.testing.assert_allclose(at_steps, 1e6 * motion().states[:, i], atol=1e-6)
    ((few, _),) = drawn(plot.trajectory(motion(), samples=2), "motion")
    assert len(few) == len(motion().times) + 2
    if direction == 2:
        slides = fj.simulate(motionless_scene(), [1e-8, 0, 0, 0], TIME)
        return np.testing.assert_equal(labels(plot.trajectory(slides)), ["motion"])
    ((t, x),) = drawn(ax, "sticks")
    inside = np.isfinite(x[1:]) & np.isfinite(x[:-1])
    sticks = np.diff(motion().times)[np.asarray(motion().contact_states)[:-1, 0] == 0].sum()
    # The last sample before its end is not drawn: one of some 180.
    assert sticks > 0 and np.diff(t)[inside].sum() == pytest.approx(1e3 * sticks, rel=0.03)
    speed = np.diff(x)[inside].sum() / np.diff(t)[inside].sum()
    assert speed == pytest.approx(1e3 * 0.15, rel=1e-6)  # um/ms


# --- surfaces and samples -----------------------------------------------------------------


def test_distribution_and_identification():
    """A step of 1/n at each of the sorted samples, and the limit."""
    ax = plot.distribution(SAMPLES, label="growth rate [1/s]", limit=0.0)
    for name, values in SAMPLES.items():
        ((x, y),) = drawn(ax, name)
        np.testing.assert_allclose(y[1:], [(np.asarray(values) <= at).mean() for at in x[1:]])
        np.testing.assert_array_equal(np.sort(values), x[1:])
    assert (drawn(ax, "limit 0")[0][0] == 0).all()
    result = spectrum_of_profile()
    ax = plot.identification(result)
    assert "limit of the instrument 6.25e+04 1/m" in labels(ax)
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), result.spectrum.power)
    ((f, power),) = drawn(ax, f"D = {result.D:.3f} ± ")
    np.testing.assert_allclose(f[[0, -1]], result.band)
    np.testing.assert_allclose(power, result.law(f))
    of_map = fj.identify(gaussian_map(np.random.default_rng(0), shape=(64, 64)), DX)
    assert "of the map" in plot.power_spectrum(of_map).get_ylabel()


def test_heights_of_one_and_two_topographies():
    z = Z.copy()
    z[5, 3] = np.nan  # left out, also of the mean and the scale
    image = plot.topography(z, 2e-6, dy=3e-6).images[0]
    np.testing.assert_allclose(image.get_array(), (z - np.nanmean(z)).T * 1e6)
    assert image.get_extent() == pytest.approx([0, 12, 0, 12]) and image.origin == "lower"
    assert image.get_clim() == pytest.approx(((0 - np.nanmean(z)) * 1e6, 34 - np.nanmean(z) * 1e6))
    assert plot.topography(Z, 1e-6).images[0].get_extent() == pytest.approx([0, 6, 0, 4])
    left, right, _ = plot.topographies(best(), n=32).axes
    surfaces = best().topographies(32)
    for ax, z in ((left, surfaces.before), (right, surfaces.after)):
        np.testing.assert_allclose(ax.images[0].get_array(), (z - z.mean()).T * 1e6)
        assert ax.images[0].get_extent() == pytest.approx([0, 1000, 0, 1000])
    heights = [ax.images[0].get_array() for ax in (left, right)]
    limits = min(z.min() for z in heights), max(z.max() for z in heights)
    assert left.images[0].get_clim() == right.images[0].get_clim() == limits
    assert left.get_title() == "given surface: D = 2.4, G = 1.342e-10 m"


# --- figures ------------------------------------------------------------------------------


def picture(figure):
    """The pixels that Jupyter is given, (height, width, 4)."""
    data, _ = DisplayFormatter().format(figure)
    return matplotlib.image.imread(io.BytesIO(data["image/png"]))


# --- basins ---------------------------------------------------------------------------------


def section(scale, count=None):
    """A made-up basin on a grid of starts: three outcomes of five, by x2 and dx1/dt."""
    x, v = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.5, 0.5, 21))
    starts = np.stack([0 * x, scale * x, v, 0 * x], axis=-1).reshape(-1, 4)
    marks = np.where(x.ravel() < 0, 0, np.where(v.ravel() < 0, 1, 3))
    outcomes = "equilibrium", "cycle 1", "diverges", "undecided"
    return fj.Basin(starts[:count], marks[:count], outcomes, (), {})


@pytest.mark.parametrize(("scale", "unit", "times"), [(2e-5, "µm", 1e6), (2.0, "m", 1)])
def test_basin(scale, unit, times):
    """Each point has the outcome of the nearest start; an outcome without starts has no colour."""
    made = section(scale)
    ax = plot.basin(made)
    assert_whole(ax.figure)
    assert (ax.get_xlabel(), ax.get_ylabel()) == (f"x2 [{unit}]", "dx1/dt [m/s]")
    assert [text.split(",")[0] for text in labels(ax)] == ["equilibrium", "cycle 1", "undecided"]
    assert labels(ax)[0].endswith(f"{made.shares['equilibrium']:.1%}")
    shown = np.asarray(ax.images[0].get_array())
    extent = [-scale * times, scale * times, -0.5, 0.5]
    np.testing.assert_allclose(ax.images[0].get_extent(), extent)
    for share_x, share_v, mark in [(0.2, 0.2, 0), (0.2, 0.9, 0), (0.8, 0.2, 1), (0.8, 0.9, 3)]:
        rows, columns = shown.shape
        assert shown[int(share_v * rows), int(share_x * columns)] == mark
