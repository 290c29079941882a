"""What the commands print, as JSON for scripts: numbers in SI units, null where there is none."""

import json
import math
from collections.abc import Callable, Mapping
from typing import Any


def add_json(parser) -> None:
    """Add `--json`."""
    parser.add_argument(
        "--json",
        action="store_true",
        help="print JSON for scripts in place of the table: SI units, null for NaN and infinity",
    )


def show(arguments, text: str | Callable[[], str], content: Callable[[], dict[str, Any]]) -> None:
    """Print the text of a command or, with --json, its content under the name of the command."""
    if arguments.json:
        document = {"command": arguments.command} | content()
        print(json.dumps(plain(document), indent=1, allow_nan=False, ensure_ascii=False))
    else:
        print(text if isinstance(text, str) else text())


def plain(x: Any) -> Any:
    """Numbers, arrays and mappings as JSON has them; a complex number as real and imag."""
    if x is None or isinstance(x, (str, bool, int)):
        return x
    if isinstance(x, float):
        return x if math.isfinite(x) else None
    if isinstance(x, complex):
        return {"real": plain(x.real), "imag": plain(x.imag)}
    if isinstance(x, Mapping):
        return {str(key): plain(value) for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain(each) for each in x]
    import numpy as np

    return plain(np.asarray(x).tolist())


def files(folder, written: Mapping[str, bytes] | list[str]) -> list[str]:
    """The paths of files written to a folder."""
    return [str(folder / name) for name in written]


def quantities(x: Any) -> dict[str, Any]:
    """The value of every quantity of a scene or structure by name."""
    from .._mechanism.quantities import quantity_names, value_of

    stored = x.stored_quantities()
    names = [each for each in quantity_names(x) if "." in each or x.sole_joint is not None]
    return {name: stored[name].value if name in stored else value_of(x, name) for name in names}


def stability_content(x: Any, friction_slope: bool) -> dict[str, Any]:
    """Growth rate, modes and joints of a scene or structure."""
    from .._contact.contact import Regime
    from .._stability.critical_friction import critical_friction
    from .._stability.stability import stability

    modes = stability(x, friction_slope)
    names = "growth_rate", "frequency", "damping_ratio", "margin", "resolution", "eigenvalues"
    content = {name: getattr(modes, name) for name in names}
    content |= {
        "squeals": bool(modes.growth_rate > modes.resolution),
        "modes": [
            {key: value for key, value in mode._asdict().items() if key != "shape"}
            for mode in modes._modes()
        ],
        "joints": {},
        "quantities": quantities(x),
    }
    if x.sole_joint is not None:
        content["critical_friction"] = critical_friction(x, friction_slope)
    for i, (name, joint) in enumerate(x.joints_by_name().items()):
        K_n, K_t = joint.stiffness()
        forces = modes.normal_force
        about = {"K_n": K_n, "K_t": K_t, "normal_force": None if forces is None else forces[i]}
        if joint.contact.fractal:
            friction = joint.friction
            state = joint.contact.state(friction.mu_s, friction.mu_m)
            about |= {
                "regime": Regime[state.regime].split(":")[0],
                "log_area_ratio": state.log_area_ratio,
                "slip_ratio": state.slip_ratio,
            }
        content["joints"][name or "joint"] = about
    return content


def cycle_content(mechanism: Any, cycle: Any) -> dict[str, Any]:
    """The numbers of a limit cycle, and those of the equilibrium."""
    import numpy as np

    from .._dynamics.cycle import CycleResult
    from .._stability.stability import growth_rate

    content = {"result": CycleResult[cycle.result], "growth_rate": growth_rate(mechanism)}
    if not np.isfinite(cycle.period):
        return content
    names = (
        "period frequency amplitude velocity_min velocity_max normal_force stick_fraction"
        " open_fraction multipliers error returns state"
    )
    return content | {name: getattr(cycle, name) for name in names.split()}


def design_content(best: Any) -> dict[str, Any]:
    """A design: what is designed, before and after, and what it meets."""
    from .._mechanism.quantities import value_of

    designed = {
        name: {
            "before": value_of(best.initial, name),
            "after": value_of(best.scene, name),
            "bounds": ends,
        }
        for name, ends in best.bounds.items()
    }
    names = (
        "outcome value growth_rate growth_rates target active violated quiet_radius"
        " squeal_probability initial_squeal_probability worst cycles starts failed_starts"
    )
    return {"designed": designed} | {name: getattr(best, name) for name in names.split()}


def identification_content(fit: Any) -> dict[str, Any]:
    """D and G with their errors, and what the fit rests on."""
    names = (
        "D G D_standard_error ln_G_standard_error covariance G_profile gamma band decades limit"
        " aliased noise_floor missing outliers unused warnings"
    )
    return {name: getattr(fit, name) for name in names.split()}


def map_content(bifurcations: Any) -> dict[str, Any]:
    """The curves of a map, each a list of points."""
    curves = [
        {"kind": "Hopf", "x": branch.x, "y": branch.y, "frequency": branch.frequency}
        for branch in bifurcations.boundary.branches
    ]
    curves += [
        {"kind": curve.kind, "x": curve.x, "y": curve.y, "period": curve.period}
        | {"amplitude": curve.amplitude}
        for curve in bifurcations.curves
    ]
    return {"x": bifurcations.x, "y": bifurcations.y, "curves": curves}


def comparison_content(comparison: Any) -> dict[str, Any]:
    """The stiffness by every law at every load."""
    names = "K_n", "K_t", "alpha", "real_area", "scatter"
    curves = {
        law: {name: getattr(curve, name) for name in names}
        for law, curve in comparison.curves.items()
    }
    content = {"loads": comparison.loads, "area": comparison.area, "laws": curves}
    return content | {"left_out": comparison.left_out}


def table_content(titles: list[str], rows: list[list[str]]) -> dict[str, Any]:
    """The rows of a table, by the titles of its columns."""
    return {"rows": [dict(zip(titles, row, strict=True)) for row in rows]}
