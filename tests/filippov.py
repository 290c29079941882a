"""An independent solver for the stick-slip motion: event by event, with SciPy's DOP853.

It uses nothing of the package. A trajectory is cut into phases, in each of which both directions
slip forward (1), slip backward (-1) or stick (0), so that the motion is smooth. What ends a phase
is linear in the state: over one step of the integrator it is a polynomial of degree 7 in time. Its
zeros are searched between its extrema, so that no reversal is too short. Inside, time is in
1/omega, length in V/omega, and the state is y = [x1, x2, w1, w2] with w = 1 - x' the sliding
velocity over V, exactly 0 in stick.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from math import comb, pi, sqrt
from typing import Any

import numpy as np
from numpy.polynomial import polynomial as poly
from scipy.integrate import DOP853, OdeSolution, solve_ivp
from scipy.optimize import brentq

MOST_RETURNS = 4  # maxima of x1 in one period
FAR = 1e3  # in V/omega and V: a motion beyond it has diverged
UNIT = np.eye(5)  # rows over [1, x1, x2, w1, w2]
# Column j: term j of 1, x, x (1-x), x^2 (1-x), ..., which a DOP853 step is made of, in powers of x.
BASIS = np.zeros((8, 8))
BASIS[0, 0] = 1
for _j in range(1, 8):
    BASIS[:, _j] = np.roll(BASIS[:, _j - 1], 1)
    if _j % 2 == 0:
        BASIS[:, _j] = BASIS[:, _j - 1] - BASIS[:, _j]
BERNSTEIN = np.array([[comb(j, i) / comb(7, i) for i in range(8)] for j in range(8)])


class Diverged(ArithmeticError):
    """The motion left every bound."""


@dataclass(frozen=True)
class Mechanism:
    """Two-direction oscillator on a belt, SI units; Coulomb friction where mu_m == mu_s."""

    m: float
    omega_1: float
    omega_2: float
    xi_1: float
    xi_2: float
    F: float
    V: float
    K_n: float
    K_t: float
    mu_s: float
    mu_m: float
    v_m: float

    @cached_property
    def omega(self) -> float:
        """Scale of time [1/s]."""
        own = self.m * (self.omega_1**2 + self.omega_2**2)
        return sqrt((self.K_n or own + self.K_t) / self.m)

    @cached_property
    def units(self) -> np.ndarray:
        """Scales of [x1, x2, x1', x2']."""
        return self.V * np.array([1 / self.omega, 1 / self.omega, 1, 1])

    def scaled(self, state) -> np.ndarray:
        """The state y of an SI state [x1, x2, x1', x2']."""
        return np.asarray(state) / self.units * [1, 1, -1, -1] + [0, 0, 1, 1]

    def si(self, y) -> np.ndarray:
        """The SI state of y; further axes of y come last."""
        return ((np.asarray(y).T - [0, 0, 1, 1]) * [1, 1, -1, -1] * self.units).T

    @cached_property
    def law(self) -> tuple[float, ...]:
        """f, c1, c2, k1, k2, n1, n2, mu_s, a, b; N1 = n1 x2, N2 = n2 x1, mu = +-mu_s - a w + b w^3."""  # noqa: E501
        s, r, drop = self.omega, self.V / self.v_m, self.mu_s - self.mu_m
        n1, n2 = self.K_n / (self.m * s**2), -self.K_t / (self.m * s**2)
        k1, k2 = (self.omega_1 / s) ** 2 - n2, (self.omega_2 / s) ** 2 + n1
        c1, c2 = 2 * self.xi_1 * self.omega_1 / s, 2 * self.xi_2 * self.omega_2 / s
        f, a, b = self.F / sqrt(2) / (self.m * s * self.V), 1.5 * drop * r, 0.5 * drop * r**3
        return f, c1, c2, k1, k2, n1, n2, self.mu_s, a, b

    def slope(self, signs) -> Callable:
        """Right-hand side of the phase with these signs."""
        f, c1, c2, k1, k2, n1, n2, mu_s, a, b = self.law
        s1, s2 = signs

        def rates(_t, y):
            x1, x2, w1, w2 = y.tolist()
            mu1, mu2 = mu_s * s1 - a * w1 + b * w1 * w1 * w1, mu_s * s2 - a * w2 + b * w2 * w2 * w2
            dw1 = k1 * x1 + c1 * (1 - w1) - f - mu1 * n1 * x2 if s1 else 0.0
            dw2 = k2 * x2 + c2 * (1 - w2) + f - mu2 * n2 * x1 if s2 else 0.0
            return np.array([1 - w1, 1 - w2, dw1, dw2])

        return rates

    def hold(self, i) -> np.ndarray:
        """Rows over [1, y] of mu_s N + free and mu_s N - free, both positive in stick.

        At w = 0 they are -w' of forward and w' of backward slip.
        """
        f, c1, c2, k1, k2, n1, n2, mu_s, *_ = self.law
        load = mu_s * np.array([n1 * UNIT[2], n2 * UNIT[1]][i])
        free = [(f - c1) * UNIT[0] - k1 * UNIT[1], (-f - c2) * UNIT[0] - k2 * UNIT[2]][i]
        return np.array([load + free, load - free])

    @cached_property
    def equilibrium(self) -> np.ndarray:
        """Steady sliding, [x1, x2, 1, 1]."""
        f, _, _, k1, k2, n1, n2, mu_s, a, b = self.law
        mu = mu_s - a + b
        return np.append(np.linalg.solve([[k1, -mu * n1], [-mu * n2, k2]], [f, -f]), [1, 1])

    @cached_property
    def growth(self) -> float:
        """Largest real part of the eigenvalues about steady sliding, over omega."""
        _, c1, c2, k1, k2, n1, n2, mu_s, a, b = self.law
        (x1, x2, _, _), mu, dmu = self.equilibrium, mu_s - a + b, 3 * b - a
        first = [k1, -mu * n1, -c1 - dmu * n1 * x2, 0]
        second = [-mu * n2, k2, 0, -c2 - dmu * n2 * x1]
        return np.linalg.eigvals([[0, 0, -1, 0], [0, 0, 0, -1], first, second]).real.max()


PLAIN = Mechanism(
    m=1.0,
    omega_1=2000 * pi,
    omega_2=1600 * pi,
    xi_1=0.001,
    xi_2=0.007,
    F=5.0,
    V=0.15,
    K_n=4e8,
    K_t=2e8,
    mu_s=0.4,
    mu_m=0.25,
    v_m=0.5,
)


@dataclass(frozen=True)
class Phase:
    """The motion between two switches, with constant signs; in SI units where `run` returns it."""

    signs: tuple[int, ...]
    t0: float
    t1: float
    start: np.ndarray
    end: np.ndarray
    dense: Callable
    steps: list = field(repr=False, default_factory=list)  # (share used, length, polynomials)
    maximum: bool = False  # whether it ends at a maximum of x1


@dataclass(frozen=True)
class Cycle:
    """A periodic motion in SI units, or only the `kind` of another motion."""

    kind: str  # "cycle", "equilibrium", "diverged", "not periodic"
    returns: int = 0  # maxima of x1 in one period
    period: Any = None
    amplitude: Any = None  # peak to peak of x1, x2
    velocity_min: Any = None  # of x1', x2'
    velocity_max: Any = None
    stick_fraction: Any = None
    tension_fraction: Any = None  # share of the period with K_n x2 < 0
    itinerary: Any = None  # [(signs, duration)], from the first end of a stick after `state` on
    margins: Any = None  # scaled distances from another itinerary; see `measure`
    state: Any = None  # [x1, x2, x1', x2'] where x1 is largest
    slopes: Any = None  # of the return map of (x1, x2, w2)
    multipliers: Any = None  # its eigenvalues; the trivial 1 is not among them


def extrema(c) -> list[float]:
    """Extrema inside 0..1 of a polynomial (rising powers); other points may be among them."""
    slope = poly.polyder(c)
    found = poly.polyroots(poly.polytrim(slope, 1e-18 * abs(slope).max())).real
    return sorted(x for x in found if 0 < x < 1)


def zeros(c, falling=False) -> list[float]:
    """Where in 0..1 a polynomial changes sign, or only where it falls through 0."""
    corners = BERNSTEIN[:, : len(c)] @ c
    if corners.min() > 0 or corners.max() < 0:
        return []
    found = []
    for low, high in pairwise([0.0, *extrema(c), 1.0]):
        p, q = poly.polyval(low, c), poly.polyval(high, c)
        if p >= 0 > q or (p < 0 <= q and not falling):
            found.append(brentq(poly.polyval, low, high, (c,), xtol=1e-16))
    return found


def land(slope, y, h, row, rtol):
    """The step from y to the zero of row @ [1, y] near h, integrated instead of interpolated."""
    end = y
    for _ in range(3 if h > 0 else 0):
        end = solve_ivp(slope, (0, h), y, "DOP853", rtol=rtol, atol=rtol, first_step=h).y[:, -1]
        shift = (row[0] + row[1:] @ end) / (row[1:] @ slope(0, end))
        if not 1e-16 < abs(shift) < min(1e-4, h):  # there, or grazing
            break
        h -= shift
    return h, end


def phases(mechanism, y, rtol, t1=np.inf, maxima=False) -> Iterator[Phase]:
    """The phases from the state y on, up to t1; with `maxima`, cut at the maxima of x1 too."""
    y, t, longest = np.array(y, float), 0.0, 3.2 * rtol**0.125
    signs, known = [0, 0], [0, 0]  # known: the order of the zero of w at the start of a phase
    for i in (0, 1):
        forward, backward = mechanism.hold(i) @ [1, *y]
        if y[2 + i] or forward < 0 or backward < 0:
            signs[i] = int(np.sign(y[2 + i])) or (1 if forward < 0 else -1)
            known[i] = int(y[2 + i] == 0)
    while True:
        slope, watch = mechanism.slope(signs), []  # (direction, signs after, row, known)
        for i, s in enumerate(signs):
            if s:
                watch.append((i, 0, s * UNIT[3 + i], known[i]))
            else:
                watch += [(i, s, row, 0) for s, row in zip((1, -1), mechanism.hold(i), strict=True)]
        if maxima and signs[0] == 1:
            watch.append((2, 0, UNIT[0] - UNIT[3], int(y[2] == 1)))
        rows = np.array([row for *_, row, _ in watch])
        solver = DOP853(slope, t, y, t1, max_step=longest, rtol=rtol, atol=rtol)
        start, t0, steps, pieces, events = y, t, [], [], []
        while not events and solver.status == "running":
            with np.errstate(over="ignore", invalid="ignore"):
                failed = solver.step()
            if failed or abs(solver.y).max() > FAR:
                raise Diverged
            pieces.append(solver.dense_output())
            c, h = BASIS @ np.vstack([y, pieces[-1].F]), solver.t - t
            g = c @ rows[:, 1:].T
            g[0] += rows[:, 0]
            above = (BERNSTEIN @ g).min(axis=0) > 0
            for k, (i, after, row, order) in enumerate(watch):
                if above[k] and (steps or not order):
                    continue
                p = g[0 if steps else order :, k]
                late = i < 2 and len(p) == 8 and p[0] < 0 and p[1] < 0  # by rounding
                events += [(x, i, after, row) for x in ([0.0] if late else zeros(p, True)[:1])]
            end, used = solver.y, h
            if events:
                used, end = land(slope, y, min(events)[0] * h, min(events)[3], rtol)
            steps.append((used / h, h, c))
            y, t = np.array(end), t + used
        before, known = tuple(signs), known if t == t0 else [0, 0]
        i, after = min(events)[1:3] if events else (-1, 0)
        if i == 2:
            y[2] = 1  # exactly
        elif i >= 0:
            y[2 + i] = 0
            forward, backward = mechanism.hold(i) @ [1, *y]
            known[i] = 1 if signs[i] else 2
            if signs[i]:
                after = -signs[i] if (backward if signs[i] == 1 else forward) < 0 else 0
            signs[i] = after
        dense = OdeSolution([t0, *(p.t for p in pieces)], pieces)
        yield Phase(before, t0, t, start, y, dense, steps, i == 2)
        if not events:
            return


def run(mechanism, start, t1, rtol=1e-12) -> list[Phase]:
    """The motion from [x1, x2, x1', x2'] until the time t1, phase by phase."""
    s, found = mechanism.omega, []
    for p in phases(mechanism, mechanism.scaled(start), rtol, t1 * s):
        ends = mechanism.si(p.start), mechanism.si(p.end)

        def dense(t, inner=p.dense):
            return mechanism.si(inner(np.asarray(t) * s))

        found.append(Phase(p.signs, p.t0 / s, p.t1 / s, *ends, dense))
    return found


def round_trip(mechanism, z, returns, rtol) -> list[Phase]:
    """From the maximum z = (x1, x2, w2) of x1 to the one `returns` later."""
    found, y = [], np.array([z[0], z[1], 1, z[2]])
    if mechanism.slope((1, 0))(0, y)[2] <= 0:
        raise ArithmeticError("not a maximum of x1")
    for p in phases(mechanism, y, rtol, FAR, maxima=True):
        found.append(p)
        if sum(p.maximum for p in found) == returns:
            return found
    raise Diverged


def returned(mechanism, z, returns, rtol) -> np.ndarray:
    """The return map of (x1, x2, w2)."""
    return round_trip(mechanism, z, returns, rtol)[-1].end[[0, 1, 3]]


def return_slopes(mechanism, z, returns, rtol, h=1e-5) -> np.ndarray:
    """Jacobian of the return map, by central differences."""
    ends = [
        returned(mechanism, z + d, returns, rtol) for d in h * np.vstack([np.eye(3), -np.eye(3)])
    ]
    return (np.array(ends[:3]) - ends[3:]).T / (2 * h)


def close(mechanism, z, returns, rtol, slopes=None) -> np.ndarray:
    """The fixed point of the return map near z, by Broyden's method."""
    matrix = return_slopes(mechanism, z, returns, rtol) if slopes is None else slopes
    z, best, matrix = np.array(z), np.inf, matrix - np.eye(3)
    residual = returned(mechanism, z, returns, rtol) - z
    for _ in range(40):
        size = abs(residual).max()
        if size < 1e-14 or (best < 1e-11 and size > best / 2):
            return z
        best = min(best, size)
        step = -np.linalg.solve(matrix, residual)
        z = z + step
        residual = returned(mechanism, z, returns, rtol) - z
        matrix = matrix + np.outer(residual, step) / (step @ step)
    raise ArithmeticError("no fixed point")


def measure(mechanism, z, returns, rtol=1e-12) -> Cycle:
    """Everything about the periodic motion through the maximum z of x1.

    margins: "graze", the smallest extremum of w in slip and of the distance from the friction
    limits in stick; "decision", the smallest such distance, of either sign, where a slip ended;
    "shortest", the share of the shortest phase in the period.
    """
    trip = round_trip(mechanism, z, returns, rtol)
    period, stuck, pulled = trip[-1].t1, np.zeros(2), 0.0
    values, graze, decision, visits = [trip[0].start], [], [], []
    for p, after in zip(trip, trip[1:] + trip[:1], strict=True):
        stuck += (p.t1 - p.t0) * (np.array(p.signs) == 0)
        rows = [r for i in (0, 1) for r in (UNIT[[3 + i]] if p.signs[i] else mechanism.hold(i))]
        for n, (used, h, c) in enumerate(p.steps):
            at = np.array([used, *(x for q in c.T for x in extrema(q) if x < used)])
            values += list(poly.polyval(at, c).T)
            for row in rows:
                g = c @ row[1:] + row[0] * np.eye(8)[0]
                at = [x for x in zeros(poly.polyder(g)) if (0 if n else 1e-6) < x < used]
                graze += list(abs(poly.polyval(np.array(at), g)))
            stops = np.array([0.0, *(x for x in zeros(c[:, 1]) if x < used), used])
            below = poly.polyval((stops[1:] + stops[:-1]) / 2, c[:, 1]) < 0
            pulled += h * np.diff(stops)[below].sum() * (mechanism.K_n > 0)
        for i in (0, 1):
            if p.signs[i] and p.signs[i] != after.signs[i]:
                decision.append(abs(mechanism.hold(i)[int(p.signs[i] == 1)] @ [1, *p.end]))
        joined = visits.pop()[1] if visits and visits[-1][0] == p.signs else 0.0
        visits.append((p.signs, joined + p.t1 - p.t0))
    if len(visits) > 1:  # the last continues in the first
        visits = [*visits[1:-1], (visits[-1][0], visits[-1][1] + visits[0][1])]
    ends = [n for i in (0, 1) for n, v in enumerate(visits) if v[0][i] and not visits[n - 1][0][i]]
    visits = visits[ends[0] :] + visits[: ends[0]] if ends else visits
    low, high = np.min(values, axis=0), np.max(values, axis=0)
    return Cycle(
        "cycle",
        returns,
        period / mechanism.omega,
        (high - low)[:2] * mechanism.units[:2],
        (1 - high[2:]) * mechanism.V,
        (1 - low[2:]) * mechanism.V,
        stuck / period,
        pulled / period,
        [(signs, t / mechanism.omega) for signs, t in visits],
        {
            "graze": min(graze, default=np.inf),
            "decision": min(decision, default=np.inf),
            "shortest": min(t for _, t in visits) / period,
        },
        mechanism.si(trip[0].start),
    )


def cycle(mechanism, start=None, rtol=1e-12, max_returns=5000, coarse=1e-8) -> Cycle:
    """The stable periodic motion that the SI start leads to, or what it leads to instead.

    The transient is run at the tolerance `coarse`.
    """
    y = mechanism.equilibrium + np.eye(4)[0] if start is None else mechanism.scaled(start)
    equilibrium, maxima, far, near = mechanism.equilibrium[[0, 1, 3]], [], [], 1e-5
    try:
        for p in phases(mechanism, y, coarse, 20.0 * max_returns, maxima=True):
            if not p.maximum:
                continue
            maxima.append(p.end[[0, 1, 3]])
            far.append(abs(maxima[-1] - equilibrium).max())
            if mechanism.growth < 0 and max(far[-50:]) < min(0.1, max(far[-100:-50], default=0)):
                return Cycle("equilibrium")
            gaps = [abs(maxima[-1] - z).max() for z in maxima[-2 : -MOST_RETURNS - 2 : -1]]
            returns = 1 + next((k for k, gap in enumerate(gaps) if gap < near), -1)
            if returns:
                last = max(maxima[-returns:], key=lambda z: z[0])
                try:
                    z = close(mechanism, last, returns, rtol)
                    gaps = [
                        abs(returned(mechanism, z, k, rtol) - z).max() for k in range(1, returns)
                    ]
                    shorter = (k for k, gap in enumerate(gaps) if gap < 1e-9)
                    returns = 1 + next(shorter, returns - 1)
                    slopes = return_slopes(mechanism, z, returns, rtol)
                except (ArithmeticError, np.linalg.LinAlgError):
                    z, slopes = np.full(3, np.inf), np.eye(3)
                found = np.array(sorted(np.linalg.eigvals(slopes), key=abs, reverse=True))
                if abs(z - last).max() < 0.05 and abs(found[0]) < 1:
                    known = measure(mechanism, z, returns, rtol)
                    return replace(known, slopes=slopes, multipliers=found)
                near /= 10  # a slow passage
            if len(maxima) == max_returns:
                break
    except Diverged:
        return Cycle("diverged")
    return Cycle("not periodic")
