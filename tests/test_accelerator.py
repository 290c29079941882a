"""What a GPU would run: it lowers for CUDA, and nowhere calls back to the host."""

import functools
import inspect
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import fractaljax as fj
from fractaljax._design import rows
from fractaljax._dynamics import basin, itinerary
from fractaljax._dynamics.limit_cycle import scale_problem
from fractaljax._stability import boundary, tracks
from fractaljax._sweep import batches
from mechanisms import PROBLEMS
from programs import BRAKE, FORCE, PRESSED, PROGRAMS, STRUCTURE, of
from structures import of_problem
from tools import primitives

# Calls of libraries of NVIDIA's, which stay on the device.
ON_DEVICE = {
    "cu_lu_pivots_to_permutation",
    "cublas_trsm_ffi",
    "cusolver_getrf_ffi",
    "cusolver_potrf_ffi",
    "cusolver_syevd_ffi",
    "cu_threefry2x32_ffi",
}
# LAPACK on the host: JAX has left eigenvectors nowhere else. The one round trip, of structures.
EIG = "cuhybrid_eig_real"


def slowly(name):
    return pytest.param(name, marks=[pytest.mark.slow] if PROGRAMS[name].slow else [])


def called(jitted: Any, *arguments: Any) -> set[str]:
    """What a program calls that XLA does not compile, on CUDA; refuses callbacks.

    Nothing is compiled, so that no GPU is needed.
    """
    jaxpr = jitted.trace(*arguments).jaxpr.jaxpr
    assert not [name for name in primitives(jaxpr) if "callback" in name or "feed" in name]
    unchecked = [export.DisabledSafetyCheck.custom_call(name) for name in (EIG, *ON_DEVICE)]
    lowered = export.export(jitted, platforms=["cuda"], disabled_checks=unchecked)(*arguments)
    assert all(x.dtype.itemsize != 4 or x.dtype.kind not in "fc" for x in lowered.out_avals)
    found = set(re.findall(r"custom_call @([\w.]+)", lowered.mlir_module()))
    return {name for name in found if not name.startswith("mhlo.")}  # operations of XLA's own


@functools.cache
def jitted(name):
    """Traced once for all tests."""
    return jax.jit((PROGRAMS | SYSTEMS)[name].function)


@pytest.mark.parametrize("name", [slowly(name) for name in PROGRAMS])
def test_public_programs_lower_for_cuda(name):
    """In float64, without a callback; only eigenvalues of structures are found on the host."""
    found = called(jitted(name), jnp.asarray(PROGRAMS[name].value, float))
    assert found - {EIG} <= ON_DEVICE
    assert EIG not in found or "structure" in name or "batch" in name


# Each compiles the search again, whose NaN the other cycles show; here what it is given has it.
SYSTEMS = {
    "limit_cycle, pressed": of(lambda x: scale_problem(x, None), PRESSED),
    "limit_cycle, excited": of(lambda x: scale_problem(x, FORCE)),
    "limit_cycle of a structure": of(lambda x: scale_problem(x, None), STRUCTURE),
}
SEARCHED = [name for name in PROGRAMS if name not in (*SYSTEMS, "limit_cycle, batch")]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SEARCHED, *SYSTEMS])
def test_what_is_invalid_is_nan(name):
    """Never a number that one could believe; the same program gives numbers for what is valid."""
    program, compiled = (PROGRAMS | SYSTEMS)[name], jitted(name)
    values = program.value, program.value * (1 + 1e-6), program.invalid
    good, moved, bad = (compiled(jnp.asarray(x, float)) for x in values)
    leaves = [[np.asarray(x) for x in jax.tree.leaves(tree)] for tree in (good, moved, bad)]
    depending = 0
    for one, other, refused in zip(*leaves, strict=True):
        if one.dtype.kind in "fc" and (one != other).any():
            depending += 1
            assert np.isnan(refused[one != other]).all()
    assert depending


def recorded(monkeypatch, module, *names):
    """Calls of jitted functions of a module from here on: the functions with their arguments."""
    calls = []
    for name in names:
        jitted = getattr(module, name)

        def call(*arguments, jitted=jitted):
            calls.append((jitted, arguments))
            return jitted(*arguments)

        monkeypatch.setattr(module, name, call)
    return calls


KICKS: dict[str, Any] = {"radius": 1.0, "starts": 2, "progress": False}
WINDOW = {"x": ("D", 2.35, 2.45), "y": ("mu", 0.3, 0.4), "lines": 4}
DRIVERS = {
    "sweep": (batches, ["_batch"], lambda: fj.sweep(fj.growth_rate, BRAKE, None, False, D=[2.4])),
    "design": (
        rows,
        ["linearised"],
        lambda: fj.design(BRAKE, {"D": (2.39, 2.41)}, starts=1, progress=False),
    ),
    "basin": (basin, ["_start_lanes", "_run"], lambda: fj.basin(BRAKE, **KICKS)),
    "track_modes": (tracks, ["_states"], lambda: fj.track_modes(STRUCTURE, "D", [2.4, 2.41])),
    "hopf_boundary": (boundary, ["_evaluate", "_tests"], lambda: fj.hopf_boundary(BRAKE, **WINDOW)),
    "continue_cycle": (
        itinerary,
        ["condensed", "lowest"],
        lambda: fj.continue_cycle(of_problem(PROBLEMS["papangelo_2017"]), "V", (1.0, 1.1)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVERS)
def test_programs_inside_of_drivers_lower_for_cuda(monkeypatch, name):
    """What Python loops call again and again: one of each."""
    module, names, run = DRIVERS[name]
    calls = recorded(monkeypatch, module, *names)
    run()
    seen = {}
    for jitted, arguments in calls:
        seen.setdefault(jitted, arguments)
    assert len(seen) == len(names)
    for jitted, arguments in seen.items():
        jitted = inspect.unwrap(jitted, stop=lambda function: hasattr(function, "trace"))
        assert called(jitted, *arguments) - {EIG} <= ON_DEVICE


def test_the_test_sees_a_callback():
    """One that does nothing counts: at it a GPU stops."""

    def program(x):
        return jax.pure_callback(lambda x: x, jax.ShapeDtypeStruct((), float), x)

    with pytest.raises(AssertionError, match="pure_callback"):
        called(jax.jit(lambda x: jax.lax.cond(x > 0, program, jnp.sin, x)), jnp.asarray(1.0))
