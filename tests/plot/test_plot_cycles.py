"""Several limit cycles in one picture."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot
import numpy as np
import pytest
from matplotlib.figure import Figure
from test_plot import assert_whole, drawn, labels

import fractaljax as fj
from tools import motionless_scene, reference_cycle, reference_scene


@pytest.fixture(scope="module")
def stiffer():
    """The cycle of a stiffer contact: smaller and faster."""
    return fj.limit_cycle(reference_scene().replace(K_n=5e8, K_t=2.5e8))


@pytest.fixture(scope="module")
def batch(stiffer):
    """Three cycles, the middle one without a result."""
    nothing = fj.limit_cycle(motionless_scene(), throw=False)
    return jax.tree.map(lambda *x: jnp.stack(x), reference_cycle(), nothing, stiffer)


@pytest.mark.parametrize("direction", [1, 2])
def test_cycles_have_a_row_each_on_common_axes(stiffer, direction):
    """Orbits and lines as they are alone, named, in one order, with the limits of the widest."""
    given = {"soft": reference_cycle(), "stiff": stiffer}
    figure = fj.plot.cycles(given, direction=direction)
    rows = [part.axes for part in figure.subfigs]
    assert [part.get_suptitle() for part in figure.subfigs] == ["soft", "stiff"]
    for (portrait, spectrum), cycle in zip(rows, given.values(), strict=True):
        alone = fj.plot.phase_portrait(cycle, direction=direction)
        np.testing.assert_array_equal(drawn(portrait, "limit cycle"), drawn(alone, "limit cycle"))
        np.testing.assert_array_equal(
            drawn(spectrum, "harmonics"),
            drawn(fj.plot.spectrum(cycle, direction=direction), "harmonics"),
        )
        # The stems stand on the common axis.
        stems = np.array(spectrum.collections[0].get_segments())
        assert (stems[:, 0, 1] == spectrum.get_ylim()[0]).all()
        np.testing.assert_allclose(stems[1:, 1], drawn(spectrum, "harmonics")[0].T)
    for column in zip(*rows, strict=True):
        assert len({ax.get_xlim() for ax in column}) == len({ax.get_ylim() for ax in column}) == 1
    widest = fj.plot.phase_portrait(reference_cycle(), direction=direction)
    assert rows[1][0].get_xlim() == pytest.approx(widest.get_xlim())
    assert_whole(figure, figure.axes)
    assert matplotlib.pyplot.get_fignums() == []


def test_one_cycle_is_enough():
    assert len(fj.plot.cycles({"alone": reference_cycle()}).axes) == 2


def test_no_cycles_are_refused(batch):
    with pytest.raises(ValueError, match="at least one limit cycle"):
        fj.plot.cycles({})
    with pytest.raises(ValueError, match="direction must be 1 or 2, got 0"):
        fj.plot.cycles({"one": reference_cycle()}, direction=0)
    with pytest.raises(ValueError, match="index the batch first"):
        fj.plot.cycles({"many": batch})


def test_amplitudes_over_a_quantity(batch):
    """Both directions in um, with a gap where there is no cycle, and tangents of the slopes."""
    over, slopes = np.array([1.0, 2.0, 5.0]), np.array([-2e-6, np.nan, 1e-6])
    ax = fj.plot.amplitudes(batch, over, label="stiffness [N/m]", slopes=slopes)
    assert labels(ax) == ["direction 1", "direction 2", "derivative of direction 1"]
    for i in (0, 1):
        ((x, y),) = drawn(ax, f"direction {i + 1}")
        np.testing.assert_array_equal(x, over)
        np.testing.assert_allclose(y, 1e6 * batch.amplitude[:, i])
        assert np.isnan(y[1]) and np.isfinite(y[[0, 2]]).all()
    for (x, y), k in zip(drawn(ax, "derivative"), range(3), strict=True):
        assert x.mean() == pytest.approx(over[k])
        if k != 1:
            assert np.diff(y) / np.diff(x) == pytest.approx(1e6 * slopes[k])
            assert y.mean() == pytest.approx(1e6 * float(batch.amplitude[k, 0]))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("stiffness [N/m]", "peak-to-peak amplitude [µm]")
    assert_whole(ax.figure, [ax, ax.get_legend()])


def test_amplitudes_take_axes_and_refuse_what_does_not_fit(batch):
    ax = Figure().add_subplot()
    assert fj.plot.amplitudes(batch, [1, 2, 3], ax, label="x") is ax
    assert labels(ax) == ["direction 1", "direction 2"]
    with pytest.raises(ValueError, match=r"over must have the shape .* got \(2,\) and \(3,\)"):
        fj.plot.amplitudes(batch, [1, 2], label="x")
    with pytest.raises(ValueError, match=r"over must have the shape .* got \(1,\) and \(\)"):
        fj.plot.amplitudes(reference_cycle(), [1], label="x")
    with pytest.raises(ValueError, match=r"slopes must have shape \(3,\), got \(2,\)"):
        fj.plot.amplitudes(batch, [1, 2, 3], label="x", slopes=[1, 2])
