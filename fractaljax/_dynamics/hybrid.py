"""A mechanism with dry friction as a hybrid system: field, guards and transitions.

Everything here is in scaled units: time 1/omega, velocity V of the first joint, length V/omega. A
state y (2n, ...) is [x, u] with u = dx/dt. Friction acts on faces: along the tangential direction
of a joint and, where the joint has a tangential spring, along its normal. The contact state s
(f, ...) has for each face +1 (slip forward, w = V - t.u > 0), -1 (slip backward), 0 (stick, w = 0)
or 2 (open, both faces of a joint together). Components are the first axis; lanes may follow.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._contact.load_curve import LoadTable, loaded_equilibrium
from .._friction import SPEEDS, Friction
from .lanes import SMALL, first_least, product, row_numbers, rows, solve, solve_positive

OPEN = 2
# Guards, by number: the section of the Poincare map, two for each face, one for each joint that
# can open. The section is where t.u of the first face falls through 0, a maximum of t.x; of an
# excited system it is the maximum of the excitation, once in each of its periods.
SECTION, NONE, UNUSED = 0, -1, -2
_SMOOTH = 1e-4  # of the way to the opening; nearer to it, what a load curve adds is below rounding
FEW = 4  # degrees of freedom up to which a product is a sum, which compiles into one loop
_FAR = 1e3  # factor by which a diverging motion exceeds all of its scales
_RESONANCE = 1e3  # largest amplification of the static response to a harmonic force
_HALVINGS = 48  # of the unit of velocity, to find how far a law continues below w = 0
_TRIALS = 4.0 ** -np.arange(13)  # shares of a step at which the steepness ahead is evaluated


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


class LawScales(eqx.Module):
    """Bounds on velocity-dependent friction at each face, which limit the steps."""

    below: Float[Array, " f"]  # how far below w = 0 its law is continued
    # Its steepest slope up to each of `SPEEDS`: by how much a unit of load changes dw/dt with w.
    steepest: Float[Array, "f v"]
    falls_until: Float[Array, " f"]  # velocity at which it is least, up to 100 m/s


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
    curves: tuple[LoadTable | None, ...]  # of the joints whose load follows one, over (L x)/P
    faces: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # of each joint
    sharing: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # the joints of each of the laws
    opens: tuple[bool, ...] = eqx.field(static=True)  # True for joints that can open
    jointless: bool = eqx.field(static=True, default=False)  # its one face belongs to no joint
    # True if the last degree of freedom is the phase of an excitation: excitation.py.
    excited: bool = eqx.field(static=True, default=False)
    # With many degrees of freedom, the largest rate of the mechanism without friction, within 1 %:
    # steps then follow the motion, as far as that rate allows. None: steps are for a rate of 1.
    fastest: Float[Array, ""] | None = None
    products: Products | None = None  # of a structure
    scales: LawScales | None = None  # None: no law depends on the velocity

    def with_scales(self) -> "HybridSystem":
        """The system with `scales`, if any law depends on the velocity.

        Below w = 0 a law continues while mu is between 0 and 2 mu_s, and is constant beyond: a
        coarse step may overshoot to where the formula of a law has no meaning.
        """
        if not any(law.velocity_dependent for law in self.laws):
            return self
        shares = jnp.asarray(2.0 ** -np.arange(_HALVINGS), self.V.dtype)
        speeds = jnp.asarray(SPEEDS, self.V.dtype)

        def numbers(law, one):
            mu = law.mu(-self.speed * shares)
            inside = ((mu >= 0) & (mu <= 2 * law.mu_s)).astype(shares.dtype)
            below = jnp.max(jax.lax.cummin(inside, reverse=True) * shares)
            falls_until = speeds[jnp.argmin(law.mu(speeds))] / self.speed
            steepest = self.speed * jax.lax.cummax(jnp.abs(law.slope(speeds)))
            return one * jnp.concatenate([jnp.stack([below, falls_until]), steepest])

        face_scales = jax.lax.stop_gradient(self._each(numbers, jnp.ones_like(self.P)))
        steepest = self._self_acceleration(face_scales[:, 2:])
        return replace(self, scales=LawScales(face_scales[:, 0], steepest, face_scales[:, 1]))

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
        return not any(self.curves) and not any(law.velocity_dependent for law in self.laws)

    @property
    def constant(self) -> int | None:
        """The component of a state that no motion changes at the section: z of an excitation."""
        return self.n - 1 if self.excited else None

    def excitation_frequency(self, lanes: int = 0) -> Array:
        """Omega of z'' = -Omega^2 z, the last degree of freedom of an excited system."""
        return self._leaf(jnp.sqrt(self.K[-1, -1]), lanes)

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
        return _FAR * (size + _RESONANCE * self.largest_force if self.excited else size)

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

    def _leaf(self, leaf, lanes: int) -> Array:
        """A leaf with an axis of length one for each lane that the system does not have."""
        return leaf.reshape(leaf.shape + (1,) * (lanes - self.omega.ndim))

    def times(self, matrix, x) -> Array:
        """matrix (i, j) times x (j, ...); a matrix (j,) is a diagonal."""
        batch_axes = self.omega.ndim
        if matrix.ndim - batch_axes == 1:
            return self._leaf(matrix, x.ndim - 1) * x
        if len(x) > 2 * FEW and not batch_axes:
            return jnp.tensordot(matrix, x, 1)
        matrix = self._leaf(matrix, x.ndim - 1)
        if len(x) == 2:  # written out: many lanes run a fifth faster than with XLA's reduction
            return matrix[:, 0] * x[:1] + matrix[:, 1] * x[1:]
        return jnp.sum(matrix * x[None], axis=1)

    def along(self, x) -> Array:
        """t.x for each face (f, ...)."""
        return x if self.T is None else self.times(self.T, x)

    def _acceleration(self, forces) -> Array:
        """Accelerations (n, ...) by forces (f, ...) on the faces."""
        return forces if self.B is None else self.times(self.B, forces)

    def linear_loads(self, x) -> Array:
        """The loads of the faces (f, ...) with springs of constant stiffness."""
        return self.times(self.L, x) + self._leaf(self.P, x.ndim - 1)

    def loads(self, x) -> Array:
        """Loads (f, ...), which friction multiplies; stick is attracting where they are > 0."""
        linear = self.linear_loads(x)
        if not any(self.curves):
            return linear
        loads = list(linear)
        for faces, force in zip(self.faces, self.normal_forces(linear), strict=True):
            loads[faces[0]] = force
        return jnp.stack(loads)

    def normal_forces(self, linear) -> Array:
        """Normal forces of joints (m, ...) whose faces have loads (f, ...) by linear springs."""
        forces = rows(linear, self._first)
        if not any(self.curves):
            return forces
        forces = list(forces)
        for j, P, e, curve in self._on_curves(linear):
            forces[j] = P * curve(e)
        return jnp.stack(forces)

    def _on_curves(self, linear) -> Iterator[tuple[int, Array, Array, LoadTable]]:
        """The joints that follow a load curve: number, P, e = (L x)/P, and the curve, by lanes."""
        for j, (faces, curve) in enumerate(zip(self.faces, self.curves, strict=True)):
            if curve is not None:
                leaf = functools.partial(self._leaf, lanes=linear.ndim - 1)
                P = leaf(self.P[faces[0]])
                yield j, P, linear[faces[0]] / P - 1, jax.tree.map(leaf, curve)

    def closures(self, x) -> Array:
        """Closures of the joints (m, ...), which fall through 0 on opening, linear in x [load]."""
        linear = self.linear_loads(x)
        closures = rows(linear, self._first)
        if not any(self.curves):
            return closures
        closures = list(closures)
        for j, P, e, curve in self._on_curves(linear):
            closures[j] = P + P * e / curve.opening
        return jnp.stack(closures)

    def sliding(self, u) -> Array:
        """Sliding velocity w of each face (f, ...)."""
        return self._leaf(self.V, u.ndim - 1) - self.along(u)

    def _each(self, function, *arrays) -> Array:
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
    def _first(self) -> list[int]:
        """The tangential face of each joint."""
        return [faces[0] for faces in self.faces]

    @property
    def _opening(self) -> list[int]:
        """The joints that can open, in the order of their guards."""
        return [j for j, opens in enumerate(self.opens) if opens]

    def limits(self, loads) -> Array:
        """The largest friction force of each face in stick (f, ...)."""
        return self._each(lambda law, load: law.mu_s * load, loads)

    def over_static(self, speeds) -> Array:
        """The coefficient of friction at sliding speeds (f, ...) [m/s], over the static one."""
        return self._each(lambda law, speed: law.mu(speed) / law.mu_s, speeds)

    def _driven(self, y, friction, s=None) -> Array:
        """Acceleration (n, ...) by these friction forces, with no force holding sticking faces."""
        x, u = y[: self.n], y[self.n :]
        if any(self.curves):
            # K contains the spring of the preload: the difference from the load curve is added.
            linear = self.linear_loads(x)
            forces = list(friction)
            for j, P, e, curve in self._on_curves(linear):
                tangential, normal = self.faces[j]
                forces[normal] = forces[normal] + linear[tangential] - P * curve(e)
            friction = jnp.stack(forces)
        if s is not None and any(self.opens):
            friction = jnp.where(s == OPEN, self._taken_back(self.linear_loads(x)), friction)
        free = self._leaf(self.F, x.ndim - 1) - self.times(self.K, x) - self.times(self.C, u)
        return free + self._acceleration(friction)

    def _taken_back(self, loads) -> Array:
        """Forces (f, ...) that cancel the springs of an open joint, which K contains."""
        if all(self.opens):
            pairs = loads.reshape(-1, 2, *loads.shape[1:])
            return jnp.stack([-pairs[:, 1], pairs[:, 0]], axis=1).reshape(loads.shape)
        taken = list(loads)
        for tangential, normal in (self.faces[j] for j in self._opening):
            taken[normal], taken[tangential] = loads[tangential], -loads[normal]
        return jnp.stack(taken)

    def _friction(self, y, signs) -> Array:
        """The friction forces of the faces (f, ...) with these signs of sliding."""
        return self._by_laws(self.sliding(y[self.n :]), self.loads(y[: self.n]), signs)

    def _by_laws(self, w, loads, signs) -> Array:
        if self.scales is not None:
            side = jnp.sign(signs)
            w = side * jnp.maximum(side * w, -self._leaf(self.scales.below, w.ndim - 1))
        return self._each(
            lambda law, w, load, sign: law.branch(self.speed * w, sign) * load, w, loads, signs
        )

    def _slipping(self, y, s) -> Array:
        """The friction forces of slipping faces (f, ...), 0 elsewhere."""
        return jnp.where(jnp.abs(s) == 1, self._friction(y, s), 0)

    def held(self, accelerations, held) -> Array:
        """Forces (f, ...) on the faces `held` that cancel their accelerations t.x'' (f, ...)."""
        required = jnp.where(held, -accelerations, 0)
        if self.products is None:
            return required
        W = self._leaf(self.products.W, held.ndim - 1)
        identity = np.eye(len(W), dtype=W.dtype).reshape(len(W), len(W), *(1,) * (held.ndim - 1))
        W = jnp.where(held[:, None] & held[None], W, identity)

        def constraint_forces():
            return jnp.where(held, solve_positive(W, required), 0)

        if len(W) <= SMALL:
            return constraint_forces()
        return jax.lax.cond(jnp.any(held), constraint_forces, lambda: jnp.zeros_like(required))

    @property
    def _at_faces(self) -> Products | None:
        """The `products`, where the forces follow from the motion at the faces alone."""
        return None if any(self.curves) else self.products

    def _face_quantities(self, products: Products, y, s, which: slice) -> tuple[Array, ...]:
        """Loads, w, forces and holding forces of faces (f, ...), and the rest of the products."""
        f, leaf = len(self.P), functools.partial(self._leaf, lanes=y.ndim - 1)
        projections = self.times(products.matrix[which], y)
        loads, along, driven, rest = jnp.split(projections, [f, 2 * f, 3 * f])
        loads, w = loads + leaf(self.P), leaf(self.V) - along
        forces = jnp.where(jnp.abs(s) == 1, self._by_laws(w, loads, s), 0)
        if any(self.opens):
            forces = jnp.where(s == OPEN, self._taken_back(loads), forces)
        accelerations = leaf(products.F) - driven + self.times(products.W, forces)
        return loads, w, forces, self.held(accelerations, s == 0), rest

    @_traced_once
    def field(self, y, s) -> Array:
        """dy/dt in contact state s. A sticking face must have w = 0."""
        products = self._at_faces
        if products is not None:
            _, _, forces, held, driven = self._face_quantities(products, y, s, slice(None))
            free = self._leaf(self.F, y.ndim - 1) - driven
            return jnp.concatenate([y[self.n :], free + self._acceleration(forces + held)])
        acceleration = self._driven(y, self._slipping(y, s), s)
        stick = s == 0
        if self.B is None:
            acceleration = jnp.where(stick, 0, acceleration)
        else:
            force = self.held(self.along(acceleration), stick)
            acceleration = acceleration + self._acceleration(force)
        return jnp.concatenate([y[self.n :], acceleration])

    def regularised_field(self, y, signs) -> Array:
        """dy/dt where friction has smoothed `signs` (f, ...) between -1 and 1."""
        force, opens = self._friction(y, signs), self.open_faces(y)
        return jnp.concatenate([y[self.n :], self._driven(y, force, jnp.where(opens, OPEN, 1))])

    def open_faces(self, y) -> Array:
        """True for faces (f, ...) of joints that can open and whose normal force would pull."""
        closures = self.closures(y[: self.n])
        opens = jnp.asarray(np.repeat(self.opens, [len(faces) for faces in self.faces]))
        first = jnp.stack([closures[j] for j, faces in enumerate(self.faces) for _ in faces])
        return opens.reshape(-1, *(1,) * (y.ndim - 1)) & (first < 0)

    def section(self, y) -> Array:
        """t.u of the first face, which falls through 0 at a return to the Poincare section.

        In an excited system it is z', so that the section is stroboscopic.
        """
        return y[-1] if self.excited else self.along(y[self.n :])[0]

    @_traced_once
    def guards(self, y, s) -> Array:
        """Functions (k, ...) that are positive while contact state s lasts, and the section.

        A face in slip has s w and a constant, a face in stick the distances of the friction force
        from its two limits; a joint that can open has its closure, or minus that while open.
        """
        x, u = y[: self.n], y[self.n :]
        products = self._at_faces
        if products is not None:
            loads, w, _, force, _ = self._face_quantities(products, y, s, slice(3 * len(self.P)))
        else:
            w, loads = self.sliding(u), self.loads(x)
            if self.B is None:
                force = -self._driven(y, jnp.zeros_like(w), s)
            else:
                force = self.held(self.along(self._driven(y, self._slipping(y, s), s)), s == 0)
        one = jnp.ones_like(w)
        limits, slip, stick = self.limits(loads), jnp.abs(s) == 1, s == 0
        lower = jnp.where(slip, s * w, jnp.where(stick, limits - force, one))
        upper = jnp.where(stick, limits + force, one)
        pairs = jnp.stack([lower, upper], axis=1).reshape(2 * len(w), *w.shape[1:])
        guards = [self.section(y)[None], pairs]
        if any(self.opens):
            closures = rows(self.closures(x), self._opening)
            opened = rows(s, [self._first[j] for j in self._opening]) == OPEN
            guards.append(jnp.where(opened, -closures, closures))
        return jnp.concatenate(guards)

    def crowding(self, y, s) -> Array:
        """Factor (...) by which segments should be shorter where load curves bend."""
        return 2 * self._of_curves(y, s, 1 / 4)

    def density(self, y, s, longest) -> Array:
        """Factor (...) by which segments from y on should be shorter than `longest` (...)."""
        shortest = self.step_length(y, s, self.field(y, s), longest, longest)
        return jnp.maximum(longest / shortest, self.crowding(y, s))

    def _self_acceleration(self, forces) -> Array:
        """Acceleration of each face (f, ...) by the force on that face alone."""
        if self.T is None or self.B is None:
            return forces
        return forces * self._leaf(
            jnp.sum(self.T * jnp.swapaxes(self.B, 0, 1), axis=1), forces.ndim - 1
        )

    def step_length(self, y, s, rate, longest, allowed) -> Array:
        """The length (...) of a step, at most `longest`, that is `allowed`/2 at a stiffness of 1.

        `rate` is dy/dt. The stiffness is the largest rate at which load curves change, or at which
        friction alone changes the velocity of a slipping face, at any velocity that the step can
        reach: far from equilibrium it exceeds every other rate, and a law may fall within a small
        part of the way to w = 0.
        """
        least = allowed / longest
        step = allowed / jnp.maximum(least, 2 * self._of_curves(y, s, 1 / 16))
        if self.scales is None:
            return step
        u, loads = y[self.n :], self.loads(y[: self.n])
        loads = self._self_acceleration(jnp.where(jnp.abs(s) == 1, jnp.abs(loads), 0))
        w, change = jnp.abs(self.sliding(u)), jnp.abs(self.along(rate[self.n :]))
        # No eigenfrequency exceeds 1, so that accelerations change by about the velocities.
        bend = (1 + jnp.max(jnp.abs(u), axis=0)) / 2
        fastest = w + (change + (longest * bend)[None]) * longest[None]
        bound = jnp.max(self._steepest(fastest) * loads, axis=0)

        def shortened():
            trials = jnp.multiply.outer(jnp.asarray(_TRIALS, y.dtype), longest)
            ways = (change[None] + (trials * bend[None])[:, None]) * trials[:, None]
            speeds = jnp.concatenate([jnp.maximum(w[None] - ways, 0), w[None], w[None] + ways])
            rates = jax.vmap(lambda w: self._steepness(w, loads))(speeds)
            slower, here, faster = jnp.split(rates, [len(trials), len(trials) + 1])
            most = jnp.maximum(here, jnp.maximum(slower, faster))
            most = jax.lax.cummax(most, reverse=True)
            steps = jnp.minimum(trials, allowed[None] / jnp.maximum(least[None], 2 * most))
            return jnp.minimum(step, jnp.max(steps, axis=0))

        return jax.lax.cond(jnp.all(2 * bound * longest <= allowed), lambda: step, shortened)

    def _steepest(self, w) -> Array:
        """The steepest slope of each face's friction at speeds up to w (f, ...)."""
        assert self.scales is not None
        # In lanes each has its own unit of speed.
        speeds = (self.speed[None] if self.speed.ndim else self.speed) * w
        # The table's speeds are 0 and then evenly spaced in their logarithm.
        decades = jnp.log10(jnp.maximum(speeds, SPEEDS[1]) / SPEEDS[1])
        place = 1 + jnp.ceil(decades / np.log10(SPEEDS[2] / SPEEDS[1])).astype(int)
        slopes = self._leaf(self.scales.steepest, w.ndim - 1)
        place = jnp.minimum(place, len(SPEEDS) - 1)[:, None]
        steepest = jnp.take_along_axis(slopes, place, axis=1)[:, 0]
        return jnp.where(speeds <= SPEEDS[-1], steepest, jnp.inf)

    def _steepness(self, w, loads) -> Array:
        """The largest rate (...) at which friction at |w| (f, ...) changes w; 0 without load."""

        def rate(law, w, load):
            return jnp.abs(self.speed * law.slope(self.speed * w)) * load

        return jnp.max(self._each(rate, w, loads), axis=0)

    def _of_curves(self, y, s, closing: float) -> Array:
        """The largest rate (...) at which load curves change; 0 without any.

        It is half the rate of the stiffness that they add to the springs of the preload, or
        `closing` times the rate of relative change of the way to the opening, where they are not
        smooth, whichever is larger.
        """
        x, u = y[: self.n], y[self.n :]
        linear, by_time, most = self.linear_loads(x), self.times(self.L, u), jnp.zeros_like(x[0])
        for j, P, e, curve in self._on_curves(linear):
            tangential, normal = self.faces[j]
            _, slope = jax.jvp(curve, (e,), (jnp.ones_like(e),))
            unit_force = jnp.zeros((len(linear), *e.shape), e.dtype).at[normal].set(1)
            added = self.times(self.L, self._acceleration(unit_force))[tangential] * (slope - 1)
            stiffer = jnp.sqrt(jnp.where(added > 0, added, 0)) / 2
            way = jnp.abs(e + curve.opening) + _SMOOTH * curve.opening
            nearing = jnp.where(s[tangential] == OPEN, 0, jnp.abs(by_time[tangential] / P) / way)
            most = jnp.maximum(most, jnp.maximum(stiffer, closing * nearing))
        return most

    def switch(self, y, s, guard) -> tuple[Array, Array]:
        """State and contact state after guard number `guard` has reached zero.

        A slip that ends reverses if the force on the other side carries it on; otherwise it
        sticks. Under a negative load it always reverses: the sliding mode there is repelling.
        """
        f = len(s)
        number_of = row_numbers(s)
        guard = jnp.broadcast_to(jnp.asarray(guard), s.shape[1:])
        ended = (guard[None] - 1) // 2 == number_of
        lower = guard[None] == 1 + 2 * number_of
        reversed_s = jnp.where(ended & (s != 0), -s, s)
        rate = self.along(self.field(y, reversed_s)[self.n :])
        reverses = (s * rate > 0) | (self.loads(y[: self.n]) < 0)
        after_slip = jnp.where(reverses, -s, 0)
        after = jnp.where(s == 0, jnp.where(lower, 1, -1), after_slip)
        new = jnp.where(ended, after.astype(s.dtype), s)
        exact = ended | (s == 0) | (new == 0)
        x, u = y[: self.n], y[self.n :]
        if any(self.opens):
            changes = self._guarded(guard, [0, 1])
            slips = jnp.where(s == OPEN, jnp.where(self.sliding(u) < 0, -1, 1), OPEN)
            new = jnp.where(changes, slips.astype(s.dtype), new)
            x = self._without_load(x, guard)
        # To rounding, the velocity of a face that sticks or starts to slip is the belt's.
        if self.B is None:
            u = jnp.where(exact, self._leaf(self.V, u.ndim - 1), u)
        else:
            u = u + self._acceleration(self.held(-self.sliding(u), exact & (new != OPEN)))
        y = jnp.concatenate([x, u])
        if self.B is None or f == 1:
            return y, new
        # The forces on sticking faces jump with the others' friction, perhaps beyond their limits.
        free = ended & (s != 0) | (new == 0)
        switched = jnp.any(guard > 0)
        return y, jax.lax.cond(switched, lambda: self._consistent(y, new, free), lambda: new)

    def _consistent(self, y, s, free) -> Array:
        """Contact state s, changed at faces `free` (f, ...) with w = 0 where it contradicts y.

        A force beyond its limits starts a slip; a slip that its own acceleration reverses sticks.
        The largest contradiction goes first, as in the pivoting of a complementarity problem.
        """
        # A contact state has no derivative, and the loop has none in reverse mode.
        system, y = jax.lax.stop_gradient((self, y))
        limits = system.limits(system.loads(y[: self.n]))
        # To rounding, a face at its limit may stick or slip.
        slack = 64 * jnp.finfo(y.dtype).eps

        def pivot(carry):
            s, _, pivots = carry
            rate = system.along(system._driven(y, system._slipping(y, s), s))
            force = system.held(rate, s == 0)
            rate = rate + system.along(system._acceleration(force))
            excess = jnp.where(s == 0, jnp.abs(force) * (1 - slack) - limits, s * rate - slack)
            excess = jnp.where(free, excess, -1)
            worst = (first_least(-excess)[0][None] == row_numbers(s)) & (excess > 0)
            slips = jnp.where(force > limits, 1, -1)
            changed = jnp.where(s == 0, slips, 0).astype(s.dtype)
            return jnp.where(worst, changed, s), jnp.any(worst), pivots + 1

        def going(carry):
            return carry[1] & (carry[2] < 2 * len(s))

        return jax.lax.while_loop(going, pivot, (s, jnp.array(True), 0))[0]

    def _guarded(self, guard, which: Sequence[int]) -> Array:
        """True for faces (f, ...) of the joint that `guard` (...) opens or closes.

        `which` selects the tangential faces (0), the normal ones (1) or both.
        """
        numbers = np.full(len(self.P), -9)  # no guard
        for k, j in enumerate(self._opening):
            numbers[[self.faces[j][i] for i in which]] = 1 + 2 * len(self.P) + k
        return guard[None] == numbers.reshape(-1, *(1,) * guard.ndim)

    def _without_load(self, x, guard) -> Array:
        """x shifted along the normal of the joint that `guard` opens or closes, to zero load."""
        of_first, of_normal = (self._guarded(guard, [i]) for i in (0, 1))
        direction = self._acceleration(of_normal.astype(x.dtype))
        loads, openings = self.linear_loads(x), jnp.ones_like(x[:1])
        if any(self.curves):
            closures, ones = list(loads), [jnp.ones_like(x[0])] * len(loads)
            for (first, *_), load, curve in zip(
                self.faces, self.closures(x), self.curves, strict=True
            ):
                closures[first] = load
                if curve is not None:
                    ones[first] = jnp.broadcast_to(
                        self._leaf(curve.opening, x.ndim - 1), load.shape
                    )
            loads, openings = jnp.stack(closures), jnp.stack(ones)
        change = jnp.sum(jnp.where(of_first, self.times(self.L, direction) / openings, 0), axis=0)
        load = jnp.sum(jnp.where(of_first, loads, 0), axis=0)
        return x - (load / jnp.where(change == 0, 1, change))[None] * direction

    def contact_state(self, y) -> Array:
        """The contact state in which the motion from y begins."""
        w = self.sliding(y[self.n :])
        s = jnp.where(self.open_faces(y), OPEN, jnp.sign(w))
        # At the belt's velocity: the side whose own field leaves it, forward if both do.
        return self._consistent(y, s.astype(y.dtype), s == 0)

    def equilibrium(self) -> Float[Array, " 2n"]:
        """The closed, forward-slipping equilibrium (Eq. 40) as a state."""
        mu = self._each(lambda law, V: law.mu(self.speed * V), self.V)
        K = jnp.diag(self.K) if self.K.ndim == 1 else self.K
        B = jnp.eye(self.n, dtype=K.dtype) if self.B is None else self.B
        coupled = K - product(B * mu[None], self.L)
        x = solve(coupled, self.F + B @ (mu * self.P))
        joints = zip(self.faces, self.curves, strict=True)
        curved = [(faces, curve) for faces, curve in joints if curve is not None]
        if curved:
            first, normal = (np.array([faces[i] for faces, _ in curved]) for i in (0, 1))
            P, curves = self.P[first], [curve for _, curve in curved]
            # The deficit of each load neither pushes along n nor rubs along t.
            missing = (B[:, normal] - mu[first][None] * B[:, first]) * P[None]
            by = jnp.linalg.solve(coupled, missing)
            e = loaded_equilibrium(curves, self.L[first] @ x / P, self.L[first] @ by / P[:, None])
            lacks = [1 + each - curve(each) for each, curve in zip(e, curves, strict=True)]
            x = x + by @ jnp.stack(lacks)
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
