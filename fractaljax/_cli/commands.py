"""`fractaljax stability`, `cycle` and `scene`."""

from pathlib import Path

from .json_text import cycle_content, files as paths, quantities, show, stability_content
from .output import csv_text, import_pictures, output, picture
from .parsing import add_constant_friction, add_out, add_scene_file, add_set, load_mechanism

_FOLDER = "fractaljax-stability"  # of the pictures of modes


def add_stability(commands) -> None:
    """Add `fractaljax stability`."""
    parser = commands.add_parser(
        "stability", help="print the stability of a scene", description=_stability.__doc__
    )
    add_scene_file(parser)
    add_constant_friction(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help=f"folder for pictures of the modes of a structure with a mesh; default {_FOLDER}",
    )
    parser.set_defaults(run=_stability)


def _stability(arguments) -> int:
    """Print the joint, the critical mode and the eigenvalues of a scene.

    For a structure (a file with a table of that name): the joints, and the modes that are unstable
    or least damped. With a mesh, pictures of the unstable modes, mode_1.png and so on, or of the
    first one.
    """
    from .._stability.summary import stability_table

    subject, slope = (
        load_mechanism(arguments.scene, structures=True, changes=arguments.set),
        not arguments.constant_friction,
    )
    if subject.mesh is None:
        if arguments.out is not None:
            raise ValueError("--out needs a structure whose file names a mesh, to draw its modes")
        show(arguments, stability_table(subject, slope), lambda: stability_content(subject, slope))
        return 0
    with output(arguments.out or Path(_FOLDER)) as write:
        files = _mode_pictures(subject, slope)
        written = write(files)
    folder = arguments.out or Path(_FOLDER)
    show(
        arguments,
        f"{stability_table(subject, slope)}\n{written}",
        lambda: stability_content(subject, slope) | {"files": paths(folder, files)},
    )
    return 0


def _mode_pictures(structure, friction_slope: bool, most: int = 8) -> dict[str, bytes]:
    """Pictures of the unstable modes, the fastest first, or of the first of all, by file name.

    At most `most` are drawn.
    """
    from .. import plot
    from .._stability.stability import stability

    modes, mesh = stability(structure, friction_slope), structure.mesh.arrays()
    drawn = (modes.unstable() or modes._modes()[:1])[:most]
    files = {}
    for i, mode in enumerate(drawn, start=1):
        ax = plot.complex_mode(structure.full(mode.shape), **mesh)
        words = f"{mode.frequency:.5g} Hz, growth rate {mode.growth_rate:.4g} 1/s"
        ax.set_title(words, fontsize="medium", loc="left")
        files[f"mode_{i}.png"] = picture(ax.figure)
    return files


def add_cycle(commands) -> None:
    """Add `fractaljax cycle`."""
    parser = commands.add_parser(
        "cycle", help="find the stick-slip limit cycle", description=_cycle.__doc__
    )
    add_scene_file(parser)
    add_out(parser, "fractaljax-cycle")
    parser.add_argument(
        "--start",
        type=float,
        nargs="+",
        metavar=("X1", "X2"),
        help="where the motion starts: displacements [m], then velocities [m/s], of every degree of"
        " freedom (a scene has two); else near the sliding equilibrium",
    )
    parser.add_argument(
        "--rtol", type=float, help="relative error of period and states; default 1e-9"
    )
    parser.add_argument(
        "--max-returns", type=int, help="returns of the Poincare map before giving up; default 5000"
    )
    parser.set_defaults(run=_cycle)


def _cycle(arguments) -> int:
    """Find the limit cycle that the motion ends in; write cycle.png and cycle.csv.

    The file holds a scene or a structure (a table of that name); if it has a mesh, motion.png
    shows the motion on it.
    """
    import jax

    from .. import plot
    from .._dynamics.limit_cycle import CycleResult, limit_cycle
    from .._dynamics.summary import cycle_table
    from .._stability.stability import require_computable

    scene = load_mechanism(arguments.scene, structures=True, changes=arguments.set)
    files: dict[str, bytes] = {}
    require_computable(scene)
    options = {name: getattr(arguments, name) for name in ("start", "rtol", "max_returns")}
    options = {name: value for name, value in options.items() if value is not None}
    import_pictures()
    with output(arguments.out) as write:
        cycle = jax.device_get(limit_cycle(scene, **options, throw=False))  # NumPy from here on
        exists = CycleResult.converged, CycleResult.inaccurate, CycleResult.unstable
        has_cycle = cycle.result in exists
        if has_cycle:
            figure, table = picture(plot.cycle(cycle)), _orbit_text(cycle).encode()
            files = {"cycle.png": figure, "cycle.csv": table}
            if scene.mesh is not None:
                files["motion.png"] = picture(plot.cycle_motion(cycle, scene))
            written = write(files)
    show(
        arguments,
        lambda: "\n".join([cycle_table(scene, cycle), *([written] if has_cycle else [])]),
        lambda: cycle_content(scene, cycle) | {"files": paths(arguments.out, files)},
    )
    return 0 if has_cycle else 1


def _orbit_text(cycle, samples: int = 512) -> str:
    t, states = cycle.orbit(samples)
    dofs = range(1, 1 + len(cycle.amplitude))
    titles = ["time [s]", *(f"x{i} [m]" for i in dofs), *(f"v{i} [m/s]" for i in dofs)]
    rows = zip(t.tolist(), states.tolist(), strict=True)
    return csv_text(titles, ([time, *state] for time, state in rows))


def add_scene(commands) -> None:
    """Add `fractaljax scene`."""
    parser = commands.add_parser(
        "scene", help="print a scene file to start from", description=_scene.__doc__
    )
    add_set(parser)
    parser.set_defaults(run=_scene)


def _scene(arguments) -> int:
    """Print the reference brake as a scene file."""
    scene = load_mechanism(None, changes=arguments.set)
    show(arguments, scene.to_toml().removesuffix("\n"), lambda: {"quantities": quantities(scene)})
    return 0
