"""The growth rate and its derivatives with 40 digits: the truth that errors are taken to."""

from typing import Any

import mpmath
import numpy as np
from mpmath import mpf
from tqdm import tqdm

mp: Any = mpmath.mp  # it makes its functions at run time


def exact_growth(b: dict[str, float], D, log_G):
    """Growth rate [1/s] at working precision; integrals by Eqs. 25 to 36, roots by mpmath."""
    c: dict[str, Any] = {name: mpf(value) for name, value in b.items()}
    E, nu, H, P, m = c["E"], c["nu"], c["H"], c["P"], c["m"]
    k_mu = 1 - mpf("0.228") * c["mu_m"]  # Eq. 19 up to mu_m = 0.3, where this brake is
    root_log_gamma = mp.sqrt(mp.log(c["gamma"]))
    size = 2 ** ((11 - 3 * D) / 2) * mp.exp((D - 2) * log_G) * root_log_gamma * mp.pi ** (D / 2)
    # delta(a) = size pi^(-3/2) a^((3-D)/2) and R = a/(pi delta) meet at a_e (Eqs. 16, 17, 20).
    pressure = mpf("3.3") * mp.pi * k_mu * c["sigma_y"] / E / 4
    a_e = (mp.pi * (size * mp.pi ** mpf("-1.5") / pressure) ** 2) ** (1 / (D - 2))
    c_e = E / 3 * mp.pi ** ((D - 4) / 2) * 2 ** ((15 - 3 * D) / 2) * root_log_gamma
    c_e *= mp.exp((D - 2) * log_G)

    def moment(p, a_l):
        r = p + (1 - D) / 2
        power = (a_l**r - a_e**r) / r if r else mp.log(a_l / a_e)
        return (D - 1) / 2 * a_l ** ((D - 1) / 2) * power

    def load(a_l):
        plastic = (D - 1) / (3 - D) * H * a_l ** ((D - 1) / 2) * a_e ** ((3 - D) / 2)
        return plastic + c_e * moment((4 - D) / 2, a_l)

    a_plastic = P * (3 - D) / ((D - 1) * H)
    K_n = K_t = mpf(0)
    if a_plastic > a_e:
        bracket = (mpf(0), 2 * mp.log(a_plastic / a_e) / (D - 1))
        t = mp.findroot(
            lambda t: mp.log(load(a_e * mp.exp(t)) / P),
            bracket,
            solver="anderson",
            tol=mpf(10) ** -68,
        )
        a_l = a_e * mp.exp(t)
        J = moment(mpf(1) / 2, a_l)
        K_n = 4 * E * (4 - D) / (3 * mp.sqrt(mp.pi) * (3 - D)) * J
        tangential = c["sigma_y"] * moment(mpf(1), a_l)
        tangential += (2 * nu - 1) * c_e * moment((4 - D) / 2, a_l)
        grip = 1 - 8 * tangential / (mp.pi * (6 - 3 * nu)) / (c["mu_s"] * P)
        K_t = 4 * E / ((1 + nu) * (2 - nu) * mp.sqrt(mp.pi)) * mp.cbrt(max(grip, 0)) * J
    drop, u = c["mu_s"] - c["mu_m"], c["V"] / c["v_m"]
    mu = c["mu_s"] - 3 * drop * u / 2 + drop * u**3 / 2
    slope = 3 * drop / (2 * c["v_m"]) * (u**2 - 1)
    K = mp.matrix(
        [[m * c["omega_1"] ** 2 + K_t, -mu * K_n], [mu * K_t, m * c["omega_2"] ** 2 + K_n]]
    )
    x = mp.lu_solve(K, mp.matrix([c["F"], -c["F"]]) / mp.sqrt(2))
    damping_1 = 2 * c["xi_1"] * c["omega_1"] + slope * K_n * x[1] / m
    damping_2 = 2 * c["xi_2"] * c["omega_2"] - slope * K_t * x[0] / m
    A = mp.zeros(4)
    A[0, 2] = A[1, 3] = 1
    A[2:4, 0:2] = -K / m
    A[2, 2], A[3, 3] = -damping_1, -damping_2
    return max(mp.re(s) for s in mp.eig(A, left=False, right=False))


def exact_rows(b: dict[str, float], D: list[float], G: list[float]) -> np.ndarray:
    """Value and derivatives to D and ln G (n, 3) with 40 digits, rounded to doubles."""
    rows = []
    with mp.workdps(40):
        h = mpf(10) ** -12
        for d, g in zip(tqdm(D, desc="40 digits"), G, strict=True):
            x, y = mpf(d), mp.log(mpf(g))
            by_D = (exact_growth(b, x + h, y) - exact_growth(b, x - h, y)) / (2 * h)
            by_log_G = (exact_growth(b, x, y + h) - exact_growth(b, x, y - h)) / (2 * h)
            rows.append([float(v) for v in (exact_growth(b, x, y), by_D, by_log_G)])
    return np.array(rows)
