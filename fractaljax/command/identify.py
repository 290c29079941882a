"""`fractaljax identify`: D and G of a measured surface, as a scene to design."""

import shlex
from pathlib import Path

from .output import output, picture

_INSTRUMENT = ("resolution", "stylus_radius")  # which a file may tell
_FOLDER = Path("fractaljax-identification")
_MEANINGLESS = ("not fractal", "too few levels")  # begin flags that leave D and G without meaning


def add_identify(commands) -> None:
    """Add `fractaljax identify`."""
    parser = commands.add_parser(
        "identify", help="find D and G of a measured surface", description=_run.__doc__
    )
    parser.add_argument("file", type=Path, help="heights: CSV, NPY or an instrument's own format")
    parser.add_argument("--dx", type=float, help="step between heights [m], if not in the file")
    parser.add_argument("--dy", type=float, help="likewise across a map [m]; default dx")
    parser.add_argument("--unit", help="unit of the heights, if not in the file: m, mm, um, nm")
    parser.add_argument("--position-unit", metavar="UNIT", help="of positions, if not the same")
    parser.add_argument("--channel", help="name or number of one of several in the file")
    parser.add_argument(
        "--band",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="spatial frequencies to be used [1/m]; else chosen",
    )
    parser.add_argument("--resolution", type=float, help="lateral, of the instrument [m]")
    parser.add_argument("--stylus-radius", type=float, metavar="RADIUS", help="[m]")
    parser.add_argument(
        "--folded",
        choices=("yes", "no"),
        help="whether waves finer than two points are folded in; else decided by the spectrum",
    )
    parser.add_argument(
        "--scene", type=Path, metavar="FILE", help="scene to put the surface in; else the brake"
    )
    parser.add_argument("--out", type=Path, default=_FOLDER, metavar="FOLDER")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Find D and G of a measured surface; write identification.png and scene.toml."""
    from .. import plot
    from ..measured.files import read_measurement
    from ..measured.identify import identify
    from ..mechanism.scene import Scene, brake_scene

    base = brake_scene() if arguments.scene is None else Scene.load(arguments.scene)
    if not base.contact.fractal:
        raise ValueError(f"{arguments.scene}: its joint is fixed and takes no surface")
    given = {name: getattr(arguments, name) for name in ("dx", "dy", "unit", "position_unit")}
    read = read_measurement(arguments.file, channel=arguments.channel, **given)
    limits = {name: getattr(arguments, name) for name in _INSTRUMENT}
    limits = {name: getattr(read, name) if x is None else x for name, x in limits.items()}
    options = limits | {
        "band": arguments.band,
        "folded": None if arguments.folded is None else arguments.folded == "yes",
        "gamma": float(base.contact.surface.gamma),
    }
    with output(arguments.out) as write:
        found = identify(read.z, read.dx, read.dy, **options)
        files, failure = {"identification.png": picture(plot.identification(found).figure)}, None
        try:
            files["scene.toml"] = _scene_text(base, read, found).encode()
        except ValueError as error:
            failure = error
        written = write(files)
    print(f"{read.source}\n{read.description}\n\n{found}\n")
    print(written)
    if failure is not None:
        if (arguments.out / "scene.toml").exists():
            print(f"{arguments.out / 'scene.toml'} is of an earlier run")
        print(f"no scene: {failure}")
        return 1
    path = shlex.quote(str(arguments.out / "scene.toml"))
    print(f"next: fractaljax design {path}{_bounds(found)}")
    return 0


def _scene_text(base, read, found) -> str:
    """The scene with the surface found, and where it is from; refused where there is none."""
    for flag in found.flags:
        if flag.startswith(_MEANINGLESS):
            raise ValueError(flag)
    scene = base.replace(surface=found.surface)
    comments = [
        f"surface identified from {read.source}",
        f"D = {found.D:.6g} with standard error {found.D_standard_error:.2g}",
        f"G = {found.G:.6g} m, standard error of ln G {found.ln_G_standard_error:.2g}",
        f"from {found.band[0]:.6g} to {found.band[1]:.6g} 1/m",
        *found.flags,
    ]
    return "\n".join([*(f"# {' '.join(line.split())}" for line in comments), scene.to_toml()])


def _bounds(found) -> str:
    """Options of `design` where its default bounds leave the surface out."""
    from ..optimise.task import DEFAULT_BOUNDS

    ranges = {
        "D": (found.D, max(found.D - 0.1, 1 + found.D / 2), min(found.D + 0.1, 1.5 + found.D / 2)),
        "G": (found.G, found.G / 10, found.G * 10),
    }
    return "".join(
        f" --{name} {low:.6g} {high:.6g}"
        for name, (x, low, high) in ranges.items()
        if not DEFAULT_BOUNDS[name][0] <= x <= DEFAULT_BOUNDS[name][1]
    )
