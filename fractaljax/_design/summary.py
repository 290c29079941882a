"""Designs as tables that people read."""

from collections.abc import Sequence

import numpy as np

from .._base.table import table
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import unit, value_of
from .._stability.stability import stability
from .._stability.summary import ABSENT, scene_rows

NO_EQUILIBRIUM = "no closed equilibrium"


def growth_text(growth: float) -> str:
    """A growth rate [1/s] as printed, or that there is none."""
    return f"{growth:+.6g}" if np.isfinite(growth) else NO_EQUILIBRIUM


def comparison_table(
    before: Mechanism,
    after: Mechanism,
    friction_slope: bool,
    active: Sequence[str],
    wavelengths: tuple[float, float] | None = None,
    designed: Sequence[str] = (),
) -> str:
    """Two of them side by side, and the requirements the second one meets with nothing to spare.

    Designed quantities come first, where the rest does not show them.
    """
    columns = []
    for x in (before, after):
        rows = _rows(x, friction_slope, wavelengths)
        titles = {name: f"{name} [{unit(x, name)}]".replace(" [-]", "") for name in designed}
        values = {title: f"{value_of(x, name):.6g}" for name, title in titles.items()}
        columns.append({title: values[title] for title in values if title not in rows} | rows)
    names = list(active) or [ABSENT]
    for i, name in enumerate(names):
        columns[0]["active constraints" if i == 0 else " " * i] = ABSENT if i == 0 else ""
        columns[1]["active constraints" if i == 0 else " " * i] = name
    return table(["before", "after"], columns)


def _rows(x, friction_slope, wavelengths) -> dict[str, str]:
    if x.uncoupled:
        return scene_rows(x, friction_slope, wavelengths)
    modes, rows = stability(x, friction_slope), {}
    for name, joint in zip(x.joint_names, x.joints, strict=True):
        K_n, K_t = joint.stiffness()
        rows |= {f"{name}: K_n [N/m]": f"{K_n:.6g}", f"{name}: K_t [N/m]": f"{K_t:.6g}"}
    return rows | {
        "growth rate [1/s]": f"{modes.growth_rate:+.6g}",
        "frequency [Hz]": f"{modes.frequency:.6g}",
        "damping ratio": f"{modes.damping_ratio:+.6g}",
    }
