"""`fractaljax contact`: the stiffness of a joint by every contact law."""

from pathlib import Path
from typing import Any

from .json_text import comparison_content, files as paths, show
from .output import csv_text, output, picture
from .parsing import add_out, add_set, load_mechanism, numbers, remarks

_OPTIONS: dict[str, dict[str, Any]] = {
    "--area": {"type": float, "help": "nominal area of the joint [m^2], if not in the scene"},
    "--loads": {
        "metavar": "LOW:HIGH",
        "help": "normal loads [N]; default a tenth to ten times that of the scene",
    },
    "--points": {"type": int, "default": 9, "help": "how many loads; default 9"},
    "--L": {
        "type": float,
        "help": "longest wavelength [m], or side of the surfaces of a spectrum without D and G; "
        "default the side of the area, or less",
    },
    "--L-s": {"type": float, "help": "shortest wavelength [m] of a fractal surface; default 4 L/n"},
    "--n": {"type": int, "help": "points of a boundary-element surface along a side; default 128"},
    "--seeds": {"type": int, "help": "how many such surfaces, 0 for none; default 4"},
    "--scene": {
        "type": Path,
        "dest": "joint",
        "metavar": "FILE",
        "help": "scene with the material and the load of a map; default the reference brake",
    },
    "--dx": {"type": float, "help": "step between heights of a map [m], if not in the file"},
    "--dy": {"type": float, "help": "step across the map [m], if not in the file; default dx"},
    "--unit": {"help": "unit of the heights, if not in the file: m, mm, um, nm"},
    "--channel": {"help": "name or number of one of several in the file"},
}


def add_contact(commands) -> None:
    """Add `fractaljax contact`."""
    parser = commands.add_parser(
        "contact", help="compare contact laws with boundary elements", description=_run.__doc__
    )
    parser.add_argument(
        "scene",
        nargs="?",
        type=Path,
        help="a scene file, or a measured map: CSV, NPY or an instrument's own format; else the"
        " reference brake",
    )
    for name, options in _OPTIONS.items():
        parser.add_argument(name, **options)
    add_set(parser)
    add_out(parser, "fractaljax-contact")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_run)


def _run(arguments) -> int:
    """K_n, K_t, d ln K_n/d ln P and the real area of a scene's joint by every contact law.

    Beside them boundary elements on surfaces of the same spectrum. Laws that need D and G are left
    out where the surface has none. Writes contact.png, contact.csv.
    With a measured map: its stiffness by boundary elements, and by its spectrum, both of as many
    copies of the map as go into the area of the joint. Writes scene.toml, a scene with the measured
    law, and contact.csv.
    """
    if arguments.scene is not None and arguments.scene.suffix != ".toml":
        from .contact_map import run_map

        return run_map(arguments)
    import numpy as np

    from .. import plot
    from .._contact.compare import compare_laws
    from .._surface.spectrum import Spectrum

    scene = load_mechanism(arguments.scene, changes=arguments.set)
    law, friction = scene.contact, scene.friction
    if not isinstance(getattr(law, "surface", None), Spectrum):
        raise ValueError(f"{arguments.scene}: the law of its contact takes no surface")
    options: dict[str, Any] = {}
    for name in ("area", "L", "L_s"):
        if (law_value := getattr(law, name, None)) is not None:
            options[name] = law_value
    for name in ("area", "L", "L_s", "n", "seeds"):
        if (argument := getattr(arguments, name)) is not None:
            options[name] = argument
    if "area" not in options:
        raise ValueError("--area must be given: the law of the scene knows no nominal area")
    ends = [float(law.P) / 10, float(law.P) * 10]
    if arguments.loads is not None:
        ends = numbers("--loads", arguments.loads, ":")
    if len(ends) != 2 or not 0 < ends[0] < ends[1]:
        raise ValueError(f"--loads must be LOW:HIGH with 0 < LOW < HIGH, got {arguments.loads!r}")
    if arguments.points < 2:
        raise ValueError(f"--points must be at least 2, got {arguments.points}")
    loads = np.geomspace(ends[0], ends[1], arguments.points)
    with output(arguments.out) as write:
        try:
            with remarks():
                comparison = compare_laws(
                    law.surface,
                    law.material,
                    loads,
                    mu_s=friction.mu_s,
                    mu_m=friction.mu_m,
                    **options,
                    progress=not arguments.quiet,
                )
        except RuntimeError as error:
            if not str(error).startswith("boundary elements did not converge"):
                raise
            raise ValueError(
                "boundary elements did not converge: --seeds 0 leaves them out"
            ) from None
        files = {"contact.png": picture(plot.laws(comparison))}
        written = write(files | {"contact.csv": csv_text(*comparison.rows()).encode()})
    names = [*files, "contact.csv"]
    show(
        arguments,
        f"{comparison!r}\n{written}",
        lambda: comparison_content(comparison) | {"files": paths(arguments.out, names)},
    )
    return 0
