"""The page of the limit cycle, run small; its errors are held, not its times."""

import numpy as np
import pytest

from benchmarks.cycles import (
    gradients as cycle_gradients,
    limit_cycle,
    methods as cycle_methods,
    transients,
)
from benchmarks.cycles.reference import AMPLITUDE, PERIOD, SLOPES, relative
from benchmarks.page import versions
from tools import quick_benchmark

LAW = transients.law()


def errors(found: transients.Extremes) -> tuple[float, float]:
    period, amplitude = transients.last_turn(LAW, found)
    return relative(period, PERIOD), relative(amplitude, AMPLITUDE)


def scipy_errors(share: float, periods: int) -> tuple[float, float]:
    return errors(transients.scipy_run(LAW, share, "LSODA", 1e-8, periods)())


@pytest.mark.slow  # compiles with numba
def test_every_integrator_solves_the_same_law():
    """Shorter than a cycle needs: what they read agrees to what their tolerance lets pass."""
    program, _ = transients.diffrax_program("Tsit5")
    runs = {
        "SciPy": transients.scipy_run(LAW, 1e-2, "LSODA", 1e-10, 6),
        "diffrax": transients.diffrax_run(program, LAW, 1e-2, 1e-10, 6),
    }
    if "numbalsoda" in versions("numbalsoda"):
        runs["numbalsoda"] = transients.numbalsoda_run(LAW, 1e-2, "LSODA", 1e-10, 6)
    if "heyoka" in versions("heyoka"):
        runs["heyoka"] = transients.heyoka_run(LAW, 1e-2, 1e-12, 6)
    read = {name: transients.last_turn(LAW, run()) for name, run in runs.items()}
    for found in read.values():
        np.testing.assert_allclose(found, read["SciPy"], rtol=1e-6)


def test_extremes_are_read_to_more_digits_than_the_floors_have():
    """Of a sine."""
    t = np.linspace(0, 20, 401)
    found, values = transients.extremes_of(t, np.sin(t), np.cos(t), -np.sin(t))
    np.testing.assert_allclose(found, np.pi * (0.5 + np.arange(len(found))), atol=1e-7)
    np.testing.assert_allclose(np.abs(values), 1, atol=1e-8)


def test_transient_is_over_where_it_is_read():
    """Half as many periods again move the error by less than a fifth of the floor."""
    periods = transients.PERIODS[1e-2]
    short, long = (np.array(scipy_errors(1e-2, n)) for n in (periods, 3 * periods // 2))
    assert np.all(np.abs(short - long) < 0.2 * long)


def test_gradients_are_compared_in_the_order_in_which_they_are_given():
    truth = np.array(list(SLOPES.values())).T
    assert truth.shape == (2, 3) and not cycle_gradients.errors(truth).any()
    found = cycle_gradients.differences(lambda place: truth @ place, 1e-3)()
    np.testing.assert_allclose(found, truth, rtol=1e-9)


def test_ratio_is_to_the_quickest_peer_that_is_as_accurate():
    rows = [
        cycle_methods.row(cycle_methods.OWN, "coarse", times=[1.0], seconds=1.0),
        cycle_methods.row(cycle_methods.OWN, "fine", times=[2.0, 4.0], seconds=3.0),
        cycle_methods.row(cycle_methods.EVENTS, "short", times=[5.0], seconds=5.0),
        cycle_methods.row(cycle_methods.EVENTS, "long", times=[8.0, 12.0], seconds=10.0),
        cycle_methods.row(cycle_methods.EVENTS, "longer", times=[9.0, 14.0], seconds=11.5),
    ]
    for found, error in zip(rows, (1e-8, 1e-10, 1e-8, 1e-10, 1e-11), strict=True):
        found |= {"period": error, "amplitude": error}
    (head,) = limit_cycle.headline(rows)
    assert head["ratio"] == 3.5 and "fine" in head["what"] and head["what"].endswith("long")


@pytest.mark.slow  # compiles limit cycles
def test_page_lists_every_method_with_its_errors(tmp_path):
    numbers, page = quick_benchmark("limit_cycle", tmp_path)
    groups = {found["group"] for found in numbers["methods"]}
    assert groups >= {"fractaljax, exact", "SciPy LSODA", "diffrax Tsit5"}
    assert bool(numbers["headline"]) == ("heyoka" not in numbers["not_installed"])
    for name in numbers["not_installed"]:
        assert f"Not installed: {', '.join(numbers['not_installed'])}" in page and name in page
    for found in numbers["methods"]:
        assert f"| {found['group']} | {found['setting']}" in page
        assert found["seconds"] > 0
        bound = 1e-9 if "exact" in found["group"] else 1e-2
        assert max(found["period"], found["amplitude"]) < bound


@pytest.mark.slow  # compiles limit cycles in both modes
def test_gradients_have_nine_digits_in_both_modes():
    value, forward, reverse, *others = cycle_gradients.measure()
    assert value["errors"] is None
    assert np.max(forward["errors"]) < 5e-9 and np.max(reverse["errors"]) < 5e-9
    for found in others:
        assert np.max(found["errors"]) < 1e-5
    section = "\n".join(cycle_gradients.section([value, forward, reverse, *others]))
    assert all(f"| {found['name']} |" in section for found in others)
