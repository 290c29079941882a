"""Mode coupling: the minimal model of Hoffmann, Fischer, Allgaier and Gaul."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj

from .case import Case, CaseResult, Curve, Panel, closed


def _structure() -> fj.Structure:
    """x'' + [[2, 1 - 4 mu/3], [1, 2]] x = 0: two springs, and a joint of stiffness 4/3."""
    joint = fj.Joint(fj.FixedContact(4 / 3, 0.0, 1.0), fj.Coulomb(0.5), 0, 1, preload=True)
    return fj.Structure(np.eye(2), None, [[2.0, 1.0], [1.0, 2.0 - 4 / 3]], joint)


def _published(mu):
    """The eigenvalues (..., 2) of Hoffmann's model in the upper half plane: s^2 = -2 +- root."""
    root = np.sqrt(np.asarray(1 - 4 * np.asarray(mu) / 3, complex))[..., None]
    s: Any = np.sqrt(-2 + root * np.array([1, -1]))
    return np.where(s.imag < 0, -s, s)


def _hoffmann() -> CaseResult:
    model = _structure()
    mu = np.linspace(0.0125, 1.5, 120)
    eigenvalues = jax.jit(jax.vmap(lambda mu: fj.stability(model.replace(mu=mu)).eigenvalues))
    s: Any = np.asarray(eigenvalues(jnp.asarray(mu)))
    published: Any = _published(mu)
    at = [int(np.abs(mu - value).argmin()) for value in (0.5, 1.5)]
    below = np.unique(np.round(np.abs(s[at[0]].imag), 9))
    exact = np.sort(published[at[0]].imag)
    checks = [
        closed("critical friction mu [-]", 3 / 4, fj.critical_friction(model), 1e-9),
        closed("lower frequency at mu = 0.5 [rad/s]", exact[0], below[0], 1e-8),
        closed("higher frequency at mu = 0.5 [rad/s]", exact[1], below[1], 1e-8),
        closed(
            "growth rate at mu = 1.5 [1/s]", published[at[1]].real.max(), s[at[1]].real.max(), 1e-9
        ),
    ]
    upper: Any = np.sort_complex(np.where(s.imag > 0, s, np.nan))[:, :2]
    panels = []
    for name, computed, exact in (
        ("frequency [rad/s]", np.sort(upper.imag), np.sort(published.imag)),
        ("growth rate [1/s]", np.sort(upper.real), np.sort(published.real)),
    ):
        curves = []
        for k, labels in enumerate((("Hoffmann et al., in closed form", "fractaljax"), ("", ""))):
            curves += [
                Curve(mu[3::4], exact[3::4, k], labels[0], False),
                Curve(mu, computed[:, k], labels[1], True),
            ]
        panels.append(Panel("friction coefficient mu [-]", name, curves))
    return CaseResult(checks, panels)


CASES = (
    Case(
        "hoffmann",
        "Minimal model of mode coupling",
        "N. Hoffmann, M. Fischer, R. Allgaier, L. Gaul, Mech. Res. Commun. 29, 197 (2002)",
        "10.1016/S0093-6413(02)00254-9",
        _hoffmann,
    ),
)
