"""Smooth contacts in closed form, by boundary elements: Hertz's ball and Westergaard's wave."""

import numpy as np

import fractaljax as fj

from .case import Case, CaseResult, Curve, Panel, closed

_MATERIAL = fj.brake_scene().contact.material
_E = float(_MATERIAL.E)


def _hertz() -> CaseResult:
    # The images of a periodic cell are a square lattice of equal charges in a uniform background:
    # its energy (Bonsall and Maradudin, Phys. Rev. B 15, 1959, 1977) and its sum of 1/r^3.
    lattice_energy, lattice_cubed = 3.900264920, 9.0336217
    n, L, R, a = 256, 1e-3, 0.1, 1.2e-4
    P = 4 * _E * a**3 / (3 * R)
    x = (np.arange(n) + 0.5) / n * L - L / 2
    # The images flatten the ball, so it is made rounder to compensate.
    curvature = 1 / R - P * lattice_cubed / (2 * np.pi * _E * L**3)
    heights = -np.add.outer(x**2, x**2) / 2 * curvature
    contact = fj.boundary_element(heights, L / n, _MATERIAL, P)
    peak = 3 * P / (2 * np.pi * a**2)
    images = lattice_energy / (np.pi * _E * L)  # of the compliance
    ring = 2 * L / n / a  # the outline moves by whole points, one at either end of a diameter
    checks = [
        closed("area of contact, pi a^2 [m^2]", np.pi * a**2, contact.area, ring),
        closed("largest pressure, 3 P/(2 pi a^2) [Pa]", peak, contact.pressure.max(), 2e-3),
        closed("stiffness K_n = 2 E a [N/m]", 2 * _E * a, 1 / (1 / contact.K_n + images), ring),
        closed(
            "approach a^2/R [m]", a**2 / R, images * P - heights.mean() - contact.mean_gap, 2e-3
        ),
    ]
    r = np.linspace(-1, 1, 49)
    row = np.asarray(contact.pressure)[n // 2]
    near = np.abs(x) < 1.5 * a
    curves = [
        Curve(r * a * 1e6, peak / 1e6 * np.sqrt(1 - r**2), "Hertz", False),
        Curve(x[near] * 1e6, row[near] / 1e6, "fractaljax", True),
    ]
    return CaseResult(checks, [Panel("distance from the centre [um]", "pressure [MPa]", curves)])


def _westergaard() -> CaseResult:
    n, dx = 512, 1e-5
    L, height = n * dx, 1e-3 * n * dx
    closes = np.pi * _E * height / L  # Pa: the mean pressure that closes all gaps
    heights = height * np.cos(2 * np.pi * (np.arange(n) + 0.5) / n)[:, None] * np.ones(2)
    A = heights.size * dx**2
    shares = np.linspace(0.02, 0.98, 25)
    contacts = [fj.boundary_element(heights, dx, _MATERIAL, share * closes * A) for share in shares]
    area = np.array([float(one.area) for one in contacts]) / A
    K_n = np.array([float(one.K_n) for one in contacts])
    gap = np.array([float(one.mean_gap) for one in contacts])

    def touching(p):
        return 2 / np.pi * np.arcsin(np.sqrt(p))

    def stiffness(p):
        return np.pi * _E * A / (L * np.log(1 / p))

    half = int(np.abs(shares - 0.5).argmin())
    checks = [
        closed("share of contact at p*/2 [-]", touching(0.5), area[half], 2 / n / touching(0.5)),
        closed(
            "largest pressure at p*/2 [Pa]",
            2 * closes * np.sqrt(0.5),
            contacts[half].pressure.max(),
            3e-3,
        ),
        closed("stiffness K_n at p*/2 [N/m]", stiffness(0.5), K_n[half], 0.02),
        closed("mean gap at p*/2 [m]", height * (0.5 + 0.5 * np.log(0.5)), gap[half], 2e-3),
    ]
    p = np.linspace(0.01, 0.98, 40)
    axis = "mean pressure over that of full contact p/p* [-]"
    panels = [
        Panel(
            axis,
            "share of contact A_r/A [-]",
            [Curve(p, touching(p), "Westergaard", False), Curve(shares, area, "fractaljax", True)],
        ),
        Panel(
            axis,
            "stiffness K_n lambda/(E A) [-]",
            [
                Curve(p, stiffness(p) * L / (_E * A), "Westergaard", False),
                Curve(shares, K_n * L / (_E * A), "fractaljax", True),
            ],
            {"yscale": "log"},
        ),
    ]
    return CaseResult(checks, panels)


CASES = (
    Case(
        "hertz",
        "A ball on a half-space",
        "H. Hertz, J. reine angew. Math. 92, 156 (1882); K. L. Johnson, Contact Mechanics (1985)",
        "10.1515/crll.1882.92.156",
        _hertz,
    ),
    Case(
        "westergaard",
        "A wavy half-space on a flat one",
        "H. M. Westergaard, J. Appl. Mech. 6, A49 (1939); K. L. Johnson, Contact Mechanics (1985)",
        "10.1017/CBO9781139171731",
        _westergaard,
    ),
)
