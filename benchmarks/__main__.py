"""The command `python -m benchmarks`."""

import argparse
from pathlib import Path

import jax

from . import growth_rate, limit_cycle


def main() -> None:
    """Run every benchmark and write its JSON, its table and its picture."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=main.__doc__)
    parser.add_argument("--quick", action="store_true", help="a small grid, for the tests")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for benchmark in (growth_rate, limit_cycle):
        for path in benchmark.run(arguments.out, arguments.quick):
            print(path)


if __name__ == "__main__":
    main()
