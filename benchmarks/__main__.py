"""The command `python -m benchmarks`."""

import argparse
from pathlib import Path

import jax

from . import contact, scene_cost
from .cycles import limit_cycle, many_cycles
from .designs import whole_design
from .extreme import extremes
from .growth import eigenvalues, growth_rate
from .index import write_index
from .page import write
from .sweeps import scale

BENCHMARKS = {
    "contact": contact,
    "eigenvalues": eigenvalues,
    "extremes": extremes,
    "growth_rate": growth_rate,
    "limit_cycle": limit_cycle,
    "many_cycles": many_cycles,
    "scale": scale,
    "scene_cost": scene_cost,
    "whole_design": whole_design,
}


def main() -> None:
    """Run every benchmark, or those named; write JSON, page and picture of each, and an index."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=main.__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}; all")
    parser.add_argument("--quick", action="store_true", help="a small grid, for the tests")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    for name in arguments.names:
        if name not in BENCHMARKS:
            parser.error(f"NAME must be one of {', '.join(BENCHMARKS)}, got {name}")
    jax.config.update("jax_enable_x64", True)
    for name in arguments.names or BENCHMARKS:
        page = BENCHMARKS[name]
        result = page.measure(arguments.quick)
        for path in write(arguments.out, name, result, page.text(result), page.picture(result)):
            print(path)
    print(write_index(arguments.out))


if __name__ == "__main__":
    main()
