"""`fractaljax explore`: a page with sliders over the quantities of a scene."""

from .json_text import files as paths, show
from .output import output
from .parsing import add_out, add_scene_file, load_mechanism, parse_windows

_FORM = "NAME=LOW:HIGH"


def add_explore(commands) -> None:
    """Add `fractaljax explore`."""
    parser = commands.add_parser(
        "explore", help="write a page with sliders to play with", description=_run.__doc__
    )
    add_scene_file(parser)
    add_out(parser, "fractaljax-explore")
    parser.add_argument(
        "--over",
        nargs="+",
        metavar=_FORM,
        default=[],
        help="quantities and their windows, the first two those of the map; default D, G, P and mu",
    )
    parser.add_argument(
        "--no-cycles", action="store_true", help="leave out limit cycles, which take minutes"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Write explore.html, a page that needs no network: sliders over the quantities of a scene.

    It shows growth rate, frequency, stiffness, the mode in motion, the surface, and limit cycles.
    """
    from ..plot.explore import page

    scene = load_mechanism(arguments.scene, changes=arguments.set)
    windows = parse_windows("--over", arguments.over, _FORM)
    with output(arguments.out) as write:
        text = page(scene, windows, not arguments.no_cycles, not arguments.quiet)
        written = write({"explore.html": text.encode()})
    show(arguments, written, lambda: {"files": paths(arguments.out, ["explore.html"])})
    return 0
