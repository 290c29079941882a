"""The surfaces of a drawing: the height that it states, with its scatter, at every H."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from tools import refusals

FILTERS: dict[str, Any] = {"cutoff": 8e-4, "shortest": 2.5e-6}
STATED = {"Ra": 4e-7, "scatter": 0.15}


def draws(scatter, count=2000):
    """The quantities of `count` surfaces drawn from a tolerance, by name."""
    material = fj.brake_scene().contact.material
    ends = (1e-3, 1e-6) if isinstance(scatter.surface, fj.Surface) else ()
    scene = fj.brake_scene().replace(
        contact=fj.PerssonContact(scatter.surface, material, 2e3, 1e-4, *ends)
    )
    tolerance = fj.Tolerance.of(scatter)
    tolerance.check(scene, {})
    deviates = np.random.default_rng(0).standard_normal((count, len(tolerance.names)))
    shifts = tolerance.shifts(deviates).T
    return scene, shifts, tolerance.scattered(scene, tolerance.base(scene), shifts)


def test_a_roughness_leaves_G_open_but_not_the_joint():
    """ln G spreads over hundreds, Ra and K_n by 15 percent, at the D of H = .85 +- .15."""
    found = fj.specify_surface(**STATED, H=0.85, H_scatter=0.15)
    expected = fj.profile_parameters(found.surface, **FILTERS, L=1e-3, L_s=1e-6)
    assert float(expected.Ra) == pytest.approx(4e-7, rel=1e-9)
    surface: Any = found.surface
    assert float(surface.D) == pytest.approx(2.15)
    scene, shifts, values = draws(found)
    D, G = np.asarray(values["D"]), np.asarray(values["G"])
    assert ((D > 2) & (D < 3) & (G > 0)).all()
    assert np.subtract(*np.quantile(np.log(G), [0.84, 0.16])) > 30

    @jax.jit
    def of(D, G):
        Ra = fj.profile_parameters(fj.Surface(D, G), **FILTERS, L=1e-3, L_s=1e-6).Ra
        return jnp.log(
            jnp.stack([Ra / 4e-7, scene.replace(D=D, G=G).contact.stiffness(0.4, 0.3)[0]])
        )

    Ra, K_n = np.asarray(jax.lax.map(lambda x: of(*x), (D, G), batch_size=100)).T
    assert Ra.std() == pytest.approx(0.15, rel=0.05) and abs(Ra.mean()) < 0.02
    assert K_n.std() == pytest.approx(0.14, abs=0.02)
    # All but the stated scatter is of second order in H.
    assert np.std(Ra - shifts[1] / 2) < 0.03


def test_a_roll_off():
    """Rz = 3 um +- 10 % of surfaces with a roll-off that scatters, too."""
    found = fj.specify_surface(
        Rz=3e-6, scatter=0.1, H=0.8, H_scatter=0.1, rolloff=1e-4, rolloff_scatter=0.2
    )
    assert found.names == ("ln Sq", "hurst", "ln rolloff")
    _, _, values = draws(found, 300)

    def log_Rz(Sq, H, rolloff):
        surface = fj.SelfAffine(Sq, H, rolloff, 1e-6)
        return jnp.log(fj.profile_parameters(surface, **FILTERS).Rz / 3e-6)

    three = tuple(jnp.asarray(values[name]) for name in ("Sq", "hurst", "rolloff"))
    Rz = np.asarray(
        jax.jit(lambda x: jax.lax.map(lambda row: log_Rz(*row), x, batch_size=50))(three)
    )
    assert Rz.std() == pytest.approx(0.1, rel=0.12) and abs(Rz.mean()) < 0.02
    H = np.asarray(values["hurst"])
    assert ((H > 0) & (H < 1)).all()


def test_no_scatter_of_H():
    found = fj.specify_surface(Sq=5e-7, scatter=0.2, H=0.7, H_scatter=0.0)
    assert found.names == ("ln m(q)",)
    assert found.standard_deviations["ln m(q)"] == pytest.approx(0.4)
    surface: Any = found.surface
    assert math.isfinite(float(surface.G))


test_refused = refusals(
    [
        ({"Rz": 1e-6}, "one of Ra, Rz and Sq must be stated, got Ra, Rz"),
        ({"Ra": None}, "one of Ra, Rz and Sq must be stated, got none"),
        ({"scatter": 0.0}, "scatter must be above 0"),
        ({"H": 1.0}, "H must be above 0 and below 1"),
        ({"H": 0.9999}, "H must be farther below 1 for this Ra"),
        ({"rolloff_scatter": 0.1}, "rolloff_scatter needs a rolloff"),
    ],
    lambda options: fj.specify_surface(**(STATED | options)),
)
