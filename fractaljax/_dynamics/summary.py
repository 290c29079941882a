"""Limit cycles as printed tables."""

from typing import Any

import numpy as np

from .._base.table import table
from .._mechanism.scene import Scene
from .._stability.stability import stability
from .._stability.summary import friction_remark, stiffness_remarks, verdict
from .contact_state import STATES
from .cycle import CycleResult, LimitCycle


def cycle_table(mechanism: Any, cycle: LimitCycle, most: int = 12) -> str:
    """The result of the search for one limit cycle, its numbers and its switches.

    At most that many multipliers and degrees of freedom of a structure are listed.
    """
    lacking = stiffness_remarks(mechanism)
    outcome = {"result": str(CycleResult[cycle.result])}
    outcome |= verdict(stability(mechanism), without_joint=bool(lacking))
    if not np.isfinite(cycle.period):
        return "\n".join([*lacking, table([""], [outcome])])
    whole = outcome | {
        "period [ms]": f"{cycle.period * 1e3:.6g}",
        "frequency [Hz]": f"{cycle.frequency:.6g}",
        "returns in a period": f"{cycle.returns}",
        **({} if mechanism.sole_joint is None else _pulls(mechanism, cycle)),
        "estimated error": f"{cycle.error:.1e}",
    }
    regularised = cycle.regularisation_error != 0
    if regularised:
        whole["off the exact law by"] = f"{cycle.regularisation_error:.1e}"
    # Rounded first, and + 0: a multiplier of zero has a sign at random.
    multipliers = (np.round(np.asarray(cycle.multipliers), 6) + 0).tolist()
    whole |= {
        f"Floquet multiplier {i}": f"{s.real:+.6f} {s.imag:+.6f}i  (modulus {abs(s):.6f})"
        for i, s in enumerate(multipliers[:most], start=1)
    }
    directions = [
        {
            "peak to peak [m]": f"{cycle.amplitude[i]:.6g}",
            "least dx/dt [m/s]": f"{cycle.velocity_min[i]:+.6g}",
            "largest dx/dt [m/s]": f"{cycle.velocity_max[i]:+.6g}",
        }
        for i in range(len(cycle.amplitude))
    ]
    if mechanism.sole_joint is None:
        names = mechanism.names or [f"x{i}" for i in range(1, mechanism.n + 1)]
        largest = sorted(range(mechanism.n), key=lambda i: -cycle.amplitude[i])[:most]
        tables = ["\n".join(lacking)] * bool(lacking) + [
            table([""], [whole]),
            table(list(mechanism.joint_names), _joint_columns(cycle)),
            table([names[i] for i in largest], [directions[i] for i in largest]),
        ]
        return "\n\n".join(tables)
    scene = mechanism
    for direction, share in zip(directions, cycle.stick_fraction, strict=True):
        direction["sticks"] = f"{share:.2%} of the period"
    tables = ["\n".join(lacking)] if lacking else []
    tables += [table([""], [whole]), table(["x1, along the belt", "x2, normal to it"], directions)]
    switches = [] if regularised or cycle.internal is not None else cycle.switches()
    if switches:
        tables.append(_switching(switches, cycle.period))
    ends = np.stack([cycle.velocity_min, cycle.velocity_max])
    tables += friction_remark(scene, np.abs(np.asarray(scene.oscillator.V) - ends).max())
    return "\n\n".join(tables)


def _pulls(scene: Scene, cycle: LimitCycle) -> dict[str, str]:
    if scene.preload:
        return {"joint is open": f"{cycle.open_fraction[0]:.2%} of the period"}
    return {"contact pulls": f"{cycle.tension_fraction:.2%} of the period"}


def _joint_columns(cycle: LimitCycle) -> list[dict[str, str]]:
    return [
        {
            "sticks": f"{cycle.stick_fraction[j]:.2%} of the period",
            "is open": f"{cycle.open_fraction[j]:.2%} of the period",
            "least normal force [N]": f"{cycle.normal_force[j, 0]:.6g}",
            "largest normal force [N]": f"{cycle.normal_force[j, 1]:.6g}",
        }
        for j in range(len(cycle.normal_force))
    ]


def _switching(switches, period) -> str:
    words = {state.name: state.description.format(velocity="dx/dt") for state in STATES}
    columns = {
        "time [ms]": [f"{at.time * 1e3:.6f}" for at in switches],
        "of the period": [f"{at.time / period:.2%}" for at in switches],
        "direction": [f"x{at.direction}" for at in switches],
        "before": [words[at.before] for at in switches],
        "after": [words[at.after] for at in switches],
    }
    names = [f"switch {i}" for i in range(1, len(switches) + 1)]
    rows = [dict(zip(names, cells, strict=True)) for cells in columns.values()]
    return table(list(columns), rows) + "\ntime 0: x1 is largest"
