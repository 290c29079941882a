"""What the package should give at a row of numbers, with many digits; each row by itself."""

from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
from mpmath import mpf

from .exact_joint import DIGITS, exact_joint

mp: Any = mpmath.mp  # it makes its functions at run time
Truth = Callable[..., dict[str, Any]]  # of the numbers of a row


def joint(*row) -> dict[str, Any]:
    """By `exact_joint`, a_l itself, and what tangential loads are taken beside."""
    found = exact_joint(*row)
    with mp.workdps(DIGITS):
        found["a_l"] = mp.exp(found["log_a_l"])
        return found | {"P": mpf(row[7]), "load": max(mpf(row[7]), abs(found["Q_e"]))}


def _linearised(m, omega_1, omega_2, xi_1, xi_2, F, V, K_n, K_t, mu_s, mu_m, v_m):
    """Eqs. 38 to 43 as they stand: a, b, c_1, c_2, g and the equilibrium."""
    drop, u = mu_s - mu_m, V / v_m
    mu, slope = mu_s - 3 * drop * u / 2 + drop * u**3 / 2, 3 * drop / (2 * v_m) * (u**2 - 1)
    stiffness = mp.matrix([[m * omega_1**2 + K_t, -mu * K_n], [mu * K_t, m * omega_2**2 + K_n]])
    x = mp.lu_solve(stiffness, mp.matrix([F, -F]) / mp.sqrt(2))
    c_1, c_2 = 2 * xi_1 * omega_1 + slope * K_n * x[1] / m, 2 * xi_2 * omega_2
    c_2 -= slope * K_t * x[0] / m
    a, b = stiffness[0, 0] / m, stiffness[1, 1] / m
    return (a, b, c_1, c_2, mu**2 * K_n * K_t / m**2), x


def eigenvalues(a, b, c_1, c_2, g) -> list[Any]:
    """Roots of (s^2 + c_1 s + a)(s^2 + c_2 s + b) + g, the largest real part first.

    By the companion matrix in units of sqrt(a + b), at the working precision: eigenvalues that
    coalesce have half its digits.
    """
    w = mp.sqrt(a + b)
    A = mp.zeros(4)
    A[0, 1] = A[1, 2] = A[2, 3] = 1
    for i, coefficient in enumerate((a * b + g, c_1 * b + c_2 * a, a + b + c_1 * c_2, c_1 + c_2)):
        A[3, i] = -coefficient / w ** (4 - i)
    return sorted((w * z for z in mp.eig(A, left=False, right=False)), key=lambda z: -mp.re(z))


def mechanism(*row) -> dict[str, Any]:
    """Eigenvalues, the margin by its definition, the equilibrium, mu_c."""
    with mp.workdps(DIGITS):
        row = [mpf(value) for value in row]
        (a, b, c_1, c_2, g), x = _linearised(*row)
        a_3, a_2, a_1, a_0 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g
        s = eigenvalues(a, b, c_1, c_2, g)
        K_n, K_t, m, omega_1, omega_2 = row[7], row[8], row[0], row[1], row[2]
        own = [2 * row[3] * omega_1, 2 * row[4] * omega_2]
        share = own[0] * own[1] / sum(own) ** 2 if sum(own) else mpf(1) / 4
        critical = share * ((a - b) ** 2 + sum(own) * (own[0] * b + own[1] * a))
        return {
            "growth_rate": mp.re(s[0]),
            "real": [mp.re(z) for z in s],
            "margin": _margin(a, b, c_1, c_2, (a_3, a_2, a_1, a_0)),
            "x_0": [x[0], x[1]],
            "mu_c": mp.sqrt(critical) * m / mp.sqrt(K_n * K_t) if K_t else mp.inf,
            "modulus": max(abs(z) for z in s),
        }


def _margin(a, b, c_1, c_2, coefficients):
    """`margin` from the coefficients themselves: cancellation costs these digits nothing."""
    w = mp.sqrt(a + b)
    a_3, a_2, a_1, a_0 = (c / w**k for k, c in enumerate(coefficients, 1))
    H_3 = a_1 * (a_3 * a_2 - a_1) - a_3**2 * a_0 - a_3 * a_1 * min(a_2, 0)
    E = a_2**2 - 4 * a_0 + a_3 * a_1
    heavy = (c_1**2 + c_2**2) / w**2 + mpf(2) ** -104
    u = _least(a_3, _least(E, 2 * H_3) / 2)
    return _least(u * heavy + a_0, u * heavy * a_0) / heavy / mp.sqrt(2)


def _least(total, product):
    return total - mp.sqrt(max(total**2 - 2 * product, 0))


def roughness(D, G, gamma, L, L_s) -> dict[str, Any]:
    """Sq and Sdq from the sums over the waves of Eq. 13."""
    with mp.workdps(DIGITS):
        # The package's own count: a ratio that is a power of gamma, up to rounding, belongs to it.
        count = 1 + int(np.floor(np.log(float(L / L_s)) / np.log(float(gamma)) + 1e-9))
        D, G, gamma, L = map(mpf, (D, G, gamma, L))
        scale = L**2 * (G / L) ** (2 * D - 4) * mp.log(gamma) / 2

        def waves(q):
            return (q**count - 1) / (q - 1)

        Sq = scale * waves(gamma ** (2 * (D - 3)))
        Sdq = scale * waves(gamma ** (2 * (D - 2))) * (2 * mp.pi / L) ** 2
        return {"Sq": mp.sqrt(Sq), "Sdq": mp.sqrt(Sdq)}


def slopes(truth: Truth, name: str, row, columns) -> list[Any]:
    """Derivatives of a scalar by some columns of the row, by central differences."""
    found = []
    with mp.workdps(DIGITS):
        row = [mpf(value) for value in row]
        for j in columns:
            if not row[j]:  # at the end of its range; it counts nothing by its logarithm
                found.append(mpf(0))
                continue
            h = abs(row[j]) * mpf(10) ** -18
            ends = [truth(*row[:j], row[j] + sign * h, *row[j + 1 :])[name] for sign in (1, -1)]
            found.append((ends[0] - ends[1]) / (2 * h))
    return found


def growth_of_surface(b: dict[str, float], D, log_G):
    """Growth rate [1/s] of the brake's numbers (`loops.brake`) with another surface."""
    contact, mass = ("gamma E nu sigma_y H P mu_s mu_m", "m omega_1 omega_2 xi_1 xi_2 F V")
    found = exact_joint(D, mp.exp(log_G), *(b[name] for name in contact.split()))
    row = [*(b[name] for name in mass.split()), found["K_n"], found["K_t"]]
    return mechanism(*row, b["mu_s"], b["mu_m"], b["v_m"])["growth_rate"]
