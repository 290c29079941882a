"""Check an installation against closed forms and published numbers."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax

from .._base.parts import flag
from .._base.table import aligned
from .check import Check

_TITLES = ["case", "quantity", "published", "ours", "difference", "tolerance", "basis", "result"]


@dataclasses.dataclass(frozen=True, repr=False)
class Validation:
    """Published numbers beside ours, as `validate` returns them; printed as a table."""

    cases: Mapping[str, Sequence[Check]]  # by name, each published number beside ours

    @property
    def agrees(self) -> bool:
        """True if no number differs by more than its tolerance."""
        return all(check.agrees for checks in self.cases.values() for check in checks)

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """The titles and the rows of the table: one for each number."""
        checks = ((name, check) for name, checks in self.cases.items() for check in checks)
        return _TITLES, [[name, *_cells(check)] for name, check in checks]

    def notes(self) -> Iterator[str]:
        """Notes below the table, a line each: misprints, and what ended a case."""
        for name, checks in self.cases.items():
            for check in checks:
                if check.note:
                    yield f"{name}, {check.quantity}: {check.note}"

    def summary(self) -> str:
        """How many numbers agree and differ, in one line."""
        verdicts = [check.agrees for checks in self.cases.values() for check in checks]
        right, wrong, cases = verdicts.count(True), verdicts.count(False), len(self.cases)
        text = (
            f"{right} number{'' if right == 1 else 's'} of {cases} case{'' if cases == 1 else 's'} "
        )
        text += "agrees" if right == 1 else "agree"
        return text + (f", {wrong} {'does' if wrong == 1 else 'do'} not." if wrong else ".")

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
    """Check this installation: numbers with a published or closed form beside ours, in a table.

    The cases are `reference`, stiffness, its slope and onset of squeal of the reference brake;
    `hoffmann`, mode coupling in closed form; and `leine`, a stick-slip limit cycle. Each number has
    a tolerance, from the digits that were printed or the rounding, and a basis: `stated` in the
    article, or a `closed form` that follows from its equations. All cases together take well under
    a minute, nearly all of it compilation. The gallery of published cases is a page of the
    documentation.

    **Arguments:**

    - `cases`: names of cases, by default all.
    - `progress`: shows a bar.

    **Returns:** a `Validation`.

    **Raises:** `ValueError` for an unknown case, and without 64 bits (`jax_enable_x64`).
    """
    from tqdm import tqdm

    from .cases import CASES

    for name in cases:
        if name not in CASES:
            raise ValueError(f"no case {name!r}; the cases are {', '.join(CASES)}")
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError('validate needs 64 bits: jax.config.update("jax_enable_x64", True)')
    chosen, validated = cases or tuple(CASES), {}
    with tqdm(total=len(chosen), unit="case", disable=not flag("progress", progress)) as bar:
        for name in chosen:
            bar.set_description(name)
            validated[name] = computed(CASES[name])
            bar.update()
    return Validation(validated)


def computed(case: Callable[[], Sequence[Check]]) -> Sequence[Check]:
    """The checks of a case; one that fails if no convergence, or no cycle, ends it."""
    try:
        return case()
    except RuntimeError as error:
        # A compiled program's message holds the relevant line of JAX's.
        checked = re.search(r"EquinoxRuntimeError: (.+)", str(error))
        reason = checked[1] if checked else str(error).partition("\n")[0]
        return (Check("all [-]", math.nan, math.nan, 0.0, "-", reason),)


def _cells(check: Check) -> list[str]:
    ends = check.published if isinstance(check.published, tuple) else (check.published,)
    shown = " to ".join(_digits(end, check.tolerance) for end in ends)
    ours = _digits(check.ours, check.tolerance)
    margin = f"{check.tolerance:.1e}" if check.tolerance else "0"
    difference = f"{check.difference:+.1e}" if check.difference else "0"
    verdict = "ok" if check.agrees else "FAILS" if math.isnan(check.ours) else "DIFFERS"
    return [check.quantity, shown, ours, difference, margin, check.basis, verdict]


def _digits(number: float, tolerance: float) -> str:
    """A number with the 4 to 13 digits that its tolerance makes significant."""
    digits = 6
    if tolerance > 0 and number:
        digits = round(math.log10(abs(number) / tolerance)) + 2
    return f"{number:.{min(max(digits, 4), 13)}g}"
