"""`fractaljax cycle`: the stick-slip limit cycle of a scene."""

from pathlib import Path

from .output import csv_text, output, picture
from .parsing import add_scene_file, load_scene

_SAMPLES = 512  # of one period


def add_cycle(commands) -> None:
    """Add `fractaljax cycle`."""
    parser = commands.add_parser(
        "cycle", help="find the stick-slip limit cycle", description=_run.__doc__
    )
    add_scene_file(parser)
    parser.add_argument("--out", type=Path, default=Path("fractaljax-cycle"), metavar="FOLDER")
    parser.add_argument(
        "--start",
        type=float,
        nargs=4,
        metavar=("X1", "X2", "V1", "V2"),
        help="where the motion starts [m, m, m/s, m/s]; else near the sliding equilibrium",
    )
    parser.add_argument("--rtol", type=float, default=1e-9, help="of period and states")
    parser.add_argument(
        "--max-turns", type=int, default=5000, help="turns of the motion after which to give up"
    )
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Find the limit cycle that the motion ends in; write cycle.png and cycle.csv."""
    from .. import plot
    from ..modes.stability import require_computable
    from ..motion.limit_cycle import CycleResult, limit_cycle
    from ..report import cycle_table

    scene = load_scene(arguments)
    require_computable(scene)
    with output(arguments.out) as write:
        cycle = limit_cycle(
            scene,
            arguments.start,
            rtol=arguments.rtol,
            max_turns=arguments.max_turns,
            throw=False,
        )
        found = cycle.result in (
            CycleResult.converged,
            CycleResult.inaccurate,
            CycleResult.unstable,
        )
        if found:
            written = write(
                {
                    "cycle.png": picture(plot.cycle(cycle)),
                    "cycle.csv": _orbit_text(cycle).encode(),
                }
            )
    print(cycle_table(scene, cycle))
    if found:
        print(written)
    return 0 if found else 1


def _orbit_text(cycle) -> str:
    t, states = cycle.orbit(_SAMPLES)
    titles = ["time [s]", "x1 [m]", "x2 [m]", "v1 [m/s]", "v2 [m/s]"]
    rows = zip(t.tolist(), states.tolist(), strict=True)
    return csv_text(titles, ([time, *state] for time, state in rows))
