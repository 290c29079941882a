"""Every public function refuses what it cannot mean, by name and in one line."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.base.parts import brief, flag, whole

SCENE = fj.brake_scene()
SURFACE, MATERIAL = SCENE.contact.surface, SCENE.contact.material
MECHANISM = dict(m=1.0, omega_1=6e3, omega_2=5e3, xi_1=0.01, xi_2=0.01, F=5.0, V=0.1)
LIMITS = dict(at_least=1e-9, at_most=1e-3)
CALLS = {
    "surface": (fj.Surface, dict(D=2.4, G=1e-10, gamma=1.5)),
    "material": (fj.Material, dict(E=1e11, nu=0.3, sigma_y=3e8, H=9e8)),
    "pair": (fj.Material.pair, dict(E1=1e11, nu1=0.3, E2=1e11, nu2=0.3, sigma_y=3e8, H=9e8)),
    "contact": (
        lambda **x: fj.FractalContact(SURFACE, MATERIAL, **x),
        dict(P=1e3, stiffness_ratio=0.5),
    ),
    "fixed": (fj.FixedContact, dict(K_n=1e8, K_t=1e8)),
    "coulomb": (fj.Coulomb, dict(mu=0.3)),
    "stribeck": (fj.Stribeck, dict(mu_s=0.4, mu_m=0.2, v_m=0.5)),
    "oscillator": (fj.Oscillator, MECHANISM),
    "scene": (fj.Scene, vars(SCENE)),
    "state": (
        lambda **x: fj.contact_state(SURFACE, MATERIAL, **x),
        dict(P=1e3, mu_s=0.4, mu_m=0.2),
    ),
    "load": (lambda **x: fj.contact_load(SURFACE, MATERIAL, **x), dict(A_r=1e-6, mu_m=0.2)),
    "parts": (
        lambda **x: fj.contact_load(**x, A_r=1e-6, mu_m=0.2),
        dict(surface=SURFACE, material=MATERIAL),
    ),
    "dimensionless": (fj.dimensionless_normal_stiffness, dict(D=2.4, A_r=1e-3, a_e=1e-5)),
    "equilibrium": (
        lambda **x: fj.equilibrium(SCENE.oscillator, **x),
        dict(K_n=1e8, K_t=1e8, mu=0.3),
    ),
    "replace": (SCENE.replace, dict(D=2.4, P=1e3, surface=SURFACE)),
    "roughness": (lambda **x: fj.constraints.Roughness(**x), LIMITS | dict(L=1e-3, L_s=1e-6)),
    "frequency": (fj.constraints.Frequency, LIMITS | dict(friction_slope=True)),
    "damping": (fj.constraints.DampingRatio, dict(at_least=0.1, friction_slope=True)),
    "envelope": (fj.Envelope, dict(ranges={"P": (1.0, 2.0)}, samples={"V": (1.0, 2.0)})),
}
NEVER = [True, np.True_, jnp.array(True), "1", b"1", 1j, np.array(["1"]), [1.0], (1, 2), object()]
NEVER += [np.ma.masked, np.nan, np.inf, -np.inf, np.array([np.nan]), SCENE, 10**400, 10**5000]


def takes(name, argument, value) -> bool:
    """The few that are right after all."""
    if argument == "friction_slope":
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


DESIGN = {
    "scene": [None, 1, SURFACE, SCENE.replace(contact=fj.FixedContact(1e8, 1e8))],
    "bounds": [1, [], {}, {"P": (1, 2)}, {1: 2}, {"D": 2.4}, {"D": (2.3,)}, {"D": (2.5, 2.3)}],
    "objective": [1, "growth_rate"],
    "target": [np.nan, "0", True, [1.0], np.array([1.0])],
    "K_n_min": [-1.0, np.inf, np.array([1.0, 2.0])],
    "constraints": [1, fj.growth_rate, [1], {"a": 1}],
    "envelope": [1, {}, {"P": 1.0}, {"P": (2.0, 1.0)}, {"P": (1.0, np.inf)}, {"Q": (1, 2)}],
    "risk": [1, "best", ("cvar",), ("cvar", 1.0), ("worst", 1), (1, 2, 3)],
    "tolerance": [1, 0, False, [], {}, {"D": -1}, {"D": "1"}, {"D": np.nan}, {"P": 1.0}],
    "quantile": [0.4, 1.0, np.nan, True, np.array([0.9])],
    "area_ratio_min": [0.5, np.nan],
    "slip_ratio_max": [0.0, 1.1],
    "friction_slope": ["no", 1, None, 0.0],
    "starts": [0, -1, 1.5, True, "4", np.nan, np.inf, [4], 10**30, 65],
    "lattice": [0, 200_000, 10**30, np.nan],
    "seed": [-1, 0.5, 10**20, 2**63, True, None],
    "progress": ["no", None],
}


@pytest.mark.parametrize("argument", DESIGN)
def test_a_design_is_refused_before_its_search(argument, monkeypatch):
    """The message has the argument's name, and comes before anything is searched for."""
    monkeypatch.setattr("fractaljax.optimise.design._choose_starts", None)
    small: dict[str, Any] = dict(scene=SCENE, lattice=8, starts=4, progress=False)
    for bad in DESIGN[argument]:
        with pytest.raises((TypeError, ValueError)) as refused:
            fj.design(**small | {argument: bad})
        message = str(refused.value)
        words = (argument, "scene", "FractalContact", "D bound", "bound", "envelope", "tolerance")
        assert any(word in message for word in words), (bad, message)
        assert len(message) < 250 and "\n" not in message, message


def test_margin_takes_no_flag_for_a_growth_rate():
    """`margin(scene, False)` means the third argument, not the second."""
    for bad in (False, np.False_, jnp.array(True), 1j):
        with pytest.raises(TypeError, match=r"^shift must be a real number"):
            fj.margin(SCENE, bad)


def test_a_scene_is_asked_for_by_name():
    structure: Any = fj.Structure.from_scene(SCENE)
    for function in (fj.margin, fj.critical_friction, fj.stiffness, fj.growth_rate):
        for bad in (SURFACE, None, 1.0) + ((structure,) if function is not fj.growth_rate else ()):
            with pytest.raises(TypeError, match=r"^scene must be a Scene, got"):
                function(bad)
    functions: list[Any] = [fj.hopf_boundary, fj.modes_over]
    for function in functions:
        with pytest.raises(TypeError, match=r"^scene must be a Scene, got"):
            function(structure, ("mu", 0.1, 0.5), ("P", 1.0, 2.0))


def test_windows_and_axes():
    bad: Any
    for bad in (1, None, "mu", ("mu",), {}, (1, [1.0])):
        with pytest.raises(TypeError, match=r"^x must be a name and its values"):
            fj.modes_over(SCENE, bad, ("P", [1.0]))
    for bad in (1, np.nan, 10**30, 2.5, "9", None):
        with pytest.raises(ValueError, match=r"^lines must be a whole number"):
            fj.hopf_boundary(SCENE, ("mu", 0.1, 0.5), ("P", 1.0, 2.0), lines=bad)


def test_flags_and_whole_numbers():
    assert flag("slope", np.True_) is True and flag("slope", False) is False
    with pytest.raises(TypeError, match=r"^slope must be True or False, got 'no'$"):
        flag("slope", "no")
    assert [whole("n", x, 1) for x in (3, 3.0, np.int8(3), jnp.array(3))] == [3, 3, 3, 3]
    with pytest.raises(ValueError, match=r"^n must be a whole number of at least 1, got 0$"):
        whole("n", 0, 1)
    assert brief([1] * 1000) == f"[{'1, ' * 25}1..." and brief(10**5000) == "a very large integer"
