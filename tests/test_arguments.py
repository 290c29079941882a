"""Every public function refuses what it cannot mean, by name and in one line."""

import inspect
import re
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj

SCENE = fj.brake_scene()
SURFACE, MATERIAL = SCENE.contact.surface, SCENE.contact.material
GAP, TABLE = dict(P=1e3, area=1e-4, L=1e-2, L_s=1e-5), ((1.0, 2.0), (1e7, 2e7))
MECHANISM = dict(m=1.0, omega_1=6e3, omega_2=5e3, xi_1=0.01, xi_2=0.01, F=5.0, V=0.1)
SLIP = dict(slip_ratio=0.2)
LIMITS = dict(at_least=1e-9, at_most=1e-3)
CALLS = {
    "surface": (fj.Surface, dict(D=2.4, G=1e-10, gamma=1.5)),
    "material": (fj.Material, dict(E=1e11, nu=0.3, sigma_y=3e8, H=9e8)),
    "pair": (fj.Material.pair, dict(E1=1e11, nu1=0.3, E2=1e11, nu2=0.3, sigma_y=3e8, H=9e8)),
    "contact": (partial(fj.FractalContact, SURFACE, MATERIAL), dict(P=1e3, stiffness_ratio=0.5)),
    "persson": (partial(fj.PerssonContact, SURFACE, MATERIAL), GAP),
    "measured": (partial(fj.MeasuredContact, *TABLE), dict(P=1e3, stiffness_ratio=0.8)),
    "fixed": (fj.FixedContact, dict(K_n=1e8, K_t=1e8)),
    "coulomb": (fj.Coulomb, dict(mu=0.3, mu_s=0.4)),
    "tabulated": (partial(fj.TabulatedFriction, [0.0, 1.0], [0.4, 0.3]), dict(mu_s=0.4)),
    "lugre": (fj.LuGre, dict(mu_s=0.4, mu_d=0.2, v_0=0.1, sigma_0=1e6, sigma_1=0.0)),
    "dahl": (fj.Dahl, dict(mu=0.3, sigma_0=1e6)),
    "rate and state": (fj.RateAndState, dict(mu_0=0.4, a=0.01, b=0.02, D_c=1e-6, v_ref=1e-3)),
    "iwan": (fj.Iwan, dict(mu=0.3, stiffness=1e8, relaxation=1e-6)),
    "stribeck": (fj.Stribeck, dict(mu_s=0.4, mu_m=0.2, v_m=0.5)),
    "oscillator": (fj.Oscillator, MECHANISM),
    "scene": (fj.Scene, vars(SCENE)),
    "state": (partial(fj.contact_state, SURFACE, MATERIAL), dict(P=1e3, mu_s=0.4, mu_m=0.2)),
    "load": (partial(fj.contact_load, SURFACE, MATERIAL), dict(A_r=1e-6, mu_m=0.2)),
    "parts": (
        partial(fj.contact_load, A_r=1e-6, mu_m=0.2),
        dict(surface=SURFACE, material=MATERIAL),
    ),
    "boundary": (
        partial(fj.boundary_element, material=MATERIAL),
        dict(heights=np.eye(3), dx=1e-6, P=1.0, rtol=1e-6),
    ),
    "run-in": (
        partial(fj.run_in, material=MATERIAL),
        dict(z=np.eye(3), dx=1e-6, pressure=1e6, depth=1e-7, steps=2, rtol=1e-6),
    ),
    "profile": (
        partial(fj.profile_parameters, np.sin(np.arange(100.0))),
        dict(dx=1e-6, cutoff=1e-5, shortest=2e-6, sections=5),
    ),
    "areal": (
        partial(fj.areal_parameters, np.outer(np.sin(np.arange(40.0)), np.arange(40.0))),
        dict(dx=1e-6, dy=1e-6, cutoff=1e-5, shortest=2e-6),
    ),
    "dimensionless": (fj.dimensionless_normal_stiffness, dict(D=2.4, A_r=1e-3, a_e=1e-5)),
    "slip": (partial(fj.dimensionless_tangential_stiffness, 2.4, 0.3, 1e-3, 1e-5), SLIP),
    "equilibrium": (partial(fj.equilibrium, SCENE.oscillator), dict(K_n=1e8, K_t=1e8, mu=0.3)),
    "replace": (SCENE.replace, dict(D=2.4, P=1e3, surface=SURFACE)),
    "roughness": (fj.constraints.Roughness, LIMITS | dict(L=1e-3, L_s=1e-6)),
    "Ra": (fj.constraints.Ra, LIMITS | dict(cutoff=8e-4, shortest=2.5e-6, L=1e-3, L_s=1e-6)),
    "frequency": (fj.constraints.Frequency, LIMITS | dict(friction_slope=True)),
    "damping": (fj.constraints.DampingRatio, dict(at_least=0.1, friction_slope=True)),
    "amplitude": (fj.constraints.CycleAmplitude, dict(at_most=1e-6)),
    "envelope": (fj.Envelope, dict(ranges={"P": (1.0, 2.0)}, samples={"V": (1.0, 2.0)})),
}
NEVER = [True, np.True_, jnp.array(True), "1", b"1", 1j, np.array(["1"]), [1.0], (1, 2), object()]
NEVER += [np.ma.masked, np.nan, np.inf, -np.inf, np.array([np.nan]), SCENE, 10**400, 10**5000]


def takes(name, argument, value) -> bool:
    """The few that are right after all."""
    if argument in ("friction_slope", "preload"):
        return isinstance(value, (bool, np.bool_))
    return (name, argument) == ("dimensionless", "a_e") and value is np.inf


@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_number_or_part_is_refused_by_name(name):
    call, given = CALLS[name]
    for argument in given:
        for bad in NEVER:
            if takes(name, argument, bad):
                call(**given | {argument: bad})
                continue
            with pytest.raises((TypeError, ValueError)) as refused:
                call(**given | {argument: bad})
            message = str(refused.value)
            assert argument.split("_")[0] in message or name in message, (argument, bad, message)
            assert len(message) < 250 and "\n" not in message, message


def test_arguments_of_the_margin_structures_and_the_boundary():
    """`margin(scene, False)` means the third argument, not the second."""
    for bad in (False, np.False_, jnp.array(True), 1j):
        with pytest.raises(TypeError, match=r"^shift must be a real number"):
            fj.margin(SCENE, bad)
    with pytest.raises(TypeError, match=r"must be a Scene, got"):
        fj.stiffness(fj.Structure.from_scene(SCENE))  # pyright: ignore[reportArgumentType]
    neither: Any = SURFACE
    with pytest.raises(TypeError, match=r"must be a Scene or a Structure, got"):
        fj.hopf_boundary(neither, ("mu", 0.1, 0.5), ("P", 1.0, 2.0))
    bad: Any
    for bad in (1, np.nan, 10**30, 2.5, "9", None):
        with pytest.raises(ValueError, match=r"^lines must be a whole number"):
            fj.hopf_boundary(SCENE, ("mu", 0.1, 0.5), ("P", 1.0, 2.0), lines=bad)


@pytest.mark.parametrize(
    "function", [fj.margin, fj.critical_friction, fj.stiffness, fj.growth_rate, fj.stability]
)
@pytest.mark.parametrize("bad", [SURFACE, None, 1.0])
def test_a_scene_is_asked_for_by_name(function, bad):
    with pytest.raises(TypeError, match=r"must be a Scene.*, got"):
        function(bad)


FUNCTIONS = [
    function
    for module in (fj, fj.plot)
    for name in module.__all__
    if inspect.isroutine(function := inspect.unwrap(getattr(module, name)))
]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_each_parameter_is_documented_by_itself(function):
    """In a list, `- name`: several that mean the same thing may share an item."""
    heads = re.findall(r"^ *- ((?:`\w+`,?\s*)+)", function.__doc__ or "", re.MULTILINE)
    listed = set(re.findall(r"\w+", " ".join(heads)))
    assert set(inspect.signature(function).parameters) <= listed
