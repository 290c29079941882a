"""The `fractaljax` command: design, stability, cycle, identify, scene."""

import logging
import sys

from ._version import __version__
from .command.cycle import add_cycle
from .command.design import add_design
from .command.identify import add_identify
from .command.parsing import Parser, reason, refuse
from .command.scene import add_scene
from .command.stability import add_stability


def _parser() -> Parser:
    parser = Parser(prog="fractaljax", description="From a machined surface to a stable mechanism.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=Parser)
    for add in (add_design, add_stability, add_cycle, add_identify, add_scene):
        add(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit status.

    0, or 1 for an infeasible design, no limit cycle or a surface that is not fractal, or 2 for bad
    input.
    """
    arguments = _parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    # A check that fails while a program runs is told below, without the traceback logged here.
    logging.getLogger("jax._src.callback").setLevel(logging.CRITICAL)
    try:
        return arguments.run(arguments)
    except KeyboardInterrupt:
        print("fractaljax: interrupted, nothing written", file=sys.stderr)
        return 130
    except Exception as error:
        message = reason(error)
        if message is None:  # a defect: its traceback is what helps
            raise
        refuse(message)
    return 2


if __name__ == "__main__":
    sys.exit(main())
