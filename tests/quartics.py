"""Problems (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g, and what is true of them in 40 digits."""

import functools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

from fractaljax._mechanism.oscillator import Linearised
from fractaljax._stability.margin import margin_of
from fractaljax._stability.quartic import rightmost_root, roots

EPS = np.finfo(float).eps

many_rightmost = jax.jit(jax.vmap(rightmost_root))
many_roots = jax.jit(jax.vmap(roots))
many_margins = jax.jit(jax.vmap(margin_of))


def stacked(columns):
    return Linearised(*(jnp.asarray(column) for column in columns))


def log_uniform(rng, low, high, n):
    return 10 ** rng.uniform(low, high, n)


def contacts(rng, n, xi_1, xi_2):
    """Fixed contacts, K_n 1e3..1e13, kappa 0..1, mu 0.01..0.9."""
    K_n, kappa, mu = log_uniform(rng, 3, 13, n), rng.uniform(0, 1, n), rng.uniform(0.01, 0.9, n)
    omega_1, omega_2, m = (log_uniform(rng, *x, n) for x in ((2, 5), (2, 5), (-2, 2)))
    a, b = omega_1**2 + kappa * K_n / m, omega_2**2 + K_n / m
    return a, b, 2 * xi_1 * omega_1, 2 * xi_2 * omega_2, mu**2 * kappa * (K_n / m) ** 2


def polynomials(rng, n, low, high, signs=(1,)):
    """Damping of 10^low..10^high beside a, b of 0.01..100."""
    c_1, c_2 = (log_uniform(rng, low, high, n) * rng.choice(signs, n) for _ in range(2))
    a, b = log_uniform(rng, -2, 2, n), log_uniform(rng, -2, 2, n)
    return a, b, c_1, c_2, log_uniform(rng, -6, 3, n)


def equal(columns):
    a, b, c, _, g = columns
    return a, b, c, c, g


def coalescing(rng, n, xi_1, xi_2):
    """|a - b| = 2 sqrt(g) (1 +- 1e-14..1e-1): both sides of the undamped exceptional point."""
    a, _, c_1, c_2, g = contacts(rng, n, xi_1, xi_2)
    off = rng.choice([-1, 1], n) * log_uniform(rng, -14, -1, n)
    return a, a + 2 * np.sqrt(g) * (1 + off), c_1, c_2, g


def equal_near_critical(rng, n):
    """One direction overdamped and one not, by the same damping: p < 0 and alpha = 0."""
    share, c = rng.uniform(0.02, 0.3, n), rng.uniform(1.42, 1.8, n)
    return share, 1 - share, c, c, log_uniform(rng, -4, -1.3, n)


def negative_leading(rng, n):
    """More mean damping than stiffness: p <= 0 in Ferrari's resolvent."""
    a, b = rng.uniform(0.1, 1, (2, n))
    c_1, c_2 = rng.uniform(2.2, 6, (2, n))
    sigma, d = (c_1 + c_2) / 4, (c_1 - c_2) / 2
    assert (a + b - 2 * sigma**2 - d**2 <= 0).all()
    return a, b, c_1, c_2, rng.uniform(0, 4, n)


def heavy(rng, n):
    return log_uniform(rng, 0, 4, n)


FAMILIES = {
    "light": lambda r, n: contacts(r, n, *r.uniform(0, 0.1, (2, n))),
    "equally damped": lambda r, n: equal(contacts(r, n, *r.uniform(0, 0.1, (2, n)))),
    "undamped": lambda r, n: contacts(r, n, np.zeros(n), np.zeros(n)),
    "heavy": lambda r, n: contacts(r, n, heavy(r, n), heavy(r, n)),
    "heavy and equal": lambda r, n: equal(contacts(r, n, heavy(r, n), heavy(r, n))),
    "heavy beside light": lambda r, n: contacts(r, n, heavy(r, n), r.uniform(0, 0.1, n)),
    "equal, near critical": equal_near_critical,
    "negative leading term": negative_leading,
    "driven": lambda r, n: polynomials(r, n, -4, -0.5, signs=(-1, 1)),
    "uncoupled": lambda r, n: (*polynomials(r, n, -4, 0)[:4], np.zeros(n)),
    "equal stiffness": lambda r, n: [polynomials(r, n, -4, 0)[i] for i in (0, 0, 2, 3, 4)],
    # Equal modes with a coupling below the rounding of a b, which must not be lost in it.
    "twins": lambda r, n: (a := heavy(r, n), a, 0 * a, 0 * a, 1e-20 * a**2),
    "overdamped": lambda r, n: polynomials(r, n, 0, 4),
    "coalescing, undamped": lambda r, n: coalescing(r, n, np.zeros(n), np.zeros(n)),
    "coalescing, equal": lambda r, n: equal(coalescing(r, n, *log_uniform(r, -6, -1, (2, n)))),
    "coalescing, unequal": lambda r, n: coalescing(r, n, *log_uniform(r, -6, -1, (2, n))),
}


def family(name, n):
    """n systems of a family, always the same."""
    return FAMILIES[name](np.random.default_rng(len(name)), n)


def quartic_roots(coefficients):
    """Roots of a quartic by the Durand-Kerner method in 100 digits, from NumPy's as a start."""
    with mp.workdps(100):
        coefficients = [mp.mpf(x) for x in coefficients]
        start = np.roots([float(x) for x in coefficients])
        found = [mp.mpmathify(complex(s)) + mp.mpc(k, 1) * 1e-12 for k, s in enumerate(start)]
        for _ in range(400):
            largest = 0
            for i, s in enumerate(found):
                others = mp.fprod(s - other for other in found[:i] + found[i + 1 :])
                step = functools.reduce(lambda total, x: total * s + x, coefficients) / others
                found[i] -= step
                largest = max(largest, abs(step))
            if largest < mp.mpf(10) ** -60:
                return found
    raise AssertionError("no convergence")


def in_units(a, b, c_1, c_2, g, *rates):
    """sqrt(a + b), and all numbers in its units, as mpmath's."""
    a, b, c_1, c_2, g, *rates = (mp.mpf(x) for x in (a, b, c_1, c_2, g, *rates))
    w = mp.sqrt(a + b)
    return w, (a / w**2, b / w**2, c_1 / w, c_2 / w, g / w**4, *(rate / w for rate in rates))


def coefficients(a, b, c_1, c_2, g):
    """Of the polynomial, highest power first."""
    return [1, c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g]


def exact_roots(*system):
    """The roots in 40 digits, the largest real part first."""
    omega, scaled = in_units(*system)
    found = (omega * root for root in quartic_roots(coefficients(*scaled)))
    return sorted(found, key=lambda s: -s.real)


def condition(s, a, b, c_1, c_2, g):
    """Sum over the coefficients x of |x ds/dx|: what one rounding of each can do to s."""
    s = mp.mpc(s)
    a, b, c_1, c_2, g = (mp.mpf(float(x)) for x in (a, b, c_1, c_2, g))
    first, second = s**2 + c_1 * s + a, s**2 + c_2 * s + b
    slope = abs((2 * s + c_1) * second + (2 * s + c_2) * first)
    size = (a + abs(c_1 * s)) * abs(second) + (b + abs(c_2 * s)) * abs(first) + g
    return float(size / slope) if slope else np.inf


def exact_least(total, product):
    return total - mp.sqrt(total**2 - 2 * product)


def exact_margin(*numbers):
    """The margin from the coefficients of the polynomial about the shift, by its definition."""
    _, (a, b, c_1, c_2, g, s) = in_units(*numbers)
    p = coefficients(a, b, c_1, c_2, g)[::-1]
    # Taylor coefficients about the shift.
    q = [sum(mp.binomial(k, j) * p[k] * s ** (k - j) for k in range(j, 5)) for j in range(4)]
    H_3 = q[1] * (q[3] * q[2] - q[1]) - q[3] ** 2 * q[0]
    E = q[2] ** 2 - 4 * q[0] + q[3] * q[1]
    u = exact_least(q[3], exact_least(E, 2 * H_3) / 2)
    heavy = c_1**2 + c_2**2
    return exact_least(u + q[0] / heavy, u * q[0] / heavy) / mp.sqrt(2)
