"""A mechanism with dry friction as a hybrid system: its field and its guards.

Everything here is in scaled units: time 1/omega, velocity V of the first joint, length V/omega. A
state y (2n, ...) is [x, u] with u = dx/dt. Friction acts on faces: along the tangential direction
of a joint and, where the joint has a tangential spring, along its normal. The contact state s
(f, ...) has for each face a code of contact_state.py; w = V - t.u is the sliding velocity.
Components are the first axis; lanes may follow.
"""

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._contact.load_curve import loaded_equilibrium
from .._friction import Friction
from .contact_state import (
    FORWARD,
    OPEN,
    STATES,
    FaceMotion,
    State,
    face_guards,
    in_states,
    state_forces,
)
from .guard import GuardNumbers
from .joint_force import JointForce
from .lanes import SMALL, product, rows, solve, solve_positive
from .law_scales import LawScales


def _traced_once(method: Callable) -> Callable:
    """Trace and lower a method that a program calls at many places once for each shape."""
    jitted = jax.jit(method)

    @functools.wraps(method)
    def call(self, *arrays):
        return jitted(self, *arrays)

    return call


class Products(eqx.Module):
    """All linear terms of a field in one product, which runs and compiles as fast as one term."""

    matrix: Float[Array, "3f+n 2n"]  # L x, T u, T (K x + C u), K x + C u
    W: Float[Array, "f f"]  # T B
    F: Float[Array, " f"]  # T F


class HybridSystem(eqx.Module):
    """M x'' + C x' + K x = F + joints (Eq. 39 and its generalisation), in scaled units."""

    laws: tuple[Friction, ...]  # of one joint, or with an axis over the faces of several
    speed: Float[Array, ""]  # unit of velocity [m/s]
    omega: Float[Array, ""]  # unit of 1/time [1/s]
    force_unit: Float[Array, ""]  # of the loads [N]
    K: Float[Array, "n n"]  # M^-1 K with closed joints; its diagonal (n,) if it is diagonal
    C: Float[Array, "n n"]  # M^-1 C; its diagonal (n,) if it is diagonal
    F: Float[Array, " n"]  # M^-1 F
    T: Float[Array, "f n"] | None  # directions of the faces; None: they are the dofs
    B: Float[Array, "n f"] | None  # M^-1 T^T; None: absorbed by the loads
    L: Float[Array, "f n"]  # the load on a face, which friction multiplies, is L x + P
    P: Float[Array, " f"]
    V: Float[Array, " f"]
    joint_forces: tuple[JointForce, ...]  # of each joint, over (L x)/P - 1
    faces: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # of each joint
    sharing: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # the joints of each of the laws
    jointless: bool = eqx.field(static=True, default=False)  # its one face belongs to no joint
    # True if the last degree of freedom is the phase of an excitation: excitation.py.
    excited: bool = eqx.field(static=True, default=False)
    # With many degrees of freedom, the largest rate of the mechanism without friction, within 1 %:
    # steps then follow the motion, as far as that rate allows. None: steps are for a rate of 1.
    fastest: Float[Array, ""] | None = None
    products: Products | None = None  # of a structure
    scales: LawScales | None = None  # None: no law depends on the velocity
    # Sliding velocities at which the law of each face is not smooth, in order; None: there are none
    knots: Float[Array, "f k"] | None = None
    # Velocities (f, ...) between which laws are as they are; beyond they go on smoothly. knots.py
    piece: tuple[Array, Array] | None = None

    def with_products(self) -> "HybridSystem":
        """The system with `products`, if it has T and B; K and C are matrices then."""
        if self.T is None or self.B is None:
            return self
        both, zero = jnp.concatenate([self.K, self.C], axis=1), jnp.zeros_like(self.T)
        blocks = [jnp.concatenate([self.L, zero], axis=1), jnp.concatenate([zero, self.T], axis=1)]
        matrix = jnp.concatenate([*blocks, self.T @ both, both])
        return replace(self, products=Products(matrix, self.T @ self.B, self.T @ self.F))

    @property
    def joints(self) -> tuple[tuple[int, ...], ...]:
        """The faces of each joint."""
        return () if self.jointless else self.faces

    @property
    def opens(self) -> tuple[bool, ...]:
        """True for joints that can open."""
        return tuple(force.opens for force in self.joint_forces)

    @property
    def linear(self) -> bool:
        """True if no joint follows a load curve."""
        return all(force.linear for force in self.joint_forces)

    @property
    def states(self) -> tuple[State, ...]:
        """The contact states that its faces can have."""
        return STATES if any(self.opens) else tuple(state for state in STATES if state.closed)

    @property
    def guard_numbers(self) -> GuardNumbers:
        """The numbers of its guards."""
        return GuardNumbers(len(self.P), tuple(np.flatnonzero(self.opens).tolist()))

    @property
    def n(self) -> int:
        """The number of degrees of freedom, including that of an excitation."""
        return self.F.shape[0]

    def mechanism_state(self, y) -> Array:
        """The mechanism's part (2n, ...) of states, without the excitation."""
        if not self.excited:
            return y
        return jnp.concatenate([y[: self.n - 1], y[self.n : -1]])

    @property
    def affine(self) -> bool:
        """True if the field of every contact state is affine."""
        return self.linear and not any(law.velocity_dependent for law in self.laws)

    @property
    def has_jump(self) -> bool:
        """True if the static coefficient of a law may lie above its limit at vanishing speed."""
        return any(law.has_jump for law in self.laws)

    @property
    def constant(self) -> int | None:
        """The component of a state that no motion changes at the section: z of an excitation."""
        return self.n - 1 if self.excited else None

    def excitation_frequency(self, lanes: int = 0) -> Array:
        """Omega of z'' = -Omega^2 z, the last degree of freedom of an excited system."""
        return self.over_lanes(jnp.sqrt(self.K[-1, -1]), lanes)

    @property
    def excitation_period(self) -> Array:
        """2 pi/Omega."""
        return 2 * jnp.pi / self.excitation_frequency()

    @property
    def largest_force(self) -> Array:
        """The largest acceleration by the constant and the harmonic forces."""
        constant = jnp.max(jnp.abs(self.F), axis=0)
        if not self.excited:
            return constant
        return constant + jnp.max(jnp.abs(self.K[:-1, -1]), axis=0)

    def bound(self, y, equilibrium) -> Array:
        """The size (...) that a motion from y (2n, ...) exceeds only if it diverges."""
        size = 1 + jnp.max(jnp.abs(y), axis=0)
        size = size + jnp.max(jnp.where(jnp.isfinite(equilibrium), jnp.abs(equilibrium), 0), axis=0)
        if self.scales is not None:
            # With a small V, motions of many V are ordinary.
            size = size + jnp.max(self.scales.falls_until, axis=0)
        if self.excited:  # a resonance amplifies the static response by up to 1e3
            size = size + 1e3 * self.largest_force
        return 1e3 * size

    def with_excitation(self, y, t) -> Array:
        """States (2n, ...) of the mechanism at the times t (...), with z = cos(Omega t)."""
        if not self.excited:
            return y
        Omega = self.excitation_frequency()
        t = jnp.broadcast_to(t, y.shape[1:])
        z, rate = jnp.cos(Omega * t)[None], (-Omega * jnp.sin(Omega * t))[None]
        x, u = jnp.split(y, 2)
        return jnp.concatenate([x, z, u, rate])

    def with_unit_excitation(self, y) -> Array:
        """States with z^2 + (z'/Omega)^2 = 1 again, which a coarse method lets decay."""
        if not self.excited:
            return y
        z, rate = y[self.n - 1], y[-1]
        size = jnp.sqrt(z**2 + (rate / self.excitation_frequency(z.ndim)) ** 2)
        return y.at[self.n - 1].divide(size).at[-1].divide(size)

    def over_lanes(self, leaf, lanes: int) -> Array:
        """A leaf with an axis of length one for each lane that the system does not have."""
        return leaf.reshape(leaf.shape + (1,) * (lanes - self.omega.ndim))

    def times(self, matrix, x) -> Array:
        """matrix (i, j) times x (j, ...); a matrix (j,) is a diagonal."""
        batch_axes = self.omega.ndim
        if matrix.ndim - batch_axes == 1:
            return self.over_lanes(matrix, x.ndim - 1) * x
        if len(x) > 8 and not batch_axes:  # up to there a sum compiles into one loop with others
            return jnp.tensordot(matrix, x, 1)
        matrix = self.over_lanes(matrix, x.ndim - 1)
        if len(x) == 2:  # written out: many lanes run a fifth faster than with XLA's reduction
            return matrix[:, 0] * x[:1] + matrix[:, 1] * x[1:]
        return jnp.sum(matrix * x[None], axis=1)

    def along(self, x) -> Array:
        """t.x for each face (f, ...)."""
        return x if self.T is None else self.times(self.T, x)

    def acceleration(self, forces) -> Array:
        """Accelerations (n, ...) by forces (f, ...) on the faces."""
        return forces if self.B is None else self.times(self.B, forces)

    def linear_loads(self, x) -> Array:
        """The loads of the faces (f, ...) with springs of constant stiffness."""
        return self.times(self.L, x) + self.over_lanes(self.P, x.ndim - 1)

    def loads(self, x) -> Array:
        """Loads (f, ...), which friction multiplies; stick is attracting where they are > 0."""
        return self._loads(self.linear_loads(x))

    def _loads(self, linear) -> Array:
        if self.linear:
            return linear
        loads = list(linear)
        for faces, force in zip(self.faces, self.normal_forces(linear), strict=True):
            loads[faces[0]] = force
        return jnp.stack(loads)

    def normal_forces(self, linear) -> Array:
        """Normal forces of joints (m, ...) whose faces have loads (f, ...) by linear springs."""
        normal_forces = rows(linear, self._tangential)
        if self.linear:
            return normal_forces
        normal_forces = list(normal_forces)
        for j, P, e, force in self.load_curves(linear):
            normal_forces[j] = P * force(e)
        return jnp.stack(normal_forces)

    def load_curves(self, linear) -> Iterator[tuple[int, Array, Array, JointForce]]:
        """Yield the joints that follow a load curve: number, P, e = (L x)/P - 1, and the force."""
        for j, (faces, force) in enumerate(zip(self.faces, self.joint_forces, strict=True)):
            if not force.linear:
                leaf = functools.partial(self.over_lanes, lanes=linear.ndim - 1)
                P = leaf(self.P[faces[0]])
                yield j, P, linear[faces[0]] / P - 1, jax.tree.map(leaf, force)

    def closures(self, x) -> Array:
        """Closures of the joints (m, ...), which fall through 0 on opening, linear in x [load]."""
        linear = self.linear_loads(x)
        closures = rows(linear, self._tangential)
        if self.linear:
            return closures
        closures = list(closures)
        for j, P, e, force in self.load_curves(linear):
            closures[j] = P + P * e / force.opening
        return jnp.stack(closures)

    def sliding(self, u) -> Array:
        """Sliding velocity w of each face (f, ...)."""
        return self.over_lanes(self.V, u.ndim - 1) - self.along(u)

    def at_each_face(self, function, *arrays) -> Array:
        """function(law, *rows) for each face, with the law of its joint."""
        values, order = [], []
        for law, joints in zip(self.laws, self.sharing, strict=True):
            faces = [i for j in joints for i in self.faces[j]]
            face_arrays = [rows(x, faces) for x in arrays]
            if len(joints) > 1:
                values.append(jax.vmap(function)(law, *face_arrays))
            else:
                values.append(jax.vmap(functools.partial(function, law))(*face_arrays))
            order += faces
        return rows(jnp.concatenate(values), np.argsort(order))

    @property
    def _tangential(self) -> list[int]:
        """The tangential face of each joint."""
        return [faces[0] for faces in self.faces]

    def is_open(self, s) -> Array:
        """True for faces whose joint is open in contact states s."""
        return in_states(s, [state for state in STATES if not state.closed])

    def resting(self, s, used) -> Array:
        """Projector (n, n, ...) of x onto t of the faces that stick in all used s (f, N, ...).

        Only a face that nothing drives sticks for a whole period, and then at any place.
        """
        assert self.T is not None  # of an excited system
        rests = jnp.all(self.is_held(s) | ~used[None], axis=1)
        T = jnp.where(rests[:, None], self.over_lanes(self.T, s.ndim - 1)[:, :, 0], 0)
        identity = np.eye(len(T), dtype=T.dtype).reshape(len(T), len(T), *(1,) * (rests.ndim - 1))
        alone = ~(rests[:, None] & rests[None])
        W = jnp.where(alone, identity, product(T, jnp.swapaxes(T, 0, 1)))
        by = jnp.stack([solve_positive(W, T[:, i]) for i in range(T.shape[1])], axis=1)
        return product(jnp.swapaxes(T, 0, 1), by)

    def is_held(self, s) -> Array:
        """True for faces that contact states s hold at w = 0."""
        return in_states(s, [state for state in self.states if state.force is None])

    def limits(self, loads) -> Array:
        """The largest friction force of each face in stick (f, ...)."""
        return self.at_each_face(lambda law, load: law.mu_s * load, loads)

    def static_excess(self) -> Array:
        """The static coefficient of each face (f,) less the limit at vanishing speed, over it."""
        return self.at_each_face(
            lambda law, one: one * (law.mu_s / law.kinetic_limit() - 1), jnp.ones_like(self.P)
        )

    def over_static(self, speeds) -> Array:
        """The coefficient of friction at sliding speeds (f, ...) [m/s], over the static one."""
        return self.at_each_face(lambda law, speed: law.mu(speed) / law.mu_s, speeds)

    def friction(self, w, loads, signs) -> Array:
        """The friction forces of the faces (f, ...) with these signs of sliding."""
        if self.scales is not None:
            side = jnp.sign(signs)
            w = side * jnp.maximum(side * w, -self.over_lanes(self.scales.below, w.ndim - 1))
        if self.piece is not None:
            return self._friction_of_piece(self.piece, w, loads, signs)
        return self.at_each_face(
            lambda law, w, load, sign: law.branch(self.speed * w, sign) * load, w, loads, signs
        )

    def _friction_of_piece(self, piece, w, loads, signs) -> Array:
        """`friction` by laws that are parabolas beyond the ends of a piece."""
        side = jnp.sign(signs)
        inside = jnp.clip(side * w, *piece)

        def force(law, w, inside, load, sign, side):
            at, beyond = self.speed * inside, self.speed * (side * w - inside)
            slope, bend = jax.jvp(law.slope, (at,), (jnp.ones_like(at),))
            mu = law.branch(side * at, sign) + side * beyond * (slope + beyond / 2 * bend)
            return mu * load

        return self.at_each_face(force, w, inside, loads, signs, side)

    def spring_release(self, linear) -> Array:
        """Forces (f, ...) that cancel the springs of an open joint, which K contains."""
        if all(self.opens):
            pairs = linear.reshape(-1, 2, *linear.shape[1:])
            return jnp.stack([-pairs[:, 1], pairs[:, 0]], axis=1).reshape(linear.shape)
        release = list(linear)
        for tangential, normal in (self.faces[j] for j in self.guard_numbers.opening):
            release[normal], release[tangential] = linear[tangential], -linear[normal]
        return jnp.stack(release)

    def self_acceleration(self, forces) -> Array:
        """Acceleration of each face (f, ...) by the force on that face alone."""
        if self.T is None or self.B is None:
            return forces
        return forces * self.over_lanes(
            jnp.sum(self.T * jnp.swapaxes(self.B, 0, 1), axis=1), forces.ndim - 1
        )

    def holding_forces(self, accelerations, held) -> Array:
        """Forces (f, ...) on the faces `held` that cancel their accelerations t.x'' (f, ...)."""
        required = jnp.where(held, -accelerations, 0)
        if self.products is None:
            return required
        W = self.over_lanes(self.products.W, held.ndim - 1)
        identity = np.eye(len(W), dtype=W.dtype).reshape(len(W), len(W), *(1,) * (held.ndim - 1))
        W = jnp.where(held[:, None] & held[None], W, identity)

        def constraint_forces():
            return jnp.where(held, solve_positive(W, required), 0)

        if len(W) <= SMALL:
            return constraint_forces()
        return jax.lax.cond(jnp.any(held), constraint_forces, lambda: jnp.zeros_like(required))

    # --- the motion in a contact state ---

    def _faces_at(self, y, s) -> FaceMotion:
        x, u = y[: self.n], y[self.n :]
        linear = self.linear_loads(x)
        return FaceMotion(self, s, self.sliding(u), self._loads(linear), linear)

    def _driven(self, y, applied) -> Array:
        """Acceleration (n, ...) by these forces on the faces, with none that holds any."""
        x, u = y[: self.n], y[self.n :]
        free = self.over_lanes(self.F, x.ndim - 1) - self.times(self.K, x) - self.times(self.C, u)
        return free + self.acceleration(applied)

    def _applied(self, faces: FaceMotion) -> Array:
        """Forces (f, ...) on the faces, without those that hold sticking ones."""
        closed = [state for state in self.states if state.closed]
        return self._with_joint_forces(state_forces(faces, closed, 0), faces)

    def _with_joint_forces(self, friction, faces: FaceMotion) -> Array:
        """Forces (f, ...) by friction and by what joints do beyond the springs that K contains."""
        if not self.linear:
            linear, applied = faces.linear_loads, list(friction)
            for j, P, e, force in self.load_curves(linear):
                tangential, normal = self.faces[j]
                applied[normal] = applied[normal] + linear[tangential] - P * force(e)
            friction = jnp.stack(applied)
        return state_forces(faces, [state for state in self.states if not state.closed], friction)

    @property
    def _at_faces(self) -> Products | None:
        """The `products`, where the forces follow from the motion at the faces alone."""
        return self.products if self.linear else None

    def _by_products(
        self, products: Products, y, s, which: slice
    ) -> tuple[FaceMotion, Array, Array, Array]:
        """The faces, the forces that hold them, other forces on them, the other products."""
        f, leaf = len(self.P), functools.partial(self.over_lanes, lanes=y.ndim - 1)
        projections = self.times(products.matrix[which], y)
        loads, along, driven, rest = jnp.split(projections, [f, 2 * f, 3 * f])
        loads, w = loads + leaf(self.P), leaf(self.V) - along
        faces = FaceMotion(self, s, w, loads, loads)
        applied = state_forces(faces, self.states, 0)
        accelerations = leaf(products.F) - driven + self.times(products.W, applied)
        holding = self.holding_forces(accelerations, self.is_held(s))
        return faces, holding, applied, rest

    @_traced_once
    def field(self, y, s) -> Array:
        """dy/dt in contact state s. A sticking face must have w = 0."""
        products = self._at_faces
        if products is not None:
            _, holding, applied, driven = self._by_products(products, y, s, slice(None))
            free = self.over_lanes(self.F, y.ndim - 1) - driven
            return jnp.concatenate([y[self.n :], free + self.acceleration(applied + holding)])
        acceleration = self._driven(y, self._applied(self._faces_at(y, s)))
        held = self.is_held(s)
        if self.B is None:
            acceleration = jnp.where(held, 0, acceleration)
        else:
            holding = self.holding_forces(self.along(acceleration), held)
            acceleration = acceleration + self.acceleration(holding)
        return jnp.concatenate([y[self.n :], acceleration])

    def forces_at_rest(self, y, s) -> tuple[Array, Array]:
        """Accelerations t.x'' of faces (f, ...) in contact state s, and the holding forces."""
        rate = self.along(self._driven(y, self._applied(self._faces_at(y, s))))
        holding = self.holding_forces(rate, self.is_held(s))
        return rate + self.along(self.acceleration(holding)), holding

    def smooth_faces(self, y) -> FaceMotion:
        """The faces where no friction force jumps: they slip, or are open."""
        return self._faces_at(y, jnp.where(self.open_faces(y), OPEN, FORWARD))

    def smooth_field(self, y, faces: FaceMotion, friction) -> Array:
        """dy/dt under forces of friction (f, ...) on the closed ones of its `smooth_faces`."""
        forces = self._with_joint_forces(friction, faces)
        return jnp.concatenate([y[self.n :], self._driven(y, forces)])

    def open_faces(self, y) -> Array:
        """True for faces (f, ...) of joints that can open and whose normal force would pull."""
        closures = self.closures(y[: self.n])
        opens = jnp.asarray(np.repeat(self.opens, [len(faces) for faces in self.faces]))
        first = jnp.stack([closures[j] for j, faces in enumerate(self.faces) for _ in faces])
        return opens.reshape(-1, *(1,) * (y.ndim - 1)) & (first < 0)

    # --- guards ---

    def section(self, y) -> Array:
        """t.u of the first face, which falls through 0 at a return to the Poincare section.

        In an excited system it is z', so that the section is stroboscopic.
        """
        return y[-1] if self.excited else self.along(y[self.n :])[0]

    @_traced_once
    def guards(self, y, s) -> Array:
        """Functions (k, ...) that are positive while contact state s lasts, and the section.

        A face has the two of its state, a joint that can open its closure, or minus that while it
        is open; `guard_numbers` has their numbers.
        """
        products = self._at_faces
        if products is not None:
            faces, holding, *_ = self._by_products(products, y, s, slice(3 * len(self.P)))
        else:
            faces = self._faces_at(y, s)
            if self.B is None:
                free = jnp.zeros_like(faces.w)  # each face is a degree of freedom by itself
                holding = -self._driven(y, self._with_joint_forces(free, faces))
            else:
                rate = self.along(self._driven(y, self._applied(faces)))
                holding = self.holding_forces(rate, self.is_held(s))
        guards = [self.section(y)[None], face_guards(faces, holding, self.states)]
        if opening := self.guard_numbers.opening:
            closures = rows(self.closures(y[: self.n]), opening)
            is_open = self.is_open(rows(s, [self._tangential[j] for j in opening]))
            guards.append(jnp.where(is_open, -closures, closures))
        return jnp.concatenate(guards)

    # --- equilibrium and units ---

    def equilibrium(self) -> Float[Array, " 2n"]:
        """The closed, forward-slipping equilibrium (Eq. 40) as a state."""
        mu = self.at_each_face(lambda law, V: law.mu(self.speed * V), self.V)
        if self.excited:  # without V friction is anything up to its limit: here it is 0
            mu = mu * jnp.sign(self.V)
        K = jnp.diag(self.K) if self.K.ndim == 1 else self.K
        B = jnp.eye(self.n, dtype=K.dtype) if self.B is None else self.B
        coupled = K - product(B * mu[None], self.L)
        x = solve(coupled, self.F + B @ (mu * self.P))
        joints = zip(self.faces, self.joint_forces, strict=True)
        curved = [(faces, force) for faces, force in joints if not force.linear]
        if curved:
            first, normal = (np.array([faces[i] for faces, _ in curved]) for i in (0, 1))
            P = self.P[first]
            curves: list[Any] = [force for _, force in curved]
            # The deficit of each load neither pushes along n nor rubs along t.
            missing = (B[:, normal] - mu[first][None] * B[:, first]) * P[None]
            by = jnp.linalg.solve(coupled, missing)
            e = loaded_equilibrium(curves, self.L[first] @ x / P, self.L[first] @ by / P[:, None])
            deficits = [1 + each - force(each) for each, force in zip(e, curves, strict=True)]
            x = x + by @ jnp.stack(deficits)
        return jnp.concatenate([x, jnp.zeros_like(x)])

    @property
    def section_direction(self) -> Float[Array, " n"]:
        """t of the first face."""
        return jnp.eye(self.n, dtype=self.F.dtype)[0] if self.T is None else self.T[0]

    @property
    def units(self) -> Float[Array, " 2n"]:
        """Units [m, ..., m/s, ...] of a scaled state of the mechanism."""
        n, length = self.n - self.excited, self.speed / self.omega
        return jnp.concatenate([jnp.full(n, length), jnp.full(n, self.speed)])
