"""Scenes, designs and limit cycles as tables that people read."""

import math

import jax.numpy as jnp
import numpy as np

from .mechanism.contact import Regime
from .mechanism.quantities import sliding_friction
from .mechanism.scene import Scene, stiffness
from .mechanism.structure import Joint, Structure
from .modes.complex_modes import UNSUPPORTED, assemble
from .modes.critical_friction import critical_friction
from .modes.stability import Stability, require_computable, stability
from .motion.cycle import CycleResult, LimitCycle
from .surface.roughness import roughness

_ABSENT = "-"
_STABLE = "stable against small disturbances"  # all that a growth rate can say
_ROUNDING = 1e-14  # of the largest eigenvalue: growth rates below it have no sign
_LEAST_DAMPED = 10  # stable modes of a structure that its table lists
_MODES = {"+": "slips, dx/dt < V", "-": "slips, dx/dt > V", "stick": "sticks"}


def scene_rows(
    scene: Scene, friction_slope: bool = True, wavelengths: tuple[float, float] | None = None
) -> dict[str, str]:
    """What a scene's joint and its critical mode are like: row titles with units, and values.

    With the longest and the shortest of the `wavelengths` [m] to count, the roughness as well.
    """
    modes, fractal = stability(scene, friction_slope), scene.contact.fractal
    rows = {}
    if fractal:
        state = scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)
        K_n, K_t = float(state.K_n), float(state.K_t)
        surface = scene.contact.surface
        rows |= {"D": f"{surface.D:.6g}", "G [m]": f"{surface.G:.6g}"}
        if wavelengths is not None:
            rough = roughness(surface, *wavelengths)
            rows |= {"Sq [m]": f"{rough.Sq:.6g}", "Sdq": f"{rough.Sdq:.6g}"}
    else:
        K_n, K_t = (float(K) for K in stiffness(scene))
    rows |= {
        "K_n [N/m]": f"{K_n:.6g}",
        "K_t [N/m]": f"{K_t:.6g}",
        "K_t/K_n": f"{K_t / K_n:.6g}" if K_n > 0 else _ABSENT,
    }
    if fractal:
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
    """The rows of one scene, its verdict, every eigenvalue, and a remark on its friction.

    **Raises:** `ValueError` if the growth rate is out of what can be computed.
    """
    require_computable(scene, friction_slope)
    modes = stability(scene, friction_slope)
    rows = scene_rows(scene, friction_slope) | _verdict(modes)
    critical = critical_friction(scene, friction_slope)
    rows |= {
        "margin": f"{modes.margin:+.6g}",
        "friction at V": f"{sliding_friction(scene):.6g}",
        "critical friction": "none" if math.isinf(critical) else f"{critical:.6g}",
    }
    rows |= {
        f"eigenvalue {i} [1/s]": f"{s.real:+.6g} {s.imag:+.6g}i"
        for i, s in enumerate(modes.eigenvalues.tolist(), start=1)
    }
    return "\n".join([table([""], [rows]), *friction_remark(scene, scene.oscillator.V)])


def _verdict(modes: Stability) -> dict[str, str]:
    growth, margin = float(modes.growth_rate), float(modes.margin)
    growth, rounding = growth + 0.0, _ROUNDING * float(jnp.abs(modes.eigenvalues).max())
    verdict = "it squeals" if growth > 0 else _STABLE
    if abs(growth) <= rounding or growth * margin > 0:
        # Beside heavy damping or without any, rounding can decide on the sign of the growth rate;
        # that of the margin, if it has one, is right.
        verdict = "0 to rounding: it neither grows nor dies out"
        if margin != 0:
            verdict = f"0 to rounding; by its margin {'it squeals' if margin < 0 else _STABLE}"
    return {"growth rate [1/s]": f"{growth:+.6g}  ({verdict})"}


def friction_remark(scene: Scene, speed) -> list[str]:
    """A line where a sliding speed [m/s] is one at which friction exceeds mu_s, else none.

    Speeds and quantities of the scene may be arrays of one shape: the worst of them is shown.
    """
    law = scene.friction
    shown = np.broadcast_arrays(*map(np.asarray, (speed, law.coefficient(speed), law.mu_s)))
    speeds, mu, static = (values.ravel() for values in shown)
    worst = int((mu / static).argmax())
    if not mu[worst] > static[worst] * (1 + _ROUNDING):
        return []
    return [
        f"remark: at a sliding speed of {speeds[worst]:.6g} m/s the friction law gives "
        f"{mu[worst]:.6g}, above mu_s = {static[worst]:.6g}: it is not meant for such speeds"
    ]


def structure_table(structure: Structure, friction_slope: bool = True) -> str:
    """The joints of a structure, its verdict, and its unstable and its least damped modes.

    **Raises:** `ValueError` as `assemble`, if the structure has no equilibrium under F, and if its
    numbers leave the range of floating-point numbers.
    """
    try:
        matrices = assemble(structure, friction_slope)
    except RuntimeError:  # of many lines, from inside a compiled program
        raise ValueError(UNSUPPORTED) from None
    for name, X in zip("MCK", matrices, strict=True):
        if not jnp.isfinite(X).all():
            raise ValueError(f"{name} with the joints attached must be finite")
    modes = stability(structure, friction_slope)
    if not jnp.isfinite(modes.eigenvalues).all():
        raise ValueError(f"M, C and K have no eigenvalues in the range of {modes.margin.dtype}")
    unstable, unresolved = modes.unstable(), modes.unresolved()
    marked = unstable + unresolved[:_LEAST_DAMPED]
    least = modes.least_damped(_LEAST_DAMPED + len(unstable) + len(unresolved))
    listed = marked + [mode for mode in least if mode.growth_rate < -mode.resolution]
    whole = {
        "degrees of freedom": f"{structure.n}",
        "unstable modes": f"{len(unstable)}  ({_structure_verdict(modes, unstable, unresolved)})",
        "growth rate [1/s]": f"{modes.growth_rate:+.6g}  (to +-{modes.resolution:.1g})",
        "least damping ratio": f"{modes.margin:+.6g}",
    }
    tables = [table([""], [whole])]
    if structure.joints:
        columns = [_joint_rows(joint) for joint in structure.joints]
        names = [name for name in columns[0] if any(column[name] != _ABSENT for column in columns)]
        columns = [{name: column[name] for name in names} for column in columns]
        tables.append(table(list(structure.joint_names), columns))
    if listed:
        columns = {
            "frequency [Hz]": [f"{mode.frequency:.6g}" for mode in listed],
            "growth rate [1/s]": [f"{mode.growth_rate:+.6g}" for mode in listed],
            "damping ratio": [f"{mode.damping_ratio:+.6g}" for mode in listed],
            "moves most": [f"{mode.largest}" for mode in listed],
            "": ["unstable"] * len(unstable)
            + [f"unresolved to +-{mode.resolution:.1g}" for mode in marked[len(unstable) :]]
            + [""] * (len(listed) - len(marked)),
        }
        titles = [f"mode {i}" for i in range(1, len(listed) + 1)]
        rows = [dict(zip(titles, cells, strict=True)) for cells in columns.values()]
        tables.append(table(list(columns), rows))
    return "\n\n".join(tables)


def _structure_verdict(modes, unstable, unresolved) -> str:
    still = modes.resolutions[modes.eigenvalues == 0]
    also = [f"{len(unresolved)} unresolved"] if unresolved else []
    if still.size:
        also.append(f"{still.size} eigenvalues 0 to +-{still.max():.1g} 1/s: rigid bodies")
    verdict = "it squeals" if unstable else f"else {_STABLE}" if also else _STABLE
    return "; ".join([verdict, *also] if unstable else [*also, verdict])


def _joint_rows(joint: Joint) -> dict[str, str]:
    K_n, K_t = (float(K) for K in joint.stiffness())
    surface = joint.contact.surface if joint.contact.fractal else None
    rows = {
        "D": f"{surface.D:.6g}" if surface else _ABSENT,
        "G [m]": f"{surface.G:.6g}" if surface else _ABSENT,
        "K_n [N/m]": f"{K_n:.6g}",
        "K_t [N/m]": f"{K_t:.6g}",
        "K_t/K_n": f"{K_t / K_n:.6g}" if K_n > 0 else _ABSENT,
        "friction coefficient": f"{joint.coefficient():.6g}",
        "regime": _ABSENT,
    }
    if joint.contact.fractal:
        state = joint.contact.state(joint.friction.mu_s, joint.friction.mu_m)
        rows["regime"] = Regime[state.regime].split(":")[0]
    return rows


def cycle_table(scene: Scene, cycle: LimitCycle) -> str:
    """What became of the search for one limit cycle, its numbers, and its changes of mode."""
    found = {"result": str(CycleResult[cycle.result])} | _verdict(stability(scene))
    if not jnp.isfinite(cycle.period):
        return table([""], [found])
    whole = found | {
        "period [ms]": f"{cycle.period * 1e3:.6g}",
        "frequency [Hz]": f"{cycle.frequency:.6g}",
        "turns in a period": f"{cycle.turns}",
        "contact pulls": f"{cycle.tension_fraction:.2%} of the period",
        "estimated error": f"{cycle.error:.1e}",
    }
    regularised = cycle.regularisation_error != 0
    if regularised:
        whole["off the exact law by"] = f"{cycle.regularisation_error:.1e}"
    # Rounded first: one of them may be zero up to rounding, with a sign that says nothing.
    multipliers = (jnp.round(cycle.multipliers, 6) + 0).tolist()
    whole |= {
        f"Floquet multiplier {i}": f"{s.real:+.6f} {s.imag:+.6f}i  (modulus {abs(s):.6f})"
        for i, s in enumerate(multipliers, start=1)
    }
    directions = [
        {
            "peak to peak [m]": f"{cycle.amplitude[i]:.6g}",
            "least dx/dt [m/s]": f"{cycle.velocity_min[i]:+.6g}",
            "largest dx/dt [m/s]": f"{cycle.velocity_max[i]:+.6g}",
            "sticks": f"{cycle.stick_fraction[i]:.2%} of the period",
        }
        for i in range(2)
    ]
    tables = [table([""], [whole]), table(["x1, along the belt", "x2, normal to it"], directions)]
    switches = [] if regularised else cycle.switches()
    if switches:
        tables.append(_switching(switches, cycle.period))
    relative = scene.oscillator.V - jnp.stack([cycle.velocity_min, cycle.velocity_max])
    tables += friction_remark(scene, jnp.abs(relative).max())
    return "\n\n".join(tables)


def _switching(switches, period) -> str:
    columns = {
        "time [ms]": [f"{at.time * 1e3:.6f}" for at in switches],
        "of the period": [f"{at.time / period:.2%}" for at in switches],
        "direction": [f"x{at.direction}" for at in switches],
        "before": [_MODES[at.before] for at in switches],
        "after": [_MODES[at.after] for at in switches],
    }
    names = [f"switch {i}" for i in range(1, len(switches) + 1)]
    rows = [dict(zip(names, cells, strict=True)) for cells in columns.values()]
    return table(list(columns), rows) + "\ntime 0: x1 is largest"


def comparison_table(
    before: Scene, after: Scene, friction_slope: bool, active, wavelengths=None
) -> str:
    """Two scenes side by side, and the requirements the second one meets with nothing to spare."""
    columns = [scene_rows(scene, friction_slope, wavelengths) for scene in (before, after)]
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
