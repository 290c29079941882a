"""What SciPy's user writes for the answers of the command: `python -m benchmarks.scipy_user cycle`.

With NumPy and SciPy alone, each answer in a process of its own, printed as JSON. The brake is that
of `fractaljax scene`. The cycle is that of the smoothed law, sgn v as tanh(v/eps), from a long
transient; the design is SLSQP's from the given surface, with differences.
"""

import json
import math
import sys
from typing import Any

D, G, GAMMA = 2.4, 1.342e-10, 1.5
E, NU, SIGMA_Y, H, P = 1.154e11, 0.3, 3.55e8, 9.94e8, 1907.3
MU_S, MU_M, V_M = 0.4, 0.25, 0.5
OMEGA_1, OMEGA_2, XI_1, XI_2, F, V = 6283.185307179586, 5026.548245743669, 0.001, 0.007, 5.0, 0.15
EPS = 1e-3 * V  # of the smoothed law [m/s]
END = 0.4  # of the transient [s]


def joint(D: float, G: float) -> tuple[float, float, float, float]:
    """K_n, K_t, ln(a_l/a_e) and Q_e/(mu_s P) by Eqs. 19 to 36."""
    from scipy.optimize import brentq

    k_mu, phi = 1 - 0.228 * MU_M, SIGMA_Y / E
    log_a_e = 2 * math.log(33 * k_mu * phi / 40) + (3 * D - 11) * math.log(2)
    log_a_e += (4 - D) * math.log(math.pi) - math.log(math.log(GAMMA))
    log_a_e = log_a_e / (2 - D) + 2 * math.log(G)
    share, r = 1.1 * k_mu * SIGMA_Y / H * (3 - D) / 2, (5 - 2 * D) / 2
    s = math.log(P / H * (3 - D) / (D - 1)) - log_a_e
    if s <= 0:
        return 0.0, 0.0, s, 0.0

    def ratio(t):
        return share * (math.expm1(r * t) / r if r else t)

    t: Any = brentq(
        lambda t: (D - 1) / 2 * t + math.log1p(ratio(t)) - s, 0, 2 * s / (D - 1), xtol=1e-14
    )

    def moment(p):
        q = p + (1 - D) / 2
        spread = -math.expm1(-q * t) / q if q else t
        return (D - 1) / 2 * math.exp(p * (log_a_e + t)) * spread

    elastic = P * ratio(t) / (1 + ratio(t))
    slip = (
        8 / (math.pi * (6 - 3 * NU)) * (SIGMA_Y * moment(1) + (2 * NU - 1) * elastic) / (MU_S * P)
    )
    K_n = 4 * E * (4 - D) / (3 * math.sqrt(math.pi) * (3 - D)) * moment(0.5)
    K_t = 4 * E / ((1 + NU) * (2 - NU) * math.sqrt(math.pi)) * moment(0.5)
    return K_n, K_t * max(1 - slip, 0) ** (1 / 3), t, slip


def growth_rate(D: float, G: float) -> float:
    """The largest real part of the eigenvalues [1/s] about steady sliding (Eqs. 39 to 43)."""
    import numpy as np

    K_n, K_t, *_ = joint(D, G)
    u, drop = V / V_M, MU_S - MU_M
    mu, slope = MU_S - 1.5 * drop * u + 0.5 * drop * u**3, 1.5 * drop * (u**2 - 1) / V_M
    K = np.array([[OMEGA_1**2 + K_t, -mu * K_n], [mu * K_t, OMEGA_2**2 + K_n]])
    x = np.linalg.solve(K, np.array([F, -F]) / math.sqrt(2))
    c_1, c_2 = 2 * XI_1 * OMEGA_1 + slope * K_n * x[1], 2 * XI_2 * OMEGA_2 - slope * K_t * x[0]
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-K, -np.diag([c_1, c_2])]])
    return float(np.real(np.linalg.eigvals(A)).max())


def stability() -> dict[str, float]:
    return {"growth_rate": growth_rate(D, G)}


def cycle() -> dict[str, float]:
    """Frequency [Hz] and peak to peak of x1 [m], of the last period of a transient."""
    import numpy as np
    from scipy.integrate import solve_ivp

    K_n, K_t, *_ = joint(D, G)
    f, drop = F / math.sqrt(2), MU_S - MU_M
    a, b = 1.5 * drop / V_M, 0.5 * drop / V_M**3

    def mu(w):
        return MU_S * math.tanh(w / EPS) - a * w + b * w**3

    def rates(_, y):
        x_1, x_2, u_1, u_2 = y
        a_1 = f - 2 * XI_1 * OMEGA_1 * u_1 - (OMEGA_1**2 + K_t) * x_1 + mu(V - u_1) * K_n * x_2
        a_2 = -f - 2 * XI_2 * OMEGA_2 * u_2 - (OMEGA_2**2 + K_n) * x_2 - mu(V - u_2) * K_t * x_1
        return [u_1, u_2, a_1, a_2]

    def maximum(_, y):
        return y[2]

    start = [1e-5, 0.0, 0.0, 0.0]
    found = solve_ivp(rates, (0, END), start, "LSODA", rtol=1e-8, atol=1e-12, events=maximum)
    t, x = found.t_events[0], np.array([y[0] for y in found.y_events[0]])
    return {"frequency": float(1 / (t[-1] - t[-3])), "amplitude": float(abs(x[-1] - x[-2]))}


def design() -> dict[str, float]:
    """The nearest stable D and G, in a box of both, that is as stiff and inside the model."""
    import numpy as np
    from scipy.optimize import minimize

    low, high = np.array([2.1, math.log(1e-12)]), np.array([2.9, math.log(1e-8)])
    least = min(XI_1 * OMEGA_1, XI_2 * OMEGA_2)
    K_n, *_ = joint(D, G)

    def surface(u):
        d, log_g = low + u * (high - low)
        return d, math.exp(log_g)

    def inside(u):
        stiff, _, t, slip = joint(*surface(u))
        rate = growth_rate(*surface(u))
        return [-np.arcsinh((rate + least / 2) / least), stiff / K_n - 1, t, 10 * (1 - slip)]

    start = (np.array([D, math.log(G)]) - low) / (high - low)
    found = minimize(
        lambda u: np.sum((u - start) ** 2),
        start,
        method="SLSQP",
        bounds=[(0, 1), (0, 1)],
        constraints={"type": "ineq", "fun": inside},
        options={"ftol": 1e-12},
    )
    return dict(zip(("D", "G"), surface(found.x), strict=True))


if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]]()))
