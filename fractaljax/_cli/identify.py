"""`fractaljax identify`: D and G of a measured surface, as a scene to design."""

import shlex
from pathlib import Path

from .output import output, picture
from .parsing import load_given

_FOLDER = Path("fractaljax-identification")
_OPTIONS = {
    "--dx": {"type": float, "help": "step between heights [m], if not in the file"},
    "--dy": {"type": float, "help": "step across a map [m], if not in the file; default dx"},
    "--unit": {"help": "unit of the heights, if not in the file: m, mm, um, nm"},
    "--position-unit": {"metavar": "UNIT", "help": "unit of positions, if different"},
    "--channel": {"help": "name or number of one of several in the file"},
    "--band": {
        "type": float,
        "nargs": 2,
        "metavar": ("LOW", "HIGH"),
        "help": "spatial frequencies to use [1/m]; chosen by default",
    },
    "--resolution": {"type": float, "help": "lateral resolution of the instrument [m]"},
    "--stylus-radius": {"type": float, "metavar": "RADIUS", "help": "of the tip [m]"},
    "--aliased": {
        "choices": ("yes", "no"),
        "help": "whether waves finer than two points are aliased; default: from the spectrum",
    },
    "--scene": {
        "type": Path,
        "metavar": "FILE",
        "help": "scene for the surface; default the brake",
    },
    "--out": {"type": Path, "default": _FOLDER, "metavar": "FOLDER"},
}


def add_identify(commands) -> None:
    """Add `fractaljax identify`."""
    parser = commands.add_parser(
        "identify", help="find D and G of a measured surface", description=_run.__doc__
    )
    parser.add_argument("file", type=Path, help="heights: CSV, NPY or an instrument's own format")
    for name, options in _OPTIONS.items():
        parser.add_argument(name, **options)
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Find D and G of a measured surface; write identification.png and scene.toml."""
    from .. import plot
    from .._identify.files import read_measurement
    from .._identify.identify import identify

    base = load_given(arguments.scene)
    if not base.contact.fractal:
        raise ValueError(f"{arguments.scene}: its joint is fixed and takes no surface")
    names = ("dx", "dy", "unit", "position_unit", "channel")
    read = read_measurement(arguments.file, **{name: getattr(arguments, name) for name in names})
    given = {name: getattr(arguments, name) for name in ("resolution", "stylus_radius")}
    with output(arguments.out) as write:
        found = identify(
            read.z,
            read.dx,
            read.dy,
            band=arguments.band,
            aliased=None if arguments.aliased is None else arguments.aliased == "yes",
            gamma=float(base.contact.surface.gamma),
            **{name: getattr(read, name) if x is None else x for name, x in given.items()},
        )
        files, failure = {"identification.png": picture(plot.identification(found).figure)}, None
        try:
            files["scene.toml"] = _scene_text(base, read, found).encode()
        except ValueError as error:
            failure = error
        written = write(files)
    print(f"{read.source}\n{read.description}\n\n{found}\n\n{written}")
    path = arguments.out / "scene.toml"
    if failure is not None:
        if path.exists():
            print(f"{path} is from an earlier run")
        print(f"no scene: {failure}")
        return 1
    print(f"next: fractaljax design {shlex.quote(str(path))}{_bounds(found)}")
    return 0


def _scene_text(base, read, found) -> str:
    """The scene with this surface, and its origin. **Raises:** `ValueError` if there is none."""
    from .._identify.warnings import DISQUALIFYING

    for warning in found.warnings:
        if warning.startswith(DISQUALIFYING):
            raise ValueError(warning)
    scene = base.replace(surface=found.surface)
    comments = [
        f"surface identified from {read.source}",
        f"D = {found.D:.6g} with standard error {found.D_standard_error:.2g}",
        f"G = {found.G:.6g} m, standard error of ln G {found.ln_G_standard_error:.2g}",
        f"from {found.band[0]:.6g} to {found.band[1]:.6g} 1/m",
        *found.warnings,
    ]
    return "\n".join([*(f"# {' '.join(line.split())}" for line in comments), scene.to_toml()])


def _bounds(found) -> str:
    """Options of `design` where its default bounds leave the surface out."""
    from .._design.problem import DEFAULT_BOUNDS

    ranges = {
        "D": (found.D, max(found.D - 0.1, 1 + found.D / 2), min(found.D + 0.1, 1.5 + found.D / 2)),
        "G": (found.G, found.G / 10, found.G * 10),
    }
    return "".join(
        f" --{name} {low:.6g} {high:.6g}"
        for name, (x, low, high) in ranges.items()
        if not DEFAULT_BOUNDS[name][0] <= x <= DEFAULT_BOUNDS[name][1]
    )
