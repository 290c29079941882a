"""An independent solver for any mechanism with joints: event by event, with SciPy's DOP853.

It uses nothing of the package. The motion obeys

    M x'' + C x' + K x = F + f(t) + sum_j [(P_j - N_j) n_j + mu_j(|w_j|) sgn(w_j) N_j t_j],
    w_j = V_j - t_j.x',   N_j = max(0, P_j + K_n n_j.x)

and is cut into phases of one mode: every face slips forward (1), slips backward (-1), sticks (0) or
is OPEN. Inside a phase the motion is smooth. What ends it is interpolated over one step of the
integrator, its zeros are searched between its extrema, and the step to the first of them is
integrated again. Inside, time is in 1/omega, velocity in the belt's speed V and length in V/omega.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from scipy.integrate import DOP853, OdeSolution, solve_ivp
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

OPEN = 9
FAR = 1e6  # in V and V/omega: a motion beyond it has diverged
SAME = 1e-10  # a sliding velocity below it is zero where a motion starts
NODES = (1 + np.cos(np.pi * (np.arange(12) + 0.5) / 12)) / 2
FIT = np.linalg.inv(chebyshev.chebvander(2 * NODES - 1, 11))
SLOPE = chebyshev.chebder(np.eye(12))  # of coefficients those of the derivative

LAWS = {
    "coulomb": lambda w, mu, mu_s=None: mu + 0 * w,
    "tabulated": lambda w, speeds, coefficients, mu_s=None: table(speeds, coefficients)(w),
    "stribeck": lambda w, mu_s, mu_m, v_m: (
        mu_s - 1.5 * (mu_s - mu_m) * (w / v_m) + 0.5 * (mu_s - mu_m) * (w / v_m) ** 3
    ),
    "exponential": lambda w, mu_s, mu_d, v_0, viscous=0.0: (
        mu_d + (mu_s - mu_d) * np.exp(-w / v_0) + viscous * w
    ),
    "hyperbolic": lambda w, mu_s, delta: mu_s / (1 + delta * w),
}


@cache
def table(speeds, coefficients):
    """SciPy's monotone cubic through a table, constant beyond its last speed."""
    cubic = PchipInterpolator(speeds, coefficients)
    last = coefficients[-1]

    def mu(w):
        w = np.asarray(w)
        k = np.clip(np.searchsorted(speeds, w.real, "right") - 1, 0, len(speeds) - 2)
        a, b, c, d = cubic.c[:, k]
        t = w - np.asarray(speeds)[k]  # complex for a slope
        return np.where(w.real > speeds[-1], last, ((a * t + b) * t + c) * t + d)[()]

    return mu


class Diverged(ArithmeticError):
    """The motion left every bound."""


class Impossible(ArithmeticError):
    """No mode of the faces agrees with the state."""


@dataclass(frozen=True)
class Joint:
    """A joint with the direction t (n,), pressed by P along n (n,) where `preload`.

    Without n its normal force is P. Without `preload` it is K_n n.x, of either sign (the source's
    form). mu is a function of the sliding speed that can be continued a little below zero. Static
    friction is mu(0), or above it where it is given.
    """

    t: np.ndarray
    V: float
    mu: Callable
    n: Any = None
    P: float = 0.0
    K_n: float = 0.0
    K_t: float = 0.0
    preload: bool = True
    static: float | None = None

    @property
    def lifts(self) -> bool:
        return self.n is not None and self.preload


@dataclass(frozen=True)
class Face:
    """Friction mu(|w|) sgn(w) (load + slope.x) along d, with w = V - d.x'."""

    joint: int
    d: np.ndarray
    V: float
    mu: Callable
    load: float
    slope: np.ndarray
    still: float  # the coefficient in stick
    jumps: bool  # above mu(0)


@dataclass(frozen=True)
class Mechanism:
    """M x'' + C x' + K x = F with joints, SI units."""

    M: np.ndarray
    C: np.ndarray
    K: np.ndarray
    F: np.ndarray
    joints: tuple[Joint, ...]
    force: Callable | None = None  # f of the times (...), (..., n)

    @classmethod
    def of(cls, problem: dict) -> "Mechanism":
        """From plain numbers, as in mechanisms.py."""
        M, C, K, F = (np.array(problem[name], float) for name in "MCKF")
        joints = []
        for given in problem["joints"]:
            law, constants = given["friction"][0], dict(given["friction"][1])

            def mu(w, function=LAWS[law], constants=constants):
                return function(w, **constants)

            n = None if given.get("normal") is None else np.array(given["normal"], float)
            rest = {k: given[k] for k in ("P", "K_n", "K_t", "preload") if k in given}
            t = np.array(given["tangential"], float)
            static = constants.get("mu_s") if law in ("coulomb", "tabulated") else None
            joints.append(Joint(t, given["V"], mu, n, static=static, **rest))
        return cls(M, C, K, F, tuple(joints))

    @cached_property
    def omega(self) -> float:
        """Scale of time [1/s]: the highest frequency with every joint closed."""
        K = self.K + sum(
            j.K_t * np.outer(j.t, j.t) + (0 if j.n is None else j.K_n * np.outer(j.n, j.n))
            for j in self.joints
        )
        return float(np.sqrt(abs(np.linalg.eigvals(np.linalg.solve(self.M, K))).max()))

    @cached_property
    def units(self) -> np.ndarray:
        """Scales of [x, x']."""
        V = (
            max(abs(j.V) for j in self.joints) or 1.0
        )  # without a belt, a speed of the order of 1 m/s
        return np.repeat([V / self.omega, V], len(self.M))

    def map_in_units(self, A) -> np.ndarray:
        """A linear map (2n, 2n) of states [x, x'] in SI, in those units."""
        return np.asarray(A) * self.units[None] / self.units[:, None]

    @cached_property
    def scaled(self) -> "Mechanism":
        """The same in units of 1/omega, V and V/omega."""
        s, V = self.omega, float(self.units[-1])
        given = self.force
        force = None if given is None else lambda t: given(t / s) / (V * s)
        joints = tuple(
            replace(
                j,
                V=j.V / V,
                mu=lambda w, mu=j.mu: mu(V * w),
                P=j.P / (V * s),
                K_n=j.K_n / s**2,
                K_t=j.K_t / s**2,
            )
            for j in self.joints
        )
        return Mechanism(self.M, self.C / s, self.K / s**2, self.F / (V * s), joints, force)

    @cached_property
    def faces(self) -> tuple[Face, ...]:
        found = []
        for i, j in enumerate(self.joints):
            kinetic, none = float(j.mu(0.0)), np.zeros(len(self.M))
            still = kinetic if j.static is None else j.static
            jumps = still > kinetic
            slope = none if j.n is None else j.K_n * j.n
            load = j.P if j.preload else 0.0
            found.append(Face(i, j.t, j.V, j.mu, load, slope, still, jumps))
            # Both directions of the source's form have their states, also without a force.
            if j.n is not None and (j.K_t or not j.preload):
                found.append(Face(i, j.n, j.V, j.mu, 0.0, -j.K_t * j.t, still, jumps))
        return tuple(found)

    @cached_property
    def fields(self) -> dict:
        return {}

    def field(self, mode) -> "Field":
        if mode not in self.fields:
            self.fields[mode] = Field(self, mode)
        return self.fields[mode]

    def sliding(self, z) -> np.ndarray:
        """w of every face."""
        return np.array([f.V - f.d @ z[len(self.M) :] for f in self.faces])

    def normal(self, i) -> np.ndarray:
        """The row over [1, z] of the joint's normal force while it is closed."""
        j, n = self.joints[i], len(self.M)
        row = np.zeros(2 * n + 1)
        row[0] = j.P if j.preload else 0.0
        row[1 : n + 1] = 0 if j.n is None else j.K_n * j.n
        return row


class Field:
    """The smooth motion in one mode, and the guards that are positive while it lasts.

    A guard is g = row.[1, z] + by.forces(z); `events` names what its zero means:
    ("w", face), ("limit", face, sign of the slip that begins), ("open" or "close", joint).
    """

    def __init__(self, mechanism: Mechanism, mode: tuple[int, ...]):
        self.n = n = len(mechanism.M)
        faces, self.mode, self.force = mechanism.faces, mode, mechanism.force
        self.f, self.K, self.C = mechanism.F.copy(), mechanism.K.copy(), mechanism.C
        inverse = np.linalg.inv(mechanism.M)
        events, rows, by = [], [], []
        for i, j in enumerate(mechanism.joints):
            is_open = any(s == OPEN for s, f in zip(mode, faces, strict=True) if f.joint == i)
            if is_open:
                self.f += j.P * j.n
            else:
                self.K += j.K_t * np.outer(j.t, j.t)
                self.K += 0 if j.n is None else j.K_n * np.outer(j.n, j.n)
            if j.lifts:
                events.append(("close" if is_open else "open", i))
                rows.append(mechanism.normal(i) * (-1 if is_open else 1))
                by.append(np.zeros(n))
        slips = [(s, f) for s, f in zip(mode, faces, strict=True) if abs(s) == 1]
        self.laws = [f.mu for _, f in slips]
        self.signs = np.array([s for s, _ in slips])
        self.D = np.array([f.d for _, f in slips]).reshape(-1, n)
        self.V = np.array([f.V for _, f in slips])
        self.load = np.array([f.load for _, f in slips])
        self.slope = np.array([f.slope for _, f in slips]).reshape(-1, n)
        self.stuck = [i for i, s in enumerate(mode) if s == 0]
        D = np.array([faces[i].d for i in self.stuck]).reshape(-1, n)
        G = D @ inverse @ D.T
        if self.stuck and np.linalg.cond(G) > 1e12:
            raise Impossible("sticking faces of one direction")
        self.multipliers = -np.linalg.solve(G, D @ inverse)  # of the forces
        self.inverse = inverse + inverse @ D.T @ self.multipliers
        for i, (s, f) in enumerate(zip(mode, faces, strict=True)):
            row = np.zeros(2 * n + 1)
            if abs(s) == 1:
                row[0], row[n + 1 :] = s * f.V, -s * f.d
                events.append(("w", i))
                rows.append(row)
                by.append(np.zeros(n))
            elif s == 0:
                row[0], row[1 : n + 1] = f.still * f.load, f.still * f.slope
                for side in (1, -1):
                    events.append(("limit", i, side))
                    rows.append(row)
                    by.append(-side * self.multipliers[self.stuck.index(i)])
        self.events, self.rows, self.by = events, np.array(rows), np.array(by)
        # Acceleration without friction, sliding speeds, and signed loads, in one product.
        none, signs = np.zeros_like(self.D), self.signs[:, None]
        free, sliding = self.inverse @ np.hstack([-self.K, -self.C]), np.hstack([none, -self.D])
        loads = np.hstack([self.slope, none])
        self.linear = np.vstack([free, signs * sliding, signs * loads])
        parts = self.inverse @ self.f, self.signs * self.V, self.signs * self.load
        self.constant, self.by_friction = np.concatenate(parts), self.inverse @ self.D.T

    def forces(self, z, t) -> np.ndarray:
        """All but inertia and the multipliers, at states z (..., 2n) and times t (...)."""
        x, v = z[..., : self.n], z[..., self.n :]
        out = self.f - x @ self.K.T - v @ self.C.T
        if self.force is not None:
            out = out + self.force(np.asarray(t))
        if self.laws:
            speeds = (self.signs * (self.V - v @ self.D.T)).T
            mu = np.array([law(w) for law, w in zip(self.laws, speeds, strict=True)]).T
            out = out + (self.signs * mu * (self.load + x @ self.slope.T)) @ self.D
        return out

    def rates(self, t, z) -> np.ndarray:
        n, slips = self.n, len(self.laws)
        found = self.constant + self.linear @ z
        acceleration = found[:n]
        if self.force is not None:
            acceleration = acceleration + self.inverse @ self.force(np.asarray(t))
        if slips:
            speeds = found[n : n + slips].tolist()
            mu = [law(w) for law, w in zip(self.laws, speeds, strict=True)]
            acceleration = acceleration + self.by_friction @ (mu * found[n + slips :])
        return np.concatenate([z[n:], acceleration])

    def values(self, z, t) -> np.ndarray:
        """The guards at states z (..., 2n) and times t (...)."""
        return self.rows[:, 0] + z @ self.rows[:, 1:].T + self.forces(z, t) @ self.by.T

    def slopes(self, z) -> np.ndarray:
        """Jacobian of the forces."""
        x, v = z[: self.n], z[self.n :]
        out = np.hstack([-self.K, -self.C])
        for k, law in enumerate(self.laws):
            s, d = self.signs[k], self.D[k]
            mu = law(s * (self.V[k] - d @ v) + 1e-30j)  # the imaginary part holds the slope
            load = self.load[k] + self.slope[k] @ x
            out[:, : self.n] += s * mu.real * np.outer(d, self.slope[k])
            out[:, self.n :] -= mu.imag / 1e-30 * load * np.outer(d, d)
        return out

    def jacobian(self, z) -> np.ndarray:
        top = np.hstack([np.zeros((self.n, self.n)), np.eye(self.n)])
        return np.vstack([top, self.inverse @ self.slopes(z)])

    def gradients(self, z) -> np.ndarray:
        """Of the guards, one a row."""
        return self.rows[:, 1:] + self.by @ self.slopes(z)


def choose(mechanism, z, t, mode, options, decided=()) -> tuple[int, ...]:
    """The first mode that agrees with the state; options: signs by face, the likely one first.

    A sliding velocity of zero must grow to the side on which the face slips, unless it is decided;
    a multiplier must lie within its limits.
    """
    best, found = -1e-10, None
    orders = [list(enumerate(o)) for o in options.values()]
    for picks in sorted(product(*orders), key=lambda p: sum(k for k, _ in p)):
        trial = list(mode)
        for i, (_, s) in zip(options, picks, strict=True):
            trial[i] = s
        field_ = mechanism.field(tuple(trial))
        forces = field_.forces(z, t)
        acceleration, margin = field_.inverse @ forces, np.inf
        for i, f in enumerate(mechanism.faces):
            if trial[i] == 0:
                limit = f.still * (f.load + f.slope @ z[: field_.n])
                hold = abs(field_.multipliers[field_.stuck.index(i)] @ forces)
                at = f.d @ np.linalg.solve(mechanism.M, f.d)
                margin = min(margin, (limit - hold) * at)
            elif i in options and i not in decided:
                margin = min(margin, -trial[i] * (f.d @ acceleration))
        if margin > 0:
            return tuple(trial)
        if margin > best:
            best, found = margin, tuple(trial)
    if found is None:
        raise Impossible(f"no mode after {mode} at {z}")
    return found


def first_mode(mechanism, z, t) -> tuple[int, ...]:
    """The mode in which a motion begins."""
    n, w, mode, options = len(mechanism.M), mechanism.sliding(z), [], {}
    for i, f in enumerate(mechanism.faces):
        row = mechanism.normal(f.joint)
        force, rate = row[0] + row[1:] @ z, row[1 : n + 1] @ z[n:]
        if mechanism.joints[f.joint].lifts and (force < 0 or (force == 0 and rate < 0)):
            mode.append(OPEN)
            continue
        mode.append(int(np.sign(w[i])) if abs(w[i]) > SAME else 0)
        if mode[-1] == 0:  # under tension it may slip to either side: it does to that of w
            options[i] = (0, 1, -1) if w[i] >= 0 else (0, -1, 1)
    return choose(mechanism, z, t, tuple(mode), options)


def next_mode(mechanism, z, t, mode, event) -> tuple[tuple[int, ...], dict]:
    """The mode after an event, and the order of the zero of each guard that it leaves at zero."""
    kind, at = event[:2]
    trial, decided = list(mode), ()
    options: dict[int, tuple] = {i: (0, 1, -1) for i, s in enumerate(mode) if s == 0}
    zeros: dict[tuple, int] = {}
    if kind == "maximum":
        return mode, {event: 1}
    if kind == "w":
        options[at] = (-mode[at], 0, mode[at])
        if mechanism.faces[at].jumps:  # it may agree with stick and with slip: it sticks
            options[at] = (0, -mode[at], mode[at])
    elif kind == "limit":
        options[at], decided = (event[2],), (at,)
    else:
        w = mechanism.sliding(z)
        for i, f in enumerate(mechanism.faces):
            if f.joint == at:
                options.pop(i, None)
                trial[i] = OPEN if kind == "open" else int(np.sign(w[i]))
        zeros["close" if kind == "open" else "open", at] = 1
    after = choose(mechanism, z, t, tuple(trial), options, decided)
    for i in options:
        if after[i]:
            alone = decided == (i,) and sum(a != b for a, b in zip(mode, after, strict=True)) == 1
            zeros["w", i] = 2 if alone and not mechanism.faces[i].jumps else 1
    return after, zeros


def put(mechanism, z, directions, speeds) -> np.ndarray:
    """The state with these velocities exactly; the impulse that this takes is rounding."""
    if not len(directions):
        return z
    n, D = len(mechanism.M), np.array(directions)
    reach = np.linalg.solve(mechanism.M, D.T)
    z = z.copy()
    z[n:] -= reach @ np.linalg.solve(D @ reach, D @ z[n:] - speeds)
    return z


def extrema(c) -> np.ndarray:
    """Extrema inside 0..1 of Chebyshev coefficients; other points may be among them."""
    slope = SLOPE @ c
    counts = np.flatnonzero(abs(slope) > 1e-15 * abs(slope).max())
    found = (1 + chebyshev.chebroots(slope[: counts.max(initial=0) + 1]).real) / 2
    return np.sort(found[(found > 0) & (found < 1)])


def at(tau, c):
    """The function with Chebyshev coefficients c (k, ...) at tau, by Clenshaw's recurrence."""
    x, after, now = 4 * tau - 2, 0.0, 0.0
    for one in c[:0:-1]:
        after, now = now, one + x * now - after
    return c[0] + x / 2 * now - after


def falls(c) -> Any:
    """Where in 0..1 the function first falls through zero."""
    places, c = [0.0, *extrema(c).tolist(), 1.0], c.tolist()
    for low, high in pairwise(places):
        if at(low, c) >= 0 > at(high, c):
            return brentq(at, low, high, (c,), xtol=1e-16)
    return None


def rate_of(field_, row, by, z, t):
    """The rate of guards row.[1, z] + by.forces(z, t) along the motion."""
    found = (row[..., 1:] + by @ field_.slopes(z)) @ field_.rates(t, z)
    if field_.force is not None:
        found = found + by @ (field_.force(t + 1e-5) - field_.force(t - 1e-5)) / 2e-5
    return found


def land(field_, guard, z, t, h, rtol):
    """The step from z to the zero of a guard near h, integrated instead of interpolated."""
    end, (row, by) = z, guard
    for _ in range(4):
        if t + h == t:
            break
        span, step = (t, t + h), t + h - t
        end = solve_ivp(field_.rates, span, z, "DOP853", rtol=rtol, atol=rtol, first_step=step)
        end = end.y[:, -1]
        value = row[0] + row[1:] @ end + by @ field_.forces(end, t + h)
        shift = value / rate_of(field_, row, by, end, t + h)
        if not 1e-16 < abs(shift) < min(1e-4, h):  # there, or grazing
            break
        h -= shift
    return h, end


@dataclass(frozen=True)
class Phase:
    """The motion in one mode; in SI units where `simulate` returns it."""

    mode: tuple[int, ...]
    t0: float
    t1: float
    start: np.ndarray
    end: np.ndarray
    dense: Callable
    event: tuple = ()  # what ended it
    steps: list = field(repr=False, default_factory=list)  # (start, end, used end, dense)


def phases(mechanism, z, rtol, t1=np.inf, maxima=False, t0=0.0) -> Iterator[Phase]:
    """The phases of a scaled mechanism; with `maxima`, cut where t.x of joint 1 is largest too."""
    z, t, longest, idle = np.array(z, float), t0, 3.2 * rtol**0.125, 0
    n, faces = len(mechanism.M), mechanism.faces
    top = np.concatenate([np.zeros(n + 1), mechanism.joints[0].t])
    mode = first_mode(mechanism, z, t)
    stuck = [i for i, s in enumerate(mode) if s == 0]
    z = put(mechanism, z, [faces[i].d for i in stuck], [faces[i].V for i in stuck])
    w = mechanism.sliding(z)
    known = {("w", i): 1 for i, s in enumerate(mode) if abs(s) == 1 and abs(w[i]) <= SAME}
    for i, j in enumerate(mechanism.joints):
        if j.lifts and mechanism.normal(i) @ [1, *z] == 0:
            known |= {("open", i): 1, ("close", i): 1}
    if maxima and abs(top[1:] @ z) < SAME:
        known["maximum", 0] = 1
    while True:
        field_ = mechanism.field(mode)
        events = [*field_.events, ("maximum", 0)] if maxima else field_.events
        rows, by = field_.rows, field_.by
        if maxima:
            rows, by = np.vstack([rows, top]), np.vstack([by, np.zeros(n)])
        orders = np.array([known.get(event, 0) for event in events])
        value = rows[:, 0] + rows[:, 1:] @ z + by @ field_.forces(z, t)
        slope = rate_of(field_, rows, by, z, t)
        solver = DOP853(field_.rates, t, z, t1, max_step=longest, rtol=rtol, atol=rtol)
        start, t0, steps, pieces, hit = z, t, [], [], None
        while hit is None and solver.status == "running":
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    failed = solver.step()
            except OverflowError as error:  # in a friction law
                raise Diverged from error
            if failed or not abs(solver.y).max() < FAR:
                raise Diverged
            pieces.append(solver.dense_output())
            h = solver.t - t
            Z = pieces[-1](t + h * NODES).T
            g = rows[:, 0] + Z @ rows[:, 1:].T + field_.forces(Z, t + h * NODES) @ by.T
            if not steps:  # zeros that are known at the start are divided out
                tau = NODES[:, None]
                g -= np.where(orders > 0, value, 0) + np.where(orders > 1, slope * h * tau, 0)
                g /= tau**orders
            c, found = FIT @ g, []
            reaches_zero = c[0] <= abs(c[1:]).sum(axis=0)
            late_ones = at(0.0, c) < 0
            for k in np.flatnonzero(reaches_zero):
                event, late = events[k], late_ones[k]
                if late and event[0] != "maximum" and not steps:
                    if value[k] < -1e-7:
                        raise Impossible(f"{event} is past in {mode} at {z}")
                    if orders[k] or slope[k] < 0:
                        found.append((0.0, k))
                        continue
                place = falls(c[:, k])
                if place is not None:
                    found.append((place, k))
            end, used = solver.y, h
            if found:
                place, k = min(found)
                hit = events[k]
                used, end = land(field_, (rows[k], by[k]), z, t, place * h, rtol)
            steps.append((t, t + h, t + used, pieces[-1]))
            z, t = np.array(end), t + used
        fixed = [(faces[i].d, faces[i].V) for i in field_.stuck]
        if hit and hit[0] == "w":
            fixed.append((faces[hit[1]].d, faces[hit[1]].V))
        if hit and hit[0] == "maximum":
            fixed.append((mechanism.joints[0].t, 0.0))
        z = put(mechanism, z, *zip(*fixed, strict=True)) if fixed else z
        dense = OdeSolution([t0, *(p.t for p in pieces)], pieces)
        yield Phase(mode, t0, t, start, z, dense, hit or (), steps)
        if hit is None or t1 - t < 1e-13:
            return
        idle = idle + 1 if t == t0 else 0
        if idle > 20:
            raise Impossible(f"no time passes in {mode} at {z}")
        mode, known = next_mode(mechanism, z, t, mode, hit)


def simulate(mechanism, start, t1, rtol=1e-12, t0=0.0) -> list[Phase]:
    """The motion from [x, x'] at t0 until the time t1, phase by phase."""
    s, units, found = mechanism.omega, mechanism.units, []
    for p in phases(mechanism.scaled, np.asarray(start) / units, rtol, t1 * s, t0=t0 * s):

        def dense(t, inner=p.dense):
            return (inner(np.asarray(t) * s).T * units).T

        ends = p.start * units, p.end * units
        found.append(Phase(p.mode, p.t0 / s, p.t1 / s, *ends, dense, p.event))
    return found


def monodromy(mechanism, trip, rtol=1e-12) -> np.ndarray:
    """The derivative of the end of a trip of scaled phases by its start, at a fixed duration."""
    size = 2 * len(mechanism.M)
    flow = np.eye(size)
    for p, after in zip(trip, [*trip[1:], None], strict=True):
        field_ = mechanism.field(p.mode)

        def rates(t, y, field_=field_):
            z, Y = y[:size], y[size:].reshape(size, size)
            return np.concatenate([field_.rates(t, z), (field_.jacobian(z) @ Y).ravel()])

        if p.t1 > p.t0:
            y = np.concatenate([p.start, flow.ravel()])
            y = solve_ivp(rates, (p.t0, p.t1), y, "DOP853", rtol=rtol, atol=rtol).y[:, -1]
            flow = y[size:].reshape(size, size)
        if after is not None and after.mode != p.mode:
            z, g = p.end, field_.gradients(p.end)[field_.events.index(p.event)]
            before, behind = field_.rates(p.t1, z), mechanism.field(after.mode).rates(p.t1, z)
            k = field_.events.index(p.event)
            speed = rate_of(field_, field_.rows[k], field_.by[k], z, p.t1)
            flow = flow + np.outer(behind - before, g @ flow) / speed
    return flow


def close(mechanism, z, T, rtol=1e-12, flow=None):
    """The periodic orbit of a scaled mechanism near z, with t.x' = 0 at joint 1, and its period."""
    return closed(mechanism, z, T, rtol, flow)[:2]


def closed(mechanism, z, T, rtol=1e-12, flow=None) -> tuple[np.ndarray, float, list[Phase]]:
    """As `close`, and the phases of one period. Newton's method begins with a monodromy `flow`."""
    z, best, size = np.array(z), np.inf, len(z)
    row = np.concatenate([np.zeros(size // 2), mechanism.joints[0].t])
    for count in range(30):
        trip = list(phases(mechanism, z, rtol, T))
        end = trip[-1].end
        residual = np.append(end - z, row @ z)
        error = abs(residual).max()
        if error < 2e-14 * max(1, abs(z).max()) or (best < 1e-10 and error > best / 2):
            return z, T, trip
        if flow is None or error > 0.1 * best:
            flow = monodromy(mechanism, trip, max(rtol, 1e-10))
        best = min(best, error)
        if count == 6 and best > 1e-3:
            break
        speed = mechanism.field(trip[-1].mode).rates(0, end)
        matrix = np.block([[flow - np.eye(size), speed[:, None]], [row[None], np.zeros((1, 1))]])
        step = np.linalg.solve(matrix, -residual)
        z, T = z + step[:-1], T + step[-1]
        if not 0 < T < 1e6 or abs(step).max() > FAR:
            break
    raise ArithmeticError("no periodic orbit")


@dataclass(frozen=True)
class Cycle:
    """A periodic motion in SI units, or only the `kind` of another motion."""

    kind: str  # "cycle", "equilibrium", "diverged", "not periodic"
    period: Any = None
    amplitude: Any = None  # (n,) peak to peak
    velocity_min: Any = None  # (n,)
    velocity_max: Any = None
    stick_fraction: Any = None  # (m,) of the joints' first faces
    second_stick_fraction: Any = None  # (m,) of their second faces, 0 where there is none
    open_fraction: Any = None  # (m,)
    normal_force: Any = None  # (m, 2) smallest and largest
    state: Any = None  # (2n,) where t.x of joint 1 is largest
    multipliers: Any = None  # (2n,) largest first
    itinerary: Any = None  # [(mode, duration)] from `state` on
    maxima: int = 0  # of t.x of joint 1 in a period
    margins: Any = None  # see `measure`
    flow: Any = None  # scaled monodromy matrix


def spread(trip, rows) -> np.ndarray:
    """The least and the largest values (r, 2) of rows.[1, z] (r, 2n + 1) over a trip."""
    steps = [step for p in trip for step in p.steps]
    Z = np.array([dense(t + (end - t) * NODES) for t, end, _, dense in steps])
    C = np.einsum("ij,sjr->isr", FIT, rows[:, 0] + np.swapaxes(Z, 1, 2) @ rows[:, 1:].T)
    used = np.array([(used - t) / (end - t) for t, end, used, _ in steps])
    ends = np.concatenate([at(0.0, C), at(used[:, None], C)])
    found, reach = np.array([ends.min(axis=0), ends.max(axis=0)]), abs(C[1:]).sum(axis=0)
    beyond = (C[0] - reach < found[0]) | (C[0] + reach > found[1])
    for k, r in np.argwhere(beyond):
        places = extrema(C[:, k, r])
        values = at(places[places < used[k]], C[:, k, r])
        found[0, r] = values.min(initial=found[0, r])
        found[1, r] = values.max(initial=found[1, r])
    return found.T


def extremes(mechanism, trip) -> np.ndarray:
    """The least and the largest value of each state, (2n, 2) in SI units, over a scaled trip."""
    size = len(mechanism.units)
    return spread(trip, np.eye(size, size + 1, 1)) * mechanism.units[:, None]


def largest_first(flow) -> np.ndarray:
    """The multipliers of a monodromy matrix."""
    return np.array(sorted(np.linalg.eigvals(flow), key=abs, reverse=True))


def shares(mechanism, trip) -> np.ndarray:
    """The times that first faces stick, second faces stick and joints are open, a row each."""
    found = np.zeros((3, len(mechanism.joints)))
    for p in trip:
        for i, (s, f) in enumerate(zip(p.mode, mechanism.faces, strict=True)):
            first = i == 0 or mechanism.faces[i - 1].joint != f.joint
            if s == 0 or (s == OPEN and first):
                found[2 if s == OPEN else int(not first), f.joint] += p.t1 - p.t0
    return found


def measure(mechanism, z, T, rtol=1e-12) -> Cycle:
    """Everything about the periodic motion of a mechanism through the scaled maximum z of t.x.

    margins: "graze", the least extremum of a guard inside a phase; "shortest", the share of the
    shortest visit to a mode in the period.
    """
    core, n, m = mechanism.scaled, len(mechanism.M), len(mechanism.joints)
    t_x = np.concatenate([core.joints[0].t, np.zeros(n)])
    trip = list(phases(core, z, rtol, T, maxima=True))
    tops = [p for p in trip if p.event == ("maximum", 0) and 1e-6 < p.t1 < T - 1e-6]
    again = next((p.t1 for p in tops if abs(p.end - z).max() < 1e-7), T)
    higher = max([z, *(p.end for p in tops)], key=lambda y: t_x @ y)
    if again < T or t_x @ higher > t_x @ z + 1e-9:
        return measure(mechanism, *close(core, higher, again, rtol), rtol)
    trip = list(phases(core, z, rtol, T))
    stick, second, opened = shares(core, trip)
    visits, graze = [], []
    for p in trip:
        joined = visits.pop()[1] if visits and visits[-1][0] == p.mode else 0.0
        visits.append((p.mode, joined + p.t1 - p.t0))
        field_ = core.field(p.mode)
        for k, (t, end, used, dense) in enumerate(p.steps):
            times = t + (end - t) * NODES
            C = FIT @ field_.values(dense(times).T, times)
            for c in C.T:
                if abs(c[1]) < 4 * sum(abs(c[2:])) or k == 0:
                    inside = [x for x in extrema(c) if 1e-3 < x < (used - t) / (end - t) - 1e-3]
                    slopes = chebyshev.chebder(c, 2)
                    graze += [abs(at(x, c)) for x in inside if at(x, slopes) > 0]
    ends, unit = extremes(mechanism, trip), mechanism.units
    forces = spread(trip, np.array([core.normal(i) for i in range(m)]))
    lifts = np.array([j.lifts for j in core.joints])
    forces = np.where(lifts[:, None], np.maximum(forces, 0), forces)
    flow = monodromy(core, trip, rtol)
    lengths = [t for _, t in visits] if len(visits) > 1 else [T]
    if len(visits) > 1 and visits[0][0] == visits[-1][0]:
        lengths = [lengths[0] + lengths[-1], *lengths[1:-1]]
    return Cycle(
        "cycle",
        T / mechanism.omega,
        ends[:n, 1] - ends[:n, 0],
        ends[n:, 0],
        ends[n:, 1],
        stick / T,
        second / T,
        opened / T,
        forces * mechanism.omega * unit[-1],
        z * unit,
        largest_first(flow),
        [(mode, t / mechanism.omega) for mode, t in visits],
        1 + len(tops),
        {"graze": min(graze, default=np.inf), "shortest": min(lengths) / T},
        flow,
    )


def cycle(mechanism, start, rtol=1e-12, coarse=1e-8, most=3000, returns=24) -> Cycle:
    """The stable periodic motion that the start [x, x'] leads to, or what it leads to instead.

    The transient is run at the tolerance `coarse` through at most `most` maxima of t.x of joint 1;
    a period has up to `returns` of them.
    """
    core, near, found = mechanism.scaled, 1e-4, []
    try:
        for p in phases(core, np.asarray(start) / mechanism.units, coarse, 1e5, maxima=True):
            if p.event != ("maximum", 0):
                continue
            found.append((p.t1, p.end))
            if len(found) == most:
                break
            gaps = [abs(p.end - z).max() for _, z in found[-2 : -returns - 2 : -1]]
            back = next((k for k, gap in enumerate(gaps, 1) if gap < near), 0)
            if not back:
                continue
            T, z = p.t1 - found[-1 - back][0], p.end
            if len(found) > 50 and abs(z[len(z) // 2 :]).max() < 1e-6:
                return Cycle("equilibrium")
            try:
                z, T_new = close(core, z, T, rtol)
                known = measure(mechanism, z, T_new, rtol)
            except (ArithmeticError, np.linalg.LinAlgError):
                known = None
            if known and abs(z - p.end).max() < 0.05 and abs(T_new / T - 1) < 0.05:
                others = np.delete(known.multipliers, abs(known.multipliers - 1).argmin())
                moves = (known.amplitude / mechanism.units[: len(known.amplitude)]).max() > 1e-4
                if abs(others).max(initial=0) < 1 and moves:
                    return known
            near /= 10  # a slow passage
            if near < 1e-9:
                break
    except Diverged:
        return Cycle("diverged")
    return Cycle("not periodic")


def forced_cycle(mechanism, start, T, settle=200, rtol=1e-12) -> Cycle:
    """The stable motion with the given period T under f(t), from `start` at t = 0.

    `state` is that at t = 0, and the shares and extremes are those of one period.
    """
    core, n, T = mechanism.scaled, len(mechanism.M), T * mechanism.omega
    *_, last = phases(core, np.asarray(start) / mechanism.units, 1e-8, settle * T)
    z, best = last.end, np.inf
    for _ in range(12):
        trip = list(phases(core, z, rtol, T))
        gap = trip[-1].end - z
        if abs(gap).max() < 1e-13 * max(1, abs(z).max()) or best < 1e-9 <= 2 * abs(gap).max():
            break
        best = abs(gap).max()
        z = z + np.linalg.solve(np.eye(2 * n) - monodromy(core, trip, rtol), gap)
    else:
        return Cycle("not periodic")
    ends, (stick, _, opened) = extremes(mechanism, trip), shares(core, trip) / T
    return Cycle(
        "cycle",
        T / mechanism.omega,
        ends[:n, 1] - ends[:n, 0],
        ends[n:, 0],
        ends[n:, 1],
        stick,
        open_fraction=opened,
        state=z * mechanism.units,
        multipliers=largest_first(monodromy(core, trip, rtol)),
        itinerary=[(p.mode, (p.t1 - p.t0) / mechanism.omega) for p in trip],
    )
