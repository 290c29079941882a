"""How five surfaces of the brake take kicks, `python docs/make_kicks.py` writes kicks.md."""

from pathlib import Path

import numpy as np
from writing import run, table

import fractaljax as fj
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.starts import ellipsoid

PAGE = Path(__file__).with_name("kicks.md")
SURFACES = (2.55, 1e-9), (2.45, 1.2e-10), (2.70, 5e-9), (2.43, 1.23e-10), (2.60, 1e-8)
RADII = 1.0, 2.0, 3.0, 5.0
STARTS = 1024  # a sphere

INTRODUCTION = f"""# Kicks that stable surfaces survive

Five surfaces of the reference brake whose sliding is stable, by growth rate. From {STARTS} starts
on a sphere about the equilibrium, of radius r in units of V/omega and V, the motion comes to rest,
squeals (cycles by their amplitude in x1), or diverges: far beyond v_m the cubic friction law grows
without bound. The least growth rate is no guide: kicks that the last surface survives make the
first one squeal. A share p has a standard error of sqrt(p (1 - p)/{STARTS}), at most
{0.5 / np.sqrt(STARTS):.3f}.
"""


def outcomes(scene: fj.Scene, radius: float, count: int) -> tuple[dict[str, float], list[float]]:
    """Shares of kicks on a sphere by outcome, and the amplitudes [um] of the cycles."""
    ways = np.random.default_rng(0).standard_normal((count, 4))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    centre, axes = ellipsoid(hybrid_system(scene), radius)
    found = fj.basin(scene, starts=centre + ways * axes, progress=False)
    return dict(found.shares), [float(cycle.amplitude[0]) * 1e6 for cycle in found.cycles]


def cell(scene: fj.Scene, radius: float, count: int) -> str:
    """The shares of one sphere in words; nothing of outcomes that there are not."""
    shares, amplitudes = outcomes(scene, radius, count)
    parts = [f"rest {shares['equilibrium']:.3f}"]
    cycles = (shares[f"cycle {i}"] for i in range(1, 1 + len(amplitudes)))
    parts += [
        f"{um:.3g} um {share:.3f}" for um, share in sorted(zip(amplitudes, cycles, strict=True))
    ]
    parts += [f"{k} {shares[k]:.3f}" for k in ("diverges", "undecided") if shares[k]]
    return ", ".join(parts)


def row(D: float, G: float, radii=RADII, count: int = STARTS) -> list[str]:
    """The row of one surface."""
    scene = fj.brake_scene().replace(D=D, G=G)
    K_n, K_t = fj.stiffness(scene)
    first = [f"{D:g}, {G:g}", f"{float(K_t / K_n):.3f}", f"{float(fj.growth_rate(scene)):.2f}"]
    return first + [cell(scene, radius, count) for radius in radii]


def page() -> str:
    """The text of kicks.md."""
    head = ["D, G [m]", "K_t/K_n", "growth [1/s]", *(f"r = {radius:g}" for radius in RADII)]
    lines = [INTRODUCTION, *table(head, [row(D, G) for D, G in SURFACES])]
    return "\n".join([*lines, "", "Written by `python docs/make_kicks.py`.", ""])


if __name__ == "__main__":
    run({PAGE: lambda: page().encode()})
