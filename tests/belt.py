"""The phase plane of the belt of Papangelo, Ciavarella and Hoffmann (2017), by SciPy."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar


def slip(v, start, time, mu_s=1.0, mu_d=0.5, v_0=0.5, c=0.1, k=1.0, P=1.0, **options):
    """x'' + c x' + k x = P (mu_d + (mu_s - mu_d) exp(-(v - x')/v_0)) from a start, by SciPy."""

    def rate(_, y):
        mu = mu_d + (mu_s - mu_d) * np.exp(-(v - y[1]) / v_0)
        return [y[1], P * mu - c * y[1] - k * y[0]]

    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14, "dense_output": True} | options
    return solve_ivp(rate, (0, time), start, **options)


def least_speed(v, mu_s=1.0, mu_d=0.5, v_0=0.5, c=0.1, k=1.0, P=1.0):
    """Of the slip that begins where stick ends, the least sliding speed one turn later."""
    motion = slip(v, [(P * mu_s - c * v) / k, v], 12, mu_s, mu_d, v_0, c, k, P).sol
    times = np.linspace(3, 9, 601)
    i = int(np.argmin(v - motion(times)[1]))
    ends: Any = {"bounds": times[[i - 1, i + 1]], "options": {"xatol": 1e-12}}
    least: Any = minimize_scalar(lambda t: v - motion(t)[1], method="bounded", **ends)
    return least.fun
