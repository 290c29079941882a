"""The joint under a given load with 60 digits, by the closed forms of Eqs. 19 to 36.

The load balance is solved by Newton's method to all of them: its left side has a slope that rises
or falls throughout, so that it converges from any start.
"""

from typing import Any

import mpmath
from mpmath import mpf

mp: Any = mpmath.mp  # it makes its functions at run time
DIGITS = 60


def exact_joint(D, G, gamma, E, nu, sigma_y, H, P, mu_s, mu_m) -> dict[str, Any]:
    """What `contact_state` gives, as numbers of mpmath; areas as logarithms."""
    with mp.workdps(DIGITS):
        k_mu = friction_correction(mu_m)
        D, G, gamma, E, nu, sigma_y, H, P, mu_s = map(
            mpf, (D, G, gamma, E, nu, sigma_y, H, P, mu_s)
        )
        log_a_e = log_critical_area(D, G, gamma, sigma_y / E, k_mu)
        share = mpf("1.1") * k_mu * sigma_y / H * (3 - D) / 2
        s = mp.log(P * (3 - D) / (H * (D - 1))) - log_a_e
        t = area_ratio(s, D, share) if s > 0 else s
        moment = {p: area_moment(p, D, log_a_e, t) for p in (mpf(1) / 2, mpf(1))}
        ratio = share * power((5 - 2 * D) / 2, t) if t > 0 else mpf(0)
        elastic_load = P * ratio / (1 + ratio)
        Q_e = sigma_y * moment[1] + (2 * nu - 1) * elastic_load
        Q_e *= 8 / (mp.pi * (6 - 3 * nu))
        slip = Q_e / (mu_s * P)
        K_t = 4 * E / ((1 + nu) * (2 - nu) * mp.sqrt(mp.pi)) * moment[mpf(1) / 2]
        return {
            "log_a_l": log_a_e + t,
            "log_a_e": log_a_e,
            "log_area_ratio": t,
            "K_n": 4 * E * (4 - D) / (3 * mp.sqrt(mp.pi) * (3 - D)) * moment[mpf(1) / 2],
            "K_t": K_t * mp.cbrt(max(1 - slip, mpf(0))),
            "Q_e": Q_e,
            "slip_ratio": slip,
            "plastic_share": 1 / (1 + ratio),
            "A_r": (D - 1) / (3 - D) * mp.exp(log_a_e + t),
        }


def friction_correction(mu_m):
    """Eq. 19, with its step at the double 0.3."""
    if mu_m <= 0.3:
        return 1 - mpf("0.228") * mpf(mu_m)
    return mpf("0.932") * mp.exp(mpf("-1.58") * (mpf(mu_m) - mpf("0.3")))


def log_critical_area(D, G, gamma, phi, k_mu):
    """ln a_e, where delta(a) (Eq. 16) and R = a/(pi delta) meet at yield (Eq. 20)."""
    # delta = size pi^(-3/2) a^((3-D)/2)
    log_size = (11 - 3 * D) / 2 * mp.log(2) + (D - 2) * mp.log(G)
    log_size += mp.log(mp.log(gamma)) / 2 + D / 2 * mp.log(mp.pi)
    log_pressure = mp.log(mpf("3.3") * mp.pi * k_mu * phi / 4)
    return (mp.log(mp.pi) + 2 * (log_size - mpf("1.5") * mp.log(mp.pi) - log_pressure)) / (D - 2)


def power(r, t):
    """(e^(rt) - 1)/r."""
    return mp.expm1(r * t) / r if r else t


def log_load(t, D, share):
    """ln P beside that of an all-plastic joint with a_l = a_e."""
    return (D - 1) / 2 * t + mp.log1p(share * power((5 - 2 * D) / 2, t))


def area_ratio(s, D, share):
    """t > 0 with log_load = s > 0."""
    r, t = (5 - 2 * D) / 2, 2 * s / (D - 1)
    for _ in range(200):
        grown = share * mp.exp(r * t)
        slope = (D - 1) / 2 + grown / (1 + share * power(r, t))
        step = (log_load(t, D, share) - s) / slope
        t -= step
        if abs(step) <= mpf(10) ** (8 - DIGITS) * s:
            return t
    raise ArithmeticError("Newton's method did not converge")


def area_moment(p, D, log_a_e, t):
    """Integral of a^p n(a) over the elastic contacts."""
    if t <= 0:
        return mpf(0)
    r = p + (1 - D) / 2
    return (D - 1) / 2 * mp.exp(p * log_a_e + (D - 1) / 2 * t) * power(r, t)
