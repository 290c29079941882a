"""The traced stability boundary: closed form, Brent's method, both sides, loops, ends, picture."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import fractaljax as fj
from fractaljax.base.ranges import is_logarithmic, within
from fractaljax.mechanism.quantities import sliding_friction
from fractaljax.modes.boundary import BranchEnd, hopf_boundary

BRAKE = fj.brake_scene()
FIXED = BRAKE.replace(contact=fj.FixedContact(402628934.268313, 191682502.096783))
CONSTANT = fj.Scene(fj.FixedContact(4e8, 6e7), fj.Coulomb(0.4), BRAKE.oscillator)

_growth = jax.jit(fj.growth_rate, static_argnames="friction_slope")


@functools.cache
def over_ratio_and_friction():
    return hopf_boundary(CONSTANT, ("K_t/K_n", 0.01, 1.0), ("mu", 0.05, 1.0))


@functools.cache
def over_surfaces():
    return hopf_boundary(BRAKE, ("D", 2.1, 2.9), ("G", 1e-12, 1e-8))


@functools.cache
def loop():
    return hopf_boundary(FIXED, ("v_m", 0.05, 2.0), ("xi_1", 0.0, 0.1))


def scaled(boundary, x, y):
    """Places in the window, each axis from 0 to 1."""
    columns = []
    for values, window in ((x, boundary.x), (y, boundary.y)):
        scale = np.log if is_logarithmic(*window[1:]) else np.asarray
        low, high = scale(window[1]), scale(window[2])
        columns.append((scale(np.asarray(values)) - low) / (high - low))
    return np.stack(columns, axis=-1)


# --- where it lies ------------------------------------------------------------------------


def test_over_stiffness_ratio_and_friction_it_is_the_closed_form():
    boundary = over_ratio_and_friction()
    (branch,) = boundary.branches
    wanted = [fj.critical_friction(CONSTANT.replace(K_t=ratio * 4e8)) for ratio in branch.x]
    np.testing.assert_allclose(branch.y, wanted, rtol=1e-12)
    assert len(branch.x) > 50
    # With a law that has a slope left out, "mu" is the friction at the velocity of the belt.
    stribeck = CONSTANT.replace(friction=fj.Stribeck(0.4, 0.25, 0.5))
    window = ("K_t/K_n", 0.01, 1.0), ("mu", 0.05, 1.0)
    (other,) = hopf_boundary(stribeck, *window, friction_slope=False).branches
    np.testing.assert_allclose(other.y, branch.y, rtol=1e-12)
    # With its slope, the law as a whole is scaled.
    (sloped,) = hopf_boundary(stribeck, *window).branches
    scene = stribeck.replace(K_t=sloped.x[20] * 4e8)
    assert sloped.y[20] == pytest.approx(float(fj.critical_friction(scene)), rel=1e-12)


def test_over_surfaces_brent_finds_the_same():
    boundary = over_surfaces()
    assert len(boundary.branches) == 2
    for branch in boundary.branches:
        for D, G in list(zip(branch.x, branch.y, strict=True))[:: len(branch.x) // 8]:

            def growth(log_G, D=D):
                return float(_growth(BRAKE.replace(D=D, G=np.exp(log_G))))

            at = np.log(G)
            root = scipy.optimize.brentq(growth, at - 1e-3, at + 1e-3, xtol=1e-13)
            assert at == pytest.approx(root, abs=1e-11)


@pytest.mark.parametrize("which", [over_ratio_and_friction, over_surfaces, loop])
def test_growth_rate_is_zero_on_it(which):
    for branch in which().branches:
        assert np.abs(branch.growth_rate).max() < 1e-8
        assert len(branch.x) == len(branch.y) == len(branch.frequency) == len(branch.growth_rate)


def test_numbers_are_those_of_stability():
    (branch,) = over_ratio_and_friction().branches
    for i in (0, 10, -1):
        at = fj.stability(CONSTANT.replace(K_t=branch.x[i] * 4e8, mu=branch.y[i]))
        assert branch.frequency[i] == pytest.approx(float(at.frequency), rel=1e-12)
        assert branch.growth_rate[i] == pytest.approx(float(at.growth_rate), abs=1e-9)


@pytest.mark.parametrize("which", [over_ratio_and_friction, over_surfaces, loop])
def test_squeal_is_on_its_right_and_nowhere_else(which):
    """2000 places: each on the side of the nearest branch that its growth rate says."""
    boundary = which()
    places = np.random.default_rng(0).uniform(size=(2000, 2))
    columns = {}
    for i, (name, low, high) in enumerate((boundary.x, boundary.y)):
        columns[name] = within(low, high, places[:, i])
    if "K_t/K_n" in columns:
        columns["K_t"] = columns.pop("K_t/K_n") * 4e8
    squeals = np.asarray(of_places(boundary.scene, columns)) > 0
    begin, step = [], []
    for branch in boundary.branches:
        points = scaled(boundary, branch.x, branch.y)
        begin.append(points[:-1])
        step.append(np.diff(points, axis=0))
    begin, step = np.concatenate(begin), np.concatenate(step)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-14)
    wrong = 0
    for place, squeal in zip(places, squeals, strict=True):
        off = place - begin
        along = np.clip((off * step).sum(axis=1) / length**2, 0, 1)
        off = off - along[:, None] * step
        nearest = np.argmin(np.linalg.norm(off, axis=1))
        if np.linalg.norm(off[nearest]) > 1e-3:  # what the polyline may be off
            s, o = step[nearest], off[nearest]
            wrong += bool(s[0] * o[1] - s[1] * o[0] < 0) != squeal
    assert wrong == 0
    assert 0 < squeals.mean() < 1


@jax.jit
def of_places(scene, columns):
    return jax.vmap(lambda numbers: fj.growth_rate(scene.replace(**numbers)))(columns)


def test_both_sides_of_a_narrow_tongue_are_found():
    """Little friction and damping: squeal only where the modes all but coincide."""
    scene = CONSTANT.replace(mu=0.001, xi_1=1e-6, xi_2=1e-6)
    window = ("omega_1", 2e4, 5e4), ("omega_2", 1e4, 5e4)
    boundary = hopf_boundary(scene, *window)
    assert len(boundary.branches) == 2
    ends = []
    for branch in boundary.branches:
        assert branch.start == branch.end == BranchEnd.window
        ends.append(scaled(boundary, branch.x, branch.y)[[0, -1]])
    apart = np.linalg.norm(ends[0] - ends[1][::-1], axis=1)
    assert 0 < apart.min() <= apart.max() < 1.5e-3


def test_a_branch_is_smooth_and_close():
    """No step longer than a 64th of the window, no turn beyond 0.15 rad."""
    for boundary in (over_ratio_and_friction(), over_surfaces(), loop()):
        for branch in boundary.branches:
            step = np.diff(scaled(boundary, branch.x, branch.y), axis=0)
            length = np.linalg.norm(step, axis=1)
            assert length.max() < 1.2 / 64
            assert length.min() > 0
            unit = step[length > 1e-9] / length[length > 1e-9, None]
            assert (unit[1:] * unit[:-1]).sum(axis=1).min() > np.cos(0.2)


# --- how it ends --------------------------------------------------------------------------


def test_it_ends_on_the_edges_of_the_window():
    for boundary in (over_ratio_and_friction(), over_surfaces()):
        for branch in boundary.branches:
            for i, end in ((0, branch.start), (-1, branch.end)):
                assert end == BranchEnd.window
                at = branch.x[i] in boundary.x[1:], branch.y[i] in boundary.y[1:]
                assert any(at)


def test_a_loop_is_closed_and_has_folds():
    (branch,) = loop().branches
    assert branch.closed
    assert branch.start == branch.end == BranchEnd.closed
    assert branch.x[0] == branch.x[-1]
    assert branch.y[0] == branch.y[-1]
    assert len(set(zip(branch.x[1:], branch.y[1:], strict=True))) == len(branch.x) - 1
    points = scaled(loop(), branch.x, branch.y)
    turn = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    assert abs(turn[-1] - turn[0]) == pytest.approx(2 * np.pi, abs=0.3)


def test_it_says_where_the_regime_of_the_joint_changes():
    """Driven by the slope of the law beyond gross slip, by coupling before: a corner."""
    boundary = hopf_boundary(BRAKE, ("P", 1e4, 1e6), ("v_m", 0.05, 0.5))
    ends = [(b.start, b.x[0]) for b in boundary.branches]
    ends += [(b.end, b.x[-1]) for b in boundary.branches]
    corners = [x for end, x in ends if end == BranchEnd.regime]
    assert len(corners) == 2
    before, after = (
        fj.contact_state(BRAKE.contact.surface, BRAKE.contact.material, x, mu_s=0.4, mu_m=0.25)
        for x in (min(corners) * (1 - 1e-4), max(corners) * (1 + 1e-4))
    )
    assert before.regime != after.regime
    assert fj.Regime.gross_slip in (before.regime, after.regime)


def test_it_says_where_all_damping_is_lost():
    """Both directions undamped by the slope of the law at one place: a corner."""
    boundary = hopf_boundary(FIXED, ("K_n", 1e6, 1e11), ("F", -1e4, 1e4))
    ends = [end for branch in boundary.branches for end in (branch.start, branch.end)]
    assert ends.count(BranchEnd.undamped) == 2
    assert boundary.untraced == 0


@pytest.mark.slow
def test_it_says_where_the_friction_correction_has_its_step():
    """A jump of 4e-4 in k_mu: the stiffness has two values there, and the boundary two ends."""
    scene = BRAKE.replace(F=5e3, V=0.02, v_m=0.1)
    boundary = hopf_boundary(scene, ("mu", 0.3, 0.6), ("K_t/K_n", 0.4, 1.0))
    ends = [(b.start, b.x[0]) for b in boundary.branches]
    ends += [(b.end, b.x[-1]) for b in boundary.branches]
    steps = [x for end, x in ends if end == BranchEnd.friction_correction]
    assert len(steps) == 2
    at = 0.3 / 0.25 * float(sliding_friction(scene))
    assert max(abs(x - at) for x in steps) < 1e-6
    assert "at mu_m = 0.3, where Eq. 19 has a step" in repr(boundary)


@pytest.mark.slow
def test_damping_that_changes_sign_everywhere_at_once_is_not_traced_but_counted():
    scene = FIXED.replace(xi_1=0.0, xi_2=0.0)
    boundary = hopf_boundary(scene, ("V", 0.3, 0.7), ("v_m", 0.3, 0.7))
    assert boundary.untraced > 10
    assert "crossings of the lattice could not be followed" in repr(boundary)


@pytest.mark.parametrize(("mu", "text"), [((0.8, 0.9), "it squeals"), ((0.01, 0.05), "stable")])
def test_without_a_boundary_it_says_which_side_this_is(mu, text):
    boundary = hopf_boundary(CONSTANT, ("K_t/K_n", 0.2, 0.6), ("mu", *mu))
    assert boundary.branches == ()
    assert boundary.squeals == (text == "it squeals")
    assert f"none found: {text}" in repr(boundary)


# --- what can be on the axes --------------------------------------------------------------


def test_derived_quantities():
    """omega_1/omega_2 moves omega_1, K_t/K_n a fixed K_t or a fractal joint's given ratio."""
    window = ("omega_1/omega_2", 0.5, 2.0), ("K_t/K_n", 0.01, 1.0)
    branch = hopf_boundary(CONSTANT, *window).branches[0]
    r, k = branch.x[10], branch.y[10]
    omega_2 = float(CONSTANT.oscillator.omega_2)
    moved = CONSTANT.replace(omega_1=r * omega_2, K_t=k * 4e8)
    assert abs(float(_growth(moved))) < 1e-8
    fractal = fj.Scene(BRAKE.contact, fj.Coulomb(0.4), BRAKE.oscillator)
    branch = hopf_boundary(fractal, ("mu", 0.2, 0.6), window[1]).branches[0]
    moved = fractal.replace(mu=branch.x[10], stiffness_ratio=branch.y[10])
    assert abs(float(_growth(moved))) < 1e-8


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (("nonsense", 0, 1), ("mu", 0.1, 1), "scene has no quantity 'nonsense'; it has K_n, "),
        (("contact", 0, 1), ("mu", 0.1, 1), "scene has no quantity 'contact'"),
        (("mu", 0.1, 1), ("K_n", 1e9, 1e8), "y must go from a lower to a higher value"),
        (("mu", 0.1, 1), ("K_n", 1e8, 1e8), "y must go from a lower to a higher value"),
        (("mu", 0.1, 1), ("K_n", 1e8, np.inf), "y limit must be finite, got inf"),
        (("mu", 0.1, 1), ("K_n", 1e8), r"y must be \(name, low, high\)"),
        (("mu", 0.0, 1), ("K_n", 1e8, 1e9), "mu must be above 0"),
        (("K_t/K_n", -0.1, 1), ("K_n", 1e8, 1e9), "K_t/K_n must be at least 0"),
        (("omega_1/omega_2", 0, 1), ("K_n", 1e8, 1e9), "omega_1/omega_2 must be above 0"),
        (("mu", 0.1, 1), ("mu", 0.1, 1), "quantities must be independent, got mu and mu"),
        (("K_t", 1e8, 1e9), ("K_t/K_n", 0.1, 1), "quantities must be independent"),
    ],
)
def test_bad_windows_are_refused_in_one_line(x, y, message):
    with pytest.raises(ValueError, match=message) as refused:
        hopf_boundary(CONSTANT, x, y)
    assert "\n" not in str(refused.value)


def test_other_bad_input_is_refused():
    with pytest.raises(ValueError, match="mu_s must be at least mu_m"):
        hopf_boundary(BRAKE, ("mu_s", 0.1, 0.9), ("D", 2.1, 2.9))
    # At the corners mu_m is inside; mu(V) is least, and so the whole law scaled most, at V = v_m.
    for name in ("V", "v_m"):
        with pytest.raises(ValueError, match=r"mu_m must be at most 0\.9, got 1\.2"):
            hopf_boundary(BRAKE, (name, 0.05, 0.95), ("mu", 0.3, 1.2))
    with pytest.raises(ValueError, match="lines must be a whole number of at least 2, got 1"):
        hopf_boundary(CONSTANT, ("mu", 0.1, 1.0), ("K_n", 1e8, 1e9), lines=1)
    many = CONSTANT.replace(mu=np.array([0.1, 0.2]))
    with pytest.raises(ValueError, match=r"use jax\.vmap for many scenes"):
        hopf_boundary(many, ("mu", 0.1, 1.0), ("K_n", 1e8, 1e9))


def test_what_cannot_be_computed_is_not_stable():
    """Found: none found, stable, where friction overflows; and a critical friction of infinity."""
    with pytest.raises(
        ValueError, match=r"^stability cannot be computed at v_m = 1e-200, xi_1 = 0"
    ):
        hopf_boundary(FIXED, ("v_m", 1e-200, 2.0), ("xi_1", 0.0, 0.1))
    assert np.isnan(fj.critical_friction(FIXED.replace(v_m=1e-150)))


@pytest.mark.slow
def test_single_precision():
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), CONSTANT)
    boundary = hopf_boundary(scene, ("K_t/K_n", 0.01, 1.0), ("mu", 0.05, 1.0))
    (branch,) = boundary.branches
    wanted = [fj.critical_friction(CONSTANT.replace(K_t=ratio * 4e8)) for ratio in branch.x]
    np.testing.assert_allclose(branch.y, wanted, rtol=1e-4)


def test_printed_it_is_a_summary():
    text = repr(over_ratio_and_friction())
    first, second = text.splitlines()
    assert first == "stability boundary, K_t/K_n from 0.01 to 1, mu from 0.05 to 1: 1 branch"
    assert second.endswith("begins at the edge of the window, ends at the edge of the window")


# --- the picture --------------------------------------------------------------------------


def test_picture(tmp_path):
    """Axes with units and scales of the window, every branch, and a bar of frequencies."""
    boundary = over_surfaces()
    ax = fj.plot.boundary(boundary)
    assert ax.get_xlabel() == "fractal dimension D [-]"
    assert ax.get_ylabel() == "fractal roughness G [m]"
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "log")
    assert ax.get_xlim() == boundary.x[1:]
    assert len(ax.lines) == len(boundary.branches)
    (lines,) = ax.collections
    assert len(lines.get_segments()) == sum(len(branch.x) - 1 for branch in boundary.branches)
    kilohertz = np.concatenate([branch.frequency for branch in boundary.branches]) / 1e3
    assert kilohertz.min() <= lines.get_array().min()
    assert lines.get_array().max() <= kilohertz.max()
    assert "frequency at the boundary [kHz]" in [a.get_ylabel() for a in ax.figure.axes]
    ax.figure.savefig(tmp_path / "boundary.png")


def test_picture_of_derived_quantities_in_given_axes():
    from matplotlib.figure import Figure

    ax = Figure().add_subplot()
    assert fj.plot.boundary(over_ratio_and_friction(), ax) is ax
    assert ax.get_xlabel() == "stiffness ratio K_t/K_n [-]"
    assert ax.get_ylabel() == "friction coefficient mu [-]"


def test_picture_without_a_boundary_and_with_a_corner():
    none = hopf_boundary(CONSTANT, ("K_t/K_n", 0.2, 0.6), ("mu", 0.8, 0.9))
    assert [text.get_text() for text in fj.plot.boundary(none).texts] == ["it squeals"]
    corner = hopf_boundary(FIXED, ("K_n", 1e6, 1e11), ("F", -1e4, 1e4))
    legend = fj.plot.boundary(corner).get_legend()
    assert "ends inside the window" in [text.get_text() for text in legend.get_texts()]
