"""Rough contacts: exponents, ratios and areas from theory and boundary elements."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import erf

import fractaljax as fj
from fractaljax._contact.compare import BOUNDARY_ELEMENTS

from .case import CLOSED, STATED, Case, CaseResult, Check, Curve, Panel, closed

_MATERIAL = fj.brake_scene().contact.material


@dataclasses.dataclass(frozen=True)
class _Patch:
    """The square patch of rough surfaces that all cases press, with n x n points."""

    L: float = 1e-2  # longest wavelength and side [m]
    n: int = 128
    Sq: float = 1e-6  # root mean square height, whatever D [m]

    @property
    def L_s(self) -> float:
        return 4 * self.L / self.n

    @property
    def load_scale(self) -> float:
        """The load E Sq L [N] by which finite-size laws count."""
        return float(_MATERIAL.E) * self.Sq * self.L

    @property
    def loads(self) -> np.ndarray:
        """The loads [N] of the boundary elements."""
        return self.load_scale * np.geomspace(1e-3, 1.0, 7)

    def surface(self, D: float) -> fj.Surface:
        unscaled = fj.roughness(fj.Surface(D, self.L), self.L, self.L_s)
        return fj.Surface(D, self.L * (self.Sq / float(unscaled.Sq)) ** (1 / (D - 2)))

    def law(self, surface, P, material=_MATERIAL) -> fj.PerssonContact:
        return fj.PerssonContact(surface, material, P, self.L**2, self.L, self.L_s)


_PATCH = _Patch()


@functools.cache
def _press(D: float) -> fj.LawComparison:
    """Boundary elements on twelve surfaces beside the laws; two cases share them."""
    options = {"area": _PATCH.L**2, "L_s": _PATCH.L_s, "n": _PATCH.n, "progress": False}
    return fj.compare_laws(_PATCH.surface(D), _MATERIAL, _PATCH.loads, seeds=12, **options)


@jax.jit
def _exponents(surface, loads):
    """d ln K_n/d ln P of Persson's law at loads (n,)."""

    def log_stiffness(log_P):
        return jnp.log(_PATCH.law(surface, jnp.exp(log_P)).stiffness(0.4, 0.25)[0])

    return jax.vmap(jax.grad(log_stiffness))(jnp.log(loads))


def _pohrt() -> CaseResult:
    fitted = 5  # loads, two decades: beyond them K_n rises to full contact
    x, dimensions = np.log(_PATCH.loads[:fitted]), (2.1, 2.3, 2.5, 2.7, 2.9)
    exponents, checks = [], []
    for D in dimensions:
        K_n = np.asarray(_press(D).curves[BOUNDARY_ELEMENTS].K_n)
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
        Curve(dimensions, exponents, "fractaljax, boundary elements", True),
    ]
    panel = Panel("fractal dimension D [-]", "exponent alpha [-]", curves, {"ylim": (0.4, 0.9)})
    return CaseResult(checks, [panel])


def _pastewka() -> CaseResult:
    checks, loads = [], np.geomspace(1e-10, 1.0, 41)
    curves = []
    for D in (2.1, 2.5, 2.9):
        alpha = np.asarray(_exponents(_PATCH.surface(D), jnp.asarray(_PATCH.load_scale * loads)))
        limit = 1 / (1 + 3 - D)
        checks.append(
            closed(f"exponent at small loads, H = {3 - D:.1f} [-]", limit, alpha[0], 1e-3)
        )
        curves.append(Curve(loads[:25:3], np.full(9, limit), f"1/(1 + H), H = {3 - D:.1f}", False))
        curves.append(Curve(loads, alpha, f"fractaljax, D = {D}", True))
    built_in = "the law joins this limit to Persson's theory, which leads at larger loads"
    checks[0] = checks[0]._replace(note=built_in)
    axes = "normal load P/(E Sq L) [-]", "d ln K_n/d ln P [-]"
    return CaseResult(checks, [Panel(*axes, curves, {"xscale": "log", "ylim": (0, 1.6)})])


def _campana() -> CaseResult:
    nu, surface = np.linspace(0.0, 0.5, 21), _PATCH.surface(2.4)

    def ratio(nu):
        material = fj.Material(_MATERIAL.E, nu, _MATERIAL.sigma_y, _MATERIAL.H)
        K_n, K_t = _PATCH.law(surface, _PATCH.load_scale, material).stiffness(0.4, 0.25)
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
    return CaseResult(checks, [Panel("Poisson's ratio nu [-]", "K_t/K_n [-]", curves)])


def _persson() -> CaseResult:
    D = 2.3
    compared, area = _press(D), _PATCH.L**2
    Sdq = float(fj.roughness(_PATCH.surface(D), _PATCH.L, _PATCH.L_s).Sdq)
    strain = _PATCH.loads / area / (float(_MATERIAL.E) * Sdq)  # p/(E Sdq)
    published = erf(np.sqrt(2) * strain)
    law = np.asarray(compared.curves["Persson"].real_area) / area
    counted = np.asarray(compared.curves[BOUNDARY_ELEMENTS].real_area) / area
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
    return CaseResult(checks, [Panel(*axes, curves, {"xscale": "log", "yscale": "log"})])


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
