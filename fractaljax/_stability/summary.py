"""The stability of scenes and structures as tables that people read."""

import functools
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.programs import exported_jit
from .._base.table import table
from .._contact.contact import Regime
from .._contact.fixed import FixedContact
from .._mechanism.joint import AnyJoint, Joint
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import has_memory
from .._mechanism.scene import Scene, stiffness
from .._mechanism.structure import Structure
from .._surface.roughness import roughness
from .._surface.spectrum import Spectrum
from .critical_friction import critical_friction
from .linearise import Assembled, linearised, with_equilibrium
from .margin import damping_ratios
from .stability import Stability, require_computable, stability

ABSENT = "-"
_STABLE = "stable against small disturbances"  # all that a growth rate can say


# Each table is one program: eager operations are slow, and so is every call of JAX's compiler.


class _Critical(NamedTuple):
    """The critical mode of a scene, named as `Stability` names it."""

    growth_rate: Array
    frequency: Array
    damping_ratio: Array
    normal_force: Array | None


@functools.partial(exported_jit, static_argnames="friction_slope")
def _critical(scene: Scene, friction_slope: bool, wavelengths):
    """Critical mode, stiffness, contact state, and the roughness over wavelengths unless None."""
    system = linearised(scene, friction_slope)
    s = system.rightmost()
    frequency = jnp.abs(s.imag) / (2 * jnp.pi)
    mode = _Critical(s.real, frequency, damping_ratios(s), system.normal_force)
    rough = None if wavelengths is None else roughness(scene.contact.surface, *wavelengths)
    return mode, stiffness(scene), _contact_state(scene), rough


@functools.partial(exported_jit, static_argnames="friction_slope")
def _numbers(scene: Scene, friction_slope: bool):
    """Stability, stiffness, contact state and friction."""
    friction = scene.coefficient()
    return stability(scene, friction_slope), stiffness(scene), _contact_state(scene), friction


def _contact_state(scene: Scene):
    friction = scene.friction
    return scene.contact.state(friction.mu_s, friction.mu_m) if scene.contact.fractal else None


def scene_rows(
    scene: Scene, friction_slope: bool = True, wavelengths: tuple[float, float] | None = None
) -> dict[str, str]:
    """The joint of a scene and its critical mode: row titles with units, and values.

    With the longest and the shortest of the `wavelengths` [m] to count, the roughness as well.
    """
    if not scene.contact.has_surface:
        wavelengths = None
    return _rows(scene, *_critical(scene, friction_slope, wavelengths))


def _rows(scene: Scene, mode: _Critical | Stability, K, state, rough=None) -> dict[str, str]:
    contact, surface, after = scene.contact, {}, {}
    if contact.has_surface:
        surface = {"D": f"{contact.surface.D:.6g}", "G [m]": f"{contact.surface.G:.6g}"}
    elif isinstance(other := getattr(contact, "surface", None), Spectrum):
        rough = roughness(other)
    if rough is not None:
        surface |= {"Sq [m]": f"{rough.Sq:.6g}", "Sdq": f"{rough.Sdq:.6g}"}
    if state is not None:
        slip = state.slip_ratio
        after = {
            "regime": Regime[state.regime].split(":")[0],
            "a_l/a_e": f"{np.exp(np.asarray(state.log_area_ratio)):.6g}",
            "Q_e/(mu_s P)": "not evaluated" if slip is None else f"{slip:.6g}",
        }
    if mode.normal_force is not None:
        after |= {"normal force [N]": f"{mode.normal_force[0]:.6g}"}
    critical = {
        "growth rate [1/s]": f"{mode.growth_rate:+.6g}",
        "frequency [Hz]": f"{mode.frequency:.6g}",
        "damping ratio": f"{mode.damping_ratio:+.6g}",
    }
    return surface | _stiffness_rows(K) | after | critical


def _stiffness_rows(K) -> dict[str, str]:
    K_n, K_t = map(float, K)
    ratio = f"{K_t / K_n:.6g}" if K_n > 0 else ABSENT
    return {"K_n [N/m]": f"{K_n:.6g}", "K_t [N/m]": f"{K_t:.6g}", "K_t/K_n": ratio}


def stability_table(x: Any, friction_slope: bool = True) -> str:
    """The stability of a scene or a structure.

    **Raises:** `ValueError` if it cannot be computed, as `growth_rate` and `assemble`.
    """
    return (_scene_table if x.uncoupled else _structure_table)(x, friction_slope)


def _scene_table(scene: Scene, friction_slope: bool) -> str:
    """The rows of one scene, its verdict, every eigenvalue, and a remark on its friction.

    **Raises:** `ValueError` if the growth rate cannot be computed.
    """
    modes, K, state, friction = _numbers(scene, friction_slope)
    require_computable(scene, friction_slope, modes)
    critical = float(critical_friction(scene, friction_slope))
    lacking = stiffness_remark(scene, K)
    rows = _rows(scene, modes, K, state) | verdict(modes, without_joint=bool(lacking))
    rows |= {
        "margin": f"{modes.margin:+.6g}",
        "friction at V": f"{friction:.6g}",
        "critical friction": "none" if math.isinf(critical) else f"{critical:.6g}",
    }
    rows |= {
        f"eigenvalue {i} [1/s]": f"{s.real:+.6g} {s.imag:+.6g}i"
        for i, s in enumerate(modes.eigenvalues.tolist(), start=1)
    }
    lines = [*lacking, table([""], [rows]), *friction_remark(scene, scene.oscillator.V)]
    return "\n".join(lines)


def stiffness_remark(
    part: AnyJoint, K: Any = None, name: str = "The joint", follows: str = "What follows"
) -> list[str]:
    """A line if the law of a contact gives it no stiffness, normal or tangential, else none.

    `follows` is its name for the results of the mechanism without the joint.
    """
    if isinstance(part.contact, FixedContact):  # a fixed stiffness is as intended
        return []
    K_n, K_t = map(float, part.stiffness() if K is None else K)
    if K_n == 0:
        why = "every contact is plastic" if part.contact.fractal else "its law gives none"
        return [f"{name} carries no stiffness: {why}. {follows} is of the mechanism without it."]
    if K_t == 0:
        return [f"{name} has no tangential stiffness: it slips as a whole."]
    return []


def stiffness_remarks(x: Mechanism, which: str = "", **words: str) -> list[str]:
    """`stiffness_remark` of every joint, with its `words`; `which` follows the joint's name."""
    lines = []
    for name, joint in x.joints_by_name().items():
        title = f"Joint {name}{which}" if name else f"The joint{which}"
        lines += stiffness_remark(joint, None, title, **words)
    return lines


def verdict(modes: Stability, without_joint: bool = False) -> dict[str, str]:
    """The growth rate of a scene as a row, and what it means."""
    growth, margin = float(modes.growth_rate) + 0.0, float(modes.margin)
    rounding = 1e-14 * np.abs(np.asarray(modes.eigenvalues)).max()
    verdict = "it squeals" if growth > 0 else _STABLE
    if abs(growth) <= rounding or growth * margin > 0:
        # With heavy damping, or without any, rounding can decide the sign of the growth rate. The
        # sign of the margin, if it is not 0, is right.
        verdict = "0 to rounding: it neither grows nor dies out"
        if margin != 0:
            verdict = f"0 to rounding; by its margin {'it squeals' if margin < 0 else _STABLE}"
    if without_joint and _STABLE in verdict:
        verdict = "no promise: see above"
    return {"growth rate [1/s]": f"{growth:+.6g}  ({verdict})"}


@exported_jit
def _friction(law, speed):
    return law.mu(speed), law.mu_s


def friction_remark(scene: Scene, speed) -> list[str]:
    """A line if friction exceeds mu_s at a sliding speed [m/s], else none.

    Speeds and quantities of the scene may be arrays of one shape: the largest excess is shown.
    """
    mu, mu_s = _friction(scene.friction, speed)
    shown = np.broadcast_arrays(*map(np.asarray, (speed, mu, mu_s)))
    speeds, mu, static = (values.ravel() for values in shown)
    worst = int((mu / static).argmax())
    if not mu[worst] > static[worst] * (1 + 1e-14):  # by more than rounding
        return []
    return [
        f"remark: at a sliding speed of {speeds[worst]:.6g} m/s the friction law gives "
        f"{mu[worst]:.6g}, above mu_s = {static[worst]:.6g}: it is not meant for such speeds"
    ]


def _structure_table(structure: Structure, friction_slope: bool) -> str:
    """The joints of a structure, its verdict, and its unstable and its least damped modes.

    **Raises:** `ValueError` as `assemble`, if the structure has no equilibrium under F or a joint
    is open there, and if its numbers leave the range of floating-point numbers.
    """
    modes = _computable_modes(structure, friction_slope)
    unstable, unresolved = modes.unstable(), modes.unresolved()
    lacking = stiffness_remarks(structure)
    meaning = _structure_verdict(modes, unstable, unresolved, lacking)
    whole = {
        "degrees of freedom": f"{structure.n}",
        **{name: f"{value:.6g}" for name, value in structure.parameters.items()},
        "unstable modes": f"{len(unstable)}  ({meaning})",
        "growth rate [1/s]": f"{modes.growth_rate:+.6g}  (to +-{modes.resolution:.1g})",
        "least damping ratio": f"{modes.margin:+.6g}",
    }
    tables = [table([""], [whole])]
    if structure.joints:
        joints = [_joint_rows(joint) for joint in structure.joints]
        for rows, force in zip(joints, _forces(modes), strict=False):
            rows["normal force [N]"] = ABSENT if math.isnan(force) else f"{force:.6g}"
        shown = [name for name in joints[0] if any(rows[name] != ABSENT for rows in joints)]
        joints = [{name: rows[name] for name in shown} for rows in joints]
        tables.append(table(list(structure.joint_names), joints))
    most = 10  # stable modes, and unresolved ones, that are listed
    least = modes.least_damped(most + len(unstable) + len(unresolved))
    listed = [(mode, "unstable") for mode in unstable]
    listed += [(mode, f"unresolved to +-{mode.resolution:.1g}") for mode in unresolved[:most]]
    listed += [(mode, "") for mode in least if mode.growth_rate < -mode.resolution]
    if listed:
        columns = ["frequency [Hz]", "growth rate [1/s]", "damping ratio", "moves most", ""]
        titles = [f"mode {i}" for i in range(1, len(listed) + 1)]
        cells = zip(*(_mode_cells(*item) for item in listed), strict=True)
        tables.append(table(columns, [dict(zip(titles, c, strict=True)) for c in cells]))
    return "\n\n".join([*["\n".join(lacking)] * bool(lacking), *tables])


def _computable_modes(structure: Structure, friction_slope: bool) -> Stability:
    """Its `stability`, where all of it can be computed."""
    with_memory = has_memory(structure)
    attached = None if with_memory else with_equilibrium(structure, friction_slope)
    if attached is not None:
        _require_closed(structure, attached)
        for name, X in zip("MCK", attached.matrices, strict=True):
            if not np.isfinite(np.asarray(X)).all():
                raise ValueError(f"{name} with the joints attached must be finite")
    modes = stability(structure, friction_slope)
    if with_memory:
        _require_closed(structure, modes)
    if not np.isfinite(np.asarray(modes.eigenvalues)).all():
        why = "the structure does not slide steadily under F, or " if with_memory else ""
        raise ValueError(
            f"{why}M, C and K have no eigenvalues in the range of {modes.margin.dtype}"
        )
    return modes


def _require_closed(structure: Structure, system: Assembled | Stability) -> None:
    for name, force in zip(structure.joint_names, _forces(system), strict=False):
        if force <= 0:
            raise ValueError(
                f"joint {name} is open at the equilibrium: its normal force is {force:.6g} N"
            )


def _forces(x: Assembled | Stability) -> list[float]:
    """The normal force of each joint [N]; none where no joint is preloaded."""
    return [] if x.normal_force is None else x.normal_force.tolist()


def _mode_cells(mode, remark) -> list[str]:
    numbers = (f"{mode.growth_rate:+.6g}", f"{mode.damping_ratio:+.6g}")
    return [f"{mode.frequency:.6g}", *numbers, f"{mode.largest}", remark]


def _structure_verdict(modes, unstable, unresolved, lacking) -> str:
    rigid = np.asarray(modes.resolutions)[np.asarray(modes.eigenvalues) == 0]
    also = [f"{len(unresolved)} unresolved"] if unresolved else []
    if rigid.size:
        also.append(f"{rigid.size} eigenvalues 0 to +-{rigid.max():.1g} 1/s: rigid bodies")
    if unstable:
        return "; ".join(["it squeals", *also])
    stable = "no promise: see above" if lacking else _STABLE
    return "; ".join([*also, f"else {stable}" if also else stable])


def _joint_rows(joint: Joint) -> dict[str, str]:
    rows = dict.fromkeys(("D", "G [m]"), ABSENT) | _stiffness_rows(joint.stiffness())
    rows |= {"friction coefficient": f"{joint.coefficient():.6g}", "regime": ABSENT}
    if joint.contact.has_surface:
        surface = joint.contact.surface
        rows |= {"D": f"{surface.D:.6g}", "G [m]": f"{surface.G:.6g}"}
    if joint.contact.fractal:
        state = joint.contact.state(joint.friction.mu_s, joint.friction.mu_m)
        rows["regime"] = Regime[state.regime].split(":")[0]
    return rows
