"""Scenes and designs as tables that people read."""

import jax.numpy as jnp

from .contact import Regime
from .scene import Scene, stiffness
from .stability import stability

_ABSENT = "-"


def scene_rows(scene: Scene, friction_slope: bool = True) -> dict[str, str]:
    """What a scene's joint and its critical mode are like: row titles with units, and values."""
    K_n, K_t = (float(K) for K in stiffness(scene))
    modes = stability(scene, friction_slope)
    rows = {}
    if scene.contact.fractal:
        surface = scene.contact.surface
        rows |= {"D": f"{surface.D:.6g}", "G [m]": f"{surface.G:.6g}"}
    rows |= {
        "K_n [N/m]": f"{K_n:.6g}",
        "K_t [N/m]": f"{K_t:.6g}",
        "K_t/K_n": f"{K_t / K_n:.6g}" if K_n > 0 else _ABSENT,
    }
    if scene.contact.fractal:
        state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
        slip = state.slip_ratio
        rows |= {
            "regime": Regime[state.regime].split(":")[0],
            "a_l/a_e": f"{jnp.exp(state.log_area_ratio):.6g}",
            "Q_e/(mu_s P)": "not evaluated" if slip is None else f"{slip:.6g}",
        }
    return rows | {
        "growth rate [1/s]": f"{modes.growth_rate:+.6g}",
        "frequency [Hz]": f"{modes.frequency:.6g}",
        "damping ratio": f"{modes.damping_ratio:+.6g}",
    }


def stability_table(scene: Scene, friction_slope: bool = True) -> str:
    """The rows of one scene, its verdict, and every eigenvalue."""
    modes = stability(scene, friction_slope)
    verdict = "it squeals" if modes.growth_rate > 0 else "stable"
    rows = scene_rows(scene, friction_slope)
    rows["growth rate [1/s]"] += f"  ({verdict})"
    rows |= {
        f"eigenvalue {i} [1/s]": f"{s.real:+.6g} {s.imag:+.6g}i"
        for i, s in enumerate(modes.eigenvalues.tolist(), start=1)
    }
    return table([""], [rows])


def comparison_table(before: Scene, after: Scene, friction_slope: bool, active) -> str:
    """Two scenes side by side, and the requirements the second one meets with nothing to spare."""
    columns = [scene_rows(scene, friction_slope) for scene in (before, after)]
    names = list(active) or [_ABSENT]
    for i, name in enumerate(names):
        columns[0]["active constraints" if i == 0 else " " * i] = _ABSENT if i == 0 else ""
        columns[1]["active constraints" if i == 0 else " " * i] = name
    return table(["before", "after"], columns)


def table(titles: list[str], columns: list[dict[str, str]]) -> str:
    """Columns of the same rows as aligned text, row titles at the left."""
    lines = [["", *titles], *([name, *(c[name] for c in columns)] for name in columns[0])]
    if not any(titles):
        lines = lines[1:]
    widths = [max(len(cell) for cell in cells) for cells in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
