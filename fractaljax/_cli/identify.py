"""`fractaljax identify`: a measured surface as a scene to design, and its errors as a tolerance."""

import shlex
from pathlib import Path

from .json_text import files as paths, identification_content, show
from .output import output, picture
from .parsing import add_out, add_set, load_mechanism, parse_envelope, parse_pairs

_OPTIONS = {
    "--dx": {"type": float, "help": "step between heights [m], if not in the file"},
    "--dy": {"type": float, "help": "step across a map [m], if not in the file; default dx"},
    "--unit": {"help": "unit of the heights, if not in the file: m, mm, um, nm"},
    "--position-unit": {"metavar": "UNIT", "help": "unit of positions, if different"},
    "--channel": {"help": "name or number of one of several in the file"},
    "--columns": {
        "nargs": "+",
        "metavar": "ROLE=COLUMN",
        "help": "title or number from 0 of the columns x, y, z, valid or invalid of a text",
    },
    "--band": {
        "type": float,
        "nargs": 2,
        "metavar": ("LOW", "HIGH"),
        "help": "spatial frequencies to use [1/m]; chosen by default",
    },
    "--resolution": {"type": float, "help": "lateral resolution of the instrument [m]"},
    "--stylus-radius": {"type": float, "metavar": "RADIUS", "help": "radius of the stylus tip [m]"},
    "--aliased": {
        "choices": ("yes", "no"),
        "help": "whether waves finer than two steps are aliased; default: as the spectrum says",
    },
    "--scene": {
        "type": Path,
        "metavar": "FILE",
        "help": "scene that the surface is put into; default the reference brake",
    },
    "--area": {
        "type": float,
        "help": "nominal area [m^2] of the joint, for a verdict by Persson's law too, and for the "
        "scene of a surface with a roll-off",
    },
    "--envelope": {
        "nargs": "+",
        "metavar": "NAME=LOW:HIGH",
        "help": "ranges that the probability of squeal counts, or NAME=V1,V2,V3 measured together",
    },
    "--force": {
        "action": "store_true",
        "help": "write the surface of the power law even where the warnings leave it no meaning",
    },
    "--tolerance": {
        "type": Path,
        "metavar": "FILE",
        "help": "write the errors of the surface here too, for the --tolerance of design",
    },
}


def add_identify(commands) -> None:
    """Add `fractaljax identify`."""
    parser = commands.add_parser(
        "identify", help="find the surface of measured heights", description=_run.__doc__
    )
    parser.add_argument("file", type=Path, help="heights: CSV, NPY or an instrument's own format")
    for name, options in _OPTIONS.items():
        parser.add_argument(name, **options)
    add_set(parser)
    add_out(parser, "fractaljax-identification")
    parser.add_argument(
        "--quiet",
        action="store_true",
        help="no progress bar: there is none, and scripts may say it to every command",
    )
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Find the surface of heights; write identification.png, scene.toml and tolerance.toml."""
    from .. import plot
    from .._base.files import write_together
    from .._base.parts import scalar
    from .._identify.files import read_measurement
    from .._identify.identify import identify
    from .._surface.spectrum import Spectrum
    from .._surface.surface import Surface

    base = load_mechanism(arguments.scene, changes=arguments.set)
    old_surface = getattr(base.contact, "surface", None)
    if not isinstance(old_surface, Spectrum):
        raise ValueError(f"{arguments.scene}: the law of its contact takes no surface")
    if arguments.area is not None:
        scalar("--area", arguments.area, above=0)
    envelope = None if arguments.envelope is None else parse_envelope(arguments.envelope)
    if envelope is not None:
        envelope.check(base, ())
    names = ("dx", "dy", "unit", "position_unit", "channel")
    file_options = {name: getattr(arguments, name) for name in names}
    if arguments.columns is not None:
        file_options["columns"] = parse_pairs("--columns", arguments.columns, "ROLE=COLUMN")
    read = read_measurement(arguments.file, **file_options)
    instrument = {name: getattr(arguments, name) for name in ("resolution", "stylus_radius")}
    with output(arguments.out) as write:
        fit = identify(
            read.z,
            read.dx,
            read.dy,
            band=arguments.band,
            aliased=None if arguments.aliased is None else arguments.aliased == "yes",
            gamma=float(old_surface.gamma) if isinstance(old_surface, Surface) else 1.5,
            **{name: getattr(read, name) if x is None else x for name, x in instrument.items()},
        )
        files, failure = {"identification.png": picture(plot.identification(fit).figure)}, None
        joint_lines: list[str] = []
        scatter = None
        try:
            scatter = fit.power_law_scatter if arguments.force else fit.scatter
            scene = _scene(base, scatter.surface, arguments.area, fit.end)
            files["scene.toml"] = _scene_text(scene, read, fit).encode()
            files["tolerance.toml"] = _tolerance_text(read, scatter).encode()
            joint_lines = _joint(scene, scatter, arguments.area, envelope)
        except ValueError as error:
            failure = error
        written = write(files)
        if arguments.tolerance is not None and "tolerance.toml" in files:
            write_together({arguments.tolerance: files["tolerance.toml"]})
    path = arguments.out / "scene.toml"
    content = {"source": read.source, "failure": None if failure is None else str(failure)}
    content["files"] = paths(arguments.out, files)
    if arguments.json:
        show(arguments, "", lambda: identification_content(fit) | content)
        return 0 if failure is None and scatter is not None else 1
    print("\n".join([read.source, read.description, "", str(fit), "", *joint_lines, written]))
    if failure is not None or scatter is None:
        if path.exists():
            print(f"{path} is from an earlier run")
        print(f"no scene: {failure}")
        return 1
    print(f"next: fractaljax design {shlex.quote(str(path))}{_bounds(scatter.surface)}")
    return 0


def _scene(base, surface, area, end: float):
    """The scene `base` with this surface, under Persson's law where that of `base` takes another.

    `area` is the nominal area [m^2] or None, `end` [1/m] the highest frequency of the surface.

    **Raises:** `ValueError` where the nominal area is not known.
    """
    import math

    from .._contact.persson import PerssonContact
    from .._surface.surface import Surface

    contact = base.contact
    if isinstance(surface, Surface) and isinstance(contact.surface, Surface):
        return base.replace(surface=surface)
    area = getattr(contact, "area", None) if area is None else area
    if area is None:
        raise ValueError(
            f"a {type(surface).__name__} takes Persson's law: give the nominal area of the joint "
            "in m^2, such as --area 1e-4"
        )
    ends = (math.sqrt(area), min(1 / end, math.sqrt(area)))
    ends = ends if isinstance(surface, Surface) else ()
    ratio = getattr(contact, "stiffness_ratio", None)
    law = PerssonContact(surface, contact.material, contact.P, area, *ends, stiffness_ratio=ratio)
    return base.replace(contact=law)


def _scene_text(scene, read, fit) -> str:
    """The scene with this surface, and its origin."""
    comments = [
        f"surface identified from {read.source}",
        f"D = {fit.D:.6g} with standard error {fit.D_standard_error:.2g}",
        f"G = {fit.G:.6g} m, standard error of ln G {fit.ln_G_standard_error:.2g}",
        f"self-affine: {fit.self_affine.description}",
        f"from {fit.band[0]:.6g} to {fit.band[1]:.6g} 1/m",
        *fit.warnings,
    ]
    return "\n".join([*(f"# {' '.join(line.split())}" for line in comments), scene.to_toml()])


def _tolerance_text(read, scatter) -> str:
    """The errors of the surface, for `fractaljax design --tolerance`."""
    from .._design.design_file import tolerance_text
    from .._design.tolerance import Tolerance

    source = " ".join(read.source.split())
    names = " and ".join(scatter.names)
    return tolerance_text(Tolerance.of(scatter), f"errors of {names} identified from {source}")


def _joint(scene, scatter, area, envelope, most: float = 4.0) -> list[str]:
    """The joint of the measured surface over its errors, and its verdict.

    K_n whose middle 68 % span more than a factor `most` is called poorly known.
    """
    from .._design.tolerance import scattered_joint
    from .._design.verdict import verdict
    from .._stability.summary import stiffness_remarks

    table = scattered_joint(scene, scatter)
    units = {"K_n": "N/m", "K_t": "N/m", "growth rate": "1/s"}
    words = [
        f"{name} = {value:.4g} {units[name]} ({low:.3g} to {high:.3g})"
        for name, (value, low, high) in table.items()
    ]
    lines = [f"{', '.join(words)}: the middle 68 % of its errors"]
    _, low, high = table["K_n"]
    if not high <= most * low:
        lines.append(
            f"warning: K_n is poorly known, {low:.3g} to {high:.3g} N/m: measure a larger map, or "
            "several and pool them (pool_surfaces)"
        )
    lines += stiffness_remarks(scene)
    try:
        verdict_area = area if scene.contact.has_surface else None
        result = verdict(scene, tolerance=scatter, area=verdict_area, envelope=envelope)
        verdict_text = str(result)
    except ValueError as error:
        verdict_text = f"no verdict: {error}"
    return [*lines, "", *verdict_text.splitlines(), ""]


def _bounds(surface) -> str:
    """Bounds for `design`, where its default ones leave the surface out."""
    from .._design.statement import DEFAULT_BOUNDS
    from .._surface.self_affine import SelfAffine
    from .._surface.surface import Surface

    if isinstance(surface, SelfAffine):
        H, Sq = float(surface.H), float(surface.Sq)
        return f" --bounds Sq={Sq / 10:.6g}:{Sq * 10:.6g} hurst={min(H, 0.3):.6g}:1"
    if not isinstance(surface, Surface):
        return " --bounds height_factor=0.1:10"
    D, G = float(surface.D), float(surface.G)
    ranges = {
        "D": (D, max(D - 0.1, 1 + D / 2), min(D + 0.1, 1.5 + D / 2)),
        "G": (G, G / 10, G * 10),
    }
    return "".join(
        f" --{name} {low:.6g} {high:.6g}"
        for name, (x, low, high) in ranges.items()
        if not DEFAULT_BOUNDS[name][0] <= x <= DEFAULT_BOUNDS[name][1]
    )
