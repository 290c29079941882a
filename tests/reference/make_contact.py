"""Tabulate the fractal contact of two rough surfaces at high precision, as truth for the tests.

Each row holds one joint (surface, material, load, friction) with its largest contact area,
stiffnesses, tangential load and first derivatives by D, ln G and ln P, to 25 significant digits.

The numbers come from quadrature of the law of one asperity over the distribution of contact areas.
No integral is taken in closed form and the critical area is the root of its defining equation, so
that an error in a closed form of the library cannot confirm itself here. Equation numbers are those
of the source paper. Areas are carried as logarithms; SI units throughout.

    python tests/reference/make_contact.py

derives every row again from its inputs; to add a joint, append a row with these only.
``joint(row)`` does it for one row. The first row is the source's brake. The others were drawn: D in
2.02..2.98, a quarter within 1e-14..1e-2 of 2.5; G in 1e-14..1e-6 m; gamma 1.5, or for a fifth in
1.2..3; P in 1..1e6 N; nu 0.3, or for half in 0..0.5; E and sigma_y of steel, or for half in
1e9..4e11 Pa and 1e-4..2e-2 E; H in 2.5..6 sigma_y; mu_m in 0..0.9, some at 0, 0.3 and 0.9; mu_s up
to 0.6 above it. A third is in each regime, and one in fifty within 1e-6..1e-2 of each boundary.
"""

import functools
import json
import multiprocessing
import pathlib
from typing import Any, NamedTuple

from mpmath import mp, mpf
from mpmath.calculus.quadrature import GaussLegendre

DIGITS = 80  # working digits: a difference quotient over STEP keeps more than 40 of them
STEP = "1e-24"  # of central differences, with an error of order STEP**2
ORDER = 48  # Gauss-Legendre nodes per panel
PANEL = 16  # longest panel in ln a; integrands change by at most exp(PANEL / 2) across one
TAIL = 130  # the plastic tail is cut where exp(-TAIL) of it is left, 3.5e-57

INPUTS = ("D", "G", "gamma", "E", "nu", "sigma_y", "H", "P", "mu_s", "mu_m")
VALUES = ("ln_a_l", "ln_a_e", "K_n", "K_t", "A_r", "Q_e", "plastic_share", "slip")
REGIMES = ("fully_plastic", "elastic_plastic", "gross_slip")
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
    """The solved joint: the columns of the table that are neither inputs nor derivatives."""

    regime: str
    ln_a_l: Any
    ln_a_e: Any
    K_n: Any
    K_t: Any
    A_r: Any
    Q_e: Any
    plastic_share: Any
    slip: Any


@functools.cache
def nodes(order, prec):
    """Gauss-Legendre nodes and weights on [-1, 1]: 12, 24, 48, ... at this binary precision."""
    return tuple(GaussLegendre(mp).calc_nodes((order // 3).bit_length(), prec + 20))


def integrate(f, low, high, order):
    """Integral of the tuple-valued f over [low, high], by Gauss-Legendre on equal panels."""
    panels = max(1, int(mp.ceil((high - low) / PANEL)))
    half = (high - low) / (2 * panels)
    total: Any = None
    for i in range(panels):
        middle = low + (2 * i + 1) * half
        for x, weight in nodes(order, mp.prec):
            terms = [weight * value for value in f(middle + half * x)]
            total = terms if total is None else [s + t for s, t in zip(total, terms, strict=True)]
    return tuple(half * s for s in total)


def root(f, x0, x1):
    """By the secant method, to nearly all working digits: the last step is below 0.6 of them."""
    return mp.findroot(f, (x0, x1), tol=mpf(10) ** (-0.6 * mp.dps))


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


def ln_critical_area(s):
    """ln a_e, where delta = (3.3 pi k_mu phi/4)^2 R (Eq. 20) with R = a/(pi delta) (Eq. 12)."""
    yield_ratio = (mpf("3.3") * mp.pi * s.k_mu * s.sigma_y / (4 * s.E)) ** 2

    def residual(ln_a):
        delta = deformation(s, ln_a)
        return mp.log(delta / (yield_ratio * mp.exp(ln_a) / (mp.pi * delta)))

    return root(residual, mpf(-30), mpf(-20))


def hertz_load(s, ln_a):
    """P_e(a) = 4/3 E sqrt(R) delta^(3/2) (Eq. 8)."""
    delta = deformation(s, ln_a)
    return mpf(4) / 3 * s.E * mp.sqrt(mp.exp(ln_a) / (mp.pi * delta)) * delta * mp.sqrt(delta)


def normal_stiffness(s, ln_a, load):
    """k_n(a) = dP_e/d delta, the ratio of the slopes of Eqs. 8 and 16 in ln a."""
    slope_delta = (3 - s.D) / 2
    slope_load = (1 - slope_delta) / 2 + 3 * slope_delta / 2
    return load * slope_load / (deformation(s, ln_a) * slope_delta)


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
    """Area, k_n, q and unfactored k_t of the asperities in [a_e, a_l], over density_factor."""

    def terms(ln_a):
        a, shape, load = mp.exp(ln_a), density_shape(s, ln_a), hertz_load(s, ln_a)
        k_n, q = normal_stiffness(s, ln_a, load), tangential_limit(s, a, load)
        return tuple(value * shape for value in (a, k_n, q, sticking_stiffness(s, a)))

    return integrate(terms, ln_a_e, ln_a_l, s.order)


def solve(s, start=None):
    """The state of the joint under its load; start is ln a_l of a neighbouring solution."""
    ln_a_e = ln_critical_area(s)
    below = plastic_sums(s, ln_a_e)
    load_at_a_e = density_factor(s, ln_a_e) * below[0]
    fully_plastic = load_at_a_e >= s.P

    def residual(ln_a_l):
        # Quadrature runs from a_e either way, so a step below a_e stays on the same smooth curve.
        if fully_plastic:
            total = plastic_sums(s, ln_a_l)[0]
        else:
            total = below[0] + elastic_load_sum(s, ln_a_e, ln_a_l)
        return mp.log(density_factor(s, ln_a_l) * total / s.P)

    guess = ln_a_e + mp.log(s.P / load_at_a_e) if start is None else start
    ln_a_l = root(residual, guess, guess + mpf("0.01" if start is None else STEP))
    factor, zero = density_factor(s, ln_a_l), mpf(0)
    if fully_plastic:
        area = factor * plastic_sums(s, ln_a_l)[1]
        return State(REGIMES[0], ln_a_l, ln_a_e, zero, zero, area, zero, mpf(1), zero)
    area, K_n, Q_e, K_t = (factor * value for value in elastic_sums(s, ln_a_e, ln_a_l))
    slip, area, share = Q_e / (s.mu_s * s.P), area + factor * below[1], factor * below[0] / s.P
    K_t = zero if slip >= 1 else mp.cbrt(1 - slip) * K_t
    return State(REGIMES[1 + (slip >= 1)], ln_a_l, ln_a_e, K_n, K_t, area, Q_e, share, slip)


def inputs_of(row, order=ORDER):
    """The row's numbers, doubles or decimal strings, taken as exact, in working precision."""
    exact = {name: mpf(row[name]) for name in ("D", "E", "nu", "sigma_y", "H", "P", "mu_s")}
    ln_G, ln_ln_gamma = mp.log(mpf(row["G"])), mp.log(mp.log(mpf(row["gamma"])))
    k_mu = friction_correction(row["mu_m"])
    return Inputs(**exact, ln_G=ln_G, ln_ln_gamma=ln_ln_gamma, k_mu=k_mu, order=order)


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
        result = {name: row[name] for name in INPUTS} | {"regime": state.regime}
        result |= {name: mp.nstr(getattr(state, name), 25) for name in VALUES}
        for name, column in zip(("dln_a_l", "dln_K_n", "dln_K_t"), slopes.values(), strict=True):
            result[name] = [mp.nstr(x, 25) for x in column] or None
    return result


def main():
    """Solve the rows in parallel and write one per line."""
    table = pathlib.Path(__file__).with_name("contact.json")
    with multiprocessing.Pool() as pool:
        rows = pool.map(joint, json.loads(table.read_text("utf-8"))["rows"], chunksize=8)
    lines = ",\n".join(json.dumps(row, separators=(",", ":")) for row in rows)
    table.write_text(f'{{"about":{json.dumps(ABOUT)},"rows":[\n{lines}\n]}}\n', "utf-8")
    # The quadrature has converged if twice its order gives the same digits.
    for row in rows[:: max(1, len(rows) // 12)]:
        if joint(row, 2 * ORDER) != row:
            print("at twice the quadrature order another digit:", row)


if __name__ == "__main__":
    main()
