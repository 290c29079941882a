"""The best scene or structure inside bounds that is stable against small disturbances.

Many designs are screened by one compiled program. From the best of distinct basins a solver
minimises the objective under the constraints, and the best of all ends that meet every requirement,
evaluated afresh, is the answer (`search.py`). `statement.py` checks what a user requires, and
`problem.py` evaluates it.
"""

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import ScalarLike

from .._base import html
from .._base.files import write_together
from .._base.parts import Record, brief, flag, require_kind, whole
from .._base.table import table
from .._contact.contact import Contact
from .._contact.persson import PerssonContact
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import meaning, replaced, unit, value_of
from .._stability.stability import growth_rate, require_computable
from .._stability.summary import stiffness_remarks
from .._surface.roughness import Roughness, roughness
from .._surface.spectrum import Spectrum
from .._surface.surface import Surface
from .._surface.topography import Topographies, topography
from . import constraints as limits
from .descent import descend, select_distinct
from .design_file import STATED, design_files, read_design
from .design_search import DesignSearch
from .drawing import Drawing, compare_drawings
from .envelope import Envelope, condition_text
from .evaluator import Evaluation, make_evaluator
from .few_modes import project_on_modes
from .joints import joint_surfaces, joint_with_surface
from .limit import LeastGrowth, least_growth
from .problem import DesignProblem
from .quiet import Kicks, quiet
from .result import DesignResult
from .rows import describe
from .search import Search, SearchResult
from .sensitivity import Sensitivity, design_sensitivity
from .solvers import Solver, slsqp
from .starts import choose_starts, draw_designs, spread_designs
from .statement import DEFAULT_BOUNDS
from .summary import NO_EQUILIBRIUM, comparison_table, growth_text
from .tolerance import Tolerance, squeal_probability


class Design(Record):
    """What `design` returns; numbers in SI units, arrays as NumPy. Printed, it is a table."""

    scene: Any  # the designed scene or structure; if infeasible, the best one found
    initial: Any  # the given scene or structure
    value: float  # the objective at `scene`: by default d^2, the squared scaled distance
    growth_rate: float  # [1/s], of `scene` itself
    active: tuple[str, ...]  # requirements met with nothing to spare
    violated: tuple[str, ...]  # requirements not met, none unless infeasible
    result: DesignResult  # a member of DesignResult
    history: Mapping[str, np.ndarray]  # one row an evaluation on the path to `scene`, as it is
    bounds: Mapping[str, tuple[float, float]]  # (lower, upper) by name
    target: float  # largest growth rate allowed [1/s]
    K_n_min: float  # least normal stiffness allowed [N/m], of the stiffest joint
    friction_slope: bool  # True if growth rates count the slope of friction
    starts: int  # designs that the solver started from, 0 if unchanged
    failed_starts: int  # how many of them ended without meeting every requirement
    options: Mapping[str, Any]  # the arguments of `design`, for another run
    growth_rates: tuple[float, float] | None = None  # as required, before and after [1/s]
    worst: Mapping[str, float] | None = None  # condition of the most pressing requirement
    worst_of: Mapping[str, Mapping[str, float]] | None = None  # of every requirement
    squeal_probability: float | None = None  # as machined
    squeal_probability_error: float | None = None  # its standard error
    initial_squeal_probability: float | None = None  # as given
    # Share of the draws without a sliding equilibrium, neither quiet nor squealing.
    undetermined: float | None = None
    initial_undetermined: float | None = None  # as given
    # What is asked of the limit cycle, before and after; 0 at rest.
    cycles: Mapping[str, tuple[float, float]] | None = None
    quiet_radius: float | None = None  # the largest kick survived, as `quiet_within` measures it
    least_growth: LeastGrowth | None = None  # where the target is out of reach

    @property
    def outcome(self) -> str:
        """The result in words."""
        return DesignResult[self.result]

    @functools.cached_property
    def sensitivity(self) -> Sensitivity | None:
        """How the design moves with each quantity that is held fixed, and what its limits cost.

        `sensitivity["D"]["P"]` is dD/dP. None where it cannot be told: without a design, with
        limits on cycles or on kicks, at a kink, and where the worst condition is inside an
        envelope. For a structure it takes several evaluations a quantity.
        """
        cycles = [self.options["objective"], *self.options["constraints"]]
        is_plain = self.options["quiet_within"] is None and self.result != DesignResult.infeasible
        if not is_plain or any(isinstance(each, limits.CycleConstraint) for each in cycles):
            return None
        problem = state_problem(self.initial, self.options)
        modes = problem.modes or None
        state = functools.partial(state_problem, options=self.options, modes=modes)
        evaluator = make_evaluator(problem, self.options["envelope"], self.options["risk"])
        return design_sensitivity(self.initial, self.scene, state, evaluator)

    @property
    def has_surface(self) -> bool:
        """True for a scene with a fractal surface."""
        joint = self.scene.sole_joint
        return joint is not None and joint.contact.has_surface

    @property
    def wavelengths(self) -> tuple[float, float]:
        """Longest and shortest [m] that roughness counts.

        They are those of a limit on Sq, or of the contact law, or 1 mm and 1 um.
        """
        for constraint in self.options["constraints"]:
            if isinstance(constraint, limits.Roughness):
                return float(constraint.L), float(constraint.L_s)
        joint = self.scene.sole_joint
        contact: Any = None if joint is None else joint.contact
        if isinstance(contact, PerssonContact) and contact.L is not None:
            band: Any = contact.L, contact.L_s
            return float(band[0]), float(band[1])
        return 1e-3, 1e-6

    def roughness(
        self, L: ScalarLike | None = None, L_s: ScalarLike | None = None
    ) -> tuple[Roughness, Roughness]:
        """Sq [m], Sa [m] and Sdq of the given and of the designed surface, as `roughness` says.

        **Arguments:**

        - `L`, `L_s`: longest and shortest wavelength [m] of a `Surface`, by default those of
          `wavelengths`; the other spectra have their own.
        """
        before, after = self._surfaces()
        if isinstance(before, Surface):
            longest, shortest = self.wavelengths
            L, L_s = longest if L is None else L, shortest if L_s is None else L_s
        return roughness(before, L, L_s), roughness(after, L, L_s)

    def drawing(
        self,
        cutoff: ScalarLike = 8e-4,
        shortest: ScalarLike = 2.5e-6,
        *,
        joint: str | None = None,
    ) -> Drawing:
        """Ra, Rz [m] of a profile, Sq [m] and Sdq of a map, of both surfaces behind the filters.

        They are those to expect of the spectrum, as `profile_parameters` says, and printed are a
        table. The waves of a `Surface` are those of `wavelengths`. `quiet_Ra` is the interval of Ra
        around the design, from a tenth to ten times, within which the growth rate stays below 0
        while all heights change in proportion, without tolerance and envelope.

        **Arguments:**

        - `cutoff`, `shortest`: nesting indices of the filters [m], 0.8 mm and 2.5 um by default.
        - `joint`: name of the joint of a structure; by default the only one with a surface.

        **Raises:** as `profile_parameters`; `ValueError` without a surface, or with several.
        """
        name, before = joint_with_surface(self.initial, joint, "a drawing")
        _, after = joint_with_surface(self.scene, name, "a drawing")
        bands = cutoff, shortest, self.wavelengths
        return compare_drawings(self.scene, name, before, after, *bands, self.friction_slope)

    def topographies(self, n: int = 1024, *, L=None, L_s=None, M=10, key=None) -> Topographies:
        """Both surfaces on a grid of n x n points with the same phases, to see the difference.

        **Arguments:**

        - `n`: points along each side, 1024 by default.
        - `L`, `L_s`: side of the square, which is the longest wavelength of a `Surface`, and the
          shortest one of a `Surface` [m]: by default those of `wavelengths`, but L_s no less than
          2 L/n.
        - `M`: directions of waves of a `Surface`, as in `topography`; 10 by default.
        - `key`: JAX random key of the phases, by default that of the design's seed.

        **Raises:** as `topography`.
        """
        surfaces, (longest, shortest) = self._surfaces(), self.wavelengths
        L = longest if L is None else L
        key = jax.random.key(self.options["seed"]) if key is None else key
        if isinstance(surfaces[0], Surface) and L_s is None and 2 * L / n < shortest:
            L_s = shortest
        before, after = (
            np.asarray(topography(surface, L, n, key=key, L_s=L_s, M=M)) for surface in surfaces
        )
        return Topographies(before, after, float(L) / n)

    def _spectra(self) -> tuple[Spectrum, Spectrum] | None:
        contacts = (getattr(x, "contact", None) for x in (self.initial, self.scene))
        before, after = (getattr(contact, "surface", None) for contact in contacts)
        if isinstance(before, Spectrum) and isinstance(after, Spectrum):
            return before, after
        return None

    def _surfaces(self) -> tuple[Spectrum, Spectrum]:
        spectra = self._spectra()
        if spectra is None:
            raise ValueError("roughness and topographies need a scene whose contact has a surface")
        return spectra

    def save(self, path: str | os.PathLike) -> None:
        """Write scenes, options, results and history to the TOML file `path`, for `repeat_design`.

        A structure, given and designed, has files of its own beside it: all are written or none.

        **Raises:** `OSError` if a file cannot be written.
        """
        write_together(design_files(self, Path(path)))

    def _repr_html_(self) -> str:
        rows: list[html.Row] = [("outcome", self.outcome, "", "")]
        for name, ends in self.bounds.items():
            before, after = (float(value_of(x, name)) for x in (self.initial, self.scene))
            low, high = ends
            words = f"{meaning(self.scene, name)}, from {low:g} to {high:g}"
            rows.append((name, f"{before:.6g} -> {after:.6g}", unit(self.scene, name), words))
        aside = {"scene", "initial", "bounds", "result", "history", "options"}
        names = [name for name in self._table_names() if name not in aside]
        return html.table("fractaljax.Design", rows + html.record_rows(self, names))

    def __repr__(self) -> str:
        shown = self.initial, self.scene, self.friction_slope, self.active, self.wavelengths
        before, after = [], stiffness_remarks(self.scene)
        if self.scene is not self.initial:
            column = "The column {}".format
            before = stiffness_remarks(self.initial, " as given", follows=column("before"))
            after = stiffness_remarks(self.scene, " as designed", follows=column("after"))
        lines = [*before, *after, comparison_table(*shown, designed=tuple(self.bounds))]
        if self.has_surface:
            L, L_s = self.wavelengths
            lines.append(f"Sq and Sdq: wavelengths from {L:g} to {L_s:g} m")
        elif self._spectra() is not None:
            lines += ["", *repr(self.drawing()).splitlines(), ""]
        else:
            lines += self._drawing_lines()
        for name, (before, after) in (self.cycles or {}).items():
            lines.append(f"{name}: {before:.6g}, then {after:.6g}")
        lines += self._condition_lines() + self._kick_lines()
        changed = self.scene.sole_joint is not None and self.result == DesignResult.found
        if changed and self.sensitivity is not None:
            lines += ["", "What this design hangs on:", repr(self.sensitivity), ""]
        lines += [f"not met: {name}" for name in self.violated]
        if self.least_growth is not None:
            lines += ["", *str(self.least_growth).splitlines(), ""]
        growth = self.growth_rate if self.growth_rates is None else self.growth_rates[1]
        promise = "not stable: small disturbances grow"
        if not np.isfinite(growth):
            promise = f"undetermined: {NO_EQUILIBRIUM}"
        elif growth < 0:
            promise = "stable against small disturbances; a larger kick may still end in squeal"
            promise = "no promise: see above" if after else promise
        return "\n".join([*lines, self.outcome, promise])

    def _drawing_lines(self) -> list[str]:
        """Which joints of a structure have a drawing, which takes many eigenvalue solutions."""
        moved = {name.rpartition(".")[0] for name in self.bounds}
        return [
            f'drawing(joint="{name}") gives Ra, Rz and where the design stays quiet'
            for name in joint_surfaces(self.scene)
            if name in moved
        ]

    def _kick_lines(self) -> list[str]:
        """The largest kick survived, and the confidence in it."""
        if not self.quiet_radius:
            return [] if self.quiet_radius is None else ["largest kick survived: none"]
        ellipsoid = isinstance(self.options["quiet_within"], list)
        unit = "of the ellipsoid" if ellipsoid else "in units of V/omega and V"
        count = self.options["search"].kick_starts[-1]
        share = f"share below {3 / count:.2g} with 95 % confidence"
        where = " " if self.options["envelope"] is None else ", shared by the worst conditions, "
        return [
            f"largest kick survived: {self.quiet_radius:.6g} {unit}",
            f"none of {count} starts within it{where}ends anywhere but at rest ({share})",
        ]

    def _condition_lines(self) -> list[str]:
        """The results over the envelope and the tolerance, before and after, and the worst."""
        if self.growth_rates is None:
            return []
        envelope, tolerance = self.options["envelope"], self.options["tolerance"]
        words, rows = [], [{}, {}]
        if envelope is not None:
            words.append(f"over {envelope}")
        if tolerance is not None:
            sigmas = tolerance.standard_deviations.items()
            words.append("where " + ", ".join(f"{n} scatters by {s:g}" for n, s in sigmas))
        for row, growth in zip(rows, self.growth_rates, strict=True):
            row["growth rate as required [1/s]"] = growth_text(growth)
        if self.squeal_probability is not None:
            error = f" +- {self.squeal_probability_error:.1g}"
            rows[0]["probability of squeal"] = f"{self.initial_squeal_probability:.3g}"
            rows[1]["probability of squeal"] = f"{self.squeal_probability:.3g}{error}"
        if self.undetermined or self.initial_undetermined:
            shares = self.initial_undetermined, self.undetermined
            for row, share in zip(rows, shares, strict=True):
                row["undetermined: no sliding equilibrium"] = f"{share:.3g}"
        lines = ["", "; ".join(words), table(["before", "after"], rows)]
        if self.worst is not None:
            lines.append(f"worst at {condition_text(self.worst)}")
        return lines


def design(
    x: Mechanism,
    bounds: Mapping[str, Sequence[float]] | None = None,
    objective: Callable[[Any], Any] | None = None,
    target: float | None = None,
    K_n_min: float | None = None,
    constraints: Sequence[Callable[[Any], Any]] = (),
    *,
    laws: Sequence[Contact] = (),
    envelope: Envelope | Mapping[str, Any] | None = None,
    risk: str | tuple[str, float] = "worst",
    tolerance: Any = None,
    quantile: float = 0.95,
    area_ratio_min: float = 2.0,
    slip_ratio_max: float = 0.9,
    friction_slope: bool = True,
    optimiser: Any = None,
    solver: Solver | None = None,
    starts: int | None = None,
    lattice: int | None = None,
    seed: int = 0,
    quiet_within: Any = None,
    search: DesignSearch = DesignSearch(),
    progress: bool = True,
) -> Design:
    """Find by gradients the scene or structure inside `bounds` that is best and meets all that is
    required of it.

    A design is required to have: a growth rate of at most `target`; every function in `constraints`
    at most 0; and, of every fractal contact whose stiffness the bounds move, K_n >= `K_n_min`, a_l
    >= `area_ratio_min` a_e and, without a given stiffness ratio, Q_e <= `slip_ratio_max` mu_s P.
    The growth rate is that of small disturbances: a larger kick may still end in a limit cycle.
    For a structure the growth rate, as objective and as requirement, is that of each of its modes
    which may grow: those with the largest real parts, two more than grow in any of a few designs.
    The largest alone has kinks where modes change places. `reduce` a structure of more than about
    a hundred degrees of freedom first, over the bounds.

    **What is asked:**

    - `x`: a `Scene` or a `Structure`.
    - `bounds`: {name: (lower, upper)} of any named quantities in SI units: D, G, P, mu_s, omega_1,
      "K_t/K_n" and so on of a scene, "left.D", or "D" for all joints that have one, of a structure;
      by default D from 2.1 to 2.9 and G from 1e-12 to 1e-8 m. Scales, such as G, P and stiffness,
      are moved in logarithms.
    - `objective`: a function of a mechanism that `jax` can differentiate, which is minimised; by
      default the distance from the given quantities, the sum of (dq/(q_hi - q_lo))^2, with ln q for
      scales. `constraints.CycleAmplitude` and `VelocityLevel` without a limit are objectives, too.
    - `target`: the largest growth rate allowed [1/s]; by default minus half the least damping rate
      without friction (min xi_i omega_i of a scene).
    - `K_n_min`: the least normal stiffness [N/m]; by default that of each contact as given.
    - `constraints`: functions of a mechanism, at most 0 where met and of order one, as those of
      `fractaljax.constraints` are. Those of a limit cycle are of the cycle of the given design that
      `limit_cycle` finds, which is followed from design to design, from the given one alone if
      `starts` is not given. Such a cycle may need a larger `target`: where it is negative only
      cycles beside a stable equilibrium are left. Where the cycle ends it leaves silence or another
      cycle behind, suddenly, so that no slope leads there. They take no envelope and no tolerance.
    - `laws`: other contact laws, under each of which the growth rate must be as low, in the place
      of the scene's own, or of those of all joints of a structure whose contacts have a surface:
      with their own quantities, but with its surface, material and load where they have them.
    - `envelope`: ranges (lower, upper) or samples of any quantities by name (see `Envelope`), over
      all of which every requirement holds and the objective is taken.
    - `risk`: how it is taken over an envelope: "worst", at the worst; "smooth" or ("smooth", T), a
      log-sum-exp of temperature T that is at least the worst; ("cvar", alpha), the mean of the
      worst 1 - alpha of all conditions.
    - `tolerance`, `quantile`: standard deviations {"D": ..., "ln G": ...} of any quantities, a
      `Tolerance` with their covariance, or an `Identification`; every requirement holds, and the
      objective is taken, at this quantile, 0.95 by default, at each condition of the envelope by
      itself. "D" of a structure scatters by the same amount in all joints, also where each is
      designed by itself. The probability of squeal counts draws by `seed` (see
      `squeal_probability`), each at a condition drawn evenly from the envelope.
    - `area_ratio_min`, `slip_ratio_max`: 2 and 0.9 by default.
    - `friction_slope`: False leaves the slope of friction out of growth rates.
    - `quiet_within`: the `radius` of `basin`, in units of V/omega and V, or the semi-axes (2n,) of
      an ellipsoid in m and m/s. No start within it of the sliding equilibrium ends anywhere else,
      as 4000 starts drawn by `seed` confirm (`search.kick_starts`); `Design.quiet_radius` is the
      largest radius, or share of the semi-axes, so confirmed. Motions follow the whole friction law
      whatever `friction_slope`. It needs a V of every joint and takes no tolerance: whether a start
      comes to rest has no quantile. Under an envelope the starts are shared by its middle, up to
      four corners and the worst conditions of the requirements, each in its own V/omega and V.

    **How it is solved:**

    - `starts`: how many designs the solver starts from; by default 12, 8 for a structure, 32 for
      one of more than two joints. They are the given design, the most promising of those screened,
      and an even spread; for more than two joints they are drawn around the given design.
    - `lattice`: how many designs a side are screened, 48, or 24 for a structure, with an envelope
      or a tolerance; 1024 or 256 in one variable; lattice^2 designs of a low-discrepancy set in
      more than two variables.
    - `optimiser`: any `optax.GradientTransformation`, such as
      `optax.adam(optax.cosine_decay_schedule(0.03, 100))`. All starts first descend by it side by
      side for 100 steps (`search.descent_steps`), on scaled variables and an exact penalty of what
      is unmet; the solver starts from the distinct best of their ends. By default there is no
      descent.
    - `solver`: a function `solver(objective, constraints, start, bounds)`; by default SciPy's SLSQP
      (see `slsqp`). For more than two joints steps in a trust region keep to the limits of every
      joint instead, the eight best of their ends go on, and rounds of more starts near the best
      follow until they cease to gain. With 60 degrees of freedom or more all that is in the space
      of the modes that grow most, and the best end in all degrees of freedom.
    - `seed`: of all that is drawn. The same arguments give the same design.
    - `search`: a `DesignSearch`, which says how thorough all this is.
    - `progress`: shows a bar.

    A request that cannot be met is a result, not an error: see `Design.result`. Then
    `Design.least_growth` is the least growth rate that was found with all else met, where, what
    holds it there, and how many starts agree; or, if that cannot be met either, what of it and why.

    **Raises:** `ValueError` for bounds on what `x` lacks, empty, inverted or without its own value,
    for an envelope of what it lacks or the design moves, and for options outside their domain.
    """
    options = {name: value for name, value in locals().items() if name not in ("x", "progress")}
    options["bounds"] = DEFAULT_BOUNDS if bounds is None else bounds
    options["envelope"] = envelope = None if envelope is None else Envelope.of(envelope)
    options["tolerance"] = None if tolerance is None else Tolerance.of(tolerance)
    progress = flag("progress", progress)
    if optimiser is not None and not callable(getattr(optimiser, "update", None)):
        raise TypeError(
            "optimiser must be an optax.GradientTransformation, such as optax.adam(0.03), got "
            + brief(optimiser)
        )
    if solver is not None and not callable(solver):
        raise TypeError(f"solver must be a function, got {brief(solver)}")
    whole("seed", seed, 0, 2**63 - 1)  # those of a JAX key
    require_kind("search", search, DesignSearch)
    problem = state_problem(x, options)
    options["bounds"] = dict(options["bounds"])
    kicks = None
    if quiet_within is not None:
        if tolerance is not None:
            raise ValueError(
                "quiet_within takes no tolerance: a start comes to rest or not, which has no "
                "quantile; give what scatters as an envelope"
            )
        kicks = Kicks.of(x, quiet_within, seed, progress, search.kick_starts)
        options["quiet_within"] = kicks.within
    evaluator = make_evaluator(problem, envelope, risk)
    count, designs = designs_to_screen(problem, starts, lattice)
    start = np.asarray(problem.start, float)
    before = evaluator.evaluate(start[None])
    if not np.isfinite(before.rows).all():
        require_computable(x, problem.friction_slope)

    def solve(problem):
        evaluator = make_evaluator(problem, envelope, risk)
        us, scale = choose_starts(start, designs, evaluator.screen(designs), count)
        if problem.cycles is not None:
            scale = abs(float(before.values[0])) or 1.0
        landing = solver or default_solver(problem)
        rough = None if landing else project_on_modes(problem, us)
        scale = 1.0 if objective is None else scale
        searching = Search(evaluator, landing, scale, rough, search)
        if optimiser is not None:
            limited, steps = problem.limited, search.descent_steps
            ends, merit = descend(evaluator, us, optimiser, limited, scale, steps)
            us = select_distinct(ends, merit, search.descent_ends)
        path, after, failed, lowest = searching.best(us, progress)
        limit = None if lowest is None else least_growth(searching, *lowest)
        return SearchResult(path, after, len(us), failed, limit)

    if objective is None and before.worst[0] <= 0:
        best = SearchResult(start[None], before, 0, 0)
    else:
        best = solve(problem)
    if kicks is None:
        return _conclude(x, problem, options, before, best)
    best, survived = quiet(problem, best, solve, kicks, envelope, search)
    best = best._replace(evaluation=evaluator.evaluate(best.path[-1:]))  # without cuts
    return _conclude(x, problem, options, before, best, survived)


def state_problem(
    x: Mechanism, options: Mapping[str, Any], modes: int | None = None
) -> DesignProblem:
    """The problem that options of `design` state; of a structure perhaps of so many modes."""
    problem = DesignProblem(x, **{name: options[name] for name in STATED}, modes=modes)
    # An average of smooth residuals over conditions is not that of the growth rates.
    smooth = problem.smooth and (problem.least_growth or options["risk"] == "worst")
    return problem.with_fields(smooth=smooth)


def designs_to_screen(
    problem: DesignProblem, starts: int | None, lattice: int | None
) -> tuple[int, np.ndarray]:
    """How many designs to start from, and those (n, v) to choose them from."""
    variables = len(problem.names)
    sides, sized = min(variables, 2), lattice is not None
    if lattice is None:
        takes_long = problem.robust or problem.modes > 0
        lattice = (256 if takes_long else 1024) if sides == 1 else (24 if takes_long else 48)
    lattice = whole("lattice", lattice, 1, 10 ** (6 // sides))  # memory holds a million
    count = lattice**sides
    if starts is None:
        starts = min(_default_starts(problem), count)
    starts = whole("starts", starts, 1, 10_000)
    if starts > count:
        raise ValueError(f"starts must be at most the {count} of the lattice, got {starts}")
    if not problem.has_many_joints:
        return starts, spread_designs(lattice, variables)
    drawn = count if sized else max(1, starts - 1)
    # Near the given design more is met, and an objective is often that of few changes.
    shares = (0.1, 0.2, 0.6) if problem.objective is None else (0.2, 0.6, 1.0)
    return starts, draw_designs(problem, np.asarray(problem.start, float), drawn, shares, 0)


def _default_starts(problem: DesignProblem) -> int:
    """The number of starts unless it is given."""
    if problem.cycles is not None:
        return 1  # the cycle is that of the given design
    if problem.has_many_joints:
        return 32  # of which few are continued
    return 8 if problem.modes else 12


def default_solver(problem: DesignProblem) -> Solver | None:
    """The solver unless one is given; None stands for steps in a trust region."""
    return None if problem.has_many_joints else slsqp


def _conclude(
    x: Mechanism,
    problem: DesignProblem,
    options: Mapping[str, Any],
    before: Evaluation,
    end: SearchResult,
    quiet_radius: float | None = None,
) -> Design:
    """How every requirement stands at the end of the path; unchanged without a start."""
    path, after, starts, failed, limit = end
    final, history = x, describe(problem, path)
    if starts:
        dtype = problem.low.dtype
        final = replaced(x, {name: np.asarray(history[name][-1], dtype) for name in problem.names})
    names, envelope, tolerance = (problem.residual_names, options["envelope"], options["tolerance"])
    residuals = dict(zip(names, after.residuals[0].tolist(), strict=True))
    for name, place in zip(problem.names, path[-1].tolist(), strict=True):
        residuals |= {f"{name} >= lower bound": -place, f"{name} <= upper bound": place - 1}
    violated = tuple(name for name, residual in residuals.items() if not residual <= 0)
    kick_size = options["quiet_within"]
    least = 1 if isinstance(kick_size, list) else kick_size
    if quiet_radius is not None and quiet_radius < least:
        violated += (f"quiet within {kick_size}",)
    active = max(1e-4, 100 * problem.rounding)
    more: dict[str, Any] = {}
    if envelope is not None or tolerance is not None:
        i = names.index("growth_rate <= target")
        more["growth_rates"] = tuple(
            float(problem.target + problem.growth_scale * np.sinh(evaluation.residuals[0, i]))
            for evaluation in (before, after)
        )
    if envelope is not None:
        at = [envelope.condition(place) for place in after.places[0, 1:]]
        more["worst_of"] = dict(zip(names, at, strict=True))
        more["worst"] = at[int(np.argmax(after.residuals[0]))]
    if tolerance is not None:
        draw = dict(friction_slope=problem.friction_slope, seed=options["seed"])
        first, last = (squeal_probability(s, tolerance, envelope, **draw) for s in (x, final))
        more["initial_squeal_probability"] = first.value
        more |= {"initial_undetermined": first.undetermined, "undetermined": last.undetermined}
        more |= {"squeal_probability": last.value, "squeal_probability_error": last.standard_error}
    if problem.cycles is not None:
        more["cycles"] = problem.cycles.ends(problem, path[-1])
    result = DesignResult.found if starts else DesignResult.unchanged
    return Design(
        scene=final,
        initial=x,
        value=float(after.values[0]),
        growth_rate=float(growth_rate(final, problem.friction_slope)),
        active=tuple(name for name, r in residuals.items() if -active <= r <= 0),
        violated=violated,
        result=DesignResult.infeasible if violated else result,
        history=history,
        bounds={name: (float(low), float(high)) for name, (low, high) in options["bounds"].items()},
        target=float(problem.target),
        K_n_min=max(map(float, problem.K_n_min), default=0.0),
        friction_slope=problem.friction_slope,
        starts=starts,
        failed_starts=failed,
        options=options,
        quiet_radius=quiet_radius,
        least_growth=limit,
        **more,
    )


def repeat_design(
    path: str | os.PathLike,
    functions: Mapping[str, Any] | None = None,
    *,
    progress: bool = True,
) -> Design:
    """Run again what a file of `Design.save` holds: with the same versions, to the last bit.

    A file of other versions is run under a warning.

    **Arguments:**

    - `path`: the TOML file.
    - `functions`: {name: function} of the user's own, an objective, constraints or a solver, which
      are in the file by name only; an optimiser of optax, which has no name, as {"optimiser":
      optimiser}. By default there are none.
    - `progress`: shows a bar.

    **Returns:** a `Design`.

    **Raises:** `OSError` if the file cannot be read; `ValueError` naming the file for anything
    unknown or missing in it, and for a precision that JAX is not set to.
    """
    x, options = read_design(path, functions)
    return design(x, **options, progress=progress)
