"""Two blocks: on one belt (Galvanetto and Bishop), and one on the other (Shin et al.)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp

import fractaljax as fj

from .case import STATED, Case, CaseResult, Check, Curve, Panel, closed, numerical

# Springs to the frame and masses are 1. The second block's friction is 1.3 times the first's.
_K = np.array([[2.2, -1.2], [-1.2, 2.2]])
_FRICTION = np.array([1.0, 1.3])


# --- stick-slip of two blocks on a belt ---------------------------------------------------


def _rate(signs, V, _, y):
    """The motion where block i slides if signs[i] is 1 or -1, and sticks if it is 0."""
    v = np.where(signs == 0, V, y[2:])
    forces = signs * _FRICTION / (1 + 3 * np.abs(V - v)) - _K @ y[:2]
    return np.concatenate([v, np.where(signs == 0, 0.0, forces)])


def _margin(i, sign, V, _, y):
    """Falls to 0 where block i breaks loose, or where it stops sliding."""
    return _FRICTION[i] - abs(_K[i] @ y[:2]) if sign == 0 else (V - y[2 + i]) * sign


def _by_scipy(V):
    """Period, shares of sticking (2,), ranges of x (2,) and the orbit (4, n), by SciPy's DOP853.

    A period begins where the first block breaks loose after the motion has settled.
    """
    t, y, signs = 0.0, np.array([0.0, -0.3, V, V]), np.array([0, 0])
    begin, period, pieces, extremes = None, None, [], ([], [])
    while period is None:
        events: list[Any] = [partial(_margin, i, signs[i], V) for i in (0, 1)]
        for event in events:
            event.terminal, event.direction = True, -1
        events += [lambda _, y: y[2], lambda _, y: y[3]]  # x is largest or least
        options: dict[str, Any] = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14}
        options["max_step"] = np.inf if begin is None else 0.1  # fine enough for a picture
        piece = solve_ivp(partial(_rate, signs, V), (t, t + 50), y, events=events, **options)
        t, y, i = piece.t[-1], piece.y[:, -1].copy(), int(len(piece.t_events[0]) == 0)
        if begin is not None:
            pieces.append((np.ptp(piece.t) * (signs == 0), piece.y))
            for k in (0, 1):
                extremes[k].extend(state[k] for state in piece.y_events[2 + k])
        pull, breaks = _K[i] @ y[:2], signs[i] == 0
        signs = signs.copy()
        signs[i] = np.sign(pull) if breaks or abs(pull) > _FRICTION[i] else 0
        y[2 + i] = V
        if breaks and i == 0 and t > 350:
            begin = begin or (t, y)
            if t > begin[0] and np.allclose(y, begin[1], rtol=0, atol=1e-8):
                period = t - begin[0]
    sticking = sum(stuck for stuck, _ in pieces) / period
    orbit = np.concatenate([states for _, states in pieces], axis=1)
    return period, sticking, [np.ptp(x) for x in extremes], orbit


def _galvanetto() -> CaseResult:
    checks, panels = [], []
    for V in (0.3, 0.5):
        joints = [
            fj.Joint(fj.FixedContact(0.0, 0.0, P), fj.HyperbolicStribeck(1.0, 3.0), [i], V=V)
            for i, P in enumerate(_FRICTION)
        ]
        blocks = fj.Structure(np.eye(2), None, _K, joints)
        cycle = fj.limit_cycle(blocks, [0.0, -0.3, 0.0, 0.0])
        period, sticking, ranges, orbit = _by_scipy(V)
        at = f"at V = {V:g}"
        checks.append(numerical(f"period {at} [s]", period, cycle.period, 1e-8))
        curves = []
        states = np.asarray(cycle.orbit(512)[1])
        for i, name in enumerate(("first", "second")):
            checks += [
                numerical(
                    f"share of sticking, {name} block {at} [-]",
                    sticking[i],
                    cycle.stick_fraction[i],
                    1e-8,
                ),
                numerical(
                    f"peak to peak, {name} block {at} [m]", ranges[i], cycle.amplitude[i], 1e-8
                ),
            ]
            x, v = orbit[[i, i + 2], :: len(orbit[0]) // 40]
            curves.append(Curve(x, v, f"{name} block, by SciPy", False))
            curves.append(Curve(states[:, i], states[:, i + 2], f"{name} block, fractaljax", True))
        axes = f"displacement [m], V = {V:g} m/s", "velocity [m/s]"
        panels.append(Panel(*axes, curves, {"ylim": (-5 * V, 2 * V)}))  # room for the legend
    return CaseResult(checks, panels)


# --- a pad and a disc ---------------------------------------------------------------------


class _Falling(fj.Friction):
    """Friction that falls with speed along a line."""

    mu_s: jax.Array = fj.quantity("-", "static friction coefficient")
    fall: jax.Array = fj.quantity("s/m", "fall of the friction coefficient with speed")

    def mu(self, speed):
        return self.mu_s - self.fall * speed


def _critical_fall(c_1, c_2, k_2):
    """The least fall of friction, times the load, where Hurwitz' determinant vanishes."""
    a = Polynomial([0.0, 1.0])
    a_3, a_2 = c_1 + c_2 - 2 * a, 1 + k_2 + c_1 * c_2 - a * (c_1 + c_2)
    a_1 = (c_1 - a) * k_2 + c_2 - a
    roots = (a_3 * a_2 * a_1 - a_1**2 - a_3**2 * k_2).roots()
    return min(x.real for x in roots if abs(x.imag) < 1e-9 and x.real > 1e-9)


def _shin() -> CaseResult:
    c_2, c_1 = 0.05, np.geomspace(0.01, 0.5, 41)
    joint = fj.Joint(fj.FixedContact(0.0, 0.0, 1.0), _Falling(0.6, 0.01), {0: 1.0, 1: -1.0}, V=1.0)

    def pad_and_disc(c, k):
        return fj.Structure(np.eye(2), jnp.diag(c), jnp.diag(k), joint)

    @jax.jit
    @jax.vmap
    def critical(c_1, k_2):
        """The fall of friction where squeal begins, by bisection in the growth rate."""
        model = pad_and_disc(jnp.array([c_1, c_2]), jnp.array([1.0, k_2]))

        def halved(_, ends):
            low, high = ends
            middle = (low + high) / 2
            grows = fj.growth_rate(model.replace(fall=middle)) > 0
            return jnp.where(grows, low, middle), jnp.where(grows, middle, high)

        # Above 0.06 both parts feed on friction.
        return jax.lax.fori_loop(0, 45, halved, (0.0 * c_1, 0.06 + 0.0 * c_1))[1]

    places = [(0.05, 1.0), (0.1, 1.0), (0.05, 1.1), (0.1, 1.1)]
    grid = [(c, k) for k in (1.0, 1.1) for c in c_1]
    ours = np.asarray(critical(*jnp.array(places + grid).T))
    note = (
        "of the article's equations, with numbers of our own: unit masses, load and pad stiffness"
    )
    checks = [
        closed(
            f"critical fall, damping {c:g} and {c_2:g}, stiffness ratio {k:g} [s/m]",
            _critical_fall(c, c_2, k) if k != 1.0 else c * c_2 / (c + c_2),
            fall,
            1e-9,
        )
        for (c, k), fall in zip(places, ours, strict=False)
    ]
    checks[0] = checks[0]._replace(note=note)
    ratio, range_ = ours[3] / ours[2], "critical fall at twice the pad's damping (falls) [-]"
    checks.append(Check(range_, (0.0, 1.0), ratio, 0.0, STATED, "damping one part destabilises"))
    curves = []
    for k_2, part in ((1.0, ours[4:45]), (1.1, ours[45:])):
        theirs = [_critical_fall(c, c_2, k_2) for c in c_1[::3]]
        label = f"stiffness ratio {k_2:g}"
        curves.append(Curve(c_1[::3], theirs, f"Hurwitz' determinant, {label}", False))
        curves.append(Curve(c_1, part, f"fractaljax, {label}", True))
    axes = "damping of the pad [N s/m]; that of the disc is 0.05", "critical fall of friction [s/m]"
    return CaseResult(checks, [Panel(*axes, curves, {"xscale": "log"})])


CASES = (
    Case(
        "galvanetto",
        "Stick-slip of two blocks",
        "U. Galvanetto, S. R. Bishop, Int. J. Mech. Sci. 36, 683 (1994)",
        None,
        _galvanetto,
    ),
    Case(
        "shin",
        "Pad and disc with falling friction: damping one of them destabilises",
        "K. Shin, M. J. Brennan, J.-E. Oh, C. J. Harris, J. Sound Vib. 254, 837 (2002)",
        "10.1006/jsvi.2001.4127",
        _shin,
    ),
)
