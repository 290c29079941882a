"""The wobbling disc of von Wagner, Hochlenert and Hagedorn: it squeals above a critical speed."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import eigvals
from scipy.optimize import brentq

import fractaljax as fj

from .case import Case, CaseResult, Curve, Panel, numerical

# Their data, in SI units: pads of stiffness k and damping d at the radius r press with N_0 on a
# disc of thickness h, inertias Theta and Phi, mounted on k_t and d_t; mu is the friction.
_H, _R, _K, _D, _N_0, _MU = 0.02, 0.13, 6.0e6, 5.0, 3000.0, 0.6
_THETA, _PHI, _K_T, _D_T = 0.16, 0.32, 1.88e7, 0.1


def _terms():
    """M, K and the parts of C that are constant, over the speed, and times the speed."""
    K = np.array(
        [
            [_K_T + 2 * _K * _R**2 + _N_0 * _H, _MU * _N_0 * _H**2 / (2 * _R)],
            [-2 * _MU * _H * _K * _R, _K_T + _N_0 * _H],
        ]
    )
    pads = np.array([[2 * _D * _R**2 + _D_T, 0.0], [-2 * _MU * _D * _H * _R, _D_T]])
    drag = np.array([[_MU * _N_0 * _H**2 / (2 * _R), 0.0], [0.0, 0.0]])
    gyroscopic = np.array([[0.0, _PHI], [-_PHI, 0.0]])
    return _THETA * np.eye(2), K, pads, drag, gyroscopic


def _eigenvalues(speed) -> Any:
    """The eigenvalues (2,) in the upper half plane at a speed [rad/s], by SciPy, slowest first."""
    _, K, pads, drag, gyroscopic = _terms()
    scale = np.sqrt(_K_T / _THETA)  # rad/s: without it rounding hides the growth rate
    C, zero, one = pads + drag / speed + gyroscopic * speed, np.zeros((2, 2)), np.eye(2)
    s: Any = scale * eigvals(np.block([[zero, one], [-K / _K_T, -C / (_THETA * scale)]]))
    s = s[s.imag > 0]
    return s[np.argsort(s.imag)]


def _wagner() -> CaseResult:
    M, K, pads, drag, gyroscopic = _terms()
    damping = [(None, pads), ("1/Omega", drag), ("Omega", gyroscopic)]
    model = fj.ParametricStructure(M, damping, K, parameters={"Omega": 10.0})
    eigenvalues = jax.jit(lambda Omega: fj.stability(model.replace(Omega=Omega)).eigenvalues)

    def upper(Omega) -> Any:
        s: Any = np.asarray(eigenvalues(Omega))
        s = s[s.imag > 0]
        return s[np.argsort(s.imag)]

    span, exact = (5.0, 40.0), {"xtol": 1e-13, "rtol": 1e-14}
    theirs = brentq(lambda Omega: _eigenvalues(Omega).real.max(), *span, **exact)
    ours = brentq(lambda Omega: upper(Omega).real.max(), *span, **exact)
    growth = jax.jit(jax.grad(lambda Omega: fj.growth_rate(model.replace(Omega=Omega))))
    step = 1e-3
    slope = np.diff([_eigenvalues(5.0 + d).real.max() for d in (-step, step)])[0] / (2 * step)
    at_5 = _eigenvalues(5.0), upper(5.0)
    checks = [
        numerical("critical speed [rad/s]", theirs, ours, 1e-9),
        numerical("growth rate at 5 rad/s [1/s]", at_5[0].real.max(), at_5[1].real.max(), 1e-8),
        numerical("lower frequency at 5 rad/s [rad/s]", at_5[0][0].imag, at_5[1][0].imag, 1e-11),
        numerical("d(growth rate)/d(speed) at 5 rad/s [-]", slope, growth(jnp.asarray(5.0)), 1e-5),
    ]
    speeds = np.linspace(1.0, 40.0, 40)
    scipy, computed = (np.array([f(x) for x in speeds]) for f in (_eigenvalues, upper))
    panels = []
    for label, theirs_over, ours_over in (
        ("growth rate [1/s]", scipy.real, computed.real),
        ("frequency [Hz]", scipy.imag / (2 * np.pi), computed.imag / (2 * np.pi)),
    ):
        curves = []
        for k, names in enumerate((("the article's matrices, by SciPy", "fractaljax"), ("", ""))):
            curves.append(Curve(speeds[k::3], theirs_over[k::3, k], names[0], False))
            curves.append(Curve(speeds, ours_over[:, k], names[1], True))
        if label.startswith("growth"):
            curves.append(Curve(speeds[[0, -1]], [0, 0], "onset", False, True))
        panels.append(Panel("speed of the disc Omega [rad/s]", label, curves))
    return CaseResult(checks, panels)


CASES = (
    Case(
        "wagner",
        "Wobbling disc",
        "U. von Wagner, D. Hochlenert, P. Hagedorn, J. Sound Vib. 302, 527 (2007)",
        "10.1016/j.jsv.2006.11.023",
        _wagner,
    ),
)
