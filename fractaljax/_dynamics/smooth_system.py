"""A mechanism in scaled units whose friction has no jumps: with memory, or tanh(v/eps) for sgn v.

A law with internal states z has them beside the motion: y = [x, u, z].
"""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.lapack import solve as solve_linear
from .._base.parts import concrete, nan_where
from .._friction import Friction
from .._mechanism.mechanism import Mechanism
from .contact_state import OPEN
from .excitation import excited_system
from .hybrid import HybridSystem
from .scaled import scaled_start


def without_jump(mechanism: Any) -> Any:
    """`mechanism`, unless a static coefficient lies above mu(0): tanh has no room for its peak.

    **Raises:** `ValueError` naming the joint; a traced mechanism becomes NaN instead.
    """
    for name, joint in mechanism.joints_by_name().items():
        law = joint.friction
        if not law.has_jump:
            continue
        excess = law.mu_s / law.kinetic_limit() - 1
        jumps = excess > 64 * jnp.finfo(excess.dtype).eps
        values = concrete(jumps)
        if values is None:
            mechanism = nan_where(jumps.any(), mechanism)
        elif values.any():
            of = f" of joint {name}" if name else ""
            raise ValueError(
                f"friction{of} must not have mu_s above mu(0) where it is regularised: "
                "leave regularisation out"
            )
    return mechanism


class SmoothSystem(eqx.Module):
    """A mechanism in scaled units whose friction is smooth; a state is [x, u, z] (2n + s,)."""

    hybrid: HybridSystem
    eps: Float[Array, ""] | None  # [m/s], of tanh(v/eps); None for laws with memory

    def _laws(self) -> Iterator[tuple[Friction, np.ndarray, slice]]:
        """The laws with memory: with an axis over their faces, these, and the place of z in y."""
        h, end = self.hybrid, 2 * self.hybrid.n
        for law, joints in zip(h.laws, h.sharing, strict=True):
            faces = [(i, i == h.faces[j][0]) for j in joints for i in h.faces[j]]
            # A spring in series rubs along t alone.
            rows = [k for k, (_, first) in enumerate(faces) if first or not law.in_series]
            leaves, tree = jax.tree.flatten(law)
            if len(joints) > 1:
                leaves = [leaf[np.array(rows)] for leaf in leaves]
            else:
                leaves = [jnp.stack([leaf] * len(rows)) for leaf in leaves]
            law = jax.tree.unflatten(tree, leaves)
            begin, end = end, end + len(rows) * law.state_size
            yield law, np.array([faces[k][0] for k in rows]), slice(begin, end)

    @property
    def units(self) -> Float[Array, " 2n+s"]:
        """The SI units of a scaled state of the mechanism, each state of a law in its own."""
        h, units = self.hybrid, [self.hybrid.units]
        if self.eps is None:
            for law, faces, place in self._laws():
                unit = jax.vmap(lambda law: jnp.asarray(law.state_unit(h.speed / h.omega)))(law)
                units.append(jnp.repeat(unit, (place.stop - place.start) // len(faces)))
        return jnp.concatenate(units)

    def field(self, y) -> Float[Array, " 2n+s"]:
        """dy/dt."""
        h, head = self.hybrid, y[: 2 * self.hybrid.n]
        faces = h.smooth_faces(head)
        if self.eps is not None:
            signs = jnp.tanh(h.speed * faces.w / self.eps)
            return h.smooth_field(head, faces, h.friction(faces.w, faces.loads, signs))
        friction, rates = jnp.zeros_like(faces.loads), [head]
        for law, at, z, w, N, unit in self._faces(y, faces):
            forces = jax.vmap(lambda law, *x: jnp.reshape(law.force(*x), ()))(law, z, w, N)
            friction = friction.at[at].set(forces / h.force_unit)
            rate = jax.vmap(lambda law, *x: law.rate(*x))(law, z, w, N)
            rates.append(rate.reshape(-1) / unit / h.omega)
        rates[0] = h.smooth_field(head, faces, friction)
        return jnp.concatenate(rates)

    def _faces(self, y, faces) -> Iterator[tuple[Friction, np.ndarray, Array, Array, Array, Array]]:
        """Each law with its faces (k,), their z (k, size), w, N in SI units, and the unit of z."""
        h, units = self.hybrid, self.units
        loads = jnp.where(faces.s == OPEN, 0, faces.loads) * h.force_unit
        for law, at, place in self._laws():
            unit = units[place.start - 2 * h.n + len(h.units) :][: place.stop - place.start]
            z = (y[place] * unit).reshape(len(at), law.state_size)
            yield law, at, z, h.speed * faces.w[at], loads[at], unit

    def with_states(self, head) -> Float[Array, " 2n+s"]:
        """The state with motion `head` (2n,) in which each law has the states of steady sliding."""
        if self.eps is not None:
            return head
        y = jnp.concatenate([head, jnp.zeros(len(self.units) - len(self.hybrid.units), head.dtype)])
        faces = self.hybrid.smooth_faces(head)
        states = [
            jax.vmap(lambda law, *x: law.steady(*x))(law, w, N).reshape(-1) / unit
            for law, _, _, w, N, unit in self._faces(y, faces)
        ]
        return jnp.concatenate([head, *states])

    def start(self, state) -> Float[Array, " 2n+s"]:
        """The scaled state at the time 0 of a start [x, v] or [x, v, z] in SI units, or None."""
        h = self.hybrid
        if state is None or len(state) == len(h.units):
            return self.with_states(scaled_start(h, state))
        units = self.units
        if len(state) != len(units):
            shapes = f"({len(h.units)},), or ({len(units)},) with the states of the laws"
            raise ValueError(f"start must have shape {shapes}, got {state.shape}")
        y = state / units
        head = h.with_excitation(y[: len(h.units)], 0.0)
        return jnp.concatenate([head, y[len(h.units) :]])

    def mechanism_state(self, y) -> Array:
        """States without the excitation."""
        head, z = jnp.split(y, [2 * self.hybrid.n])
        return jnp.concatenate([self.hybrid.mechanism_state(head), z])

    def with_excitation(self, y, t) -> Array:
        """States of the mechanism at the times t, with the excitation."""
        head, z = jnp.split(y, [len(self.hybrid.units)])
        return jnp.concatenate([self.hybrid.with_excitation(head, t), z])

    def section(self, y) -> Array:
        """As `HybridSystem.section`."""
        return self.hybrid.section(y[: 2 * self.hybrid.n])

    def equilibrium(self) -> Float[Array, " 2n+s"]:
        """Steady sliding: by Newton's method from that of the law's `mu`; NaN if there is none."""

        def step(y, _):
            change = solve_linear(jax.jacfwd(self.field)(y), self.field(y))
            return y - change, jnp.max(jnp.abs(change))

        # From the root, which laws of the package begin with, each step adds an order of
        # derivatives.
        start = jax.lax.stop_gradient(self.with_states(self.hybrid.equilibrium()))
        y, changes = jax.lax.scan(step, start, length=8)
        eps = float(jnp.finfo(y.dtype).eps)
        return jnp.where(changes[-1] <= eps**0.5 * (1 + jnp.max(jnp.abs(y))), y, jnp.nan)


def smooth_system(mechanism: Mechanism, excitation, eps=None) -> SmoothSystem:
    """The scaled system of a mechanism: with memory, or with eps [m/s] of the regularised law."""
    return SmoothSystem(excited_system(mechanism, excitation, memory=eps is None), eps)


def linearised_field(
    mechanism: Mechanism,
) -> tuple[Float[Array, "k k"], HybridSystem, Float[Array, " m"]]:
    """The Jacobian of the field at the equilibrium, its scaled system, the normal forces [N]."""
    system = smooth_system(mechanism, None)
    y, h = system.equilibrium(), system.hybrid
    loads = h.loads(y[: h.n])[np.array([faces[0] for faces in h.faces])] * h.force_unit
    is_open = jnp.any(jnp.array(h.opens) & ~(loads > 0))
    return jnp.where(is_open, jnp.nan, jax.jacfwd(system.field)(y)), h, loads
