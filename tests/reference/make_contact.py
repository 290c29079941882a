"""Tabulate the fractal contact of two rough surfaces at high precision, as truth for the tests.

Every row holds one joint (surface, material, load, friction) with its largest contact area,
stiffnesses, tangential load and their first derivatives, written with 25 significant digits.

The numbers come from quadrature of the law of a single asperity over the distribution of contact
areas. No integral is taken in closed form, and the critical area is found as a root of its defining
equation, so that an error in a closed form of the library cannot confirm itself here. Equation
numbers are those of the paper that the library implements. Areas are carried as logarithms, since
the critical area spans hundreds of decades as D approaches 2. SI units throughout.

    python tests/reference/make_contact.py [--points N] [--out FILE]

``joint(row)`` derives one row again; it needs nothing but mpmath.
"""

import argparse
import functools
import json
import math
import multiprocessing
import pathlib
import random
import time
from typing import Any, NamedTuple

from mpmath import mp, mpf

DIGITS = 80  # working digits: a difference quotient over STEP still keeps more than 40 of them
STEP = "1e-24"  # central differences: truncation of order STEP**2
ORDER = 48  # Gauss-Legendre nodes per panel
AIM_DIGITS = 20  # enough, with AIM_ORDER, to place a point 1e-6 from a regime boundary
AIM_ORDER = 16
AIM_TRIES = 12  # joints tried at one D before another D is drawn
PANEL = 16  # longest panel in ln a; integrands change by at most exp(PANEL / 2) across one
TAIL = 130  # the plastic tail is cut where exp(-TAIL) of it is left, 3.5e-57
PROCESSES = 2

INPUTS = ("D", "G", "gamma", "E", "nu", "sigma_y", "H", "P", "mu_s", "mu_m")
VALUES = ("ln_a_l", "ln_a_e", "K_n", "K_t", "A_r", "Q_e", "plastic_share", "slip")
REGIMES = ("fully_plastic", "elastic_plastic", "gross_slip")
MAX_MU = 0.9

# The reference joint as decimals; its row in the table takes the nearest doubles.
REFERENCE_TEXT = {
    "D": "2.4",
    "G": "1.342e-10",
    "gamma": "1.5",
    "E": "1.154e11",
    "nu": "0.3",
    "sigma_y": "3.55e8",
    "H": "9.94e8",  # 2.8 sigma_y
    "P": "1907.3",
    "mu_s": "0.4",
    "mu_m": "0.25",
}
REFERENCE = {name: float(text) for name, text in REFERENCE_TEXT.items()}
# Found earlier and separately for the exact decimals, rounded to 15 digits.
REFERENCE_VALUES = {
    "a_l": "1.1765673964468e-6",
    "a_e": "1.7849797376094e-7",
    "A_r": "2.74532392504253e-6",
    "K_n": "402628934.268313",
    "K_t": "191682502.096783",
    "slip": "0.182002986014594",
    "plastic_share": "0.812579599496363",
}
ABOUT = (
    "Fractal contact of rough surfaces from quadrature of the single-asperity law, 25 significant "
    "digits; derivatives are with respect to [D, ln G, ln P]; made by make_contact.py."
)


class Inputs(NamedTuple):
    """One joint in working precision."""

    D: Any
    ln_G: Any
    ln_ln_gamma: Any
    E: Any
    nu: Any
    sigma_y: Any
    H: Any
    P: Any
    mu_s: Any
    k_mu: Any
    order: int


class State(NamedTuple):
    """The solved joint: the columns of the table that are not inputs or derivatives."""

    regime: str
    ln_a_l: Any
    ln_a_e: Any
    K_n: Any
    K_t: Any
    A_r: Any
    Q_e: Any
    plastic_share: Any
    slip: Any


# ---------------------------------------------------------------------------------------------
# Numerical tools
# ---------------------------------------------------------------------------------------------


def _legendre(order, x):
    """Value and slope of the Legendre polynomial inside (-1, 1)."""
    before, value = mpf(1), x
    for k in range(2, order + 1):
        before, value = value, ((2 * k - 1) * x * value - (k - 1) * before) / k
    return value, order * (before - x * value) / (1 - x * x)


@functools.cache
def _nodes_at(order, prec):
    """Gauss-Legendre nodes and weights on [-1, 1], for this order and binary precision."""
    nodes = []
    with mp.workprec(prec + 20):
        for i in range(order):
            x = mpf(math.cos(math.pi * (i + 0.75) / (order + 0.5)))
            # The start has two digits or more, and Newton's method doubles them.
            for _ in range(prec.bit_length() + 2):
                value, slope = _legendre(order, x)
                x -= value / slope
            slope = _legendre(order, x)[1]
            nodes.append((x, 2 / ((1 - x * x) * slope**2)))
    return tuple(nodes)


def integrate(f, low, high, order=ORDER, panel=PANEL):
    """Integral of the tuple-valued f over [low, high], by Gauss-Legendre on equal panels."""
    panels = max(1, int(mp.ceil((high - low) / panel)))
    half = (high - low) / (2 * panels)
    total: Any = None
    for i in range(panels):
        middle = low + (2 * i + 1) * half
        for x, weight in _nodes_at(order, mp.prec):
            terms = [weight * value for value in f(middle + half * x)]
            total = terms if total is None else [s + t for s, t in zip(total, terms, strict=True)]
    return tuple(half * s for s in total)


def secant(f, x0, x1):
    """Root of f by the secant method, to nearly all working digits."""
    # A step below this leaves an error of the order of its product with the step before.
    small = mpf(10) ** (-0.6 * mp.dps)
    f0, f1 = f(x0), f(x1)
    for _ in range(60):
        if f1 == f0:
            return x1
        step = -f1 * (x1 - x0) / (f1 - f0)
        x0, f0, x1 = x1, f1, x1 + step
        if abs(step) <= small * max(1, abs(x1)):
            return x1
        f1 = f(x1)
    raise ArithmeticError("the secant method did not converge")


# ---------------------------------------------------------------------------------------------
# One asperity
# ---------------------------------------------------------------------------------------------


def friction_correction(mu_m):
    """k_mu (Eq. 19); the double 0.3 counts as 0.3, as it must in double precision."""
    if float(mu_m) <= 0.3:
        return 1 - mpf("0.228") * mpf(mu_m)
    return mpf("0.932") * mp.exp(-mpf("1.58") * (mpf(mu_m) - mpf("0.3")))


def deformation(s, ln_a):
    """delta(a) (Eq. 16)."""
    ln_delta = (
        (11 - 3 * s.D) / 2 * mp.ln2
        + (s.D - 2) * s.ln_G
        + s.ln_ln_gamma / 2
        + (s.D - 3) / 2 * mp.log(mp.pi)
        + (3 - s.D) / 2 * ln_a
    )
    return mp.exp(ln_delta)


def radius(s, ln_a):
    """Tip radius R(a) (Eq. 12)."""
    return mp.exp(ln_a) / (mp.pi * deformation(s, ln_a))


def ln_critical_area(s):
    """ln a_e, where the deformation is the one at which yield begins (Eq. 20)."""
    yield_ratio = (mpf("3.3") * mp.pi * s.k_mu * s.sigma_y / (4 * s.E)) ** 2

    def excess(ln_a):
        return mp.log(deformation(s, ln_a) / (yield_ratio * radius(s, ln_a)))

    return secant(excess, mpf(-30), mpf(-20))


def hertz_load(s, ln_a):
    """P_e(a) = 4/3 E sqrt(R) delta^(3/2) (Eq. 8)."""
    delta = deformation(s, ln_a)
    return mpf(4) / 3 * s.E * mp.sqrt(mp.exp(ln_a) / (mp.pi * delta)) * delta * mp.sqrt(delta)


def normal_stiffness(s, ln_a, load, delta):
    """k_n(a) = dP_e/d delta, the ratio of the slopes of Eqs. 8 and 16 in ln a."""
    slope_delta = (3 - s.D) / 2
    slope_radius = 1 - slope_delta
    slope_load = slope_radius / 2 + 3 * slope_delta / 2
    return (load * slope_load) / (delta * slope_delta)


def tangential_limit(s, a, load):
    """q(a) (Eq. 32)."""
    return 8 * (s.sigma_y * a + (2 * s.nu - 1) * load) / (mp.pi * (6 - 3 * s.nu))


def sticking_stiffness(s, a):
    """k_t(a) (Eq. 35) before the factor for partial slip, which is the same for every asperity."""
    shear_modulus = s.E / (2 * (1 + s.nu))
    return 8 * shear_modulus * mp.sqrt(a) / ((2 - s.nu) * mp.sqrt(mp.pi))


def density_factor(s, ln_a_l):
    """The part of n(a) (Eq. 25) that depends on the largest area alone."""
    return (s.D - 1) / 2 * mp.exp((s.D - 1) / 2 * ln_a_l)


def density_shape(s, ln_a):
    """The part of n(a) da (Eq. 25) that depends on a, per unit of ln a."""
    return mp.exp(-(s.D + 1) / 2 * ln_a + ln_a)


# ---------------------------------------------------------------------------------------------
# The joint
# ---------------------------------------------------------------------------------------------


def plastic_sums(s, ln_a_top):
    """Load and area of the asperities below a_top, over density_factor."""
    # The integrand falls as exp((3 - D)/2 ln a): in these units of ln a, always as exp(-v).
    unit = 2 / (3 - s.D)

    def terms(v):
        ln_a = ln_a_top - unit * v
        area = mp.exp(ln_a) * density_shape(s, ln_a) * unit
        return s.H * area, area

    return integrate(terms, mpf(0), mpf(TAIL), s.order)


def elastic_load_sum(s, ln_a_e, ln_a_l):
    """Load of the asperities in [a_e, a_l], over density_factor."""

    def terms(ln_a):
        return (hertz_load(s, ln_a) * density_shape(s, ln_a),)

    return integrate(terms, ln_a_e, ln_a_l, s.order)[0]


def elastic_sums(s, ln_a_e, ln_a_l):
    """Load, area, k_n, q, unfactored k_t of the asperities in [a_e, a_l], over density_factor."""

    def terms(ln_a):
        a, shape = mp.exp(ln_a), density_shape(s, ln_a)
        load = hertz_load(s, ln_a)
        k_n = normal_stiffness(s, ln_a, load, deformation(s, ln_a))
        q, k_t = tangential_limit(s, a, load), sticking_stiffness(s, a)
        return tuple(value * shape for value in (load, a, k_n, q, k_t))

    return integrate(terms, ln_a_e, ln_a_l, s.order)


def load_at(s, ln_a_l):
    """P(a_l), the load that makes a_l the largest contact area."""
    ln_a_e = ln_critical_area(s)
    total = plastic_sums(s, min(ln_a_e, ln_a_l))[0]
    if ln_a_l > ln_a_e:
        total += elastic_load_sum(s, ln_a_e, ln_a_l)
    return density_factor(s, ln_a_l) * total


def _starts(start, guess):
    """Two starting points for the secant method: beside a known solution, or a rough pair."""
    if start is None:
        return guess, guess + mpf("0.01")
    return start, start + mpf(STEP)


def _fully_plastic(s, ln_a_e, plastic_at_a_e, start):
    guess = ln_a_e + mp.log(s.P / plastic_at_a_e)

    def excess(ln_a_l):
        return mp.log(density_factor(s, ln_a_l) * plastic_sums(s, ln_a_l)[0] / s.P)

    ln_a_l = secant(excess, *_starts(start, guess))
    area = density_factor(s, ln_a_l) * plastic_sums(s, ln_a_l)[1]
    zero = mpf(0)
    return State("fully_plastic", ln_a_l, ln_a_e, zero, zero, area, zero, mpf(1), zero)


def _part_elastic(s, ln_a_e, plastic, plastic_at_a_e, start):
    guess = ln_a_e + mp.log(s.P / plastic_at_a_e)

    def excess(ln_a_l):
        # Quadrature runs from a_e either way, so a step below a_e stays on the same smooth curve.
        total = plastic[0] + elastic_load_sum(s, ln_a_e, ln_a_l)
        return mp.log(density_factor(s, ln_a_l) * total / s.P)

    ln_a_l = secant(excess, *_starts(start, guess))
    factor = density_factor(s, ln_a_l)
    _, area, k_n, q, k_t = (factor * value for value in elastic_sums(s, ln_a_e, ln_a_l))
    slip = q / (s.mu_s * s.P)
    regime = "gross_slip" if slip >= 1 else "elastic_plastic"
    K_t = mpf(0) if slip >= 1 else mp.cbrt(1 - slip) * k_t
    share = factor * plastic[0] / s.P
    return State(regime, ln_a_l, ln_a_e, k_n, K_t, factor * plastic[1] + area, q, share, slip)


def solve(s, start=None):
    """The state of the joint under its load; start is ln a_l of a neighbouring solution."""
    ln_a_e = ln_critical_area(s)
    plastic = plastic_sums(s, ln_a_e)
    plastic_at_a_e = density_factor(s, ln_a_e) * plastic[0]
    if plastic_at_a_e >= s.P:
        return _fully_plastic(s, ln_a_e, plastic_at_a_e, start)
    return _part_elastic(s, ln_a_e, plastic, plastic_at_a_e, start)


def inputs_of(row, order=ORDER):
    """The row's numbers, doubles or decimal strings, taken as exact, in working precision."""
    exact = {name: mpf(row[name]) for name in ("D", "E", "nu", "sigma_y", "H", "P", "mu_s")}
    return Inputs(
        **exact,
        ln_G=mp.log(mpf(row["G"])),
        ln_ln_gamma=mp.log(mp.log(mpf(row["gamma"]))),
        k_mu=friction_correction(row["mu_m"]),
        order=order,
    )


def derivatives(s, state):
    """Central differences of ln a_l, ln K_n, ln K_t with respect to D, ln G, ln P."""
    h = mpf(STEP)
    columns = {"ln_a_l": [], "K_n": [], "K_t": []}
    for move in (
        lambda t: s._replace(D=s.D + t),
        lambda t: s._replace(ln_G=s.ln_G + t),
        lambda t: s._replace(P=s.P * mp.exp(t)),
    ):
        up, down = (solve(move(t), state.ln_a_l) for t in (h, -h))
        if not up.regime == down.regime == state.regime:
            raise ArithmeticError("a difference reaches across a regime boundary")
        columns["ln_a_l"].append((up.ln_a_l - down.ln_a_l) / (2 * h))
        for name in ("K_n", "K_t"):
            # A stiffness that is zero all through its regime has no logarithm.
            if getattr(state, name):
                ratio = getattr(up, name) / getattr(down, name)
                columns[name].append(mp.log(ratio) / (2 * h))
    return columns


def joint(row, order=ORDER):
    """One row of the table: the inputs of row and everything derived from them, as strings."""
    with mp.workdps(DIGITS):
        s = inputs_of(row, order)
        state = solve(s)
        slopes = derivatives(s, state)
        result = {name: row[name] for name in INPUTS}
        result["regime"] = state.regime
        for name in VALUES:
            result[name] = mp.nstr(getattr(state, name), 25)
        for name, column in zip(("dln_a_l", "dln_K_n", "dln_K_t"), slopes.values(), strict=True):
            result[name] = [mp.nstr(x, 25) for x in column] or None
    return result


# ---------------------------------------------------------------------------------------------
# The points
# ---------------------------------------------------------------------------------------------


def _log_uniform(rng, low, high):
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _draw_dimension(rng, index):
    """D over its range, a quarter of the points close to 2.5 and a few exactly on it."""
    if index % 89 == 0:
        return 2.5
    if index % 4 == 0:
        return 2.5 + rng.choice((-1, 1)) * _log_uniform(rng, 1e-14, 1e-2)
    return rng.uniform(2.02, 2.98)


def _draw(rng, D):
    """A random joint of dimension D, whatever its regime."""
    E, sigma_y = REFERENCE["E"], REFERENCE["sigma_y"]
    if rng.random() < 0.5:
        E = _log_uniform(rng, 1e9, 4e11)
        sigma_y = E * _log_uniform(rng, 1e-4, 2e-2)
    mu_m = rng.choice((0.0, 0.3, MAX_MU)) if rng.random() < 0.12 else rng.uniform(0, MAX_MU)
    low = max(mu_m, 0.02)
    return {
        "D": D,
        "G": _log_uniform(rng, 1e-14, 1e-6),
        "gamma": rng.uniform(1.2, 3) if rng.random() < 0.2 else 1.5,
        "E": E,
        "nu": rng.uniform(0, 0.5) if rng.random() < 0.5 else 0.3,
        "sigma_y": sigma_y,
        "H": rng.uniform(2.5, 6) * sigma_y,
        "P": _log_uniform(rng, 1, 1e6),
        "mu_s": rng.uniform(low, low + 0.6),
        "mu_m": mu_m,
    }


def _set_slip(row, state, slip):
    """The row with mu_s such that Q_e / (mu_s P) is slip, or None where no such mu_s is allowed."""
    mu_s = float(state.Q_e / (slip * mpf(row["P"])))
    return row | {"mu_s": mu_s} if 0 < mu_s <= MAX_MU else None


def _aim_regime(rng, row, regime):
    state = solve(inputs_of(row, AIM_ORDER))
    if state.regime == "elastic_plastic" and regime == "gross_slip":
        return _set_slip(row, state, 1 / mpf(rng.uniform(0.05, 0.999)))
    return row if state.regime == regime else None


def _aim_yield_edge(rng, row, _):
    """A load that puts a_l just above or below a_e."""
    s = inputs_of(row, AIM_ORDER)
    distance = rng.choice((-1, 1)) * _log_uniform(rng, 1e-6, 1e-2)
    P = float(load_at(s, ln_critical_area(s) + distance))
    return row | {"P": P} if 1 <= P <= 1e6 else None


def _aim_slip_edge(rng, row, _):
    """A friction that puts Q_e just above or below mu_s P."""
    state = solve(inputs_of(row, AIM_ORDER))
    distance = rng.choice((-1, 1)) * _log_uniform(rng, 1e-6, 1e-2)
    return None if state.Q_e <= 0 else _set_slip(row, state, 1 - mpf(distance))


def _plan(index, points):
    """The aim of the point with this index: one in fifty at each boundary, the rest by regime."""
    edge = points // 50
    if index <= edge:
        return _aim_yield_edge, None
    if index <= 2 * edge:
        return _aim_slip_edge, None
    return _aim_regime, REGIMES[index % 3]


def sample(points, seed=2026):
    """The inputs of every row: the reference joint, then random joints aimed at each regime."""
    rng = random.Random(seed)
    rows = [dict(REFERENCE)]
    with mp.workdps(AIM_DIGITS):
        for index in range(1, points):
            aim, regime = _plan(index, points)
            D, row, tries = None, None, 0
            while row is None:
                # Keep D over several tries, so that a rare regime still covers the range of D.
                D = _draw_dimension(rng, index) if tries % AIM_TRIES == 0 else D
                row, tries = aim(rng, _draw(rng, D), regime), tries + 1
            rows.append(row)
    return rows


# ---------------------------------------------------------------------------------------------
# The file
# ---------------------------------------------------------------------------------------------


def print_reference():
    """Compare the reference joint, as exact decimals, with the values found earlier."""
    row = joint(REFERENCE_TEXT)
    print("reference joint: value here, value found earlier, relative difference")
    with mp.workdps(30):
        found = {name: mpf(row[name]) for name in ("A_r", "K_n", "K_t", "slip", "plastic_share")}
        found["a_l"], found["a_e"] = mp.exp(mpf(row["ln_a_l"])), mp.exp(mpf(row["ln_a_e"]))
        for name, text in REFERENCE_VALUES.items():
            error = mp.nstr(found[name] / mpf(text) - 1, 2)
            print(f"  {name:14} {mp.nstr(found[name], 17):24} {text:20} {error}")


def _numbers(item):
    """The numbers of one table entry: a string, a list of strings, or nothing."""
    if item is None:
        return []
    return [mpf(text) for text in (item if isinstance(item, list) else [item])]


def largest_change(rows, order):
    """Largest relative change of any tabulated number when the quadrature order is changed."""
    worst = mpf(0)
    with mp.workdps(30):
        for row in rows:
            again = joint(row, order)
            for name in (*VALUES, "dln_a_l", "dln_K_n", "dln_K_t"):
                for old, new in zip(_numbers(row[name]), _numbers(again[name]), strict=True):
                    if old != 0:
                        worst = max(worst, abs(new / old - 1))
    return worst


def write(rows, path):
    """Write one row per line, so that a change of one point is a change of one line."""
    lines = ",\n".join(json.dumps(row, separators=(",", ":")) for row in rows)
    path.write_text(f'{{"about":{json.dumps(ABOUT)},"rows":[\n{lines}\n]}}\n', encoding="utf-8")


def main():
    """Choose the points, solve them in parallel, write the file and print the checks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=1120)
    parser.add_argument(
        "--out", type=pathlib.Path, default=pathlib.Path(__file__).with_name("contact.json")
    )
    args = parser.parse_args()

    start = time.perf_counter()
    inputs = sample(args.points)
    print(f"{len(inputs)} points chosen in {time.perf_counter() - start:.0f} s")
    start = time.perf_counter()
    with multiprocessing.Pool(PROCESSES) as pool:
        rows = pool.map(joint, inputs, chunksize=8)
    print(f"solved in {time.perf_counter() - start:.0f} s")
    write(rows, args.out)

    for regime in REGIMES:
        print(f"  {regime:16} {sum(row['regime'] == regime for row in rows)}")
    print_reference()
    change = largest_change(rows[:: max(1, len(rows) // 12)], 2 * ORDER)
    print(f"largest relative change at twice the quadrature order: {mp.nstr(change, 2)}")


if __name__ == "__main__":
    main()
