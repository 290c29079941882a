"""The command `python -m benchmarks`."""

import argparse
import importlib
from pathlib import Path

import jax

from .page import INDEX, index, measured, write

NAMES = (
    "boundary_element branches contact eigenvalues extremes first_answers growth_rate limit_cycle"
    " many_cycles many_designs many_dofs reduction scale scene_cost whole_design"
)
PAGES = {name: importlib.import_module(f".{name}", __package__) for name in NAMES.split()}


def main() -> None:
    """Run every benchmark, or those named; write JSON, page and picture of each, and an index."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=main.__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PAGES)}; all")
    parser.add_argument("--quick", action="store_true", help="a small grid, for the tests")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()
    for name in arguments.names:
        if name not in PAGES:
            parser.error(f"NAME must be one of {', '.join(PAGES)}, got {name}")
    jax.config.update("jax_enable_x64", True)
    for name in arguments.names or PAGES:
        result = measured(PAGES[name], arguments.quick)
        print(*write(arguments.out, name, PAGES[name], result), sep="\n")
    (arguments.out / INDEX).write_text(index(arguments.out))
    print(arguments.out / INDEX)


if __name__ == "__main__":
    main()
