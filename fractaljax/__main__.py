"""The `fractaljax` command: design, stability, cycle, identify, scene."""

import sys

from .command.cycle import add_cycle
from .command.design import add_design
from .command.identify import add_identify
from .command.parsing import Parser, refuse
from .command.scene import add_scene
from .command.stability import add_stability


def _parser() -> Parser:
    parser = Parser(prog="fractaljax", description="From a machined surface to a stable mechanism.")
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
    try:
        return arguments.run(arguments)
    except (ValueError, TypeError, OSError) as error:
        refuse(error)
    except KeyboardInterrupt:
        print("fractaljax: interrupted, nothing written", file=sys.stderr)
        return 130
    return 2


if __name__ == "__main__":
    sys.exit(main())
