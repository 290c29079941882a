"""Run the published cases and write validation.md with its pictures.

`FRACTALJAX_BRAKE=FOLDER python docs/make_validation.py`, with the folder of the brake's matrices.
"""

from pathlib import Path

import jax
import matplotlib as mpl
from writing import run, small_png, table

import fractaljax as fj

PAGE = Path(__file__).with_name("validation.md")

INTRODUCTION = """\
# Validation

What others published, computed again: our curve over theirs, number beside number.

    fractaljax validate                             # all of it: exit status 1 if a number differs
    fractaljax validate leine thomsen --out gallery # two cases, with their pictures

In Python it is `fj.validate("leine")`. The tolerance comes from the digits that were printed, the
order of an approximation, or the grid. The basis says where a published number is from:

- **stated**: it is printed in the article.
- **closed form**: it follows from the article's equations by hand.
- **SciPy**: SciPy's solution of the article's equations, which shares no code with ours.
- **corrected**: what the article states is wrong. The note says how; the number beside ours is a
  closed form or SciPy's.

The last column is the difference in percent of the tolerance; of a range, whether it is met.

"""

CLOSING = """\
Of the source's Figs. 7 to 10 [a page of its own](figures_7_to_10.md) checks every claim, and
[another](contact_laws.md) has contact laws beside boundary elements.

Written by `python docs/make_validation.py`.
"""


def rows(case: fj.ValidatedCase) -> list[list[str]]:
    """The rows of a case's table."""
    found = []
    for quantity, published, ours, _, tolerance, basis, result in case.rows():
        check = next(check for check in case.checks if check.quantity == quantity)
        used = result
        if result == "ok":
            share = abs(check.difference or 0.0) / check.tolerance if check.tolerance else 0.0
            used = f"{share:.0%}" if check.tolerance else "within"
        found.append([quantity, published, ours, tolerance, basis, used])
    return found


def picture_of(name: str) -> Path:
    """Where the picture of a case is."""
    return PAGE.with_name(f"validation_{name}.png")


def section(case: fj.ValidatedCase) -> str:
    """The part of the page on one case."""
    source = case.citation
    if case.doi is not None:
        source += f", [doi:{case.doi}](https://doi.org/{case.doi})"
    head = ["quantity", "published", "ours", "tolerance", "basis", "difference"]
    lines = [f"## {case.title}", "", f"`{case.name}`: {source}.", "", *table(head, rows(case)), ""]
    notes = [f"- {check.quantity}: {check.note}." for check in case.checks if check.note]
    lines += [*notes, ""] if notes else []
    return "\n".join(
        [*lines, f"![{case.title}: ours over theirs]({picture_of(case.name).name})", ""]
    )


def page(found: fj.Validation) -> str:
    """The text of validation.md."""
    return INTRODUCTION + "\n".join([*map(section, found.cases.values()), CLOSING])


def main() -> None:
    """Write the page and its pictures.

    **Raises:** `SystemExit` if a case lacks its data.
    """
    found = fj.validate()
    if lacking := [case.reason for case in found.cases.values() if case.reason]:
        raise SystemExit("; ".join(lacking))
    print(found)
    contents = {PAGE: lambda: page(found).encode()}
    for name, case in found.cases.items():
        contents[picture_of(name)] = lambda case=case: small_png(fj.plot.validation(case).figure)
    run(contents)


if __name__ == "__main__":
    mpl.use("agg")
    jax.config.update("jax_enable_x64", True)
    main()
