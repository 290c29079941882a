"""A scene without a part costs less than the scene with it."""

from typing import Any

import jax
import pytest

from benchmarks.scene_cost import BY_NAME, ROWS, cost, in_a_process, operations, traced

EDGES = [(row.without, row.name) for row in ROWS if row.without]
COUNTS = "operations", "flops", "bytes_accessed"


def test_every_row_but_the_first_says_what_it_goes_beyond():
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names)
    assert [row.name for row in ROWS if row.without is None] == names[:1]
    for without, name in EDGES:
        assert names.index(without) < names.index(name)


def test_operations_inside_loops_and_calls_are_counted():
    def function(x):
        return jax.lax.fori_loop(0, 3, lambda i, x: jax.jit(lambda x: x * x + 1)(x), x)

    found = operations(jax.make_jaxpr(function)(1.0).jaxpr)
    assert (found["mul"], found["add"]) == (1, 2)  # the second add counts the turns


def held(rows, measured: Any, counts):
    for row in rows:
        if row.without:
            for count in counts:
                # What the compiler fuses moves the bytes by a little.
                slack = 1.01 if count == "bytes_accessed" else 1
                less, more = (measured(name)[count] for name in (row.without, row.name))
                assert less < slack * more, (row.name, count)


def test_the_row_without_a_part_is_the_cheaper_one():
    """In the operations that are traced; compiled below."""
    found = {
        row.name: {"operations": operations(traced(row)[0].jaxpr.jaxpr).total()}
        for row in ROWS
        if row.quick
    }
    held([row for row in ROWS if row.quick], found.get, ["operations"])


@pytest.mark.slow  # compiles limit cycles and their gradients, minutes
def test_the_row_without_a_part_is_the_cheaper_one_when_compiled():
    found = {row.name: cost(row, repeats=1) for row in ROWS}
    held(ROWS, found.get, COUNTS)


@pytest.mark.slow  # starts Python
def test_stability_loads_no_library_of_motion_design_or_pictures():
    found = in_a_process(BY_NAME["growth rate with gradient by D, G"], 1)
    assert found["heavy_modules"] == []
    assert min(found["run_s"], found["compile_s"]) > 0
