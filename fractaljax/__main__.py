"""The `fractaljax` command: design, stability, cycle, scene."""

import argparse
import contextlib
import csv
import io
import re
import sys
import tempfile
from pathlib import Path


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        # Older Pythons take -1e-5 for an option.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message):
        _refuse(message)


def _refuse(message) -> None:
    """One line on standard error, and exit status 2."""
    line = " ".join(str(message).split())
    print(f"fractaljax: {line}", file=sys.stderr)
    raise SystemExit(2)


def _parser() -> _Parser:
    parser = _Parser(
        prog="fractaljax", description="From a machined surface to a stable mechanism."
    )
    commands = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)

    design = commands.add_parser(
        "design", help="find the nearest surface that does not squeal", description=_design.__doc__
    )
    _add_scene(design)
    _add_constant_friction(design)
    design.add_argument("--out", type=Path, default=Path("fractaljax-design"), metavar="FOLDER")
    design.add_argument("--D", type=float, nargs=2, metavar=("LOW", "HIGH"), help="bounds on D")
    design.add_argument("--G", type=float, nargs=2, metavar=("LOW", "HIGH"), help="on G [m]")
    design.add_argument("--target", type=float, help="largest growth rate allowed [1/s]")
    design.add_argument("--K-n-min", type=float, help="least normal stiffness allowed [N/m]")
    design.add_argument("--area-ratio-min", type=float, help="least a_l/a_e")
    design.add_argument("--slip-ratio-max", type=float, help="largest Q_e/(mu_s P)")
    _add_conditions(design)
    _add_constraints(design)
    design.add_argument("--starts", type=int, help="surfaces improved side by side")
    design.add_argument("--lattice", type=int, help="surfaces a side that starts are chosen from")
    design.add_argument("--seed", type=int, help="of the surfaces drawn as machined; default 0")
    design.add_argument(
        "--repeat", type=Path, metavar="FILE", help="run again what a run.toml holds, nothing else"
    )
    design.add_argument("--quiet", action="store_true", help="no progress bar")
    design.set_defaults(run=_design)

    stability = commands.add_parser(
        "stability", help="print the stability of a scene", description=_stability.__doc__
    )
    _add_scene(stability)
    _add_constant_friction(stability)
    stability.set_defaults(run=_stability)

    cycle = commands.add_parser(
        "cycle", help="find the stick-slip limit cycle", description=_cycle.__doc__
    )
    _add_scene(cycle)
    cycle.add_argument("--out", type=Path, default=Path("fractaljax-cycle"), metavar="FOLDER")
    cycle.add_argument(
        "--start",
        type=float,
        nargs=4,
        metavar=("X1", "X2", "V1", "V2"),
        help="where the motion starts [m, m, m/s, m/s]; else near the sliding equilibrium",
    )
    cycle.add_argument("--rtol", type=float, default=1e-9, help="of period and states")
    cycle.add_argument(
        "--max-turns", type=int, default=5000, help="turns of the motion after which to give up"
    )
    cycle.set_defaults(run=_cycle)

    scene = commands.add_parser(
        "scene", help="print a scene file to start from", description=_scene.__doc__
    )
    scene.set_defaults(run=_scene)
    return parser


def _add_scene(parser) -> None:
    parser.add_argument(
        "scene", nargs="?", type=Path, help="a scene file; else the reference brake"
    )


def _add_conditions(parser) -> None:
    parser.add_argument(
        "--envelope",
        nargs="+",
        metavar="NAME=LOW:HIGH",
        help="ranges, or NAME=V1,V2,V3 measured together, that the design withstands",
    )
    parser.add_argument("--risk", help="worst (the default), smooth, smooth:T or cvar:ALPHA")
    parser.add_argument(
        "--tolerance",
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


def _add_constant_friction(parser) -> None:
    parser.add_argument(
        "--constant-friction",
        action="store_true",
        help="leave out the slope of the friction law (the source's Eq. 43)",
    )


def _load(arguments):
    from .scene import Scene, brake_scene

    return brake_scene() if arguments.scene is None else Scene.load(arguments.scene)


def _scene(arguments) -> int:
    """Print the reference brake as a scene file."""
    from .scene import brake_scene

    print(brake_scene().to_toml(), end="")
    return 0


def _stability(arguments) -> int:
    """Print the joint, the critical mode and the eigenvalues of a scene.

    Of a structure (a file with a table of that name): the joints, and the modes that are unstable
    or least damped.
    """
    from .report import stability_table, structure_table
    from .scene import brake_scene
    from .structure import Structure, load

    subject = brake_scene() if arguments.scene is None else load(arguments.scene)
    slope = not arguments.constant_friction
    if isinstance(subject, Structure):
        print(structure_table(subject, slope))
    else:
        print(stability_table(subject, slope))
    return 0


def _design(arguments) -> int:
    """Find the nearest stable surface; write design.toml, run.toml, history.csv and design.png."""
    from . import plot
    from .design import design
    from .design_file import design_text, read_design

    if arguments.repeat is None:
        scene, options = _load(arguments), _options(arguments)
    else:
        given = [name for name in _OWN if getattr(arguments, name) not in (None, False)]
        if given:
            raise ValueError(f"--repeat takes everything from its file, got {', '.join(given)} too")
        scene, options = read_design(arguments.repeat)
    with _output(arguments.out) as write:
        best = design(scene, **options, progress=not arguments.quiet)
        files = {
            "design.toml": _scene_text(best).encode(),
            "run.toml": design_text(best).encode(),
            "history.csv": _history_text(best).encode(),
            "design.png": _picture(plot.design(best).figure),
        }
        write(files)
    print(best)
    print(f"written to {arguments.out}: {', '.join(files)}")
    return 1 if best.violated else 0


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


def _options(arguments) -> dict:
    """The arguments of `design` that a command asks for."""
    from .task import DEFAULT_BOUNDS

    asked = {"D": arguments.D, "G": arguments.G}
    bounds = DEFAULT_BOUNDS | {name: tuple(ends) for name, ends in asked.items() if ends}
    options = {name: getattr(arguments, name) for name in _OPTIONS}
    options = {name: value for name, value in options.items() if value is not None}
    options |= {"bounds": bounds, "friction_slope": not arguments.constant_friction}
    options["constraints"] = _constraints(arguments)
    if arguments.risk is not None:
        kind, _, number = arguments.risk.partition(":")
        options["risk"] = (kind, _float("--risk", number)) if number else kind
    if arguments.envelope is not None:
        options["envelope"] = _envelope(arguments.envelope)
    if arguments.tolerance is not None:
        pairs = [_pair("--tolerance", text, "NAME=SIGMA") for text in arguments.tolerance]
        options["tolerance"] = {
            "ln G" if name == "lnG" else name: _float("--tolerance", text) for name, text in pairs
        }
    return options


def _constraints(arguments) -> list:
    from . import constraints

    limits = {
        name: _limits(f"--{name}", getattr(arguments, name.replace("-", "_"))) for name in _LIMITS
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


def _limits(option, text):
    """LOW:HIGH as two numbers, either of them None where it is absent; LOW alone is LOW:."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    return tuple(_float(option, end) if end else None for end in (low, high))


def _envelope(texts):
    from .envelope import Envelope

    ranges, samples = {}, {}
    for name, values in (_pair("--envelope", text, "NAME=LOW:HIGH") for text in texts):
        into, separator = (ranges, ":") if ":" in values else (samples, ",")
        into[name] = [_float(f"--envelope {name}", value) for value in values.split(separator)]
    return Envelope(ranges, samples)


def _pair(option, text, form):
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise ValueError(f"{option} must be {form}, got {text!r}")
    return name, value


def _float(option, text) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{option} must be numbers, got {text!r}") from None


def _cycle(arguments) -> int:
    """Find the limit cycle that the motion ends in; write cycle.png and cycle.csv."""
    from . import plot
    from .limit_cycle import CycleResult, limit_cycle
    from .report import cycle_table

    scene = _load(arguments)
    with _output(arguments.out) as write:
        cycle = limit_cycle(
            scene,
            arguments.start,
            rtol=arguments.rtol,
            max_turns=arguments.max_turns,
            throw=False,
        )
        found = cycle.result in (CycleResult.converged, CycleResult.inaccurate)
        files = {}
        if found:
            files["cycle.png"] = _picture(plot.cycle(cycle))
            files["cycle.csv"] = _orbit_text(cycle).encode()
            write(files)
    print(cycle_table(scene, cycle))
    if found:
        print(f"written to {arguments.out}: {', '.join(files)}")
    return 0 if found else 1


@contextlib.contextmanager
def _output(folder: Path):
    """Make sure that files can be written to `folder`, and offer to write {name: content} there.

    Where nothing has been written at the end, folders made for it are removed.
    """
    from .scene_file import write_whole

    def write(files):
        for name, content in files.items():
            write_whole(folder / name, content)

    created = _make_folder(folder)
    try:
        yield write
    finally:
        with contextlib.suppress(OSError):  # no longer empty
            for made in created:
                made.rmdir()


def _make_folder(path: Path) -> list[Path]:
    """Make sure that files can be written to a folder; returns those it made, innermost first."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=path):
        return missing


def _scene_text(best) -> str:
    lines = [f"# {best.outcome}", f"# growth rate {best.growth_rate:+.6g} 1/s"]
    lines += [f"# not met: {name}" for name in best.violated]
    return "\n".join([*lines, best.scene.to_toml()])


_SAMPLES = 512  # of one period
_UNITS = {"G": "m", "growth_rate": "1/s", "K_n": "N/m", "K_t": "N/m"}


def _history_text(best) -> str:
    titles = [f"{name} [{_UNITS[name]}]" if name in _UNITS else name for name in best.history]
    columns = [column.tolist() for column in best.history.values()]
    return _csv_text(
        ["step", *titles], ([i, *row] for i, row in enumerate(zip(*columns, strict=True)))
    )


def _orbit_text(cycle) -> str:
    t, states = cycle.orbit(_SAMPLES)
    titles = ["time [s]", "x1 [m]", "x2 [m]", "v1 [m/s]", "v2 [m/s]"]
    rows = zip(t.tolist(), states.tolist(), strict=True)
    return _csv_text(titles, ([time, *state] for time, state in rows))


def _csv_text(titles, rows) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(titles)
    writer.writerows(rows)
    return text.getvalue()


def _picture(figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=150)
    return content.getvalue()


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit status.

    0, or 1 for an infeasible design or no limit cycle, or 2 for bad input.
    """
    arguments = _parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    try:
        return arguments.run(arguments)
    except (ValueError, TypeError, OSError) as error:
        _refuse(error)
    except KeyboardInterrupt:
        print("fractaljax: interrupted, nothing written", file=sys.stderr)
        return 130
    return 2


if __name__ == "__main__":
    sys.exit(main())
