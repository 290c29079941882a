"""`fractaljax design`: the nearest surface that is stable against small disturbances."""

from pathlib import Path

from .output import csv_text, npy, output, picture
from .parsing import (
    add_constant_friction,
    add_scene_file,
    load_scene,
    low_and_high,
    number,
    pairs_of,
    remarks,
)

_UNITS = {"G": "m", "growth_rate": "1/s", "K_n": "N/m", "K_t": "N/m"}  # of the history
_LIMITS = {
    "sq": "Sq of the surface [m]",
    "elastic-share": "share of the load on elastic contacts",
    "real-area": "real contact area [m^2]",
    "damping-ratio": "least damping ratio",
    "frequency": "frequencies of both modes [Hz]",
}
_OPTIONS = (
    "target",
    "K_n_min",
    "area_ratio_min",
    "slip_ratio_max",
    "quantile",
    "starts",
    "lattice",
    "seed",
)
_OWN = (  # arguments that leave nothing to repeat
    "scene",
    "D",
    "G",
    "constant_friction",
    "envelope",
    "risk",
    "tolerance",
    "sq_lengths",
    *_OPTIONS,
    *(name.replace("-", "_") for name in _LIMITS),
)


def add_design(commands) -> None:
    """Add `fractaljax design`."""
    parser = commands.add_parser(
        "design",
        help="find the nearest surface that is stable against small disturbances",
        description=_run.__doc__,
    )
    add_scene_file(parser)
    add_constant_friction(parser)
    parser.add_argument("--out", type=Path, default=Path("fractaljax-design"), metavar="FOLDER")
    parser.add_argument("--D", type=float, nargs=2, metavar=("LOW", "HIGH"), help="bounds on D")
    parser.add_argument("--G", type=float, nargs=2, metavar=("LOW", "HIGH"), help="on G [m]")
    parser.add_argument("--target", type=float, help="largest growth rate allowed [1/s]")
    parser.add_argument("--K-n-min", type=float, help="least normal stiffness allowed [N/m]")
    parser.add_argument("--area-ratio-min", type=float, help="least a_l/a_e")
    parser.add_argument("--slip-ratio-max", type=float, help="largest Q_e/(mu_s P)")
    _add_conditions(parser)
    _add_constraints(parser)
    parser.add_argument("--starts", type=int, help="surfaces improved side by side")
    parser.add_argument("--lattice", type=int, help="surfaces a side that starts are chosen from")
    parser.add_argument("--seed", type=int, help="of the surfaces drawn as machined; default 0")
    parser.add_argument(
        "--repeat", type=Path, metavar="FILE", help="run again what a run.toml holds, nothing else"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_run)


def _add_conditions(parser) -> None:
    parser.add_argument(
        "--envelope",
        action="extend",
        nargs="+",
        metavar="NAME=LOW:HIGH",
        help="ranges, or NAME=V1,V2,V3 measured together, that the design withstands",
    )
    parser.add_argument("--risk", help="worst (the default), smooth, smooth:T or cvar:ALPHA")
    parser.add_argument(
        "--tolerance",
        action="extend",
        nargs="+",
        metavar="NAME=SIGMA",
        help="standard deviations of D and lnG as machined",
    )
    parser.add_argument("--quantile", type=float, help="of the scatter; default 0.95")


def _add_constraints(parser) -> None:
    for name, meaning in _LIMITS.items():
        parser.add_argument(f"--{name}", metavar="LOW:HIGH", help=f"{meaning}; one may be absent")
    parser.add_argument(
        "--sq-lengths",
        type=float,
        nargs=2,
        metavar=("L", "L_S"),
        help="longest and shortest wavelength that --sq counts [m]; default 1e-3 1e-6",
    )


def _run(arguments) -> int:
    """Find the nearest surface stable against small disturbances; write scene, run and pictures.

    The files: design.toml, run.toml, history.csv, design.png, topographies.png with the surfaces
    before and after, and topography.npy with the heights of the designed one [m].
    """
    from .. import plot
    from ..optimise.design import design
    from ..optimise.design_file import design_text, read_design

    if arguments.repeat is None:
        scene, options = load_scene(arguments), _options(arguments)
    else:
        given = [name for name in _OWN if getattr(arguments, name) not in (None, False)]
        if given:
            raise ValueError(f"--repeat takes everything from its file, got {', '.join(given)} too")
        with remarks():
            scene, options = read_design(arguments.repeat)
    with output(arguments.out) as write:
        best = design(scene, **options, progress=not arguments.quiet)
        surfaces = best.topographies()
        files = {
            "design.toml": _scene_text(best).encode(),
            "run.toml": design_text(best).encode(),
            "history.csv": _history_text(best).encode(),
            "design.png": picture(plot.design(best).figure),
            "topographies.png": picture(plot.topographies(best)),
            "topography.npy": npy(surfaces.after),
        }
        written = write(files)
    *table, promise = str(best).splitlines()
    print("\n".join([*table, *_remarks(scene, options)]))
    print(written)
    side, dx = len(surfaces.after), surfaces.dx
    print(f"topography.npy: {side} x {side} heights in m, dx = {dx:g} m")
    print(promise)
    return 1 if best.violated else 0


def _options(arguments) -> dict:
    """The arguments of `design` that a command asks for."""
    from ..optimise.task import DEFAULT_BOUNDS

    asked = {"D": arguments.D, "G": arguments.G}
    bounds = DEFAULT_BOUNDS | {name: tuple(ends) for name, ends in asked.items() if ends}
    options = {name: getattr(arguments, name) for name in _OPTIONS}
    options = {name: value for name, value in options.items() if value is not None}
    options |= {"bounds": bounds, "friction_slope": not arguments.constant_friction}
    options["constraints"] = _constraints(arguments)
    if arguments.risk is not None:
        kind, _, value = arguments.risk.partition(":")
        options["risk"] = (kind, number("--risk", value)) if value else kind
    if arguments.envelope is not None:
        options["envelope"] = _envelope(arguments.envelope)
    if arguments.tolerance is not None:
        pairs = pairs_of("--tolerance", arguments.tolerance, "NAME=SIGMA")
        options["tolerance"] = {
            "ln G" if name == "lnG" else name: number("--tolerance", text)
            for name, text in pairs.items()
        }
    return options


def _constraints(arguments) -> list:
    from ..optimise import constraints

    limits = {
        name: low_and_high(f"--{name}", getattr(arguments, name.replace("-", "_")))
        for name in _LIMITS
    }
    if arguments.sq_lengths is not None and limits["sq"] is None:
        raise ValueError("--sq-lengths needs --sq")
    L, L_s = arguments.sq_lengths or (1e-3, 1e-6)
    kinds = {
        "sq": lambda low, high: constraints.Roughness(low, high, L=L, L_s=L_s),
        "elastic-share": lambda low, high: constraints.ElasticShare(low),
        "real-area": constraints.RealContactArea,
        "damping-ratio": lambda low, high: constraints.DampingRatio(
            low, friction_slope=not arguments.constant_friction
        ),
        "frequency": lambda low, high: constraints.Frequency(
            low, high, friction_slope=not arguments.constant_friction
        ),
    }
    for name in ("elastic-share", "damping-ratio"):
        if (limits[name] or (None, None))[1] is not None:
            raise ValueError(f"--{name} has a lower limit only: LOW:")
    return [kinds[name](*ends) for name, ends in limits.items() if ends is not None]


def _envelope(texts):
    from ..optimise.envelope import Envelope

    ranges, samples = {}, {}
    for name, values in pairs_of("--envelope", texts, "NAME=LOW:HIGH").items():
        into, separator = (ranges, ":") if ":" in values else (samples, ",")
        into[name] = [number(f"--envelope {name}", value) for value in values.split(separator)]
        if len(into[name]) < 2:
            raise ValueError(
                f"--envelope {name} must be LOW:HIGH or at least two samples, got {values!r}"
            )
    return Envelope(ranges, samples)


def _remarks(scene, options) -> list[str]:
    """What `friction_remark` says of the scene, over its envelope."""
    from ..optimise.envelope import Envelope
    from ..report import friction_remark

    if options.get("envelope") is not None:
        envelope = Envelope.of(options["envelope"])
        values = envelope.values(envelope.grid())
        scene = scene.replace(**dict(zip(envelope.names, values.T, strict=True)))
    return friction_remark(scene, scene.oscillator.V)


def _scene_text(best) -> str:
    from ..base.versions import version_text

    lines = [f"# {best.outcome}", f"# growth rate {best.growth_rate:+.6g} 1/s"]
    lines.append(f"# designed by {version_text()}")
    lines += [f"# not met: {name}" for name in best.violated]
    return "\n".join([*lines, best.scene.to_toml()])


def _history_text(best) -> str:
    titles = [f"{name} [{_UNITS[name]}]" if name in _UNITS else name for name in best.history]
    columns = [column.tolist() for column in best.history.values()]
    return csv_text(
        ["step", *titles], ([i, *row] for i, row in enumerate(zip(*columns, strict=True)))
    )
