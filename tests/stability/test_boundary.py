"""The traced stability boundary: closed form, Brent's method, both sides, loops, ends, picture."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

import fractaljax as fj
from fractaljax._base.ranges import is_logarithmic, within
from tools import refusals

BRAKE = fj.brake_scene()
FIXED = BRAKE.replace(contact=fj.FixedContact(402628934.268313, 191682502.096783))
CONSTANT = fj.Scene(fj.FixedContact(4e8, 6e7), fj.Coulomb(0.4), BRAKE.oscillator)
STRIBECK = CONSTANT.replace(friction=fj.Stribeck(0.4, 0.25, 0.5))
TONGUE = CONSTANT.replace(mu=0.001, xi_1=1e-6, xi_2=1e-6)  # squeal where the modes all but coincide
STEP = BRAKE.replace(F=5e3, V=0.02, v_m=0.1)
RATIO, MU = ("K_t/K_n", 0.01, 1.0), ("mu", 0.05, 1.0)
PROBLEMS = {
    "ratio and friction": (CONSTANT, RATIO, MU),
    "surfaces": (BRAKE, ("D", 2.1, 2.9), ("G", 1e-12, 1e-8)),
    "loop": (FIXED, ("v_m", 0.05, 2.0), ("xi_1", 0.0, 0.1)),
    "tongue": (TONGUE, ("omega_1", 2e4, 5e4), ("omega_2", 1e4, 5e4)),
    "all damping lost": (FIXED, ("K_n", 1e6, 1e11), ("F", -1e4, 1e4)),
    "gross slip": (BRAKE, ("P", 1e4, 1e6), ("v_m", 0.05, 0.5)),
    "step of Eq. 19": (STEP, ("mu", 0.3, 0.6), ("K_t/K_n", 0.4, 1.0)),
}
TRACED = pytest.mark.parametrize("name", ["ratio and friction", "surfaces", "loop"])
slow = pytest.mark.slow
growth = jax.jit(fj.growth_rate, static_argnames="friction_slope")


@functools.cache
def boundary(name):
    return fj.hopf_boundary(*PROBLEMS[name])


@functools.cache
def only(name):
    (branch,) = boundary(name).branches
    return branch


def ends(name):
    """(why, x) of both ends of every branch."""
    branches = boundary(name).branches
    return [(b.start, b.x[0]) for b in branches] + [(b.end, b.x[-1]) for b in branches]


def scaled(boundary, branch):
    """Points in the window, each axis from 0 to 1."""
    columns = []
    for values, window in ((branch.x, boundary.x), (branch.y, boundary.y)):
        scale = np.log if is_logarithmic(*window[1:]) else np.asarray
        low, high = scale(window[1]), scale(window[2])
        columns.append((scale(values) - low) / (high - low))
    return np.stack(columns, axis=-1)


def test_over_stiffness_ratio_and_friction_it_is_the_closed_form():
    branch = only("ratio and friction")
    scenes = [CONSTANT.replace(K_t=ratio * 4e8) for ratio in branch.x]
    wanted = [fj.critical_friction(scene) for scene in scenes]
    np.testing.assert_allclose(branch.y, wanted, rtol=1e-12)
    assert len(branch.x) > 50
    for i in (0, 10, -1):
        at = fj.stability(scenes[i].replace(mu=branch.y[i]))
        assert branch.frequency[i] == pytest.approx(float(at.frequency), rel=1e-12)
        assert branch.growth_rate[i] == pytest.approx(float(at.growth_rate), abs=1e-9)


@slow
@pytest.mark.parametrize("slope", [True, False])
def test_mu_scales_a_friction_law_as_a_whole(slope):
    """ "mu" is the friction at the belt velocity, with the slope of the law or without."""
    (branch,) = fj.hopf_boundary(STRIBECK, RATIO, MU, friction_slope=slope).branches
    at = branch.x[::8], branch.y[::8]
    wanted = [fj.critical_friction(STRIBECK.replace(K_t=x * 4e8), slope) for x in at[0]]
    np.testing.assert_allclose(at[1], wanted, rtol=1e-12)


@pytest.mark.slow
def test_over_surfaces_brent_finds_the_same():
    assert len(boundary("surfaces").branches) == 2
    for branch in boundary("surfaces").branches:
        for D, G in list(zip(branch.x, branch.y, strict=True))[:: len(branch.x) // 8]:

            def rate(log_G, D=D):
                return float(growth(BRAKE.replace(D=D, G=np.exp(log_G))))

            at = np.log(G)
            root = scipy.optimize.brentq(rate, at - 1e-3, at + 1e-3, xtol=1e-13)
            assert at == pytest.approx(root, abs=1e-11)


@jax.jit
def of_places(scene, columns):
    return jax.vmap(lambda numbers: fj.growth_rate(scene.replace(**numbers)))(columns)


@pytest.mark.slow
@TRACED
def test_squeal_is_on_its_right_and_nowhere_else(name):
    """2000 places: each on the side of the nearest branch that its growth rate says."""
    found = boundary(name)
    places = np.random.default_rng(0).uniform(size=(2000, 2))
    columns = {
        window[0]: within(*window[1:], places[:, i]) for i, window in enumerate((found.x, found.y))
    }
    if "K_t/K_n" in columns:
        columns["K_t"] = columns.pop("K_t/K_n") * 4e8
    squeals = np.asarray(of_places(found.scene, columns)) > 0
    polylines = [scaled(found, branch) for branch in found.branches]
    begin = np.concatenate([points[:-1] for points in polylines])
    step = np.concatenate([np.diff(points, axis=0) for points in polylines])
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-14)
    off = places[:, None] - begin
    along = np.clip((off * step).sum(axis=-1) / length**2, 0, 1)
    off = off - along[..., None] * step
    nearest = np.linalg.norm(off, axis=-1).argmin(axis=1)
    off, step = off[np.arange(2000), nearest], step[nearest]
    right = step[:, 0] * off[:, 1] - step[:, 1] * off[:, 0] < 0
    sure = np.linalg.norm(off, axis=1) > 1e-3  # the error of the polyline
    np.testing.assert_array_equal(right[sure], squeals[sure])
    assert 0 < squeals.mean() < 1 and sure.mean() > 0.9


@TRACED
def test_a_branch_is_a_smooth_polyline_of_points_without_growth(name):
    """No step longer than a 64th of the window, no turn beyond 0.15 rad."""
    found = boundary(name)
    for branch in found.branches:
        assert np.abs(branch.growth_rate).max() < 1e-8
        assert len(branch.x) == len(branch.y) == len(branch.frequency) == len(branch.growth_rate)
        step = np.diff(scaled(found, branch), axis=0)
        length = np.linalg.norm(step, axis=1)
        assert length.min() > 0 and length.max() < 1.2 / 64
        unit = step[length > 1e-9] / length[length > 1e-9, None]
        assert (unit[1:] * unit[:-1]).sum(axis=1).min() > np.cos(0.2)


@pytest.mark.slow
def test_both_sides_of_a_narrow_tongue_are_found():
    one, other = (scaled(boundary("tongue"), b)[[0, -1]] for b in boundary("tongue").branches)
    apart = np.linalg.norm(one - other[::-1], axis=1)
    assert 0 < apart.min() <= apart.max() < 1.5e-3


@pytest.mark.parametrize("name", ["ratio and friction", "surfaces", "tongue"])
def test_it_ends_on_the_edges_of_the_window(name):
    found = boundary(name)
    for branch in found.branches:
        assert branch.start == branch.end == fj.BoundaryEnd.window
        for i in (0, -1):
            assert branch.x[i] in found.x[1:] or branch.y[i] in found.y[1:]


def test_a_loop_is_closed_and_has_folds():
    branch = only("loop")
    assert branch.closed
    assert branch.start == branch.end == fj.BoundaryEnd.closed
    assert (branch.x[0], branch.y[0]) == (branch.x[-1], branch.y[-1])
    assert len(set(zip(branch.x[1:], branch.y[1:], strict=True))) == len(branch.x) - 1
    angle = np.unwrap(np.arctan2(*np.diff(scaled(boundary("loop"), branch), axis=0).T[::-1]))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi, abs=0.3)
    # Both directions undamped by the slope of the law at one place: a corner.
    assert [end for end, _ in ends("all damping lost")].count(fj.BoundaryEnd.undamped) == 2
    assert boundary("all damping lost").untraced == 0
    legend = fj.plot.boundary(boundary("all damping lost")).get_legend()
    assert legend is not None
    assert "ends inside the window" in [text.get_text() for text in legend.get_texts()]


@slow
def test_it_says_where_the_regime_or_the_friction_correction_changes():
    """Driven by the slope of the law beyond gross slip, by coupling before: a corner."""
    corners = [x for end, x in ends("gross slip") if end == fj.BoundaryEnd.regime]
    assert len(corners) == 2
    contact = BRAKE.contact
    before, after = (
        fj.contact_state(contact.surface, contact.material, x, mu_s=0.4, mu_m=0.25).regime
        for x in (min(corners) * (1 - 1e-4), max(corners) * (1 + 1e-4))
    )
    assert before != after
    assert fj.Regime.gross_slip in (before, after)
    # A jump of 4e-4 in k_mu: the stiffness has two values there, and the boundary two ends.
    name = "step of Eq. 19"
    steps = [x for end, x in ends(name) if end == fj.BoundaryEnd.friction_correction]
    assert len(steps) == 2
    at = 0.3 / 0.25 * float(PROBLEMS[name][0].coefficient())
    assert max(abs(x - at) for x in steps) < 1e-6
    assert "at mu_m = 0.3, where Eq. 19 has a step" in repr(boundary(name))


@slow
def test_damping_that_changes_sign_along_a_line_is_not_traced_but_counted():
    scene = FIXED.replace(xi_1=0.0, xi_2=0.0)
    found = fj.hopf_boundary(scene, ("V", 0.3, 0.7), ("v_m", 0.3, 0.7))
    assert found.untraced > 10
    assert "crossings of the lattice could not be followed" in repr(found)


@pytest.mark.parametrize(("mu", "text"), [((0.8, 0.9), "it squeals"), ((0.01, 0.05), "stable")])
def test_without_a_boundary_it_says_which_side_this_is(mu, text):
    found = fj.hopf_boundary(CONSTANT, ("K_t/K_n", 0.2, 0.6), ("mu", *mu))
    assert found.branches == ()
    assert found.squeals == (text == "it squeals")
    assert f"none found: {text}" in repr(found)
    assert [shown.get_text() for shown in fj.plot.boundary(found).texts] == [text]


@slow
def test_derived_quantities():
    """omega_1/omega_2 moves omega_1, K_t/K_n a fixed K_t or a fractal joint's given ratio."""
    branch = fj.hopf_boundary(CONSTANT, ("omega_1/omega_2", 0.5, 2.0), RATIO).branches[0]
    omega_2 = float(CONSTANT.oscillator.omega_2)
    moved = CONSTANT.replace(omega_1=branch.x[10] * omega_2, K_t=branch.y[10] * 4e8)
    assert abs(float(growth(moved))) < 1e-8
    fractal = fj.Scene(BRAKE.contact, fj.Coulomb(0.4), BRAKE.oscillator)
    branch = fj.hopf_boundary(fractal, ("mu", 0.2, 0.6), RATIO).branches[0]
    moved = fractal.replace(mu=branch.x[10], stiffness_ratio=branch.y[10])
    assert abs(float(growth(moved))) < 1e-8


K_N = ("K_n", 1e8, 1e9)
REFUSED = [
    (CONSTANT, ("nonsense", 0, 1), MU, "scene has no quantity 'nonsense'; it has K_n, "),
    (CONSTANT, MU, ("K_n", 1e9, 1e8), "y must go from a lower to a higher value"),
    (CONSTANT, MU, ("K_n", 1e8, np.inf), "y limit must be finite, got inf"),
    (CONSTANT, MU, ("K_n", 1e8), r"y must be \(name, low, high\)"),
    (CONSTANT, ("mu", 0.0, 1), K_N, "mu must be above 0"),
    (CONSTANT, ("omega_1/omega_2", 0, 1), K_N, "omega_1/omega_2 must be above 0"),
    (CONSTANT, MU, MU, "quantities must be independent, got mu and mu"),
    (CONSTANT.replace(mu=np.array([0.1, 0.2])), MU, K_N, r"use jax\.vmap for many scenes"),
    (BRAKE, ("mu_s", 0.1, 0.9), ("D", 2.1, 2.9), "mu_s must be at least mu_m"),
    # At the corners mu_m is inside; mu(V) is least, and so the law is scaled most, at V = v_m.
    (BRAKE, ("V", 0.05, 0.95), ("mu", 0.3, 1.2), r"mu_m must be at most 0\.9, got 1\.2"),
    (BRAKE, ("v_m", 0.05, 0.95), ("mu", 0.3, 1.2), r"mu_m must be at most 0\.9, got 1\.2"),
    # Without this: none found, stable.
    (FIXED, ("v_m", 1e-200, 2.0), ("xi_1", 0.0, 0.1), "^stability cannot be computed at v_m = 1e-"),
]


test_bad_windows_are_refused_in_one_line = refusals(REFUSED, fj.hopf_boundary)


@slow
def test_float32():
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), CONSTANT)
    (branch,) = fj.hopf_boundary(scene, RATIO, MU).branches
    wanted = [fj.critical_friction(CONSTANT.replace(K_t=ratio * 4e8)) for ratio in branch.x]
    np.testing.assert_allclose(branch.y, wanted, rtol=1e-4)


def test_summary_and_picture():
    first, second = repr(boundary("ratio and friction")).splitlines()
    assert first == "stability boundary, K_t/K_n from 0.01 to 1, mu from 0.05 to 1: 1 branch"
    assert second.endswith("begins at the edge of the window, ends at the edge of the window")
    # Axes with units and scales of the window, every branch, and a bar of frequencies.
    found = boundary("surfaces")
    ax = fj.plot.boundary(found)
    assert (ax.get_xlabel(), ax.get_ylabel()) == (
        "fractal dimension D [-]",
        "fractal roughness G [m]",
    )
    assert (ax.get_yscale(), ax.get_xlim()) == ("log", found.x[1:])
    assert len(ax.lines) == len(found.branches)
    (lines,) = ax.collections
    assert isinstance(lines, LineCollection)
    assert len(lines.get_segments()) == sum(len(branch.x) - 1 for branch in found.branches)
    kilohertz = np.concatenate([branch.frequency for branch in found.branches]) / 1e3
    shown = np.asarray(lines.get_array())
    assert kilohertz.min() <= shown.min() <= shown.max() <= kilohertz.max()
    assert "frequency at the boundary [kHz]" in [a.get_ylabel() for a in ax.figure.axes]
    given = Figure().add_subplot()
    assert fj.plot.boundary(boundary("ratio and friction"), given) is given
    for figure in (each.get_figure(root=True) for each in (ax, given)):
        assert figure is not None
        figure.draw_without_rendering()
