"""Run published cases and put their numbers beside ours."""

import dataclasses
import functools
import importlib
import math
import re
from collections.abc import Iterator

import jax

from .._base.parts import flag
from .._base.table import aligned
from .case import Case, Check, Panel

_MODULES = ("source", "coupling", "follower", "belts", "rough", "smooth", "finite_elements")
_TITLES = ["case", "quantity", "published", "ours", "difference", "tolerance", "basis", "result"]


@dataclasses.dataclass(frozen=True)
class ValidatedCase:
    """One published case after its run."""

    name: str  # by which `validate` takes it
    title: str  # what is computed
    citation: str  # of the article
    doi: str | None  # of the article
    checks: tuple[Check, ...]  # each published number beside ours
    panels: tuple[Panel, ...] = dataclasses.field(repr=False)  # the curves of its picture
    reason: str = ""  # why it did not run, or what ended it
    failed: bool = False  # True if an error ended it

    @property
    def agrees(self) -> bool:
        """True if no number differs by more than its tolerance, and no error ended the run."""
        return not self.failed and all(check.agrees is not False for check in self.checks)

    def rows(self) -> list[list[str]]:
        """The rows of the table, without the name of the case: one for each number."""
        rows = [_cells(check) for check in self.checks]
        if self.reason:
            dashes = ["-"] * (len(_TITLES) - 3)
            rows.append([self.title, *dashes, "FAILS" if self.failed else "NOT RUN"])
        return rows


@dataclasses.dataclass(frozen=True, repr=False)
class Validation:
    """Published numbers beside ours, as `validate` returns them; printed as a table."""

    cases: dict[str, ValidatedCase]  # by name

    @property
    def agrees(self) -> bool:
        """True if all cases that ran agree with the published numbers."""
        return all(case.agrees for case in self.cases.values())

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """The titles and the rows of the table: one for each number."""
        rows = [[case.name, *row] for case in self.cases.values() for row in case.rows()]
        return _TITLES, rows

    def notes(self) -> Iterator[str]:
        """Notes below the table, a line each: misprints, and why a case did not run."""
        for case in self.cases.values():
            for check in case.checks:
                if check.note:
                    yield f"{case.name}, {check.quantity}: {check.note}"
            if case.reason:
                yield f"{case.name}: {case.reason}"

    def summary(self) -> str:
        """How many checks agree, differ and did not run, in one line."""
        verdicts = [check.agrees for case in self.cases.values() for check in case.checks]
        lacking = sum(bool(case.reason) and not case.failed for case in self.cases.values())
        right, skipped = verdicts.count(True), lacking + verdicts.count(None)
        wrong = verdicts.count(False) + sum(case.failed for case in self.cases.values())
        said = f"{_count(right, 'number')} of {_count(len(self.cases) - lacking, 'case')} agree"
        said += "s" if right == 1 else ""
        said += f", {wrong} {'does' if wrong == 1 else 'do'} not" if wrong else ""
        return said + (f", {skipped} not run." if skipped else ".")

    def __repr__(self) -> str:
        titles, rows = self.rows()
        previous = [""] + [name for name, *_ in rows]
        shown = [
            ["" if row[0] == above else row[0], *row[1:]]
            for row, above in zip(rows, previous, strict=False)
        ]
        notes = [f"- {note}" for note in self.notes()]
        return "\n".join([aligned([titles, *shown]), *notes, self.summary()])


def validate(*cases: str, progress: bool = True) -> Validation:
    """Compute published results, and compare the numbers in a table.

    Each number has a tolerance, from the digits that were printed or the order of an approximation,
    and a basis: `stated` in the article, a `closed form` that follows from its equations, the
    solution of its equations by `SciPy`, or `corrected` where the article is wrong, with a note
    that says how. SI units unless the quantity names another. A case without its data says so and
    is not counted. The 4669-degree-of-freedom brake needs the folder of its matrices, in the
    environment variable FRACTALJAX_BRAKE. All cases together take about three minutes.

    `plot.validation(case)` draws our curves over theirs.

    **Arguments:**

    - `cases`: names of published cases, by default all.
    - `progress`: shows a bar.

    **Returns:** a `Validation`.

    **Raises:** `ValueError` for an unknown case, and without 64 bits (`jax_enable_x64`).
    """
    from tqdm import tqdm

    chosen = [case_named(name) for name in cases] or list(case_names().values())
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError('validate needs 64 bits: jax.config.update("jax_enable_x64", True)')
    validated = {}
    with tqdm(total=len(chosen), unit="case", disable=not flag("progress", progress)) as bar:
        for case in chosen:
            bar.set_description(case.name)
            validated[case.name] = _run(case)
            bar.update()
    return Validation(validated)


@functools.cache
def case_names() -> dict[str, Case]:
    """All published cases by name, in the order of the gallery."""
    modules = (importlib.import_module(f"{__package__}.{name}") for name in _MODULES)
    return {case.name: case for module in modules for case in module.CASES}


def case_named(name: str) -> Case:
    """The case with this name.

    **Raises:** `ValueError` for an unknown name.
    """
    published = case_names()
    if name not in published:
        raise ValueError(f"no case {name!r}; the cases are {', '.join(published)}")
    return published[name]


def _run(case: Case) -> ValidatedCase:
    head = case.name, case.title, case.citation, case.doi
    if reason := case.missing():
        return ValidatedCase(*head, (), (), f"not run: {reason}")
    try:
        checks, panels = case.run()
    except RuntimeError as error:  # no convergence, or no cycle
        return ValidatedCase(*head, (), (), _reason(error), failed=True)
    return ValidatedCase(*head, tuple(checks), tuple(panels))


def _reason(error: RuntimeError) -> str:
    """The message of an error; the relevant line of JAX's if a compiled program raised it."""
    checked = re.search(r"EquinoxRuntimeError: (.+)", str(error))
    return checked[1] if checked else str(error).partition("\n")[0]


def _cells(check: Check) -> list[str]:
    published = check.published
    if isinstance(published, tuple):
        shown = " to ".join(_digits(end, check.tolerance) for end in published)
    else:
        shown = _digits(published, check.tolerance)
    if check.ours is None or check.difference is None:
        return [check.quantity, shown, "-", "-", "-", check.basis, "NOT RUN"]
    ours = _digits(check.ours, check.tolerance)
    margin = f"{check.tolerance:.1e}" if check.tolerance else "0"
    difference = f"{check.difference:+.1e}" if check.difference else "0"
    return [check.quantity, shown, ours, difference, margin, check.basis, _VERDICTS[check.agrees]]


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


_VERDICTS = {True: "ok", False: "DIFFERS", None: "NOT RUN"}


def _digits(number: float, tolerance: float) -> str:
    """A number with the 4 to 13 digits that its tolerance makes significant."""
    digits = 6
    if tolerance > 0 and number:
        digits = round(math.log10(abs(number) / tolerance)) + 2
    return f"{number:.{min(max(digits, 4), 13)}g}"
