"""What a quiet scene or structure rests on: its growth rate where an assumption is another."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.parts import Record, flag, rebuild, require_kind, require_scalar, scalar, substitute
from .._base.programs import exported_jit
from .._base.table import table
from .._contact.asperity import AsperityContact
from .._contact.contact import Contact
from .._contact.fixed import FixedContact
from .._contact.fractal import FractalContact
from .._contact.material import mindlin_ratio
from .._contact.persson import PerssonContact
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import quantity_names, require_one, unit, value_of
from .._mechanism.scene import Scene
from .._stability.quartic import rightmost_root
from .._stability.stability import growth_rate, stability
from .._stability.two_directions import two_directions
from .._surface.spectrum import Spectrum
from .design import DesignResult, design
from .envelope import Envelope
from .growing_modes import needs_modes
from .joints import with_contact_law, with_contacts
from .quiet import Kicks
from .summary import growth_text
from .tolerance import Tolerance, squeal_probability
from .wear import WornGrowth, check_depths, worn_growth


class Question(NamedTuple):
    """One assumption, changed."""

    assumed: str  # in the scene
    name: str  # instead
    answer: str  # in words
    quiet: bool
    undetermined: bool = False  # it is not quiet because it has no answer

    @property
    def outcome(self) -> str:
        """What is printed: quiet, squeals, or that there is no answer."""
        return "quiet" if self.quiet else "undetermined" if self.undetermined else "squeals"


class Verdict(Record):
    """What a quiet scene rests on, as `verdict` returns it; printed, it is a table."""

    questions: tuple[Question, ...]  # assumptions that were changed, with the answers
    incurable: bool  # whether the slope of the friction feeds in more than all damping takes out
    omitted: tuple[str, ...] = ()  # what `verdict` would ask with other arguments, in brackets
    wear: WornGrowth | None = None  # growth `rates` [1/s] over `depths` [Sq], where asked

    @property
    def rests_on(self) -> tuple[str, ...]:
        """The assumptions without which it is not quiet."""
        lost = (question.assumed for question in self.questions[1:] if not question.quiet)
        return tuple(dict.fromkeys(lost))

    @property
    def quiet(self) -> bool:
        """True if it is quiet in all that was asked."""
        return all(question.quiet for question in self.questions)

    def __repr__(self) -> str:
        columns: list[dict[str, str]] = [
            {question.name: question.answer for question in self.questions},
            {question.name: question.outcome for question in self.questions},
        ]
        lines = [table(["growth rate [1/s]", ""], columns)]
        if self.incurable:
            lines.append(
                "No surface cures this: the slope of the friction feeds in more than all damping "
                "takes out. See `suggest`."
            )
        if self.quiet:
            lines.append("Quiet in all that was asked." if self.omitted else "Quiet in all.")
        elif self.questions[0].quiet:
            lines.append(f"Quiet, but it rests on: {'; '.join(self.rests_on)}.")
        else:
            lines.append("Not quiet.")
        if self.omitted:
            lines.append(f"Not asked: {', '.join(self.omitted)}.")
        return "\n".join(lines)


def verdict(
    x: Mechanism,
    *,
    area: Any = None,
    laws: Sequence[Contact] = (),
    tolerance: Any = None,
    envelope: Envelope | Mapping[str, Any] | None = None,
    quiet_within: Any = None,
    run_in: Sequence[float] | None = None,
    friction_slope: bool = True,
    seed: int = 0,
    progress: bool = True,
) -> Verdict:
    """Ask of a scene or a structure whether it stays quiet where an assumption is another.

    Its growth rate [1/s] as it is; with the load P in the friction, or without it where it is
    there; with the tangential spring in series with the friction, as `Jenkins` has it, where K_t
    has no part in steady sliding; under other contact laws; with K_t/K_n between its own, the
    fractal law's and Mindlin's, the worst of 65 values, or 17 of a structure; the probability of
    squeal, quiet below 5 percent; the largest kick survived; and while its surfaces run in. What
    no argument asks for is named. The joints of a structure change together.

    **Arguments:**

    - `x`: a scene or structure of scalars.
    - `area`: nominal area [m^2], one for all joints or {joint: area}, for `AsperityContact` and
      `PerssonContact` with wavelengths from its side down to a hundredth of it. By default they are
      left out.
    - `laws`: other contact laws, each with the surface, material and load of `x`.
    - `tolerance`: as in `squeal_probability`, by default none.
    - `envelope`: as in `squeal_probability`, by default none.
    - `quiet_within`: the kick that has to be survived, as in `design`; by default none.
    - `run_in`: (least, greatest) mean height worn off, in units of Sq, such as (0, 0.3); by default
      none. Two maps of 256 x 256 points are drawn from the spectrum of each joint and worn as in
      the function `run_in`; the stiffness of the joint grows as theirs. A contact without an area
      of its own needs `area`. Debris and friction that changes are left out.
    - `friction_slope`: False leaves the slope of friction out of growth rates.
    - `seed`: of all that is drawn, 0 by default.
    - `progress`: shows a bar.

    **Returns:** a `Verdict`.

    **Raises:** `ValueError` for what holds arrays, for an area without a surface or of a joint that
    is not there, and as those functions.
    """
    require_one("x", x)
    flag("friction_slope", friction_slope)
    depths = None if run_in is None else check_depths(run_in)
    parts = x.joints_by_name()
    laws_in_use = " and ".join(
        dict.fromkeys(type(part.contact).__name__ for part in parts.values())
    )
    for i, law in enumerate(laws):
        require_kind(f"laws[{i}]", law, Contact)
    cases = [("", f"as it is ({laws_in_use})", x), *_other_load(x, friction_slope)]
    before = len(cases)
    by = [(type(law).__name__, with_contact_law(x, law)) for law in laws]
    if area is not None:
        by += [(kind.__name__, with_contacts(x, laws)) for kind, laws in _laws_of(x, area)]
    cases += [(laws_in_use, f"by {name}", other) for name, other in by]
    growth = _growth_rates(tuple(other for *_, other in cases), friction_slope)
    rates, names = growth.rates.tolist(), [case[:2] for case in cases]
    if not all(part.friction.in_series for part in parts.values()):
        rates.insert(before, float(growth.in_series))
        names.insert(before, ("K_t beside the friction", "tangential spring in series"))
    questions = [
        Question(assumed, name, growth_text(rate), rate < 0, not np.isfinite(rate))
        for (assumed, name), rate in zip(names, rates, strict=True)
    ]
    if (stiff := np.asarray(growth.stiff)).any():
        ratios, own_ratios = (np.asarray(r)[..., stiff] for r in (growth.ratios, growth.own_ratios))
        questions.append(
            _stiffness_ratio_question(ratios, np.asarray(growth.at_ratios), own_ratios)
        )
    if tolerance is not None:
        questions.append(_scatter_question(x, tolerance, envelope, friction_slope, seed))
    if quiet_within is not None:
        kicks = Kicks.of(x, quiet_within, seed, flag("progress", progress))
        survived, size = kicks.survived([x]), kicks.size
        words = f"comes to rest from {survived:.3g} of {size:.3g}"
        name = f"kicks within {quiet_within}"
        questions.append(Question("smaller kicks", name, words, survived >= size))
    worn = None
    if depths is not None:
        worn = worn_growth(x, depths, area, friction_slope, seed)
        questions.append(_wear_question(depths, worn))
    # A reduced structure does not have all eigenvalues.
    incurable = bool(growth.trace > 0) and getattr(x, "band", None) is None
    others = "area" if any(part.contact.has_surface for part in parts.values()) else "laws"
    options = {f"other contact laws ({others})": by, "scatter (tolerance)": tolerance is not None}
    options["kicks (quiet_within)"] = quiet_within is not None
    if any(isinstance(getattr(part.contact, "surface", None), Spectrum) for part in parts.values()):
        options["wear (run_in)"] = depths is not None
    omitted = tuple(name for name, was in options.items() if not was)
    return Verdict(tuple(questions), incurable, omitted, worn)


def _other_load(x: Mechanism, friction_slope: bool) -> list[tuple[str, str, Mechanism]]:
    """With the load P in the friction of all joints that have one, or without it."""
    joints = x.joints_by_name()
    able = [
        name
        for name, joint in joints.items()
        if joint.normal is not None and getattr(joint.contact, "P", None) is not None
    ]
    preloaded = any(joints[name].preload for name in able)
    falls = friction_slope and any(j.friction.velocity_dependent for j in joints.values())
    if not able or (preloaded and falls and x.F is None):  # without F there is no slope
        return []
    changed = {name: rebuild(joints[name], {"preload": not preloaded}) for name in able}
    other = x.with_joints(joints | changed)
    along = "x2" if x.uncoupled else "n.x"
    force, instead = f"friction on K_n {along}", f"friction on P + K_n {along}"
    if preloaded:
        force, instead = instead, force
    return [(force, instead, other)]


def _laws_of(x: Mechanism, area: Any) -> list[tuple[type[Contact], dict[str, Contact]]]:
    """The other laws of the surfaces on nominal areas, by joint."""
    parts = {name: p for name, p in x.joints_by_name().items() if p.contact.has_surface}
    if not parts:
        kinds = " and ".join(
            dict.fromkeys(type(p.contact).__name__ for p in x.joints_by_name().values())
        )
        raise ValueError(f"area needs a contact with a surface, got a {kinds}")
    if not isinstance(area, Mapping):
        area = dict.fromkeys(parts, area)
    elif set(area) != set(parts):
        raise ValueError(f"area must be of the joints {', '.join(parts)}, got {', '.join(area)}")
    asperity, persson = {}, {}
    for name, part in parts.items():
        A = scalar(f"area {name}".strip(), area[name], above=0)
        contact, L = part.contact, jnp.sqrt(A)
        arguments, L_s = (contact.surface, contact.material, contact.P), L / 100
        asperity[name] = AsperityContact(*arguments, L_s)
        persson[name] = PerssonContact(*arguments, A, L, L_s)
    return [(AsperityContact, asperity), (PerssonContact, persson)]


def _with_springs_in_series(x: Mechanism) -> Mechanism:
    """`x` with each tangential spring in series with the friction of its joint.

    In steady sliding the slider slips: the spring holds mu N, and K_t is in no matrix.
    """
    contacts = {}
    for name, part in x.joints_by_name().items():
        if part.friction.in_series:
            contacts[name] = part.contact
            continue
        K_n, _ = part.contact.stiffness(part.friction.mu_s, part.friction.mu_m)
        load = getattr(part.contact, "P", None)
        contact = FixedContact(1.0, 0.0, None if load is None else 1.0)
        contacts[name] = substitute(contact, {"K_n": K_n} | ({} if load is None else {"P": load}))
    return with_contacts(x, contacts)


class _GrowthRates(NamedTuple):
    """What `_growth_rates` returns, of the j joints whose contacts have a material."""

    rates: Array  # (m,) [1/s], of the mechanisms
    in_series: Array  # that of the first one with its tangential springs in series [1/s]
    at_ratios: Array  # (k,) [1/s], at the ratios
    ratios: Array  # (k, j) of K_t to K_n
    own_ratios: Array  # (j,)
    stiff: Array  # (j,) whether K_n is above 0
    trace: Array  # the sum of the growth rates, which no stiffness changes


@functools.partial(exported_jit, static_argnames="friction_slope")
def _growth_rates(mechanisms: tuple[Any, ...], friction_slope: bool) -> _GrowthRates:
    """Growth rates of m mechanisms, and of the first changed, in one program.

    The ratios of each joint lie between its own, the fractal law's and Mindlin's.
    """
    first, zero = mechanisms[0], FixedContact(0.0, 0.0, 1.0)
    mechanisms = *mechanisms, _with_springs_in_series(first)
    stiffness, ends = {}, []
    for name, part in first.joints_by_name().items():
        contact, friction = part.contact, part.friction
        if getattr(contact, "material", None) is None:
            continue
        pairs = [contact.stiffness(friction.mu_s, friction.mu_m)]
        if isinstance(contact, FractalContact) and contact.stiffness_ratio is not None:
            law = FractalContact(contact.surface, contact.material, contact.P)
            pairs.append(law.stiffness(friction.mu_s, friction.mu_m))
        stiffness[name] = pairs[0]
        mindlin = jnp.asarray(mindlin_ratio(contact.material.nu), pairs[0][0].dtype)
        ends.append(jnp.stack([*(K_t / K_n for K_n, K_t in pairs), mindlin]))
    count = 65 if first.uncoupled else 17  # eigenvalues of a structure take long
    low, high, own_ratio = (
        jnp.stack([of(end) for end in ends]) if ends else jnp.zeros(0)
        for of in (jnp.min, jnp.max, lambda end: end[0])
    )
    shares = jnp.linspace(0.0, 1.0, count if ends else 0, dtype=own_ratio.dtype)
    ratios = low[None] + shares[:, None] * (high - low)[None]

    def at(row):
        contacts = {}
        for (name, (K_n, K_t)), ratio in zip(stiffness.items(), row, strict=True):
            K_t = jnp.where(K_n > 0, ratio * K_n, K_t)
            P = getattr(first.joints_by_name()[name].contact, "P", zero.P)
            contacts[name] = substitute(zero, {"K_n": K_n, "K_t": K_t, "P": P})
        return with_contacts(first, contacts)

    if not needs_modes(first):
        # One closed form for all: each use of it takes long to compile.
        systems = [two_directions(x, friction_slope).polynomial for x in mechanisms]
        own_systems = jax.tree.map(lambda *x: jnp.stack(x), *systems)
        changed = jax.vmap(lambda row: two_directions(at(row), friction_slope).polynomial)(ratios)
        every = jax.tree.map(lambda *x: jnp.concatenate(x), own_systems, changed)
        rates = jax.vmap(rightmost_root)(every).real
        trace = -(systems[0].c_1 + systems[0].c_2)
    else:
        at_ratios = jax.lax.map(lambda row: growth_rate(at(row), friction_slope), ratios)
        rates = jnp.stack([growth_rate(x, friction_slope) for x in mechanisms])
        rates = jnp.concatenate([rates, at_ratios])
        trace = stability(first, friction_slope).eigenvalues.real.sum()
    stiff = [K_n > 0 for K_n, _ in stiffness.values()]
    stiff = jnp.stack(stiff) if stiff else jnp.zeros(0, bool)
    m = len(mechanisms)
    own, in_series, at_ratios = rates[: m - 1], rates[m - 1], rates[m:]
    return _GrowthRates(own, in_series, at_ratios, ratios, own_ratio, stiff, trace)


def _stiffness_ratio_question(
    ratios: np.ndarray, rates: np.ndarray, own_ratio: np.ndarray
) -> Question:
    """The worst growth rate between the K_t/K_n of the joint, the fractal law's and Mindlin's."""
    worst = int(np.argmax(rates))
    name = f"K_t/K_n from {ratios[0].min():.3g} to {ratios[-1].max():.3g}"
    words = f"{growth_text(rates[worst])} at {_extent(ratios[worst])}"
    quiet, undetermined = bool(rates[worst] < 0), bool(np.isnan(rates[worst]))
    return Question(f"K_t/K_n = {_extent(own_ratio)}", name, words, quiet, undetermined)


def _extent(values) -> str:
    """One number, or the ends of many."""
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def _scatter_question(
    x, tolerance, envelope, friction_slope, seed, accepted: float = 0.05
) -> Question:
    """The probability of squeal, quiet below `accepted`."""
    tolerance = Tolerance.of(tolerance)
    probability = squeal_probability(
        x, tolerance, envelope, friction_slope=friction_slope, seed=seed
    )
    names = " and ".join(tolerance.names)
    over = "" if envelope is None else f" over {Envelope.of(envelope)}"
    words = f"squeals with probability {probability.value:.3g} +- {probability.standard_error:.1g}"
    if probability.undetermined:
        words += f", has no sliding equilibrium with {probability.undetermined:.3g}"
    exact = f"{names} without scatter"
    quiet = probability.value + probability.undetermined < accepted
    undetermined = not quiet and probability.value < accepted
    return Question(exact, f"{names} scatter{over}", words, quiet, undetermined)


def _wear_question(depths: tuple[float, float], worn: WornGrowth) -> Question:
    """The worst growth rate while the surfaces run in, and where it begins to squeal."""
    worst = int(np.argmax(worn.rates))
    words = f"{growth_text(worn.rates[worst])} at {worn.depths[worst]:.3g} Sq"
    if worn.onset is not None:
        words += f", squeals from {worn.onset:.3g} Sq on"
    name = f"worn by {depths[0]:g} to {depths[1]:g} Sq"
    quiet, undetermined = bool(worn.rates[worst] < 0), bool(np.isnan(worn.rates[worst]))
    return Question("surfaces without wear", name, words, quiet, undetermined)


class Suggestion(Record):
    """The least change of each quantity that makes a scene quiet, as `suggest` returns it."""

    scene: Scene  # as given
    values: dict[str, float | None]  # by name; None where none inside its bounds does
    bounds: dict[str, tuple[float, float]]  # (lower, upper) by name, inside which was sought

    def __repr__(self) -> str:
        rows = {}
        for name, value in self.values.items():
            value_now, of = float(value_of(self.scene, name)), unit(self.scene, name)
            low, high = self.bounds[name]
            to = f"nothing from {low:.4g} to {high:.4g}" if value is None else f"{value:.6g}"
            rows[f"{name} [{of}]".replace(" [-]", "")] = f"{value_now:.6g} -> {to}"
        return "Quiet by one change:\n" + table([""], [rows])


def suggest(
    scene: Scene,
    bounds: Mapping[str, Sequence[float]] | None = None,
    *,
    target: float | None = None,
    friction_slope: bool = True,
) -> Suggestion:
    """The least change of one quantity at a time that brings the growth rate to `target`.

    What a surface cannot cure, damping, friction or load may. Each is a `design` of its own, with
    its `target`, but without limits on K_n and on the regime of the joint.

    **Arguments:**

    - `scene`: a scene of scalars.
    - `bounds`: {name: (lower, upper)} of quantities in SI units, by default: each damping ratio up
      to 0.5; the friction as a whole down to a hundredth; the smallest friction up to the static
      one, which is the slope, where the law has both; the load and the belt velocity from a
      hundredth to a hundred times.
    - `target`: largest growth rate [1/s], by default that of `design`.
    - `friction_slope`: False leaves the slope of friction out of growth rates.

    **Returns:** a `Suggestion`.

    **Raises:** `ValueError` as `design`.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    if bounds is None:
        bounds = _suggested_bounds(scene)
    values: dict[str, float | None] = {}
    for name, ends in bounds.items():
        best = design(
            scene,
            {name: ends},
            target=target,
            K_n_min=0.0,
            area_ratio_min=1.0,
            slip_ratio_max=1.0,
            friction_slope=friction_slope,
            starts=4,
            progress=False,
        )
        is_quiet = best.result != DesignResult.infeasible
        values[name] = float(value_of(best.scene, name)) if is_quiet else None
    return Suggestion(
        scene, values, {name: (float(a), float(b)) for name, (a, b) in bounds.items()}
    )


def _suggested_bounds(scene: Scene) -> dict[str, tuple[float, float]]:
    factor = 100.0  # the largest change of a scale, up or down
    values = {name: float(value_of(scene, name)) for name in ("xi_1", "xi_2", "mu", "V")}
    bounds = {name: (values[name], max(0.5, 2 * values[name])) for name in ("xi_1", "xi_2")}
    bounds["mu"] = values["mu"] / factor, values["mu"]
    names = quantity_names(scene)
    if {"mu_s", "mu_m"} <= set(names) and scene.friction.mu_m < scene.friction.mu_s:
        bounds["mu_m"] = float(scene.friction.mu_m), float(scene.friction.mu_s)
    for name in ("P", "V"):
        if name in names and (value := float(value_of(scene, name))) > 0:
            bounds[name] = value / factor, value * factor
    return bounds
