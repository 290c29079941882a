"""Public functions compiled as users compile them, beside what other tests compile.

Most tests leave optimisation out. Here every public function gives the same numbers with it.
"""

import functools
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest

import fractaljax as fj
from mechanisms import PROBLEMS
from programs import BRAKE, MATERIAL, PRESSED, STRUCTURE, SURFACE
from structures import of_problem, two_joints
from synthetic import DX, gaussian_profile, rough
from tools import ROOT

pytestmark = pytest.mark.optimised

# What computes nothing, or only draws, reads and stores.
NO_NUMBERS = {"quantity", "read_measurement", "read_matrices", "load", "save"}
NO_NUMBERS |= {"brake_scene", "explore", "repeat_design"}
QUIET: dict[str, Any] = {"progress": False}
NEAR = {"D": (2.39, 2.41)}
WINDOW = {"x": ("D", 2.35, 2.45), "y": ("mu", 0.3, 0.4), "lines": 4}
FRICTION = {"mu_s": 0.4, "mu_m": 0.25}
# x'' + 0.1 x' + x = mu(w), mu_s 1, mu_d 0.5, v_0 0.5
BELT = of_problem(PROBLEMS["papangelo_2017"])
M, K = np.eye(2), np.array([[2.0, -0.3], [-0.3, 1.5]])


def cycle_numbers() -> list[Any]:
    cycle = fj.limit_cycle(BRAKE)
    return [cycle.period, cycle.amplitude, cycle.velocity_max, cycle.tension_fraction]


def design_numbers() -> list[Any]:
    bounds = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}
    found = fj.design_many(BRAKE.replace(P=np.array([1500.0, 1907.3])), bounds, **QUIET)
    problem = fj.DesignProblem(BRAKE, bounds)
    u = np.array([0.3, 0.5])
    return [found.D, found.value, problem.loss(u), *problem.residuals(u)]


@functools.cache
def branch() -> fj.Branch:
    return fj.continue_cycle(BELT, "V", (0.5, 2.5), "hopf")


def reduced() -> fj.ReducedStructure:
    return fj.reduce(two_joints(6), {}, (0.0, 1e5), tol=1e-6)


def trend(D) -> Any:
    return fj.growth_rate(BRAKE.replace(D=D))


CALLS: dict[str, Callable[[], Any]] = {
    "areal_parameters": lambda: fj.areal_parameters(
        rough((48, 40)), 1e-6, cutoff=2e-5, shortest=4e-6
    ),
    "assemble": lambda: fj.assemble(STRUCTURE),
    "attractors": lambda: [cycle.period for cycle in fj.attractors(BRAKE)],
    "basin": lambda: [*fj.basin(BRAKE, radius=1.0, starts=2, **QUIET).shares.values()],
    "bifurcation_map": lambda: (
        fj.bifurcation_map(
            BELT, ("V", 0.9, 1.3), ("mu_s", 0.9, 1.1), radius=1.0, starts=2, lines=2, **QUIET
        )
        .boundary.branches[0]
        .x
    ),
    "boundary_element": lambda: fj.boundary_element(rough((16, 16)), 1e-5, MATERIAL, 50.0).K_n,
    "compare_laws": lambda: (
        fj.compare_laws(
            SURFACE, MATERIAL, [1e3, 2e3], area=1e-4, L=1e-3, L_s=1.3e-4, n=16, seeds=1, **QUIET
        )
        .curves["Persson"]
        .K_n
    ),
    "contact_load": lambda: fj.contact_load(SURFACE, MATERIAL, 1e-8, mu_m=0.25),
    "contact_state": lambda: fj.contact_state(SURFACE, MATERIAL, 1907.3, **FRICTION).K_n,
    "continue_cycle": lambda: [branch().period, branch().amplitude],
    "continue_event": lambda: fj.continue_event(BELT, branch().grazings[0], "mu_s", (0.95, 1.05)).x,
    "critical_friction": lambda: fj.critical_friction(BRAKE),
    "design": lambda: fj.design(BRAKE, NEAR, starts=1, **QUIET).value,
    "design_many": design_numbers,
    "dimensionless_normal_stiffness": lambda: fj.dimensionless_normal_stiffness(2.4, 1e-2, 1e-3),
    "dimensionless_tangential_stiffness": lambda: fj.dimensionless_tangential_stiffness(
        2.4, 0.3, 1e-2, 1e-3, 0.2
    ),
    "energy_shares": lambda: fj.energy_shares(STRUCTURE).strain,
    "equilibrium": lambda: fj.equilibrium(BRAKE.oscillator, 4e8, 2e8, 0.3),
    "growth_rate": lambda: [jax.value_and_grad(trend)(2.4), jax.jit(jax.hessian(trend))(2.4)],
    "hopf_boundary": lambda: [x.x for x in fj.hopf_boundary(BRAKE, **WINDOW).branches],
    "identify": lambda: fj.identify(gaussian_profile(np.random.default_rng(1)), DX).D,
    "limit_cycle": cycle_numbers,
    "margin": lambda: fj.margin(BRAKE),
    "modal_damping": lambda: fj.modal_damping(M, K, 0.01),
    "pareto": lambda: (
        fj.pareto(
            BRAKE,
            fj.growth_rate,
            lambda x: fj.stiffness(x)[0],
            bounds=NEAR,
            target=80.0,
            points=3,
            **QUIET,
        ).first
    ),
    "prepare_measurement": lambda: fj.prepare_measurement(rough((48, 40)), 1e-6).z[::9, ::9],
    "profile_parameters": lambda: fj.profile_parameters(
        rough((600, 2))[:, 0], 1e-6, cutoff=1e-4, shortest=4e-6
    ),
    "rayleigh_damping": lambda: fj.rayleigh_damping(M, K, 0.1, 0.2),
    "reduce": lambda: fj.growth_rate(reduced()),
    "reduction_errors": lambda: fj.reduction_errors(reduced()).max() < 1e-6,
    "roughness": lambda: fj.roughness(SURFACE, 1e-3, 1e-6).Sq,
    "run_in": lambda: fj.run_in(rough((16, 16)), 1e-6, MATERIAL, 1e8, 1e-8).heights,
    "simulate": lambda: fj.simulate(BRAKE, [1e-5, 0.0, 0.0, 0.0], 1e-3).end,
    "spectral_moments": lambda: fj.spectral_moments(fj.SelfAffine(1e-6, 0.8, 1e-4, 1e-5)).m4,
    "pool_surfaces": lambda: (
        fj.pool_surfaces(
            [fj.identify(gaussian_profile(np.random.default_rng(i)), DX) for i in (1, 2)]
        ).covariance
    ),
    "specify_surface": lambda: fj.specify_surface(Ra=4e-7, scatter=0.15).covariance,
    "spectrum_of": lambda: fj.roughness(fj.spectrum_of(rough((64, 64)), 1e-6)).Sdq,
    "squeal_probability": lambda: fj.squeal_probability(BRAKE, {"D": 0.01}, samples=64).value,
    "stability": lambda: fj.stability(PRESSED).eigenvalues,
    "stiffness": lambda: fj.stiffness(BRAKE),
    "suggest": lambda: [x for x in fj.suggest(BRAKE, NEAR).values.values() if x is not None],
    "sweep": lambda: fj.sweep(fj.growth_rate, BRAKE, D=[2.4, 2.41], **QUIET).values,
    "topography": lambda: fj.topography(SURFACE, 1e-3, 16, key=jax.random.key(0), L_s=1e-4),
    "track_modes": lambda: fj.track_modes(STRUCTURE, "D", [2.4, 2.41]).eigenvalues,
    "validate": lambda: [
        check.ours for check in fj.validate("reference", **QUIET).cases["reference"]
    ],
    "verdict": lambda: [float(question.quiet) for question in fj.verdict(BRAKE, **QUIET).questions],
}


LONG = {"attractors", "bifurcation_map", "design_many", "limit_cycle", "pareto"}


def numbers(name: str) -> list[float]:
    """What a call gives, as real numbers."""
    leaves = [np.ravel(x) for x in jax.tree.leaves(CALLS[name]())]
    return [float(x) for leaf in leaves for part in (np.real(leaf), np.imag(leaf)) for x in part]


@functools.cache
def unoptimised(names: tuple[str, ...]) -> dict[str, list[float]]:
    """The numbers of these calls, by JAX's own switch without optimisation, in another process."""
    run = subprocess.run(
        [sys.executable, __file__, *names],
        env=os.environ
        | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "JAX_ENABLE_X64": "1"}
        | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


def test_every_public_function_is_here():
    functions = {name for name in dir(fj) if inspect.isroutine(getattr(fj, name))}
    assert {*CALLS} == functions - NO_NUMBERS


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in CALLS]
)
def test_optimisation_changes_no_number(name, request):
    test = request.node.nodeid.partition("[")[0]
    asked = [x for x in request.session.items if x.nodeid.partition("[")[0] == test]
    found = numbers(name)
    without = unoptimised(tuple(each.callspec.params["name"] for each in asked))
    np.testing.assert_allclose(found, without[name], rtol=1e-6, atol=1e-300)


if __name__ == "__main__":
    print(json.dumps({name: numbers(name) for name in sys.argv[1:]}))
