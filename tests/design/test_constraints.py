"""Requirements on a scene: their values, signs, slopes and names."""

import math
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._design.constraints import (
    DampingRatio,
    ElasticShare,
    Frequency,
    NormalStiffness,
    RealContactArea,
    Roughness,
)
from fractaljax._surface.roughness import root_mean_square
from tools import both_modes, reference_scene, refusals, state_matrix

ALL = {
    "K_n >= 4e+08 N/m": NormalStiffness(4e8),
    "elastic share >= 0.3": ElasticShare(0.3),
    "2e-06 <= A_r <= 3e-06 m^2": RealContactArea(2e-6, 3e-6),
    "Sq <= 2e-06 m": Roughness(at_most=2e-6, L=1e-3, L_s=1e-6),
    "damping ratio >= 0.001": DampingRatio(1e-3),
    "1000 <= frequencies <= 5000 Hz": Frequency(1000, 5000),
}


@pytest.fixture(scope="module")
def scene():
    return fj.brake_scene()


@jax.jit
def everything(scene):
    """Values of all of them, and their derivatives by D and ln G in both modes."""

    def values(x):
        moved = scene.replace(D=x[0], G=jnp.exp(x[1]))
        return jnp.stack([constraint(moved) for constraint in ALL.values()])

    x = jnp.stack([scene.contact.surface.D, jnp.log(scene.contact.surface.G)])
    return both_modes(values, x)


def test_names():
    """What is required, with units."""
    assert [constraint.name for constraint in ALL.values()] == list(ALL)
    assert RealContactArea(None, 1e-6).name == "A_r <= 1e-06 m^2"


@pytest.mark.slow
def test_values_and_signs(scene):
    """At most 0 exactly where the quantity is within its limits, and each as it is defined."""
    state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
    modes = fj.stability(scene)
    frequencies = np.abs(np.asarray(modes.eigenvalues.imag)) / (2 * math.pi)
    share = 1 - float(state.plastic_share)
    eigenvalues = np.asarray(modes.eigenvalues)
    damping = float(np.min(-np.real(eigenvalues) / np.abs(eigenvalues)))
    expected = [
        1 - float(state.K_n) / 4e8,
        1 - share / 0.3,
        max(math.log(2e-6 / state.A_r), math.log(state.A_r / 3e-6)),
        math.log(root_mean_square(scene.contact.surface, 1e-3, 1e-6) / 2e-6),
        math.asinh((1e-3 - damping) / 1e-3),
        max(1 - frequencies.min() / 1000, frequencies.max() / 5000 - 1),
    ]
    values, _, _ = everything(scene)
    np.testing.assert_allclose(values, expected, rtol=1e-10, atol=1e-12)
    met = [state.K_n >= 4e8, share >= 0.3, True, True, damping >= 1e-3, True]
    np.testing.assert_array_equal(np.asarray(values) <= 0, met)


@pytest.mark.slow
def test_derivatives(scene):
    """Both modes against differences."""
    _, forward, reverse = everything(scene)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    surface = scene.contact.surface
    for i, step in enumerate([1e-6, 1e-6]):
        pair = [
            everything(
                scene.replace(D=surface.D + s * (i == 0), G=surface.G * jnp.exp(s * (i == 1)))
            )[0]
            for s in (step, -step)
        ]
        np.testing.assert_allclose((pair[0] - pair[1]) / (2 * step), forward[:, i], rtol=1e-5)


@pytest.mark.slow
def test_fully_plastic_joints_know_the_way_back(scene):
    """Not met, finite, larger the deeper, and continuous at the critical area."""
    wanting = [0, 1, 2]
    deep, deeper = (everything(scene.replace(D=2.2, G=G)) for G in (1e-10, 1e-9))
    for values, forward, _ in (deep, deeper):
        assert jnp.isfinite(values).all() and jnp.isfinite(forward).all()
        assert (values[jnp.array(wanting)] > 1).all()
        assert (jnp.abs(forward[jnp.array(wanting)]) > 1).all()
    assert (deeper[0][:3] > deep[0][:3]).all()

    def depth(log_G):
        moved = scene.replace(G=math.exp(log_G))
        return float(moved.contact.state(0.4, 0.25).log_area_ratio)

    low, high = math.log(1e-10), math.log(1e-8)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if depth(middle) > 0 else (low, middle)
    sides = [everything(scene.replace(G=math.exp(g)))[0] for g in (low - 1e-9, high + 1e-9)]
    np.testing.assert_allclose(*sides, atol=1e-6)


def test_joints_of_given_stiffness_and_pytrees_under_vmap(scene):
    """Those that ask for stiffness and modes only need no surface; the others say so."""
    fixed = scene.replace(contact=fj.FixedContact(4e8, 2e8))
    assert NormalStiffness(5e8)(fixed) == pytest.approx(0.2)
    assert jnp.isfinite(DampingRatio(0.001)(fixed)) and jnp.isfinite(Frequency(10)(fixed))
    for constraint, message in (
        (ElasticShare(0.1), "elastic share needs a FractalContact"),
        (RealContactArea(1e-6, None), "A_r needs a scene whose contact law has a real area"),
        (ALL["Sq <= 2e-06 m"], "Sq needs a scene whose contact has a surface"),
    ):
        with pytest.raises(ValueError, match=message):
            constraint(fixed)
    # The limits are leaves: many of them at once; a name says nothing of a batch.
    limits = jnp.array([2e8, 4e8, 8e8])
    found = jax.jit(jax.vmap(lambda limit: NormalStiffness(limit)(scene)))(limits)
    np.testing.assert_allclose(found, 1 - fj.stiffness(scene)[0] / limits, rtol=1e-12)
    assert hash(jax.tree.structure(ALL["Sq <= 2e-06 m"])) is not None


def test_real_area_is_that_of_the_contact_law(scene):
    for law in (
        scene.contact,
        fj.PerssonContact(scene.contact.surface, scene.contact.material, 1907.3, 1e-4, 1e-2, 1e-4),
    ):
        expected = np.log(1e-6 / law.real_area(scene.friction.mu_m))
        found = RealContactArea(1e-6, None)(scene.replace(contact=law))
        assert found == pytest.approx(expected, abs=1e-12)


test_refusals = refusals(
    [
        (lambda: NormalStiffness(0.0), "K_n at_least must be above 0, got 0.0"),
        (lambda: NormalStiffness(cast(Any, None)), "K_n needs at_least or at_most"),
        (lambda: ElasticShare(1.5), "elastic share at_least must be above 0 and below 1, got 1.5"),
        (lambda: RealContactArea(None, None), "A_r needs at_least or at_most"),
        (lambda: RealContactArea(2.0, 1.0), "A_r at_least must be below at_most, got 2.0, 1.0"),
        (lambda: Roughness(L=1e-3, L_s=1e-6), "Sq needs at_least or at_most"),
        (lambda: Roughness(1e-6, L=1e-6, L_s=1e-3), "L_s must be below L"),
        (lambda: Roughness(math.nan, L=1e-3, L_s=1e-6), "Sq at_least must be above 0, got nan"),
        (lambda: DampingRatio(2.0), "damping ratio at_least must be above -1 and below 1, got 2.0"),
        (lambda: Frequency(at_most=-1.0), "frequencies at_most must be above 0, got -1.0"),
    ],
    plain=True,
)


def test_damping_ratio_is_that_of_the_state_matrix():
    """The least -Re/|lambda| of the state matrix, stable and squealing."""
    for scene in (reference_scene(), reference_scene().replace(mu_s=0.1, mu_m=0.05)):
        mu = scene.friction.mu(scene.oscillator.V)
        A = state_matrix(scene.oscillator, mu, scene.contact.K_n, scene.contact.K_t)
        eigenvalues = np.linalg.eigvals(A)
        expected = (-np.real(eigenvalues) / np.abs(eigenvalues)).min()
        found = DampingRatio(0.0, friction_slope=False).measure(scene)
        np.testing.assert_allclose(found, expected, rtol=1e-9)
