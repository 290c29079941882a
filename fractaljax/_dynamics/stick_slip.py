"""Dry friction as a Filippov system: slip forward, slip backward or stick, in each direction.

Everything here is in scaled units: time 1/omega, omega^2 = omega_1^2 + omega_2^2 + (K_t + K_n)/m,
velocity V, length V/omega. A state y is [x1, x2, u1, u2], u_i = (dx_i/dt)/V. The contact state s
is [s1, s2] with s_i = +1 (slip forward, u_i < 1), -1 (slip backward, u_i > 1) or 0 (stick,
u_i = 1). Components are the first axis of both; further axes may follow.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, DTypeLike, Float

from .._base.parts import concrete, number
from .._friction import Friction
from .._mechanism.oscillator import static_displacements
from .._mechanism.scene import Scene, stiffness

# Guards 0 to 3 are two for each direction. This one is u1, which falls through 0 at a maximum of
# x1: the section of the Poincare map.
SECTION = 4


class StickSlip(eqx.Module):
    """The oscillator on its belt (Eq. 39) with the exact friction law, in scaled units."""

    friction: Friction
    V: Float[Array, ""]  # belt velocity [m/s], which scales the friction law's argument
    omega: Float[Array, ""]  # [1/s]
    a: Float[Array, ""]  # (omega_1^2 + K_t/m)/omega^2; that of direction 2 is 1 - a
    n_1: Float[Array, ""]  # K_n/(m omega^2): the load on direction 1 is n_1 x2
    n_2: Float[Array, ""]  # K_t/(m omega^2): the load on direction 2 is -n_2 x1
    c_1: Float[Array, ""]  # damping
    c_2: Float[Array, ""]
    f: Float[Array, ""]  # external force

    def loads(self, y) -> tuple[Array, Array]:
        """What the coefficient of friction multiplies; sticking attracts where it is positive."""
        return self.n_1 * y[1], -self.n_2 * y[0]

    def free(self, y, one=1.0) -> tuple[Array, Array]:
        """Acceleration without friction; `one` = 0 leaves its linear part."""
        return (
            one * self.f - self.c_1 * y[2] - self.a * y[0],
            -one * self.f - self.c_2 * y[3] - (1 - self.a) * y[1],
        )

    def accelerations(self, y, signs) -> list[Array]:
        """Of both directions in slip, with friction of the given `signs`."""
        parts = zip(self.free(y), self.loads(y), y[2:], signs, strict=True)
        return [
            free + self.friction.branch(self.V * (1 - u), sign) * load
            for free, load, u, sign in parts
        ]

    def field(self, y, s) -> Array:
        """dy/dt in contact state s. A sticking direction must have u_i = 1."""
        slipping = zip(self.accelerations(y, s), s, strict=True)
        return jnp.stack([y[2], y[3], *(jnp.where(s_i == 0, 0, a) for a, s_i in slipping)])

    def stiffness(self, y) -> Array:
        """The largest rate (...) at which friction alone changes sliding velocities.

        Far from equilibrium it exceeds every other rate. Zero for a law without slope.
        """
        if not self.friction.velocity_dependent:
            return jnp.zeros_like(y[0])
        rates = [
            jnp.abs(self.V * self.friction.slope(self.V * (1 - u)) * load)
            for load, u in zip(self.loads(y), y[2:], strict=True)
        ]
        return jnp.maximum(*rates)

    def guards(self, y, s, one=1.0) -> Array:
        """Five functions (5, ...), affine in y, that are positive while contact state s lasts.

        Two for each direction: in slip, the sliding velocity s_i (1 - u_i) and a constant; in
        stick, the distances of the friction force from its two limits. The last is u1, the
        section. `one` = 0 leaves the linear part: the guards of dy/dt are the rates of the guards.
        """
        limit = self.friction.mu_s
        rows = []
        for free, load, u, s_i in zip(self.free(y, one), self.loads(y), y[2:], s, strict=True):
            slips = s_i != 0
            rows.append(jnp.where(slips, s_i * (one - u), limit * load + free))
            rows.append(jnp.where(slips, one, limit * load - free))
        return jnp.stack([*rows, jnp.broadcast_to(y[2], rows[0].shape)])

    def switch(self, y, s, guard) -> tuple[Array, Array]:
        """State and contact state after the guard of that number has reached zero.

        A slip that ends reverses if the force on the other side carries it on; otherwise it
        sticks. Under a negative load it always reverses: the sliding mode there is repelling.
        """
        velocities, states = [], []
        limit = self.friction.mu_s
        for i, (free, load) in enumerate(zip(self.free(y), self.loads(y), strict=True)):
            s_i, u = s[i], y[2 + i]
            ended = (guard == 2 * i) | (guard == 2 * i + 1)
            on_other_side = s_i * (free - s_i * limit * load)
            after_slip = jnp.where(on_other_side > 0, -s_i, 0)
            after_stick = jnp.where(guard == 2 * i, 1, -1)
            after = jnp.where(s_i == 0, after_stick, after_slip)
            states.append(jnp.where(ended, after.astype(s_i.dtype), s_i))
            velocities.append(jnp.where(ended, 1, u))
        velocities[0] = jnp.where(guard == SECTION, 0, velocities[0])
        return jnp.stack([y[0], y[1], *velocities]), jnp.stack(states)

    def contact_state(self, y) -> Array:
        """The contact state in which the motion from y begins."""
        states = []
        limit = self.friction.mu_s
        for free, load, u in zip(self.free(y), self.loads(y), y[2:], strict=True):
            forward, backward = free + limit * load, free - limit * load
            # At the belt's velocity: the side whose own field leaves it, forward if both do.
            leaving = jnp.where(forward < 0, 1, jnp.where(backward > 0, -1, 0))
            states.append(jnp.where(u < 1, 1, jnp.where(u > 1, -1, leaving)).astype(y.dtype))
        return jnp.stack(states)


def stick_slip(scene: Scene) -> StickSlip:
    """The scaled system of a scene."""
    if scene.preload:
        raise ValueError("preload has no motion yet: only the source's form, preload=False, has")
    o = scene.oscillator
    K_n, K_t = stiffness(scene)
    a, b = o.omega_1**2 + K_t / o.m, o.omega_2**2 + K_n / o.m
    omega = jnp.sqrt(a + b)
    return StickSlip(
        friction=scene.friction,
        V=o.V,
        omega=omega,
        a=a / omega**2,
        n_1=K_n / o.m / omega**2,
        n_2=K_t / o.m / omega**2,
        c_1=2 * o.xi_1 * o.omega_1 / omega,
        c_2=2 * o.xi_2 * o.omega_2 / omega,
        f=o.F / o.m / jnp.sqrt(2.0) / omega / o.V,
    )


def sliding_equilibrium(scene: Scene, system: StickSlip) -> Float[Array, "4"]:
    """The sliding equilibrium (Eq. 40) as a scaled state."""
    K_n, K_t = stiffness(scene)
    x_1, x_2 = static_displacements(scene.oscillator, K_n, K_t, scene.friction.mu(system.V))
    length = system.V / system.omega
    return jnp.stack([x_1 / length, x_2 / length, jnp.zeros_like(x_1), jnp.zeros_like(x_1)])


def units(system: StickSlip) -> Float[Array, "4"]:
    """Units [m, m, m/s, m/s] of a scaled state."""
    length = system.V / system.omega
    return jnp.stack([length, length, system.V, system.V])


def start_state(start: ArrayLike | Sequence[float]) -> Float[Array, "4"]:
    """`start` as an array [x1, x2, v1, v2]; `ValueError` unless it has that shape."""
    state = number("start", jnp.asarray(start))
    if state.shape != (4,):
        raise ValueError(f"start must have shape (4,), got {state.shape}; use jax.vmap for many")
    return state


def scaled_start(scene: Scene, system: StickSlip, start: Array | None) -> Float[Array, "4"]:
    """The start in scaled units, constant: by default the equilibrium with x1 displaced."""
    if start is None:
        y = sliding_equilibrium(scene, system).at[0].add(1.0)
    else:
        y = start / units(system)
    return jax.lax.stop_gradient(y)


def check_rtol(rtol: Any, dtype: DTypeLike) -> float:
    """`rtol` if it can be reached in `dtype`; by default 1e-9, or the least that can.

    **Raises:** `ValueError` for one above 0.1, or below 4096 times the rounding error of `dtype`;
    `TypeError` unless it is a number known at trace time.
    """
    least = 4096 * float(jnp.finfo(dtype).eps)
    if rtol is None:
        return max(1e-9, least)
    if isinstance(rtol, (bool, str)) or concrete(rtol) is None or np.ndim(rtol):
        raise TypeError(f"rtol must be a number, got {rtol!r}")
    if not 0 < rtol <= 0.1:
        raise ValueError(f"rtol must be above 0 and at most 0.1, got {rtol!r}")
    if rtol < least:
        raise ValueError(f"rtol must be at least {least:.2g} in {jnp.dtype(dtype)}, got {rtol!r}")
    return float(rtol)
