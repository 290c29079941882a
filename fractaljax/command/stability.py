"""`fractaljax stability`: the joint, the critical mode and the eigenvalues of a scene."""

from .parsing import add_constant_friction, add_scene_file


def add_stability(commands) -> None:
    """Add `fractaljax stability`."""
    parser = commands.add_parser(
        "stability", help="print the stability of a scene", description=_run.__doc__
    )
    add_scene_file(parser)
    add_constant_friction(parser)
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """Print the joint, the critical mode and the eigenvalues of a scene.

    Of a structure (a file with a table of that name): the joints, and the modes that are unstable
    or least damped.
    """
    from ..mechanism.scene import brake_scene
    from ..mechanism.structure import Structure, load
    from ..report import stability_table, structure_table

    subject = brake_scene() if arguments.scene is None else load(arguments.scene)
    slope = not arguments.constant_friction
    if isinstance(subject, Structure):
        print(structure_table(subject, slope))
    else:
        print(stability_table(subject, slope))
    return 0
