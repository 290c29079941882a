"""The `fractaljax` command: design, stability, cycle, identify, scene."""

import contextlib
import logging
import os
import signal
import sys
import threading

from ._version import __version__
from .command.compiled import keep_compiled
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
    input, or 128 and the number of the signal that ended it.
    """
    arguments = _parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    # A check that fails while a program runs is told below, without the traceback logged here.
    logging.getLogger("jax._src.callback").setLevel(logging.CRITICAL)
    try:
        with _ended_by(signal.SIGTERM):
            status = arguments.run(arguments)
        if sys.stdout is not None:  # as where it was closed from the start
            sys.stdout.flush()
        return status
    except BrokenPipeError:
        _drop_output()
        print("fractaljax: standard output was closed", file=sys.stderr)
        return 141  # as a shell says it of SIGPIPE
    except KeyboardInterrupt:
        print("fractaljax: interrupted, nothing written", file=sys.stderr)
        return 130
    except Exception as error:
        _drop_output()
        message = reason(error)
        if message is None:  # a defect: its traceback is what helps
            raise
        refuse(message)
    return 2


@contextlib.contextmanager
def _ended_by(number: signal.Signals):
    """Let a signal end the command as Ctrl-C does, with nothing half-written."""

    def end(*_):
        print("fractaljax: terminated, nothing written", file=sys.stderr)
        raise SystemExit(128 + number)

    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(number) is not signal.SIG_DFL:
        yield
        return
    signal.signal(number, end)
    try:
        yield
    finally:
        signal.signal(number, signal.SIG_DFL)


def _drop_output() -> None:
    """Forget output that cannot be written, which Python would try once more at its end."""
    stream = sys.stdout
    if stream is None:
        return
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    sys.exit(main())
