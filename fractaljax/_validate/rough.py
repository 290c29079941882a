"""Rough contacts: exponents, ratios and areas from theory and boundary elements."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import erf

import fractaljax as fj
from fractaljax._contact.compare import BOUNDARY_ELEMENTS

from .case import CLOSED, STATED, Case, Check, Curve, Found, Panel, closed

_E, _L, _N = 1.154e11, 1e-2, 128
_MATERIAL = fj.Material(_E, nu=0.3, sigma_y=3.55e8, H=9.94e8)
_L_S = 4 * _L / _N
_SQ = 1e-6  # m
_UNIT = _E * _SQ * _L  # N, the load scale of finite-size laws
_LOADS = np.geomspace(1e-3, 1.0, 7)  # in _UNIT
_DIMENSIONS = (2.1, 2.3, 2.5, 2.7, 2.9)
_SEEDS = 12


def _surface(D: float) -> fj.Surface:
    """Surface with the root mean square height Sq."""
    unit = fj.Surface(D, _L)
    return fj.Surface(D, _L * (_SQ / float(fj.roughness(unit, _L, _L_S).Sq)) ** (1 / (D - 2)))


def _law(surface, P, nu=0.3, area=_L**2, L_s=_L_S) -> fj.PerssonContact:
    """Persson's law on a surface; L = 10 mm."""
    return fj.PerssonContact(surface, fj.Material(_E, nu, 3.55e8, 9.94e8), P, area, _L, L_s)


@functools.cache
def _pressed(D: float) -> fj.LawComparison:
    """Boundary elements compared with the laws."""
    options = {"area": _L**2, "L_s": _L_S, "n": _N, "seeds": _SEEDS, "progress": False}
    return fj.compare_laws(_surface(D), _MATERIAL, _UNIT * _LOADS, **options)


@jax.jit
def _exponents(surface, loads):
    """d ln K_n/d ln P of Persson's law at loads (n,)."""

    def log_stiffness(log_P):
        return jnp.log(_law(surface, jnp.exp(log_P)).stiffness(0.4, 0.25)[0])

    return jax.vmap(jax.grad(log_stiffness))(jnp.log(loads))


def _pohrt() -> Found:
    fitted = 5  # loads, two decades: beyond them K_n rises to full contact
    x = np.log(_LOADS[:fitted])
    exponents, checks = [], []
    for D in _DIMENSIONS:
        K_n = np.asarray(_pressed(D).curves[BOUNDARY_ELEMENTS].K_n)
        exponents.append(np.polyfit(x, np.log(K_n[:fitted]), 1)[0])
        checks.append(
            Check(
                f"exponent of K_n ~ P^alpha, D = {D} [-]", (0.51, 0.77), exponents[-1], 0.0, STATED
            )
        )
    range_ = "fitted over P/(E Sq L) from 1e-3 to 1e-1; beyond, K_n rises towards full contact"
    checks[0] = checks[0]._replace(note=range_)
    ends = np.array([2.0, 3.0])
    curves = [
        Curve(ends, [0.51, 0.77], "Pohrt and Popov, 0.51 to 0.77 for D = 2 to 3", False, True),
        Curve(_DIMENSIONS, exponents, "fractaljax, boundary elements", True),
    ]
    panel = Panel("fractal dimension D [-]", "exponent alpha [-]", curves, {"ylim": (0.4, 0.9)})
    return Found(checks, [panel])


def _pastewka() -> Found:
    checks, loads = [], np.geomspace(1e-10, 1.0, 41)
    curves = []
    for D in (2.1, 2.5, 2.9):
        alpha = np.asarray(_exponents(_surface(D), jnp.asarray(_UNIT * loads)))
        limit = 1 / (1 + 3 - D)
        checks.append(
            closed(f"exponent at small loads, H = {3 - D:.1f} [-]", limit, alpha[0], 1e-3)
        )
        curves.append(Curve(loads[:25:3], np.full(9, limit), f"1/(1 + H), H = {3 - D:.1f}", False))
        curves.append(Curve(loads, alpha, f"fractaljax, D = {D}", True))
    built_in = "the law joins this limit to Persson's theory, which leads at larger loads"
    checks[0] = checks[0]._replace(note=built_in)
    axes = "normal load P/(E Sq L) [-]", "d ln K_n/d ln P [-]"
    return Found(checks, [Panel(*axes, curves, {"xscale": "log", "ylim": (0, 1.6)})])


def _campana() -> Found:
    nu, surface = np.linspace(0.0, 0.5, 21), _surface(2.4)

    def ratio(nu):
        K_n, K_t = _law(surface, _UNIT, nu).stiffness(0.4, 0.25)
        return K_t / K_n

    published, ours = (2 - 2 * nu) / (2 - nu), np.asarray(jax.jit(jax.vmap(ratio))(jnp.asarray(nu)))
    checks = [
        closed(f"K_t/K_n at nu = {nu[i]:g} [-]", published[i], ours[i], 1e-12) for i in (0, 12, 20)
    ]
    checks[0] = checks[0]._replace(note="the law takes the published ratio as it is")
    curves = [
        Curve(nu[::2], published[::2], "(2 - 2 nu)/(2 - nu)", False),
        Curve(nu, ours, "fractaljax, Persson's law", True),
    ]
    return Found(checks, [Panel("Poisson's ratio nu [-]", "K_t/K_n [-]", curves)])


def _persson() -> Found:
    D = 2.3
    compared = _pressed(D)
    Sdq = float(fj.roughness(_surface(D), _L, _L_S).Sdq)
    strain = _UNIT * _LOADS / _L**2 / (_E * Sdq)  # p/(E Sdq)
    published = erf(np.sqrt(2) * strain)
    law = np.asarray(compared.curves["Persson"].real_area) / _L**2
    counted = np.asarray(compared.curves[BOUNDARY_ELEMENTS].real_area) / _L**2
    # The law takes Eq. 13's waves as a continuous spectrum, `roughness` as the sum that they are.
    checks = [
        closed("A_r/A at p = 0.045 E Sdq [-]", published[-1], law[-1], 5e-3),
        Check(
            "A_r E Sdq/P by boundary elements [-]",
            (np.sqrt(8 / np.pi), np.sqrt(2 * np.pi)),
            counted[-1] / strain[-1],
            0.0,
            CLOSED,
            "between Persson's theory and that of Bush, Gibson and Thomas, Wear 35, 87 (1975). At "
            "smaller loads contacts are a few grid points, and counted too large",
        ),
    ]
    curves = [
        Curve(strain, published, "Persson, erf(sqrt(2) p/(E Sdq))", False),
        Curve(strain, np.sqrt(2 * np.pi) * strain, "Bush, Gibson and Thomas", False, True),
        Curve(strain, law, "fractaljax, Persson's law", True),
        Curve(strain, counted, "fractaljax, boundary elements", True),
    ]
    axes = "mean pressure p/(E Sdq) [-]", "real over nominal area A_r/A [-]"
    return Found(checks, [Panel(*axes, curves, {"xscale": "log", "yscale": "log"})])


CASES = (
    Case(
        "pohrt",
        "Stiffness over load of fractal surfaces",
        "R. Pohrt, V. L. Popov, Phys. Rev. Lett. 108, 104301 (2012)",
        "10.1103/PhysRevLett.108.104301",
        _pohrt,
    ),
    Case(
        "pastewka",
        "Stiffness of finite surfaces at small loads",
        "L. Pastewka, N. Prodanov, B. Lorenz, M. H. Mueser, M. O. Robbins, B. N. J. Persson, Phys. "
        "Rev. E 87, 062809 (2013)",
        "10.1103/PhysRevE.87.062809",
        _pastewka,
    ),
    Case(
        "campana",
        "Tangential over normal stiffness",
        "C. Campana, B. N. J. Persson, M. H. Mueser, J. Phys. Condens. Matter 23, 085001 (2011)",
        "10.1088/0953-8984/23/8/085001",
        _campana,
    ),
    Case(
        "persson",
        "Real area of contact",
        "B. N. J. Persson, J. Chem. Phys. 115, 3840 (2001)",
        "10.1063/1.1388626",
        _persson,
    ),
)
