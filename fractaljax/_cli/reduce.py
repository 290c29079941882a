"""`fractaljax reduce`: a finite-element model to few degrees of freedom."""

from pathlib import Path
from typing import Any

from .json_text import files as paths, show, stability_content
from .output import output
from .parsing import add_out, add_set, changed, load_noted, numbers, parse_pairs, parse_reduction

_FORM = "NAME=LOW:HIGH"
_FILE = "reduced.toml"


def add_reduce(commands) -> None:
    """Add `fractaljax reduce`."""
    parser = commands.add_parser(
        "reduce",
        help="reduce a finite-element model to few degrees of freedom",
        description=_run.__doc__,
    )
    parser.add_argument("structure", type=Path, help="a file with a table [structure]")
    add_out(parser, "fractaljax-reduced")
    parser.add_argument(
        "--band",
        metavar="LOW:HIGH",
        help="range of the eigenvalues to keep, in rad/s; default that of the file's [reduction]",
    )
    parser.add_argument(
        "--over",
        nargs="+",
        metavar=_FORM,
        help="quantities and the ranges in which the reduction holds; else those of the file",
    )
    parser.add_argument(
        "--tol", type=float, help="largest error of an eigenvalue s, relative to |s|; default 1e-8"
    )
    add_set(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Keep the eigenvalues of a structure in a band, over ranges of its quantities.

    Writes reduced.toml and reduced.npz, which go wherever a structure goes.
    """
    from .._base.table import table
    from .._stability.reduction import reduce
    from .._stability.summary import stability_table

    options: dict[str, Any] = parse_reduction(arguments.structure)
    if arguments.band is not None:
        options["band"] = numbers("--band", arguments.band, ":")
    if arguments.tol is not None:
        options["tol"] = arguments.tol
    if arguments.over is not None:
        ranges = parse_pairs("--over", arguments.over, _FORM)
        options["over"] = {
            name: numbers(f"--over {name}", text, ":") for name, text in ranges.items()
        }
    if "band" not in options:
        raise ValueError("--band must be LOW:HIGH in rad/s: the file has no table [reduction]")
    structure = load_noted(arguments.structure)
    if structure.sole_joint is not None:
        raise ValueError(f"{arguments.structure}: a scene has two directions, which are few enough")
    structure = changed(structure, arguments.set)
    with output(arguments.out) as write:
        reduced = reduce(structure, **options, progress=not arguments.quiet)
        files = reduced._files(arguments.out / _FILE)
        written = write({path.name: content for path, content in files.items()})
    reduction = reduced.reduction
    rows = {
        "degrees of freedom": f"{reduced.n} of {structure.n}",
        "band [rad/s]": f"{reduction.band[0]:g} to {reduction.band[1]:g}",
        **{f"over {name}": f"{low:g} to {high:g}" for name, (low, high) in reduction.over.items()},
        "largest error, of |s|": f"{reduction.error:.2g}",
        "points with eigenvectors": f"{len(reduction.points)}",
    }
    slope = reduction.friction_slope
    about = {
        "degrees_of_freedom": {"before": structure.n, "after": reduced.n},
        "band": reduction.band,
        "over": reduction.over,
        "error": reduction.error,
        "files": paths(arguments.out, [path.name for path in files]),
    }
    show(
        arguments,
        f"{table([''], [rows])}\n\n{stability_table(reduced, slope)}\n{written}",
        lambda: about | stability_content(reduced, slope),
    )
    return 0
