"""Eq. 43 of the mass on a belt: its equilibrium, and what its quartic gives in closed form."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, ScalarLike

from .._base.singular import positive_sqrt, safe_divide
from .._contact.load_curve import LoadCurve, loaded_equilibrium
from .._mechanism.joint import AnyJoint
from .._mechanism.oscillator import Linearised, dimensionless, linearise, static_normal_force
from .._mechanism.quantities import require_no_memory
from .._mechanism.scene import Scene
from . import quartic
from .critical_pair import CriticalPair
from .margin import margin_of


class Eigensolution(NamedTuple):
    """All 2n modes of n degrees of freedom, and the margin of stability."""

    s: Complex[Array, " k"]  # eigenvalues [1/s], the largest real part first
    shapes: Complex[Array, "k n"]  # of any length
    resolutions: Float[Array, " k"]  # rounding errors of the real parts [1/s]
    margin: Float[Array, ""]
    counted: Bool[Array, " k"]  # of a reduced structure, whether it lies in the band


class TwoDirections(NamedTuple):
    """The linearised equations of a scene; the face is that of `Assembled`."""

    scene: Scene
    K_n: Array  # at the equilibrium: the contact's own, or on a load curve its slope there
    K_t: Array
    static: tuple[Array, Array] | None  # x_01 and the normal force, where a load curve decides them
    polynomial: Linearised

    @property
    def normal_force(self) -> Float[Array, " 1"] | None:
        """The normal force [N] of a preloaded joint, at most 0 if it is open."""
        P = self.scene.normal_load
        if P is None:
            return None
        if self.static is not None:
            return self.static[1][None]
        mu = self.scene.coefficient()
        return static_normal_force(self.scene.oscillator, self.K_n, self.K_t, mu, P)[None]

    @property
    def open(self) -> Array:
        """False: where the joint is open, all results are NaN."""
        return jnp.zeros((), bool)

    def rightmost(self) -> Complex[Array, ""]:
        """The eigenvalue with the largest real part [1/s]."""
        return quartic.rightmost_root(self.polynomial)

    def margin(self, shift: ScalarLike = 0.0) -> Float[Array, ""]:
        """As `margin`."""
        return margin_of(self.polynomial, shift)

    def modes(self) -> Eigensolution:
        """All four modes."""
        s = quartic.roots(self.polynomial)
        x = self._displacements(s)
        error = quartic.resolutions(self.polynomial, s)
        return Eigensolution(s, x, error, self.margin(), jnp.ones(s.shape, bool))

    def hopf_test(self, rigid: Any = None) -> Float[Array, ""]:
        """`hopf_test_function`; there are no `rigid` bodies."""
        return hopf_test_function(self.polynomial)

    def critical(self, rigid: Any = None) -> CriticalPair:
        """The critical mode, with the damping of both directions over sqrt(a + b)."""
        lin = self.polynomial
        damping = jnp.stack([lin.c_1, lin.c_2]) / jnp.sqrt(lin.a + lin.b)
        growth, frequency = self.rightmost().real, critical_frequency(lin)
        return CriticalPair(self.hopf_test(), frequency, growth, damping)

    def _displacements(self, s) -> Complex[Array, "4 2"]:
        """(x1, x2) of each eigenvalue s of any length.

        (s^2 + c_1 s + a) x1 = mu K_n/m x2 and (s^2 + c_2 s + b) x2 = -mu K_t/m x1.
        """
        lin, mobility = self.polynomial, self.scene.coefficient() / self.scene.oscillator.m
        unit = lin.a + lin.b
        first, second = ((s * (s + c) + k) / unit for c, k in ((lin.c_1, lin.a), (lin.c_2, lin.b)))
        to_1, to_2 = (jnp.full_like(s, mobility * K / unit) for K in (self.K_n, self.K_t))
        # Either equation will do; the other may be 0 = 0.
        size_1, size_2 = (jnp.abs(y.real) + jnp.abs(y.imag) for y in (first, second))
        by_first = size_1 + to_1.real >= size_2 + to_2.real
        x = jnp.stack(
            [jnp.where(by_first, to_1, second), jnp.where(by_first, first, -to_2)], axis=-1
        )
        # Two equal modes without coupling: any shape is one.
        none = (x == 0).all(axis=-1, keepdims=True)
        return jnp.where(none, jnp.array([1, 0], x.dtype)[None], x)


def two_directions(scene: Scene, friction_slope: bool) -> TwoDirections:
    """The linearised equations of a scene (Eq. 43), with the stiffness of its contact."""
    require_no_memory(scene)
    K_n, K_t, static = _pressed(scene)
    o, law, P = scene.oscillator, scene.friction, scene.normal_load
    lin = linearise(o, law, K_n, K_t, friction_slope, P, static)
    return TwoDirections(scene, K_n, K_t, static, lin)


def _pressed(scene: Scene) -> tuple[Array, Array, tuple[Array, Array] | None]:
    """K_n, K_t and `static`, as `TwoDirections` has them."""
    (K_n, K_t), P = scene.stiffness(), scene.normal_load
    if P is None or not scene.follows_load_curve:
        return K_n, K_t, None
    o, mu, curve = scene.oscillator, scene.coefficient(), load_curve(scene)
    r_1, r_2 = 1 / (o.m * o.omega_1**2 + K_t), 1 / (o.m * o.omega_2**2 + K_n)
    # A missing load does not push along x_2, nor rub along x_1.
    by = K_n * r_2 * (1 + mu**2 * K_t * r_1) / (1 + mu**2 * K_n * r_2 * K_t * r_1)
    linear = static_normal_force(o, K_n, K_t, mu, P) / P - 1
    e = loaded_equilibrium([curve], linear[None], by[None, None])[0]
    force, slope = on_curve(curve, e)
    x_01 = (o.F / jnp.sqrt(2.0) + mu * P * force) * r_1
    return K_n * slope, K_t, (x_01, P * force)


def load_curve(joint: AnyJoint) -> LoadCurve:
    """The load curve of a scene or joint that follows one."""
    return joint.contact.load_curve(joint.friction.mu_s, joint.friction.mu_m)


def on_curve(curve: LoadCurve, e) -> tuple[Array, Array]:
    """N/P and its slope."""
    return jax.jvp(curve, (e,), (jnp.ones_like(e),))


def critical_coupling(lin: Linearised) -> Float[Array, ""]:
    """g_c [1/s^4], the coupling at which a pair of eigenvalues is imaginary.

    Without damping it depends on how the damping vanishes: the value is that of equal damping,
    (a - b)^2/4, at which the modes coalesce.
    """
    a_3, a_1 = lin.c_1 + lin.c_2, lin.c_1 * lin.b + lin.c_2 * lin.a
    half = jnp.full_like(a_3, 0.5)
    # Two quotients: products of dampings would underflow in derivatives in float32.
    share = safe_divide(lin.c_1, a_3, half) * safe_divide(lin.c_2, a_3, half)
    return share * ((lin.a - lin.b) ** 2 + a_3 * a_1)


def hopf_test_function(lin: Linearised) -> Float[Array, ""]:
    """(g_c - g)/(a + b)^2 [-], below 0 exactly where an eigenvalue has a positive real part.

    It varies on the scale of the stiffness, unlike the growth rate and the margin, which vary on
    that of the damping. That suits Newton's method. Negative where a direction has negative
    damping, whatever g_c.
    """
    _, lin = dimensionless(lin)
    value = critical_coupling(lin) - lin.g
    return jnp.where((lin.c_1 < 0) | (lin.c_2 < 0), -jnp.abs(value), value)


def critical_frequency(lin: Linearised) -> Float[Array, ""]:
    """Frequency [Hz] of the imaginary pair where g = g_c: omega^2 = a_1/a_3."""
    a_3, a_1 = lin.c_1 + lin.c_2, lin.c_1 * lin.b + lin.c_2 * lin.a
    return positive_sqrt(safe_divide(a_1, a_3, (lin.a + lin.b) / 2)) / (2 * jnp.pi)
