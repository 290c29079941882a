"""`fractaljax identify`: D and G of a measured surface, as a scene to design."""

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
        "help": "nominal area [m^2] of the joint, for a verdict by Persson's law too",
    },
    "--envelope": {
        "nargs": "+",
        "metavar": "NAME=LOW:HIGH",
        "help": "ranges that the probability of squeal counts, or NAME=V1,V2,V3 measured together",
    },
    "--force": {
        "action": "store_true",
        "help": "write a scene even where the warnings leave D and G no meaning",
    },
}


def add_identify(commands) -> None:
    """Add `fractaljax identify`."""
    parser = commands.add_parser(
        "identify", help="find D and G of a measured surface", description=_run.__doc__
    )
    parser.add_argument("file", type=Path, help="heights: CSV, NPY or an instrument's own format")
    for name, options in _OPTIONS.items():
        parser.add_argument(name, **options)
    add_set(parser)
    add_out(parser, "fractaljax-identification")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Find D and G of a measured surface; write identification.png, scene.toml, tolerance.toml."""
    from .. import plot
    from .._base.parts import scalar
    from .._identify.files import read_measurement
    from .._identify.identify import identify

    base = load_mechanism(arguments.scene, changes=arguments.set)
    if not base.contact.has_surface:
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
            gamma=float(base.contact.surface.gamma),
            **{name: getattr(read, name) if x is None else x for name, x in instrument.items()},
        )
        files, failure = {"identification.png": picture(plot.identification(fit).figure)}, None
        joint_lines: list[str] = []
        try:
            files["scene.toml"] = _scene_text(base, read, fit, arguments.force).encode()
            files["tolerance.toml"] = _tolerance_text(read, fit).encode()
            joint_lines = _joint(base, fit, arguments.area, envelope)
        except ValueError as error:
            failure = error
        written = write(files)
    path = arguments.out / "scene.toml"
    content = {"source": read.source, "failure": None if failure is None else str(failure)}
    content["files"] = paths(arguments.out, files)
    if arguments.json:
        show(arguments, "", lambda: identification_content(fit) | content)
        return 0 if failure is None else 1
    print("\n".join([read.source, read.description, "", str(fit), "", *joint_lines, written]))
    if failure is not None:
        if path.exists():
            print(f"{path} is from an earlier run")
        print(f"no scene: {failure}")
        return 1
    print(f"next: fractaljax design {shlex.quote(str(path))}{_bounds(fit)}")
    return 0


def _scene_text(base, read, fit, force, most: int = 5) -> str:
    """The scene with this surface, and its origin.

    **Raises:** `ValueError` if D and G have no meaning, or for `most` warnings, without `force`.
    """
    from .._identify.warnings import DISQUALIFYING

    for warning in fit.warnings:
        if warning.startswith(DISQUALIFYING) and not force:
            raise ValueError(f"{warning} (--force writes one all the same)")
    if len(fit.warnings) >= most and not force:
        raise ValueError(f"{len(fit.warnings)} warnings (--force writes one all the same)")
    scene = base.replace(surface=fit.surface)
    comments = [
        f"surface identified from {read.source}",
        f"D = {fit.D:.6g} with standard error {fit.D_standard_error:.2g}",
        f"G = {fit.G:.6g} m, standard error of ln G {fit.ln_G_standard_error:.2g}",
        f"from {fit.band[0]:.6g} to {fit.band[1]:.6g} 1/m",
        *fit.warnings,
    ]
    return "\n".join([*(f"# {' '.join(line.split())}" for line in comments), scene.to_toml()])


def _tolerance_text(read, fit) -> str:
    """The errors of D and ln G, for `fractaljax design --tolerance`."""
    from .._design.design_file import tolerance_text
    from .._design.tolerance import Tolerance

    source = " ".join(read.source.split())
    return tolerance_text(Tolerance.of(fit), f"errors of D and ln G identified from {source}")


def _joint(base, fit, area, envelope) -> list[str]:
    """The joint of the measured surface, with the errors from D and G, and its verdict."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from .._design.verdict import verdict
    from .._mechanism.quantities import substituted
    from .._mechanism.scene import stiffness
    from .._stability.stability import growth_rate

    scene = base.replace(surface=fit.surface)

    def joint(x):
        varied = substituted(scene, {"D": x[0], "G": jnp.exp(x[1])})
        return jnp.stack([*stiffness(varied), growth_rate(varied)])

    at = jnp.stack([jnp.asarray(fit.D), jnp.log(fit.G)])
    values, slopes = map(np.asarray, jax.jit(lambda x: (joint(x), jax.jacfwd(joint)(x)))(at))
    errors = np.sqrt(np.einsum("ij,jk,ik->i", slopes, np.asarray(fit.covariance), slopes))
    names = ("K_n = {} N/m", "K_t = {} N/m", "growth rate {} 1/s")
    shown = zip(names, values, errors, strict=True)
    lines = [name.format(f"{value:.4g} +- {error:.2g}") for name, value, error in shown]
    try:
        verdict_text = str(verdict(scene, tolerance=fit, area=area, envelope=envelope))
    except ValueError as error:  # errors so large that they leave the domain of the model
        verdict_text = f"no verdict: {error}"
    return [", ".join(lines), "", *verdict_text.splitlines(), ""]


def _bounds(fit) -> str:
    """Bounds on D and G for `design`, where its default bounds leave the surface out."""
    from .._design.statement import DEFAULT_BOUNDS

    ranges = {
        "D": (fit.D, max(fit.D - 0.1, 1 + fit.D / 2), min(fit.D + 0.1, 1.5 + fit.D / 2)),
        "G": (fit.G, fit.G / 10, fit.G * 10),
    }
    return "".join(
        f" --{name} {low:.6g} {high:.6g}"
        for name, (x, low, high) in ranges.items()
        if not DEFAULT_BOUNDS[name][0] <= x <= DEFAULT_BOUNDS[name][1]
    )
