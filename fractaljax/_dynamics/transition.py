"""Changes of contact states: where a motion begins, and when a guard has reached zero."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .contact_state import BACKWARD, FORWARD, OPEN, STICK, Event, follow_end, follow_opening
from .hybrid import HybridSystem
from .lanes import first_least, row_numbers


def first_contact_state(system: HybridSystem, y) -> Array:
    """The contact state (f, ...) in which the motion from y begins."""
    w = system.sliding(y[system.n :])
    s = jnp.where(system.open_faces(y), OPEN, jnp.sign(w))
    # At the belt's velocity: the side whose own field leaves it, forward if both do.
    return _settle(system, y, s.astype(y.dtype), s == STICK)


def switch(system: HybridSystem, y, s, guard) -> tuple[Array, Array]:
    """State and contact state after guard number `guard` has reached zero."""
    faces, numbers = row_numbers(s), system.guard_numbers
    guard = jnp.broadcast_to(jnp.asarray(guard), s.shape[1:])
    ended, lower = numbers.face(guard[None]) == faces, guard[None] == numbers.lower(faces)
    event = Event(system, y, s, ended)
    new = jnp.where(ended, follow_end(event, lower, system.states).astype(s.dtype), s)
    rests = ended
    for state in system.states:
        for change, at_lower in ((state.lower, True), (state.upper, False)):
            if change is not None and not change.at_rest:
                rests = rests & ~((lower == at_lower) & (s == state.code))
    # To rounding, the velocity of a face that sticks or starts to slip is the belt's.
    exact = rests | system.is_held(s) | system.is_held(new)
    x, u = y[: system.n], y[system.n :]
    if any(system.opens):
        after = follow_opening(event, system.states)
        new = jnp.where(_faces_of_joint(system, guard, (0, 1)), after.astype(s.dtype), new)
        exact = exact if system.B is None else exact & ~system.is_open(new)
        x = _without_load(system, x, guard)
    if system.B is None:
        u = jnp.where(exact, system.over_lanes(system.V, u.ndim - 1), u)
    else:
        u = u + system.acceleration(system.holding_forces(-system.sliding(u), exact))
    y = jnp.concatenate([x, u])
    if system.B is None or len(s) == 1:
        return y, new
    # The forces on sticking faces jump with the others' friction, perhaps beyond their limits.
    free = rests & (s != STICK) | (new == STICK)
    switched = jnp.any(guard > 0)
    return y, jax.lax.cond(switched, lambda: _settle(system, y, new, free), lambda: new)


def _settle(system: HybridSystem, y, s, free) -> Array:
    """Contact state s, changed at faces `free` (f, ...) with w = 0 where it contradicts y.

    A force beyond its limits starts a slip; a slip that its own acceleration reverses sticks. The
    largest contradiction goes first, as in the pivoting of a complementarity problem.
    """
    # A contact state has no derivative, and the loop has none in reverse mode.
    system, y = jax.lax.stop_gradient((system, y))
    limits = system.limits(system.loads(y[: system.n]))
    # To rounding, a face at its limit may stick or slip.
    slack = 64 * jnp.finfo(y.dtype).eps

    def pivot(carry):
        s, _, pivots = carry
        rate, force = system.forces_at_rest(y, s)
        excess = jnp.where(s == STICK, jnp.abs(force) * (1 - slack) - limits, s * rate - slack)
        excess = jnp.where(free, excess, -1)
        worst = (first_least(-excess)[0][None] == row_numbers(s)) & (excess > 0)
        slips = jnp.where(force > limits, FORWARD, BACKWARD)
        changed = jnp.where(s == STICK, slips, STICK).astype(s.dtype)
        return jnp.where(worst, changed, s), jnp.any(worst), pivots + 1

    def going(carry):
        return carry[1] & (carry[2] < 2 * len(s))

    return jax.lax.while_loop(going, pivot, (s, jnp.array(True), 0))[0]


def _faces_of_joint(system: HybridSystem, guard, which: tuple[int, ...]) -> Array:
    """True for faces (f, ...) of the joint that `guard` (...) opens or closes.

    `which` selects the tangential faces (0), the normal ones (1) or both.
    """
    numbers = np.full(len(system.P), -9)  # no guard
    for j in system.guard_numbers.opening:
        opening_guard = system.guard_numbers.opening_guard(j)
        numbers[[system.faces[j][i] for i in which]] = opening_guard
    return guard[None] == numbers.reshape(-1, *(1,) * guard.ndim)


def _without_load(system: HybridSystem, x, guard) -> Array:
    """x shifted along the normal of the joint that `guard` opens or closes, to zero load."""
    tangential, normal = (_faces_of_joint(system, guard, (i,)) for i in (0, 1))
    direction = system.acceleration(normal.astype(x.dtype))
    loads, openings = system.linear_loads(x), jnp.ones_like(x[:1])
    if not system.linear:
        closures, ones = list(loads), [jnp.ones_like(x[0])] * len(loads)
        joints = zip(system.faces, system.closures(x), system.joint_forces, strict=True)
        for (first, *_), load, force in joints:
            closures[first] = load
            if not force.linear:
                opening = system.over_lanes(jnp.asarray(force.opening), x.ndim - 1)
                ones[first] = jnp.broadcast_to(opening, load.shape)
        loads, openings = jnp.stack(closures), jnp.stack(ones)
    change = system.times(system.L, direction) / openings
    change = jnp.sum(jnp.where(tangential, change, 0), axis=0)
    load = jnp.sum(jnp.where(tangential, loads, 0), axis=0)
    return x - (load / jnp.where(change == 0, 1, change))[None] * direction
