"""`fractaljax design`: the nearest design that is stable against small disturbances."""

import inspect
from pathlib import Path
from typing import Any

from .json_text import design_content, files as paths, show
from .output import csv_text, import_pictures, npy, output, picture
from .parsing import (
    add_constant_friction,
    add_out,
    add_scene_file,
    kick_size,
    load_mechanism,
    number,
    numbers,
    parse_envelope,
    parse_pairs,
    remarks,
)

_UNITS = {"G": "m", "growth_rate": "1/s", "K_n": "N/m", "K_t": "N/m"}  # of the history
_LIMITS = {  # option: class of `fractaljax.constraints`, and its meaning
    "sq": ("Roughness", "Sq of the surface [m]"),
    "ra": ("Ra", "Ra of a profile of the surface [m], behind the filters of --cutoff"),
    "rz": ("Rz", "Rz of a profile of the surface [m], behind the filters of --cutoff"),
    "elastic-share": ("ElasticShare", "share of the load on elastic contacts"),
    "real-area": ("RealContactArea", "real contact area [m^2]"),
    "damping-ratio": ("DampingRatio", "least damping ratio"),
    "frequency": ("Frequency", "frequencies of all modes [Hz]"),
    "cycle-amplitude": ("CycleAmplitude", "peak-to-peak amplitude of the limit cycle in x1 [m]"),
    "velocity-level": ("VelocityLevel", "velocity level of the limit cycle in x1 [dB re 1 nm/s]"),
}
_OPTIONS = {  # plain arguments of `design`
    "target": (
        float,
        "largest growth rate allowed [1/s]; default -min(xi_i omega_i)/2",
    ),
    "K_n_min": (float, "least normal stiffness allowed [N/m]; default that of the scene"),
    "area_ratio_min": (float, "least a_l/a_e; default 2"),
    "slip_ratio_max": (float, "largest Q_e/(mu_s P); default 0.9"),
    "quantile": (float, "quantile of the scatter that counts; default 0.95"),
    "starts": (int, "how many designs the solver starts from; default 12, 8 of a structure"),
    "lattice": (int, "how many designs a side the starts are chosen from; default 48 or fewer"),
    "seed": (int, "seed of all draws; default 0"),
}
_SEVERAL = {
    "bounds": ("NAME=LOW:HIGH", "bounds on any quantities; default D=2.1:2.9 G=1e-12:1e-8"),
    "envelope": (
        "NAME=LOW:HIGH",
        "ranges, or NAME=V1,V2,V3 measured together, that the design withstands",
    ),
    "tolerance": (
        "NAME=SIGMA",
        "standard deviations as machined, such as D=0.01 lnG=0.1; or the tolerance.toml that "
        "`fractaljax identify` writes",
    ),
}


def add_design(commands) -> None:
    """Add `fractaljax design`."""
    parser = commands.add_parser(
        "design",
        help="find the nearest design that is stable against small disturbances",
        description=_run.__doc__,
    )
    add_scene_file(parser)
    add_constant_friction(parser)
    add_out(parser, "fractaljax-design")
    parser.pairs = "--D", "--G"
    for name, unit in (("D", ""), ("G", " [m]")):
        ends = ("LOW", "HIGH")
        parser.add_argument(
            f"--{name}",
            type=float,
            nargs=2,
            metavar=ends,
            help=f"as --bounds {name}=LOW:HIGH{unit}; LOW:HIGH is one word too",
        )
    for name, (form, meaning) in _SEVERAL.items():
        parser.add_argument(f"--{name}", action="extend", nargs="+", metavar=form, help=meaning)
    for name, (kind, meaning) in _OPTIONS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, help=meaning)
    parser.add_argument(
        "--risk", help="over the envelope: worst (the default), smooth, smooth:T or cvar:ALPHA"
    )
    for name, (_, meaning) in _LIMITS.items():
        parser.add_argument(
            f"--{name}", metavar="LOW:HIGH", help=f"limits: {meaning}; LOW or HIGH may be left out"
        )
    parser.add_argument(
        "--sq-lengths",
        type=float,
        nargs=2,
        metavar=("L", "L_S"),
        help="longest and shortest wavelength [m] that --sq counts, and --ra and --rz of a fractal "
        "surface; default 1e-3 1e-6",
    )
    parser.add_argument(
        "--cutoff",
        type=float,
        nargs=2,
        metavar=("LAMBDA_C", "LAMBDA_S"),
        help="longest and shortest wavelength [m] that the filters of --ra and --rz leave; default "
        "8e-4 2.5e-6",
    )
    parser.add_argument(
        "--quiet-within",
        metavar="R",
        help="every kick up to R, in units of V/omega and V, comes to rest; or a list of semi-axes "
        "in m and m/s, X1,X2,V1,V2",
    )
    parser.add_argument(
        "--area", type=float, help="nominal area [m^2], for a verdict by Persson's law too"
    )
    parser.add_argument(
        "--repeat", type=Path, metavar="FILE", help="run again what a run.toml holds, nothing else"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    allowed = {"repeat", "quiet", "out", "area", "json", "help"}  # beside --repeat
    design_options = [action.dest for action in parser.actions if action.dest not in allowed]
    parser.set_defaults(run=_run, design_options=design_options)


def _run(arguments) -> int:
    """Find the nearest design stable against small disturbances; write scene, run and pictures.

    The files: design.toml, run.toml and history.csv. For a scene with a fractal surface also
    design.png, where D and G are designed, topographies.png with the surfaces before and after, and
    topography.npy with the heights of the designed one [m].
    """
    from .. import plot
    from .._base.parts import scalar
    from .._design.design import design
    from .._design.design_file import design_files, read_design
    from ..plot.topography import drawn_topographies

    if arguments.repeat is None:
        options = _options(arguments)
        how = {"quiet": arguments.quiet, "changes": arguments.set}
        x = load_mechanism(arguments.scene, True, options["bounds"], **how)
    else:
        names = arguments.design_options
        conflicting = [name for name in names if getattr(arguments, name) not in (None, False)]
        if conflicting:
            raise ValueError(
                f"--repeat takes everything from its file, got {', '.join(conflicting)} too"
            )
        with remarks():
            x, options = read_design(arguments.repeat)
    if arguments.area is not None:  # before the computation, which a late error would lose
        scalar("--area", arguments.area, above=0)
        if x.sole_joint is None or not x.sole_joint.contact.has_surface:
            raise ValueError("--area needs a scene whose contact has a surface")
    import_pictures()
    with output(arguments.out) as write:
        best = design(x, **options, progress=not arguments.quiet)
        heights, designed = [], arguments.out / "design.toml"
        if x.sole_joint is None:
            made = best.scene._files(designed)
        else:
            made = {designed: _scene_text(best).encode()}
        made |= design_files(best, arguments.out / "run.toml")
        files = {path.name: content for path, content in made.items()}
        files["history.csv"] = _history_text(best).encode()
        if best.has_surface and set(best.bounds) <= {"D", "G"}:
            files["design.png"] = picture(plot.design(best).figure)
        if best.has_surface:
            surfaces = best.topographies()
            files["topographies.png"] = picture(drawn_topographies(best, surfaces))
            files["topography.npy"] = npy(surfaces.after)
            side, dx = len(surfaces.after), surfaces.dx
            heights = [f"topography.npy: {side} x {side} heights in m, dx = {dx:g} m"]
        written = write(files)
    *table, promise = str(best).splitlines()
    verdict_lines = [] if x.sole_joint is None else _verdict(x, best, arguments.area)
    lines = [*table, *_remarks(x, options), *verdict_lines, written, *heights, promise]
    content = {"promise": promise, "files": paths(arguments.out, files)}
    show(arguments, "\n".join(lines), lambda: design_content(best) | content)
    return 1 if best.violated else 0


def _verdict(x, best, area) -> list[str]:
    """The verdict on the designed scene; where no surface is quiet, what else makes x quiet."""
    from .._design.verdict import suggest, verdict

    keys = ("laws", "tolerance", "envelope", "friction_slope", "seed")
    options = {name: best.options[name] for name in keys}
    result = verdict(best.scene, area=area, **options)
    lines = ["", *str(result).splitlines(), ""]
    if result.incurable and best.violated:
        cure = suggest(x, target=best.options["target"], friction_slope=options["friction_slope"])
        lines += [*str(cure).splitlines(), ""]
    return lines


def _options(arguments) -> dict:
    """The arguments of `design`, from those of the command line."""
    from .._design.statement import DEFAULT_BOUNDS

    options = {name: getattr(arguments, name) for name in _OPTIONS}
    options = {name: value for name, value in options.items() if value is not None}
    options |= {"friction_slope": not arguments.constant_friction}
    options["bounds"] = {
        name: tuple(ends) for name in ("D", "G") if (ends := getattr(arguments, name))
    }
    if arguments.bounds is None:
        options["bounds"] = DEFAULT_BOUNDS | options["bounds"]
    else:
        for name, text in parse_pairs("--bounds", arguments.bounds, _SEVERAL["bounds"][0]).items():
            options["bounds"][name] = tuple(numbers(f"--bounds {name}", text, ":"))
    options["constraints"] = _constraints(arguments)
    if arguments.quiet_within is not None:
        options["quiet_within"] = kick_size("--quiet-within", arguments.quiet_within)
    if arguments.risk is not None:
        kind, _, value = arguments.risk.partition(":")
        options["risk"] = (kind, number("--risk", value)) if value else kind
    if arguments.envelope is not None:
        options["envelope"] = parse_envelope(arguments.envelope)
    if arguments.tolerance is not None:
        options["tolerance"] = _tolerance(arguments.tolerance)
    return options


def _tolerance(texts: list[str]) -> Any:
    """Standard deviations by name, or the errors in a file that `fractaljax identify` writes."""
    from .._design.design_file import read_tolerance

    if len(texts) == 1 and "=" not in texts[0] and texts[0].endswith(".toml"):
        return read_tolerance(texts[0])
    return {
        f"ln {name[2:]}" if name.startswith("ln") else name: number("--tolerance", text)
        for name, text in parse_pairs("--tolerance", texts, "NAME=SIGMA").items()
    }


def _constraints(arguments) -> list:
    from .._design import constraints

    drawn = arguments.ra, arguments.rz
    if arguments.sq_lengths is not None and not any((arguments.sq, *drawn)):
        raise ValueError("--sq-lengths needs --sq, --ra or --rz")
    if arguments.cutoff is not None and not any(drawn):
        raise ValueError("--cutoff needs --ra or --rz")
    more: dict = dict(zip(("L", "L_s"), arguments.sq_lengths or (1e-3, 1e-6), strict=True))
    more |= zip(("cutoff", "shortest"), arguments.cutoff or (8e-4, 2.5e-6), strict=True)
    more["friction_slope"] = not arguments.constant_friction
    limits = []
    for name, (kind, _) in _LIMITS.items():
        text = getattr(arguments, name.replace("-", "_"))
        if text is None:
            continue
        low, _, high = text.partition(":")
        ends = {"at_least": low, "at_most": high}
        values = {end: number(f"--{name}", x) if x else None for end, x in ends.items()}
        law = getattr(constraints, kind)
        takes = inspect.signature(law).parameters
        for end, only in (
            ("at_most", "a lower limit only: LOW:"),
            ("at_least", "an upper limit only: :HIGH"),
        ):
            if values[end] is not None and end not in takes:
                raise ValueError(f"--{name} has {only}")
        limits.append(law(**{key: x for key, x in (values | more).items() if key in takes}))
    return limits


def _remarks(x, options) -> list[str]:
    """The lines of `friction_remark` for a scene, over its envelope."""
    from .._design.envelope import Envelope
    from .._mechanism.quantities import replaced
    from .._stability.summary import friction_remark

    if x.sole_joint is None:
        return []
    if options.get("envelope") is not None:
        envelope = Envelope.of(options["envelope"])
        values = envelope.values(envelope.grid())
        x = replaced(x, dict(zip(envelope.names, values.T, strict=True)))
    return friction_remark(x, x.oscillator.V)


def _scene_text(best) -> str:
    from .._base.versions import version_text

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
