"""Every public program as a function of one number, traced: what an accelerator would run.

Each checks its number, as user code does under `jit`. An invalid one is beside it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj

BRAKE = fj.brake_scene()
SURFACE, MATERIAL = BRAKE.contact.surface, BRAKE.contact.material
STRUCTURE = fj.Structure.from_scene(BRAKE)
START = [1e-5, 0.0, 0.0, 0.0]
FORCE = fj.Excitation({"x1": 20.0}, frequency=2500.0)
LAWS = {
    "fractal": BRAKE.contact,
    "asperity": fj.AsperityContact(SURFACE, MATERIAL, 1907.3, L_s=1e-6),
    "persson": fj.PerssonContact(SURFACE, MATERIAL, 1907.3, area=1e-4, L=1e-3, L_s=1e-6, Q=100.0),
    "measured": fj.MeasuredContact([100.0, 1e3, 1e4], [1e7, 1e8, 3e8], 1907.3, 0.5),
}
FIXED = BRAKE.replace(contact=fj.FixedContact(4e8, 2e8))
PRESSED = fj.Scene(LAWS["persson"], BRAKE.friction, BRAKE.oscillator, preload=True)


class Program(NamedTuple):
    """What is traced, and what it is called with."""

    function: Callable[[Any], Any]
    value: float
    invalid: float
    slow: bool = False  # to trace and lower


def of(measure: Callable[[Any], Any], x: Any = BRAKE, slow: bool = False) -> Program:
    """A measure of a scene or structure, by its D."""
    return Program(lambda D: measure(x.replace(D=D)), 2.4, 3.5, slow)


def slope(measure: Callable[[Any], Any], x: Any = BRAKE, slow: bool = False) -> Program:
    """Its derivatives, in both modes."""
    function = of(measure, x).function
    return Program(lambda D: (jax.jacfwd(function)(D), jax.jacrev(function)(D)), 2.4, 3.5, slow)


def _ground(Sq):
    return fj.SelfAffine(Sq, 0.8, 1e-4, 1e-5, lay=3.0)


def _joint(law):
    return lambda P: fj.stiffness(BRAKE.replace(contact=law, P=P))


BOUNDS = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}


def _designs(P):
    """Two designs of several starts, and what they must meet."""
    xs = BRAKE.replace(P=P * jnp.array([1.0, 1.1]))
    found = fj.design_many(xs, BOUNDS, starts=2, lattice=8, progress=False)
    return found.quantities, found.value, found.growth_rate, found.residuals


def _problem(P):
    """Loss and residuals of a problem, and their slopes."""
    problem = fj.DesignProblem(BRAKE.replace(P=P), BOUNDS, fj.growth_rate)
    slopes = jax.jacrev(problem.loss)(problem.start), jax.jacfwd(problem.residuals)(problem.start)
    return problem.loss(problem.start), problem.residuals(problem.start), slopes


def _batch(measure, x: Any = BRAKE):
    return lambda D: jax.vmap(lambda D: measure(x.replace(D=D)))(D * jnp.ones(3))


def _heights(D):
    surface = fj.Surface(D, 1.342e-10)
    return fj.topography(surface, 1e-3, 16, key=jax.random.key(0), L_s=1e-4)


def _pressed(**options):
    return lambda D: fj.boundary_element(_heights(D), 1e-3 / 16, MATERIAL, 50.0, **options)


def _worn(D):
    worn = fj.run_in(_heights(D), 1e-3 / 16, MATERIAL, 5e7, 1e-8, steps=2)
    return worn.heights, worn.pressure


def _cycle(**options):
    return lambda x: fj.limit_cycle(x, **options)


def _motion(**options):
    return lambda x: fj.simulate(x, START, 1e-4, max_steps=64, **options)


GAP = LAWS["persson"]
PROGRAMS: dict[str, Program] = {
    "design_many": Program(_designs, 1907.3, -1.0, slow=True),
    "DesignProblem": Program(_problem, 1907.3, -1.0, slow=True),
    "replace": of(lambda x: x),
    "replace of a structure": of(lambda x: x, STRUCTURE),
    "replace of the matrices": Program(
        lambda m: STRUCTURE.replace(M=m * jnp.eye(2)).sums["M"], 1.0, -1.0
    ),
    "Structure.from_scene": of(fj.Structure.from_scene),
    **{f"stiffness, {name}": Program(_joint(law), 1907.3, -1.0) for name, law in LAWS.items()},
    "stiffness, fixed": Program(lambda K_n: fj.stiffness(FIXED.replace(K_n=K_n)), 4e8, -1.0),
    "stiffness, spectrum with a lay": Program(
        lambda Sq: fj.PerssonContact(_ground(Sq), MATERIAL, 1e3, 1e-6).stiffness(0.4, 0.25),
        1e-6,
        -1.0,
    ),
    "spectral_moments": Program(lambda Sq: fj.spectral_moments(_ground(Sq)), 1e-6, -1.0),
    "profile_parameters of a spectrum": Program(
        lambda Sq: fj.profile_parameters(_ground(Sq), cutoff=8e-4, shortest=2e-5), 1e-6, -1.0
    ),
    "areal_parameters of a surface": Program(
        lambda D: fj.areal_parameters(fj.Surface(D, 1e-10), cutoff=8e-4, L=1e-3, L_s=1e-6),
        2.4,
        3.5,
    ),
    "topography of a spectrum": Program(
        lambda Sq: fj.topography(_ground(Sq), 1e-3, 16, key=jax.random.key(0)), 1e-6, -1.0
    ),
    "contact_state": of(
        lambda x: fj.contact_state(x.contact.surface, MATERIAL, 1907.3, mu_s=0.4, mu_m=0.25)
    ),
    "contact_load": Program(
        lambda A_r: fj.contact_load(SURFACE, MATERIAL, A_r, mu_m=0.25), 1e-6, -1.0
    ),
    "dimensionless stiffness": Program(
        lambda D: fj.dimensionless_normal_stiffness(D, 1e-3, 1e-5), 2.4, 3.5
    ),
    "load curve": Program(lambda u: GAP.load(jnp.array([0.0, 1.0]) * u), 1e-8, jnp.inf),
    "roughness": Program(lambda D: fj.roughness(fj.Surface(D, 1e-10), 1e-3, 1e-6), 2.4, 3.5),
    "topography": Program(_heights, 2.4, 3.5),
    "boundary_element": Program(_pressed(), 2.4, 3.5),
    "boundary_element, plastic": Program(_pressed(plastic=True), 2.4, 3.5),
    "boundary_element, slope": Program(jax.jacrev(lambda D: _pressed()(D).mean_gap), 2.4, 3.5),
    "run_in": Program(_worn, 2.4, 3.5),
    "run_in, slope": Program(jax.jacrev(lambda D: _worn(D)[0].std()), 2.4, 3.5),
    "growth_rate": of(fj.growth_rate),
    "growth_rate, friction by a table": of(
        fj.growth_rate,
        BRAKE.replace(friction=fj.TabulatedFriction([0.0, 0.1, 1.0], [0.4, 0.3, 0.25], 0.5)),
    ),
    "growth_rate of a structure": of(fj.growth_rate, STRUCTURE),
    "growth_rate, pressed": of(fj.growth_rate, PRESSED, slow=True),
    "growth_rate, slope": slope(fj.growth_rate),
    "growth_rate of a structure, slope": slope(fj.growth_rate, STRUCTURE, slow=True),
    "growth_rate, batch": Program(_batch(fj.growth_rate), 2.4, 3.5),
    "growth_rate of structures, batch": Program(_batch(fj.growth_rate, STRUCTURE), 2.4, 3.5),
    "stability": of(fj.stability),
    "stability of a structure": of(fj.stability, STRUCTURE),
    "margin": of(fj.margin),
    "margin of a structure": of(fj.margin, STRUCTURE),
    "critical_friction": of(fj.critical_friction),
    "critical_friction of a structure": of(fj.critical_friction, STRUCTURE),
    "critical_friction, slope": slope(fj.critical_friction, slow=True),
    "assemble": of(fj.assemble, STRUCTURE),
    "modal_damping": Program(
        lambda k: fj.modal_damping(np.eye(2), k * np.eye(2), 0.1), 1.0, np.inf
    ),
    "simulate": of(_motion()),
    "simulate at times": of(_motion(saveat=[1e-5, 1e-4], t0=1e-6), slow=True),
    "simulate a structure": of(_motion(excitation=FORCE), STRUCTURE, slow=True),
    "simulate, slope": slope(lambda x: _motion()(x).end, slow=True),
    "simulate, regularised": of(_motion(regularisation=0.01), slow=True),
    "limit_cycle": of(_cycle()),
    "limit_cycle, slope": slope(lambda x: fj.limit_cycle(x).amplitude, slow=True),
    "limit_cycle of a structure": of(_cycle(), STRUCTURE, slow=True),
    "limit_cycle, pressed": of(_cycle(), PRESSED, slow=True),
    "limit_cycle, excited": of(_cycle(excitation=FORCE), slow=True),
    "limit_cycle, regularised": of(_cycle(regularisation=0.01), slow=True),
    "limit_cycle, batch": Program(_batch(_cycle()), 2.4, 3.5, slow=True),
}
