"""The `fractaljax` command and its list of commands."""

import contextlib
import gc
import os
import signal
import sys
import threading


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status.

    It is 0; 1 for an infeasible design, no limit cycle, a surface that is not fractal or a
    published number that is not met; 2 for bad input; or 128 plus the number of the signal that
    ended it.
    """
    from ._cli.commands import add_cycle, add_scene, add_stability
    from ._cli.contact import add_contact
    from ._cli.design import add_design
    from ._cli.explore import add_explore
    from ._cli.identify import add_identify
    from ._cli.map import add_map
    from ._cli.parsing import Parser, Version, reason, refuse
    from ._cli.reduce import add_reduce
    from ._cli.validate import add_validate

    parser = Parser(
        prog="fractaljax",
        description="From a machined surface to a stable mechanism.",
        epilog="Without a scene file a command takes the reference brake; `fractaljax scene > "
        "brake.toml` writes it as a file to change. `fractaljax COMMAND --help` lists the options.",
    )
    parser.add_argument("--version", action=Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", parser_class=Parser
    )
    for add in (
        add_design,
        add_stability,
        add_cycle,
        add_reduce,
        add_map,
        add_explore,
        add_contact,
        add_identify,
        add_validate,
        add_scene,
    ):
        add(commands)
    parser.commands = tuple(commands.choices)
    words = sys.argv[1:] if argv is None else argv
    if not words:
        parser.print_help()
        return 0
    arguments = parser.parse_args(words)
    # Garbage collection among the modules, which stay, took a tenth of a command's time.
    gc.set_threshold(50_000, 20, 50)
    import jax

    from ._base.programs import keep_programs

    jax.config.update("jax_enable_x64", True)
    try:
        with _interruptible(), keep_programs(), _terminable():
            status = arguments.run(arguments)
        if sys.stdout is not None:  # None where it was closed from the start
            sys.stdout.flush()
        return status
    except BrokenPipeError:
        _drop_output()
        print("fractaljax: standard output was closed", file=sys.stderr)
        return 128 + 13  # SIGPIPE
    except KeyboardInterrupt:
        print("fractaljax: interrupted, nothing written", file=sys.stderr)
        return 128 + signal.SIGINT
    except Exception as error:
        _drop_output()
        message = reason(error)
        if message is None:  # a defect, which needs its traceback
            raise
        refuse(message)
    return 2


def command() -> int:
    """Run `main` as a process of its own, which ends without a last garbage collection."""
    # While modules load, they could take an exception for an error of their own.
    signal.signal(signal.SIGINT, _end_at_once)
    try:
        return main()
    finally:
        gc.freeze()


def _end_at_once(*_) -> None:
    """End an interrupted command before it has begun."""
    os.write(2, b"fractaljax: interrupted, nothing written\n")
    os._exit(128 + signal.SIGINT)


@contextlib.contextmanager
def _interruptible():
    """Let Ctrl-C end a command that runs by itself, whatever it meets.

    An exception is lost in a callback of the garbage collector, so that it waits for the end of
    one; and a library may make an error of its own of it.
    """
    if signal.getsignal(signal.SIGINT) is not _end_at_once:
        yield
        return
    collecting = interrupted = False

    def begin(phase, _):
        nonlocal collecting
        collecting |= phase == "start"

    def end(phase, _):
        nonlocal collecting
        collecting &= phase == "start"

    def interrupt(*_):
        nonlocal interrupted
        if collecting:
            threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
            return
        interrupted = True
        raise KeyboardInterrupt

    gc.callbacks.insert(0, begin)
    gc.callbacks.append(end)
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    except Exception as error:
        if interrupted:
            raise KeyboardInterrupt from error
        raise
    finally:
        gc.callbacks.remove(begin)
        gc.callbacks.remove(end)


@contextlib.contextmanager
def _terminable():
    """Let SIGTERM end the command as Ctrl-C does, with nothing half-written."""

    def end(*_):
        print("fractaljax: terminated, nothing written", file=sys.stderr)
        raise SystemExit(128 + signal.SIGTERM)

    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _drop_output() -> None:
    """Discard output that cannot be written. Python would try again when it exits."""
    stream = sys.stdout
    if stream is None:
        return
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    sys.exit(command())
