"""Run the published cases of docs/gallery and write validation.md with its pictures.

`FRACTALJAX_BRAKE=FOLDER python docs/make_validation.py`, with the folder of the brake's matrices;
or the names of cases, whose sections and pictures alone are written. Exit status 1 if one differs.
"""

import argparse
import re
from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
from gallery import CASES
from gallery.case import Case, CaseResult, Check
from gallery.picture import picture
from writing import run, small_png, table

import fractaljax as fj

PAGE = Path(__file__).with_name("validation.md")

INTRODUCTION = """\
# Validation

What others published, computed again: our curve over theirs, number beside number. The cases are
modules of docs/gallery, each a few lines of the article's equations.

    fractaljax validate                             # checks an installation in a minute
    python docs/make_validation.py leine den_hartog # in the repository: two cases with pictures

In Python it is `fj.validate()`. The tolerance comes from the digits that were printed, the
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


def rows(checks: list[Check]) -> list[list[str]]:
    """The rows of a case's table."""
    written = []
    _, cells = fj.Validation({"": checks}).rows()
    for check, (_, quantity, published, ours, _, tolerance, basis, used) in zip(
        checks, cells, strict=True
    ):
        if check.agrees:
            share = abs(check.difference) / check.tolerance if check.tolerance else 0.0
            used = f"{share:.0%}" if check.tolerance else "within"
        written.append([quantity, published, ours, tolerance, basis, used])
    return written


def picture_of(name: str) -> Path:
    """Where the picture of a case is."""
    return PAGE.with_name(f"validation_{name}.png")


def section(case: Case, checks: list[Check]) -> str:
    """The part of the page on one case."""
    source = case.citation
    if case.doi is not None:
        source += f", [doi:{case.doi}](https://doi.org/{case.doi})"
    head = ["quantity", "published", "ours", "tolerance", "basis", "difference"]
    lines = [
        f"## {case.title}",
        "",
        f"`{case.name}`: {source}.",
        "",
        *table(head, rows(checks)),
        "",
    ]
    notes = [f"- {check.quantity}: {check.note}." for check in checks if check.note]
    lines += [*notes, ""] if notes else []
    image = f"![{case.title}: ours over theirs]({picture_of(case.name).name})"
    return "\n".join([*lines, image, ""])


def contents() -> str:
    """A list of the cases with a link to each: the gallery at a glance."""

    def anchor(title: str) -> str:
        return re.sub(r"[^\w -]", "", title).lower().replace(" ", "-")

    cases = CASES.values()
    return "".join(f"- [{case.title}](#{anchor(case.title)})\n" for case in cases)


def page(sections: Mapping[str, str]) -> str:
    """The text of validation.md."""
    parts = [INTRODUCTION, contents(), *(sections[name] for name in CASES), CLOSING]
    return "\n".join(parts)


def sections_of(text: str) -> dict[str, str]:
    """The sections of a page by the name of their case."""
    parts = re.split(r"^(?=## )", text.partition("\nOf the source's Figs.")[0], flags=re.MULTILINE)
    return {part.split("`")[1]: part.rstrip("\n") + "\n" for part in parts[1:]}


def main() -> int:
    """Write the page and its pictures; 1 if a number differs.

    **Raises:** `SystemExit` for an unknown case, and if a case lacks its data.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "cases", nargs="*", metavar="CASE", choices=[*CASES, []], help="default all"
    )
    chosen = parser.parse_args().cases or list(CASES)
    if lacking := [reason for name in chosen if (reason := CASES[name].missing())]:
        raise SystemExit("; ".join(lacking))
    results: dict[str, CaseResult] = {}
    for name in chosen:
        results[name] = CASES[name].run()
        print(fj.Validation({name: results[name].checks}), flush=True)
    sections = sections_of(PAGE.read_text(encoding="utf-8"))
    sections |= {name: section(CASES[name], list(one.checks)) for name, one in results.items()}
    files = {PAGE: lambda: page(sections).encode()}
    for name, one in results.items():
        figure = picture(CASES[name], one.panels)
        files[picture_of(name)] = lambda figure=figure: small_png(figure)
    run(files)
    return int(not all(check.agrees for one in results.values() for check in one.checks))


if __name__ == "__main__":
    mpl.use("agg")
    raise SystemExit(main())
