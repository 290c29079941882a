"""`fractaljax validate`: published results beside ours."""

from pathlib import Path

from .json_text import add_json, files as paths, show, table_content
from .output import csv_text, output, picture


def add_validate(commands) -> None:
    """Add `fractaljax validate`."""
    parser = commands.add_parser(
        "validate", help="compute what was published elsewhere", description=_run.__doc__
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", help="published cases; default all")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="the folder for a picture of each case and validation.csv; default none",
    )
    add_json(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Compute published cases; print their numbers beside ours. Exit status 1 if one differs.

    A case that lacks its data is not run. FRACTALJAX_BRAKE names the folder of the matrices of the
    4669-degree-of-freedom brake.
    """
    from .._validate.validate import validate

    if arguments.out is None:
        validation = validate(*arguments.cases, progress=not arguments.quiet)
        show(arguments, repr(validation), lambda: table_content(*validation.rows()))
        return 0 if validation.agrees else 1
    from .. import plot

    with output(arguments.out) as write:
        validation = validate(*arguments.cases, progress=not arguments.quiet)
        files = {
            f"{name}.png": picture(plot.validation(case))
            for name, case in validation.cases.items()
            if case.panels
        }
        written = write(files | {"validation.csv": csv_text(*validation.rows()).encode()})
    content = {"files": paths(arguments.out, [*files, "validation.csv"])}
    text = f"{validation!r}\n{written}"
    show(arguments, text, lambda: table_content(*validation.rows()) | content)
    return 0 if validation.agrees else 1
