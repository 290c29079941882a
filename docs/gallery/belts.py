"""A mass on a belt: m x'' + c x' + k x = P mu(V - x'), stick-slip and its onset."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import i1

import fractaljax as fj
from fractaljax._validate.cases import falling_friction

from .case import Case, CaseResult, Check, Curve, Panel, closed, numerical, self_checked


def _belt(friction: fj.Friction, V: float, m=1.0, c=0.0, k=1.0, P=1.0) -> fj.Structure:
    joint = fj.Joint(fj.FixedContact(0.0, 0.0, P), friction, tangential=[1.0], V=V)
    return fj.Structure([[m]], [[c]], [[k]], joint)


# --- the same by SciPy --------------------------------------------------------------------


def _slip(force, V, m=1.0, c=0.0, k=1.0, until_stick=True):
    """SciPy's solution from where stick ends; `force(w)` is the friction at the sliding speed w.

    Its events are the turning points, the maxima of the speed, and the start of the next stick.
    """

    def rate(_, y):
        return [y[1], (force(V - y[1]) - c * y[1] - k * y[0]) / m]

    def at_rest(_, y):
        return y[1]

    def fastest(t, y):
        return rate(t, y)[1] if t > 0 else 1.0

    def sticks(t, y):
        return y[1] - V if t > 0 else -1.0

    fastest.direction = -1
    sticks.terminal, sticks.direction = until_stick, 1
    return solve_ivp(
        rate,
        (0.0, 10 * np.sqrt(m / k)),
        [(force(0.0) - c * V) / k, V * (1 - 1e-14)],  # the first motion is off the belt
        method="DOP853",
        rtol=1e-13,
        atol=1e-15,
        events=(at_rest, fastest, sticks),
        dense_output=True,
    )


def _stick_slip(force, V, c=0.0, m=1.0, k=1.0):
    """Period, share of sticking, least and largest x, and x, x' (2, n) of SciPy's cycle."""
    solution = _slip(force, V, m, c, k)
    end, (last,) = solution.t_events[2][0], solution.y_events[2]
    stuck = ((force(0.0) - c * V) / k - last[0]) / V
    extremes = solution.y_events[0][:, 0]
    orbit = np.append(solution.sol(np.linspace(0, end, 49)), solution.sol(0.0)[:, None], axis=1)
    return end + stuck, stuck / (end + stuck), extremes.min(), extremes.max(), orbit


def _grazing(force, low, high, c):
    """The belt speed at which the slip that follows a stick just comes up to the belt again."""

    def lacking(V):
        solution = _slip(force, V, c=c, until_stick=False)
        return V - solution.y_events[1][:, 1].max()

    return brentq(lacking, low, high, xtol=1e-12)


def _cycle_checks(cycle, theirs) -> list[Check]:
    period, share, low, high, _ = theirs
    top = float(cycle.state[0])  # the cycle begins at the maximum of x
    return [
        numerical("period [s]", period, cycle.period, 1e-8),
        numerical("share of sticking [-]", share, cycle.stick_fraction[0], 1e-8),
        numerical("largest x [m]", high, top, 1e-8),
        numerical("least x [m]", low, top - float(cycle.amplitude[0]), 1e-8),
    ]


def _portrait(cycle, theirs, scale=1.0, unit="m") -> Panel:
    """The cycle in the phase plane, x in a unit of which `scale` make a metre."""
    (x, v), (their_x, their_v) = np.asarray(cycle.orbit(512)[1]).T, theirs[-1]
    curves = [
        Curve(their_x * scale, their_v, "the article's equation, by SciPy", False),
        Curve(x * scale, v, "fractaljax", True),
    ]
    return Panel(f"displacement x [{unit}]", "velocity dx/dt [m/s]", curves)


def _sizes(branch, scale=1.0):
    """The belt speeds of a branch, and half of its peak-to-peak amplitude times `scale`."""
    return np.asarray(branch.parameter), np.asarray(branch.amplitude)[:, 0] * scale / 2


def _event(branch, kind) -> float:
    return next(float(event.value) for event in branch.events if event.kind == kind)


def _slope_at_hopf(branch, hopf, scale=1.0):
    """d(half amplitude)^2/dV where the branch vanishes, by a parabola through its last points."""
    V, size = _sizes(branch, scale)
    near = np.s_[-5:-1]  # the branch ends at the Hopf point
    return np.polyfit(V[near] - hopf, size[near] ** 2 / (V[near] - hopf), 2)[-1]


def _amplitudes(branch, theirs, scale=1.0, label="half of peak to peak of x [m]") -> Panel:
    """Our branch over V, stable and unstable, with the published curves."""
    V, size = _sizes(branch, scale)
    stable = np.asarray(branch.stable)
    curves = list(theirs)
    for name, part in (("stable", stable), ("unstable", ~stable)):
        if part.any():
            shown = np.where(part, size, np.nan)
            curves.append(Curve(V, shown, f"fractaljax, {name}", True))
    return Panel("belt speed V [m/s]", label, curves)


def _harmonic(drop, v_0, c, sizes):
    """Belt speeds at which a cycle has an amplitude of velocity, by the balance of its first wave.

    c A/2 = drop e^(-V/v_0) I_1(A/v_0): damping takes what friction drop e^(-w/v_0) feeds in.
    """
    return v_0 * np.log(2 * drop * i1(sizes / v_0) / (c * sizes)), sizes


# --- the cases ----------------------------------------------------------------------------


def _leine() -> CaseResult:
    cycle = fj.limit_cycle(falling_friction(), [0.0, 0.0])
    theirs = _stick_slip(lambda w: 1 / (1 + 3 * w), 0.2)
    checks = [*self_checked("leine"), *_cycle_checks(cycle, theirs)]
    return CaseResult(checks, [_portrait(cycle, theirs)])


def _thomsen() -> CaseResult:
    mu_s, mu_m, v_m, c, V = 0.4, 0.25, 0.5, 0.1, 0.42
    hopf = v_m * np.sqrt(1 - 2 * c * v_m / (3 * (mu_s - mu_m)))
    sticks, size = np.sqrt(4 / 5) * hopf, 2 * np.sqrt(hopf**2 - V**2)
    branches = []
    for share in (1.0, 0.5, 0.25):  # of the friction range and of the damping
        law = fj.Stribeck(mu_m + share * (mu_s - mu_m), mu_m, v_m)
        cycle = fj.limit_cycle(_belt(law, V, c=share * c), [0.6, 0.0])
        branch = fj.continue_cycle(_belt(law, V, c=share * c), "V", (0.2, 0.5), start=cycle)
        branches.append((branch, float(cycle.amplitude[0]) / 2, _event(branch, "grazing")))
    branch, amplitude, grazing = branches[0]
    second = (mu_s - mu_m) ** 2  # the order of the terms that the approximation neglects
    falls = [(branches[1][k] - x) / (branches[2][k] - x) for k, x in ((1, size), (2, sticks))]
    half = "error {} over that at half the friction range and damping [-]"
    checks = [
        closed("fastest belt with cycles, v_b1 [m/s]", hopf, _event(branch, "Hopf"), 1e-9),
        closed("fastest belt with sticking, v_b0 [m/s]", sticks, grazing, second),
        closed(half.format("of v_b0"), 4.0, falls[1], 0.02),
        closed("amplitude of pure slip at 0.42 m/s [m]", size, amplitude, second),
        closed(half.format("of it"), 4.0, falls[0], 0.02),
    ]
    speeds = np.linspace(sticks, hopf, 13)
    pure = Curve(speeds, 2 * np.sqrt(hopf**2 - speeds**2), "Thomsen and Fidlin, pure slip", False)
    ends = Curve([sticks, sticks], [0.15, 0.5], "Thomsen and Fidlin, v_b0", False, True)
    return CaseResult(checks, [_amplitudes(branch, [pure, ends])])


def _papangelo() -> CaseResult:
    c, v_0, drop = 0.1, 0.5, 0.5

    def force(w):
        return 0.5 + drop * np.exp(-w / v_0)

    belt = _belt(fj.ExponentialStribeck(1.0, 0.5, v_0), 1.0, c=c)
    cycle = fj.limit_cycle(belt, [1.5, 0.0])
    branch = fj.continue_cycle(belt, "V", (0.5, 2.5), start=cycle)
    theirs = _stick_slip(force, 1.0, c)
    hopf = v_0 * np.log(drop / (v_0 * c))
    grazing = _grazing(force, 1.7, 1.95, c)
    checks = [
        closed("slowest belt without squeal [m/s]", hopf, _event(branch, "Hopf"), 1e-9),
        closed(
            "d(amplitude^2)/dV there, 8 v_0 [m^2/(m/s)]",
            8 * v_0,
            _slope_at_hopf(branch, hopf),
            1e-6,
        ),
        numerical("fastest belt with stick-slip [m/s]", grazing, _event(branch, "grazing"), 1e-9),
        *_cycle_checks(cycle, theirs),
    ]
    balance = _harmonic(drop, v_0, c, np.linspace(0.05, 1.8, 22))
    curves = [
        Curve(*balance, "their equation, balance of the first wave", False),
        Curve([hopf, hopf], [0, 2.2], "Hopf point v_0 ln(drop/(v_0 c))", False, True),
    ]
    return CaseResult(checks, [_portrait(cycle, theirs), _amplitudes(branch, curves)])


def _veraszto() -> CaseResult:
    m, c, k, V = 0.538, 5.746, 6957.0, 0.22  # their Tables 1 and 2
    kinetic, static, c_v, b_s, P = 2.0, 6.0, 10.0, 0.2, 10.0

    def force(w):
        return kinetic + (static - kinetic) * np.exp(-c_v * w) + b_s * w

    law = fj.ExponentialStribeck(static / P, kinetic / P, 1 / c_v, viscous=b_s / P)
    belt = _belt(law, V, m, c, k, P)
    cycle = fj.limit_cycle(belt, [0.002, 0.0])
    branch = fj.continue_cycle(belt, "V", (0.1, 0.45), start=cycle)
    hopf, omega = np.log(c_v * (static - kinetic) / (c + b_s)) / c_v, np.sqrt(k / m)
    slope = _slope_at_hopf(branch, hopf, omega)
    theirs = _stick_slip(force, V, c, m, k)
    checks = [
        closed("slowest belt without squeal, Eq. 11 [m/s]", hopf, _event(branch, "Hopf"), 1e-9),
        closed("d(amplitude^2)/dV there, 8/c_v [m/s]", 8 / c_v, slope, 1e-4),
        *_cycle_checks(cycle, theirs),
    ]
    speeds = np.linspace(hopf, 0.28, 15)
    curves = [
        Curve(
            speeds, np.sqrt(8 * (speeds - hopf) / c_v), "normal form, sqrt(8 (V - V_H)/c_v)", False
        ),
        Curve([hopf, hopf], [0, 0.3], "Hopf point, Eq. 11", False, True),
    ]
    panels = [
        _portrait(cycle, theirs, 1e3, "mm"),
        _amplitudes(branch, curves, omega, "half of peak to peak of omega x [m/s]"),
    ]
    return CaseResult(checks, panels)


CASES = (
    Case(
        "leine",
        "Stick-slip without damping",
        "R. I. Leine, D. H. van Campen, A. de Kraker, L. van den Steen, Nonlinear Dyn. 16, 41 "
        "(1998)",
        "10.1023/A:1008289604683",
        _leine,
    ),
    Case(
        "thomsen",
        "Pure slip and the onset of sticking, by perturbation",
        "J. J. Thomsen, A. Fidlin, Int. J. Non-Linear Mech. 38, 389 (2003)",
        "10.1016/S0020-7462(01)00073-7",
        _thomsen,
    ),
    Case(
        "papangelo",
        "Subcritical bifurcation of a belt with exponential friction",
        "A. Papangelo, M. Ciavarella, N. Hoffmann, Nonlinear Dyn. 90, 2037 (2017)",
        None,
        _papangelo,
    ),
    Case(
        "veraszto",
        "Bistable stick-slip",
        "Z. Veraszto, G. Stepan, Int. J. Non-Linear Mech. (2017)",
        "10.1016/j.ijnonlinmec.2017.01.006",
        _veraszto,
    ),
)
