"""Derivatives of the places of a branch's events by every other quantity of the mechanism.

An event solves the equations of the orbit and one condition more. Implicit differentiation gives
how the quantity at the event moves with the mechanism; no branch is followed again.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._base.programs import exported_jit
from .._mechanism.mechanism import Mechanism
from .hybrid import HybridSystem
from .shooting import durations, equations, reduced_guard, return_jacobian


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def event_value(kind: str, x: Mechanism, event: Any) -> Array:
    """The quantity at an event: (window, chain, lifted, u, details).

    `kind` is what vanishes there: "fold", the null vector's component along the quantity; "touch",
    a reduced guard at the place `details`; "vanish", the duration of phase `details`;
    "multiplier", the modulus of a Floquet multiplier less 1; "hopf", the growth rate.
    """
    window, *_, u, _ = event
    return window.value(u[-1])


@event_value.defjvp
def _event_jvp(kind, primals, tangents):
    x, event = primals
    return event_value(kind, x, event), _change(kind, x, event, tangents[0])


@functools.partial(exported_jit, static_argnames="kind")
def _change(kind, x, event, x_dot):
    window, u = event[0], event[-2]
    _, slope = jax.jvp(window.value, (u[-1],), (jnp.ones_like(u[-1]),))
    function, weights, along = (_hopf if kind == "hopf" else _orbit)(kind, x, event)
    _, change = jax.jvp(function, (x,), (x_dot,))
    return -slope * jnp.sum(weights * change) / along


def _hopf(kind, x, event):
    window, *_, u, _ = event
    frozen = jax.lax.stop_gradient(x)

    def matrix(x, q):
        system: HybridSystem = window.system(x, q)
        slips = jnp.ones(len(system.P), u.dtype)
        return jax.jacfwd(lambda y: system.field(y, slips))(system.equilibrium())

    values, right = jnp.linalg.eig(matrix(frozen, u[-1]))
    k = jnp.argmin(jnp.abs(values - 2j * jnp.pi / u[-2]))
    left = jnp.linalg.inv(right)[k]

    def growth(x, q):
        return jnp.real(left @ matrix(x, q).astype(left.dtype) @ right[:, k])[None]

    _, along = jax.jvp(lambda q: growth(frozen, q)[0], (u[-1],), (jnp.ones_like(u[-1]),))
    return lambda x: growth(x, u[-1]), jnp.ones(1, u.dtype), along


def _orbit(kind, x, event):
    """The vanishing function of x at fixed unknowns, its weights, and their normalisation."""
    window, chain, lifted, u, details = event
    frozen = jax.lax.stop_gradient(x)
    _, jacobian, lifted, _ = equations(frozen, window, chain, lifted, u)
    lifted = jax.lax.stop_gradient(lifted)
    if kind == "fold":
        # The left null vector of the equations with the quantity held.
        weights = jnp.linalg.svd(jacobian[:, :-1])[0][:, -1]

        def residual(x):
            return equations(x, window, chain, lifted, u)[0]

        return residual, weights, weights @ jacobian[:, -1]

    details: Any = _eigenvectors(jacobian, len(lifted.y)) if kind == "multiplier" else details

    def condition(x, states, u):
        if kind == "vanish":
            return u[len(lifted.y) + details]
        if kind == "touch":
            system = window.system(x, u[-1])
            h = durations(chain, u, system.n)
            return reduced_guard(system, chain, states.at(u), h, details, details.theta)
        of_orbit = equations(x, window, chain, states, u)[1]
        left, right, value = details
        J = return_jacobian(of_orbit, len(lifted.y)).astype(left.dtype)
        return jnp.real(jnp.conj(value) * (left @ J @ right))

    def everything(x):
        residual, _, states, _ = equations(x, window, chain, lifted, u)
        return jnp.append(residual, condition(x, states, u))

    row = jax.grad(lambda u: condition(frozen, lifted, u))(u)
    # The component of the inverse's last row belongs to the quantity.
    last = jnp.zeros(len(u), u.dtype).at[-1].set(1)
    weights = jnp.linalg.solve(jnp.concatenate([jacobian, row[None]]).T, last)
    return everything, weights, jnp.ones((), u.dtype)


def _eigenvectors(jacobian, k: int):
    """Left and right eigenvector and value of the multiplier nearest to the unit circle."""
    values, right = jnp.linalg.eig(return_jacobian(jacobian, k))
    # Multipliers of sticking and of the section are 0.
    i = jnp.argmin(jnp.abs(jnp.abs(values) - 1))
    return jnp.linalg.inv(right)[i], right[:, i], values[i]
