"""`fractaljax validate`: check the installation."""

from .json_text import add_json, show, table_content


def add_validate(commands) -> None:
    """Add `fractaljax validate`."""
    parser = commands.add_parser(
        "validate", help="check this installation", description=_run.__doc__
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", help="cases to compute; default all")
    add_json(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Compute numbers whose closed or published form is known; print both, with their tolerance.

    Exit status 1 if one differs.
    """
    from .._validate.validate import validate

    validation = validate(*arguments.cases, progress=not arguments.quiet)
    show(arguments, repr(validation), lambda: table_content(*validation.rows()))
    return 0 if validation.agrees else 1
