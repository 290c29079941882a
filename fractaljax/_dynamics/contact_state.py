"""Contact states of a face: the table that forces, guards, transitions, names and plots read.

To add a contact state, add its row to `STATES`, with functions for what no other row has, and let
another row lead to it.
"""

import functools
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

if TYPE_CHECKING:
    from .hybrid import HybridSystem

FORWARD, BACKWARD, STICK, OPEN = 1, -1, 0, 2  # codes; that of a slip is the sign of w


class FaceMotion(NamedTuple):
    """The faces (f, ...) of a system in motion: what forces and guards are made of."""

    system: "HybridSystem"
    s: Array  # contact states
    w: Array  # sliding velocities V - t.u
    loads: Array  # which friction multiplies
    linear_loads: Array  # the same with springs of constant stiffness, which K contains


class Event(NamedTuple):
    """A guard that has reached zero, for the choice of the state that follows."""

    system: "HybridSystem"
    y: Array
    s: Array  # contact states (f, ...) before
    ended: Array  # True for the face (f, ...) whose guard it is


@dataclass(frozen=True)
class Change:
    """What follows a contact state at one of its guards."""

    to: tuple[int, ...]  # codes of the states that may follow, the usual one first
    choose: Callable[[Event], Array] | None = None  # codes of those that do; None: the only one
    at_rest: bool = True  # w = 0 there, which is then made exact

    @property
    def rule(self) -> Hashable:
        """Equal for changes that are made in the same way."""
        return self.choose or self.to

    def code(self, event: Event) -> Any:
        """Codes of the states that follow, or the one code."""
        return self.to[0] if self.choose is None else self.choose(event)


@dataclass(frozen=True)
class State:
    """A contact state of a face: a row of the table."""

    code: int  # in arrays of contact states
    symbol: str  # in itineraries
    name: str  # in a `Switch`
    description: str  # in tables and legends, of the {velocity} along t
    colour: str  # in plots
    # Force on the face. None: whatever holds it at w = 0.
    force: Callable[[FaceMotion], Array] | None
    # The lower and the upper guard, positive while the state lasts, by the motion and the forces
    # that hold faces at w = 0. None: there is none.
    guards: Callable[[FaceMotion, Array], tuple[Array, Array | None]] | None
    lower: Change | None  # at its lower guard
    upper: Change | None  # at its upper guard
    opening: Change  # at the guard of its joint, which opens or closes
    closed: bool = True  # the springs of the joint act


# --- forces ---------------------------------------------------------------------------------------


def _friction(faces: FaceMotion) -> Array:
    return faces.system.friction(faces.w, faces.loads, faces.s)


def _release(faces: FaceMotion) -> Array:
    return faces.system.spring_release(faces.linear_loads)


# --- guards ---------------------------------------------------------------------------------------


def _sliding(faces: FaceMotion, _: Array) -> tuple[Array, None]:
    return faces.s * faces.w, None


def _within_limits(faces: FaceMotion, holding: Array) -> tuple[Array, Array]:
    limits = faces.system.limits(faces.loads)
    return limits - holding, limits + holding


# --- changes --------------------------------------------------------------------------------------


def _stick_or_reverse(event: Event) -> Array:
    """A slip reverses if the force on the other side carries it on; otherwise it sticks.

    Under a negative load it always reverses: the sliding mode there is repelling.
    """
    system, y, s, ended = event
    if system.has_jump:
        # Static friction may hold a face which sliding friction would let go on.
        _, holding = system.forces_at_rest(y, jnp.where(ended, STICK, s))
        loads = system.loads(y[: system.n])
        return jnp.where((-s * holding > system.limits(loads)) | (loads < 0), -s, STICK)
    reversed_s = jnp.where(ended & (s != STICK), -s, s)
    rate = system.along(system.field(y, reversed_s)[system.n :])
    reverses = (s * rate > 0) | (system.loads(y[: system.n]) < 0)
    return jnp.where(reverses, -s, STICK)


def _slip_by_velocity(event: Event) -> Array:
    w = event.system.sliding(event.y[event.system.n :])
    return jnp.where(w < 0, BACKWARD, FORWARD)


_OPENS = Change((OPEN,))

STATES = (
    State(
        code=FORWARD,
        symbol="+",
        name="+",
        description="slips, {velocity} < V",
        colour="tab:blue",
        force=_friction,
        guards=_sliding,
        lower=Change((STICK, BACKWARD), _stick_or_reverse),
        upper=None,
        opening=_OPENS,
    ),
    State(
        code=BACKWARD,
        symbol="-",
        name="-",
        description="slips, {velocity} > V",
        colour="tab:cyan",
        force=_friction,
        guards=_sliding,
        lower=Change((STICK, FORWARD), _stick_or_reverse),
        upper=None,
        opening=_OPENS,
    ),
    State(
        code=STICK,
        symbol="0",
        name="stick",
        description="sticks",
        colour="tab:orange",
        force=None,
        guards=_within_limits,
        lower=Change((FORWARD,)),
        upper=Change((BACKWARD,)),
        opening=_OPENS,
    ),
    State(
        code=OPEN,
        symbol="o",
        name="open",
        description="open",
        colour="tab:red",
        force=_release,
        guards=None,
        lower=None,
        upper=None,
        opening=Change((FORWARD, BACKWARD), _slip_by_velocity),
        closed=False,
    ),
)


def find_state(code: int) -> State:
    """The row with a code."""
    return next(state for state in STATES if state.code == code)


# --- reading the table ----------------------------------------------------------------------------


def in_states(s: Array, states: Sequence[State]) -> Array:
    """True for faces (f, ...) in one of these states; opposite codes take one comparison."""
    codes = [state.code for state in states]
    pairs = [code for code in codes if code > 0 and -code in codes]
    single = [code for code in codes if abs(code) not in pairs]
    masks = [jnp.abs(s) == code for code in pairs] + [s == code for code in single]
    return functools.reduce(jnp.logical_or, masks)


def alike(
    states: Sequence[State], key: Callable[[State], Any]
) -> Iterator[tuple[Any, list[State]]]:
    """Yield what states share, unless it is None, and the states that share it."""
    groups: dict[Any, list[State]] = {}
    for state in states:
        groups.setdefault(key(state), []).append(state)
    yield from ((shared, group) for shared, group in groups.items() if shared is not None)


def state_forces(faces: FaceMotion, states: Sequence[State], otherwise: Any) -> Array:
    """The forces on faces (f, ...) in one of `states`, 0 where they are held."""
    for force, group in alike(states, lambda state: state.force):
        otherwise = jnp.where(in_states(faces.s, group), force(faces), otherwise)
    return otherwise


def face_guards(faces: FaceMotion, holding: Array, states: Sequence[State]) -> Array:
    """The lower and the upper guards of all faces (2f, ...), in turn; 1 where there is none."""
    lower = upper = jnp.ones_like(faces.w)
    for guards, group in alike(states[::-1], lambda state: state.guards):
        at_lower, at_upper = guards(faces, holding)
        mask = in_states(faces.s, group)
        lower = jnp.where(mask, at_lower, lower)
        upper = upper if at_upper is None else jnp.where(mask, at_upper, upper)
    return jnp.stack([lower, upper], axis=1).reshape(2 * len(lower), *lower.shape[1:])


def _follow(event: Event, states: Sequence[State], rule: Callable, code: Callable) -> Array:
    """The `code` of each state at the faces in it, once for states with one `rule`."""
    (_, first), *others = alike(states, rule)
    after = jnp.asarray(code(first[0]))
    for _, group in others:
        after = jnp.where(in_states(event.s, group), code(group[0]), after)
    return after


def follow_end(event: Event, lower: Array, states: Sequence[State]) -> Array:
    """Codes (f, ...) after the `lower` or upper guard of faces in their states has reached zero."""

    def rule(state: State) -> Hashable:
        return state.lower and (state.lower.rule, state.upper and state.upper.rule)

    def code(state: State) -> Any:
        assert state.lower is not None
        at_lower = state.lower.code(event)
        return (
            at_lower if state.upper is None else jnp.where(lower, at_lower, state.upper.code(event))
        )

    return _follow(event, states, rule, code)


def follow_opening(event: Event, states: Sequence[State]) -> Array:
    """Codes (f, ...) after the guard of a joint that opens or closes has reached zero."""
    return _follow(
        event, states, lambda state: state.opening.rule, lambda state: state.opening.code(event)
    )
