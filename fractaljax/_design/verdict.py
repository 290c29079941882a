"""What a quiet scene rests on: its growth rate under each assumption that a workshop may doubt."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ScalarLike

from .._base.parts import Record, flag, require_kind, require_scalar, scalar, substitute
from .._base.quick import quick_jit
from .._base.table import table
from .._contact.asperity import AsperityContact
from .._contact.contact import Contact
from .._contact.fixed import FixedContact
from .._contact.fractal import FractalContact
from .._contact.persson import PerssonContact, mindlin_ratio
from .._mechanism.quantities import known_quantities, unit, value_of
from .._mechanism.scene import Scene, stiffness
from .._stability.stability import growth_rate, stability
from .design import DesignResult, design
from .envelope import Envelope
from .problem import under
from .quiet import Kicks
from .tolerance import Tolerance, squeal_probability

_WAVES = 100  # of the side of the area, for a law that needs a shortest wavelength
_ACCEPTED = 0.05  # probability of squeal
_RATIOS = 65  # values of K_t/K_n between its ends
_RANGE = 100.0  # a suggestion changes a scale up to so many times, either way
_DAMPING = 0.5  # and a damping ratio up to this


class Question(NamedTuple):
    """One assumption, changed."""

    assumed: str  # in the scene
    name: str  # instead
    found: str  # what was found, in words
    quiet: bool


class Verdict(Record):
    """What a quiet scene rests on, as `verdict` returns it; printed, it is a table."""

    questions: tuple[Question, ...]
    incurable: bool  # whether the slope of the friction feeds in more than all damping takes out
    not_asked: tuple[str, ...] = ()  # what `verdict` would ask with other arguments, in brackets

    @property
    def rests_on(self) -> tuple[str, ...]:
        """The assumptions without which it is not quiet."""
        lost = (question.assumed for question in self.questions[1:] if not question.quiet)
        return tuple(dict.fromkeys(lost))

    @property
    def quiet(self) -> bool:
        """Whether it is quiet in all that was asked."""
        return all(question.quiet for question in self.questions)

    def __repr__(self) -> str:
        columns: list[dict[str, str]] = [
            {question.name: question.found for question in self.questions},
            {
                question.name: "quiet" if question.quiet else "squeals"
                for question in self.questions
            },
        ]
        lines = [table(["growth rate [1/s]", ""], columns)]
        if self.incurable:
            lines.append(
                "No surface cures this: the slope of the friction feeds in more than all damping "
                "takes out. See `suggest`."
            )
        if self.quiet:
            lines.append("Quiet in all that was asked." if self.not_asked else "Quiet in all.")
        elif self.questions[0].quiet:
            lines.append(f"Quiet, but it rests on: {'; '.join(self.rests_on)}.")
        else:
            lines.append("Not quiet.")
        if self.not_asked:
            lines.append(f"Not asked: {', '.join(self.not_asked)}.")
        return "\n".join(lines)


def verdict(
    scene: Scene,
    *,
    area: ScalarLike | None = None,
    laws: Sequence[Contact] = (),
    tolerance: Any = None,
    envelope: Envelope | Mapping[str, Any] | None = None,
    quiet_within: Any = None,
    friction_slope: bool = True,
    seed: int = 0,
    progress: bool = True,
) -> Verdict:
    """Ask of a scene whether it stays quiet where an assumption is another.

    Its growth rate [1/s] as it is; with the load P in the friction, or without it where it is
    there; under every other of the contact `laws`, with its surface, material and load, and by
    `AsperityContact` and `PerssonContact` if the nominal `area` [m^2] is given, with wavelengths
    from its side down to a hundredth of it; and with K_t/K_n between its own, the fractal law's
    and Mindlin's, the worst of 65 values. With a `tolerance` or an `Identification`, and an
    `envelope`, the probability of squeal (see `squeal_probability`), quiet below 5 percent; with
    `quiet_within` (see `design`) the largest kick survived. What no argument asks for is named.

    **Raises:** `ValueError` for a scene that holds arrays, and as those functions.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    flag("friction_slope", friction_slope)
    laws = list(laws)
    for i, law in enumerate(laws):
        require_kind(f"laws[{i}]", law, Contact)
    if area is not None:
        laws += _laws_of(scene, scalar("area", area, above=0))
    own, slope = type(scene.contact).__name__, friction_slope
    questions = [_of("", f"as it is ({own})", scene, slope)]
    if getattr(scene.contact, "P", None) is not None:
        other = Scene(scene.contact, scene.friction, scene.oscillator, not scene.preload)
        force, instead = "friction on K_n x2", "friction on P + K_n x2"
        if scene.preload:
            force, instead = instead, force
        questions.append(_of(force, instead, other, slope))
    for law in laws:
        questions.append(_of(own, f"by {type(law).__name__}", under(scene, law), slope))
    questions += _stiffness_ratios(scene, friction_slope)
    if tolerance is not None:
        questions.append(_scattered(scene, tolerance, envelope, friction_slope, seed))
    if quiet_within is not None:
        kicks = Kicks.of(scene, quiet_within, seed, flag("progress", progress))
        survived, asked = kicks.survived([scene]), kicks.size
        found = f"comes to rest from {survived:.3g} of {asked:.3g}"
        name = f"kicks within {quiet_within}"
        questions.append(Question("smaller kicks", name, found, survived >= asked))
    # The sum of the growth rates is minus the trace of the damping, whatever the stiffness.
    incurable = bool(stability(scene, friction_slope).eigenvalues.real.sum() > 0)
    others = "area" if scene.contact.has_surface else "laws"
    asked = {f"other contact laws ({others})": laws, "scatter (tolerance)": tolerance is not None}
    asked["kicks (quiet_within)"] = quiet_within is not None
    return Verdict(
        tuple(questions), incurable, tuple(name for name, was in asked.items() if not was)
    )


def _of(assumed: str, name: str, scene: Scene, friction_slope: bool) -> Question:
    growth = float(growth_rate(scene, friction_slope))
    found = f"{growth:+.6g}" if np.isfinite(growth) else "no closed equilibrium"
    return Question(assumed, name, found, growth < 0)


def _laws_of(scene: Scene, area) -> tuple[Contact, ...]:
    """The other laws of the surface on a nominal area."""
    contact = scene.contact
    if not contact.has_surface:
        raise ValueError(f"area needs a contact with a surface, got a {type(contact).__name__}")
    L, joint = jnp.sqrt(area), (contact.surface, contact.material, contact.P)
    return AsperityContact(*joint, L / _WAVES), PerssonContact(*joint, area, L, L / _WAVES)


def _stiffness_ratios(scene: Scene, friction_slope: bool) -> Iterator[Question]:
    """The worst growth rate between the scene's own K_t/K_n, the fractal law's and Mindlin's."""
    material = getattr(scene.contact, "material", None)
    if material is None:
        return
    K_n, K_t = stiffness(scene)
    if not K_n > 0:
        return
    own = float(K_t / K_n)
    ends = [own, float(mindlin_ratio(material.nu))]
    if isinstance(scene.contact, FractalContact) and scene.contact.stiffness_ratio is not None:
        contact = scene.contact
        law = FractalContact(contact.surface, contact.material, contact.P)
        K_n, K_t = law.stiffness(scene.friction.mu_s, scene.friction.mu_m)
        ends.append(float(K_t / K_n))
    ratios = np.linspace(min(ends), max(ends), _RATIOS)
    rates = np.asarray(_rates(scene, K_n, jnp.asarray(ratios, K_n.dtype), friction_slope))
    worst = int(np.argmax(rates))
    name = f"K_t/K_n from {ratios[0]:.3g} to {ratios[-1]:.3g}"
    found = f"{rates[worst]:+.6g} at {ratios[worst]:.3g}"
    yield Question(f"K_t/K_n = {own:.3g}", name, found, bool(rates[worst] < 0))


@functools.partial(quick_jit, static_argnames="friction_slope")
def _rates(scene: Scene, K_n, ratios, friction_slope: bool):
    """Growth rates (k,) at ratios (k,) of K_t to K_n."""
    zero = FixedContact(0.0, 0.0, 1.0)

    def at(ratio):
        P = getattr(scene.contact, "P", zero.P)
        known = substitute(zero, {"K_n": K_n, "K_t": ratio * K_n, "P": P})
        return growth_rate(eqx.tree_at(lambda s: s.contact, scene, known), friction_slope)

    return jax.vmap(at)(ratios)


def _scattered(scene, tolerance, envelope, friction_slope, seed) -> Question:
    tolerance = Tolerance.of(tolerance)
    found = squeal_probability(scene, tolerance, envelope, friction_slope=friction_slope, seed=seed)
    names = " and ".join(tolerance.names)
    over = "" if envelope is None else f" over {Envelope.of(envelope)}"
    words = f"squeals with probability {found.value:.3g} +- {found.standard_error:.1g}"
    exact = f"{names} without scatter"
    return Question(exact, f"{names} scatter{over}", words, found.value < _ACCEPTED)


class Suggestion(Record):
    """The least change of each quantity that makes a scene quiet, as `suggest` returns it."""

    scene: Scene
    values: dict[str, float | None]  # by name; None where none inside its bounds does
    bounds: dict[str, tuple[float, float]]

    def __repr__(self) -> str:
        rows = {}
        for name, value in self.values.items():
            own, of = float(value_of(self.scene, name)), unit(self.scene, name)
            low, high = self.bounds[name]
            to = f"nothing from {low:.4g} to {high:.4g}" if value is None else f"{value:.6g}"
            rows[f"{name} [{of}]".replace(" [-]", "")] = f"{own:.6g} -> {to}"
        return "Quiet by one change:\n" + table([""], [rows])


def suggest(
    scene: Scene,
    bounds: Mapping[str, Sequence[float]] | None = None,
    *,
    target: float | None = None,
    friction_slope: bool = True,
) -> Suggestion:
    """The least change of one quantity at a time that brings the growth rate to `target`.

    What a surface cannot cure, damping, friction or load may. `bounds` maps quantities to (lower,
    upper), by default: each damping ratio up to 0.5; the friction as a whole down to a hundredth;
    the smallest friction up to the static one, which is the slope, where the law has both; the load
    and the belt velocity from a hundredth to a hundred times. Each is a `design` of its own, with
    its `target`, but without limits on K_n and on the regime of the joint.

    **Raises:** `ValueError` as `design`.
    """
    require_kind("scene", scene, Scene)
    require_scalar(scene)
    if bounds is None:
        bounds = _suggested(scene)
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
        found = best.result != DesignResult.infeasible
        values[name] = float(value_of(best.scene, name)) if found else None
    return Suggestion(
        scene, values, {name: (float(a), float(b)) for name, (a, b) in bounds.items()}
    )


def _suggested(scene: Scene) -> dict[str, tuple[float, float]]:
    own = {name: float(value_of(scene, name)) for name in ("xi_1", "xi_2", "mu", "V")}
    bounds = {name: (own[name], max(_DAMPING, 2 * own[name])) for name in ("xi_1", "xi_2")}
    bounds["mu"] = own["mu"] / _RANGE, own["mu"]
    known = known_quantities(scene)
    if {"mu_s", "mu_m"} <= set(known) and scene.friction.mu_m < scene.friction.mu_s:
        bounds["mu_m"] = float(scene.friction.mu_m), float(scene.friction.mu_s)
    for name in ("P", "V"):
        if name in known and (value := float(value_of(scene, name))) > 0:
            bounds[name] = value / _RANGE, value * _RANGE
    return bounds
