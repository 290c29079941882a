"""A harmonic force on a mechanism, as one more degree of freedom of its hybrid system.

The force a cos(Omega t) is a z, where z'' = -Omega^2 z, z(0) = 1 and z'(0) = 0; no force acts on z.
Motions, periodic orbits and all derivatives are then those of an autonomous system.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import Numbers, Record, number, require_kind
from .._base.programs import exported_jit
from .._mechanism.joint import Dof
from .._mechanism.mechanism import Mechanism
from .hybrid import HybridSystem
from .scaled import hybrid_system


class Excitation(Record):
    """A harmonic force: F_i(t) = F_i + amplitude_i cos(2 pi frequency t + phase_i).

    `amplitude` [N] is (n,), one number for each degree of freedom, or a mapping {degree of freedom:
    N}, by index or name; those of a scene are named x1 and x2. `frequency` [Hz] is above 0. `phase`
    [rad] is one number, or one for each number of `amplitude`, in their order: a rotating
    unbalance is `Excitation({"x": f, "y": f}, frequency, phase=(0.0, -pi / 2))`.

    **Raises:** `TypeError` or `ValueError` for anything else.
    """

    amplitude: Numbers  # [N]
    frequency: Numbers  # [Hz]
    phase: Numbers  # [rad]
    dofs: tuple[Dof, ...] | None = eqx.field(static=True)  # None: all of them

    def __init__(
        self,
        amplitude: ArrayLike | Sequence[ArrayLike] | Mapping[Dof, ArrayLike],
        frequency: ScalarLike,
        phase: ArrayLike | Sequence[ArrayLike] = 0.0,
    ):
        self.dofs = None
        if isinstance(amplitude, Mapping):
            if not amplitude:
                raise ValueError("amplitude must hold at least one degree of freedom, got {}")
            self.dofs = tuple(int(d) if isinstance(d, np.integer) else d for d in amplitude)
            self.amplitude = jnp.stack(
                [number(f"amplitude at {d}", a) for d, a in amplitude.items()]
            )
        else:
            self.amplitude = _numbers("amplitude", amplitude)
        self.frequency = number("frequency", frequency, above=0)
        self.phase = _numbers("phase", phase)

    def parts(self, mechanism: Mechanism) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The forces (n,) [N] on `mechanism` that multiply cos(Omega t) and sin(Omega t).

        **Raises:** `ValueError` for a degree of freedom that the mechanism does not have, one given
        twice, or arrays of another shape.
        """
        n = mechanism.n
        shape = (n,) if self.dofs is None else (len(self.dofs),)
        if self.amplitude.shape != shape:
            shapes = f"{shape}, got {self.amplitude.shape}"
            raise ValueError(f"amplitude of the excitation must have shape {shapes}")
        if self.phase.shape not in ((), shape):
            shapes = f"() or {shape}, got {self.phase.shape}"
            raise ValueError(f"phase of the excitation must have shape {shapes}")
        if self.frequency.ndim:
            raise ValueError(f"frequency must be a single number, got shape {self.frequency.shape}")
        phase = jnp.broadcast_to(self.phase, shape)
        forces = self.amplitude * jnp.cos(phase), -self.amplitude * jnp.sin(phase)
        if self.dofs is None:
            return forces
        places = [mechanism.index(dof) for dof in self.dofs]
        if len(set(places)) < len(places):
            raise ValueError(f"the excitation has one degree of freedom twice: {self.dofs}")
        cosine, sine = (jnp.zeros(n, f.dtype).at[np.array(places)].set(f) for f in forces)
        return cosine, sine


def _numbers(name: str, values: Any) -> Numbers:
    """One number, or several, some perhaps traced, as an array."""
    if isinstance(values, (list, tuple)):
        values = jnp.stack([number(name, value) for value in values] or [jnp.zeros(0)])
    return number(name, values)


def excited_system(
    mechanism: Any, excitation: Excitation | None, memory: bool = False
) -> HybridSystem:
    """The scaled system of a scene or a structure, with the excitation if there is one.

    Its last degree of freedom is z, dimensionless and of order one. Its unit of time is the
    reciprocal of hypot(omega, Omega), so that no frequency exceeds 1. Where the first joint has V =
    0, the unit of velocity is the amplitude of the acceleration times that of time.
    """
    if excitation is None:
        return hybrid_system(mechanism, memory=memory)
    require_kind("excitation", excitation, Excitation)
    cosine, sine = excitation.parts(mechanism)
    cosine, sine = mechanism.over_mass(jnp.stack([cosine, sine], axis=1)).T
    Omega = 2 * jnp.pi * excitation.frequency

    def unit_speed(V, omega):
        largest = jnp.max(jnp.hypot(cosine, sine)) / jnp.hypot(omega, Omega)
        largest = jax.lax.stop_gradient(jnp.where(largest > 0, largest, 1))
        return jnp.where(V > 0, V, largest)

    system = hybrid_system(mechanism, unit_speed, memory)
    omega = jnp.hypot(system.omega, Omega)
    r, unit, n = system.omega / omega, omega * system.speed, system.n
    Omega = Omega / omega

    def matrix(x):
        return jnp.diag(x) if x.ndim == 1 else x

    def padded(x, column, corner):
        last = jnp.zeros(n, x.dtype)
        top = jnp.concatenate([x, column[:, None]], axis=1)
        return jnp.concatenate([top, jnp.append(last, corner)[None]])

    T = jnp.eye(n, dtype=system.F.dtype) if system.T is None else system.T
    B = jnp.eye(n, dtype=system.F.dtype) if system.B is None else system.B
    # cos(Omega t) = z and sin(Omega t) = -z'/Omega.
    return replace(
        system,
        omega=omega,
        force_unit=system.force_unit / r,
        K=padded(matrix(system.K) * r**2, -cosine / unit, Omega**2),
        C=padded(matrix(system.C) * r, sine / unit / Omega, 0.0),
        F=jnp.append(system.F * r, 0.0),
        T=jnp.pad(T, ((0, 0), (0, 1))),
        B=jnp.pad(B, ((0, 1), (0, 0))),
        L=jnp.pad(system.L * r**2, ((0, 0), (0, 1))),
        P=system.P * r,
        excited=True,
        fastest=None if system.fastest is None else jnp.maximum(system.fastest * r, Omega),
    ).with_products()


# For use outside of a program, where some hundred operations would be compiled one by one.
compiled_system = exported_jit(excited_system)
