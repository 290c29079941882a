"""`fractaljax scene`: a scene file to start from."""


def add_scene(commands) -> None:
    """Add `fractaljax scene`."""
    parser = commands.add_parser(
        "scene", help="print a scene file to start from", description=_run.__doc__
    )
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Print the reference brake as a scene file."""
    from ..mechanism.scene import brake_scene

    print(brake_scene().to_toml(), end="")
    return 0
