"""`fractaljax map`: where a mechanism is quiet, squeals, or does what the kick decides."""

from typing import Any

from .json_text import files as paths, map_content, show
from .output import csv_text, output, picture
from .parsing import add_out, add_scene_file, kick_size, load_mechanism, parse_windows

_FORM = "NAME=LOW:HIGH"


def add_map(commands) -> None:
    """Add `fractaljax map`."""
    parser = commands.add_parser(
        "map",
        help="map where it is quiet, where it squeals and where a kick decides",
        description=_run.__doc__,
    )
    add_scene_file(parser)
    add_out(parser, "fractaljax-map")
    for which, name in (("x", "D"), ("y", "G")):
        parser.add_argument(
            f"--{which}", metavar=_FORM, help=f"a quantity and its window; default around {name}"
        )
    parser.add_argument(
        "--radius",
        metavar="R",
        help="size of the kicks that look for cycles, in units of V/omega and V, 5 by default; or "
        "a list of semi-axes in m and m/s, X1,X2,V1,V2",
    )
    parser.add_argument("--starts", type=int, help="how many kicks; default 128")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Trace the stability boundary and the boundaries of the limit cycles in two quantities.

    Takes a scene or a structure. Writes map.png and map.csv, a row for each point of a curve.
    """
    from .. import plot
    from .._dynamics.bifurcation import bifurcation_map

    how = {"quiet": arguments.quiet, "changes": arguments.set}
    x = load_mechanism(arguments.scene, structures=True, **how)
    windows = [_window(x, which, getattr(arguments, which)) for which in ("x", "y")]
    options: dict[str, Any] = {}
    if arguments.radius is not None:
        options["radius"] = kick_size("--radius", arguments.radius)
    if arguments.starts is not None:
        options["starts"] = arguments.starts
    with output(arguments.out) as write:
        bifurcations = bifurcation_map(x, *windows, **options, progress=not arguments.quiet)
        figure = picture(plot.bifurcation_map(bifurcations).figure)
        files = {"map.png": figure, "map.csv": _text(bifurcations).encode()}
        written = write(files)
    show(
        arguments,
        f"{bifurcations!r}\n{written}",
        lambda: map_content(bifurcations) | {"files": paths(arguments.out, files)},
    )
    return 0


def _window(x, which: str, text: str | None) -> tuple[str, float, float]:
    """A quantity and its window; by default around the value of D or G."""
    from .._mechanism.quantities import quantity_names, value_of

    if text is None:
        name = {"x": "D", "y": "G"}[which]
        if name not in quantity_names(x):
            raise ValueError(f"--{which} must be {_FORM}: the scene has no {name}")
        value = float(value_of(x, name))
        if name == "G":
            return name, value / 2, value * 2
        return name, max(2.001, value - 0.05), min(2.999, value + 0.05)
    ((name, window),) = parse_windows(f"--{which}", [text], _FORM).items()
    return name, *window


def _text(bifurcations) -> str:
    """The curves as a table; a Hopf point has the period of its critical mode and no amplitude."""
    n = max((curve.amplitude.shape[1] for curve in bifurcations.curves), default=0)
    amplitudes = [f"peak to peak of x{i + 1} [m]" for i in range(n)]
    rows = []
    for k, branch in enumerate(bifurcations.boundary.branches):
        for x, y, f in zip(branch.x, branch.y, branch.frequency, strict=True):
            rows.append([k + 1, "Hopf", x, y, 1 / f if f else "", *[0.0] * n])
    for k, curve in enumerate(bifurcations.curves, len(bifurcations.boundary.branches)):
        for row in zip(curve.x, curve.y, curve.period, curve.amplitude, strict=True):
            rows.append([k + 1, curve.kind, *row[:3], *row[3]])
    titles = ["curve", "kind", bifurcations.x[0], bifurcations.y[0], "period [s]", *amplitudes]
    return csv_text(titles, rows)
