"""The command `python -m benchmarks`."""

import argparse
from pathlib import Path

import jax

from . import contact, eigenvalues, growth_rate, limit_cycle, scene_cost

BENCHMARKS = {
    "contact": contact,
    "eigenvalues": eigenvalues,
    "growth_rate": growth_rate,
    "limit_cycle": limit_cycle,
    "scene_cost": scene_cost,
}


def main() -> None:
    """Run every benchmark, or those named, and write JSON, table and picture of each."""
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
        for path in BENCHMARKS[name].run(arguments.out, arguments.quick):
            print(path)


if __name__ == "__main__":
    main()
