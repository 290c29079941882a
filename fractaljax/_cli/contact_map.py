"""`fractaljax contact MAP`: the contact law of a measured map, pressed by boundary elements."""

import warnings

import numpy as np

from .json_text import files as paths, show
from .output import csv_text, output
from .parsing import load_mechanism


def run_map(arguments) -> int:
    """Press a map by boundary elements; write scene.toml with its law, and contact.csv."""
    from .._base.parts import rebuild
    from .._base.table import aligned
    from .._contact.measured import MeasuredContact
    from .._contact.persson import PerssonContact
    from .._identify.files import read_measurement
    from .._identify.spectrum_of import spectrum_of

    scene = load_mechanism(arguments.joint, changes=arguments.set)
    contact, coefficients = scene.contact, (scene.friction.mu_s, scene.friction.mu_m)
    material, P = getattr(contact, "material", None), getattr(contact, "P", None)
    if material is None or P is None:
        raise ValueError(f"{arguments.joint}: a map needs the material and the load of its contact")
    area = getattr(contact, "area", None) if arguments.area is None else arguments.area
    if area is None:
        raise ValueError("--area must be given: the law of the scene knows no nominal area")
    names = ("dx", "dy", "unit", "channel")
    read = read_measurement(arguments.scene, **{name: getattr(arguments, name) for name in names})
    if read.dy is None:
        raise ValueError(f"{arguments.scene}: a profile cannot be pressed, a map is needed")
    with output(arguments.out) as write:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            spectrum = spectrum_of(read)
            try:
                law = MeasuredContact.from_heights(read, None, material, P, area)
            except (RuntimeError, ValueError) as error:
                raise ValueError(f"{arguments.scene}: {error}") from None
        loads = np.asarray(law.loads)
        # Of the map's own area, as often as it is in that of the joint: hills carry small loads,
        # and on a larger area a spectrum has higher ones than the repeated map.
        own = read.dx * read.dy * read.z.size
        copies = area / own
        persson = PerssonContact(spectrum, material, P, own)
        by_spectrum = [
            float(copies * rebuild(persson, {"P": load / copies}).stiffness(*coefficients)[0])
            for load in loads
        ]
        titles = ["load [N]", "K_n [N/m]", "by its spectrum [N/m]", "ratio"]
        numbers = zip(loads, law.stiffnesses, by_spectrum, strict=True)
        rows = [[f"{P:.4g}", f"{K:.4g}", f"{S:.4g}", f"{S / K:.2f}"] for P, K, S in numbers]
        files = {"scene.toml": scene.replace(contact=law).to_toml().encode()}
        written = write(files | {"contact.csv": csv_text(titles, rows).encode()})
    lines = [f"warning: {each.message}" for each in caught]
    text = [read.source, read.description, "", aligned([titles, *rows]), *lines, written]
    show(
        arguments,
        "\n".join(text),
        lambda: {
            "source": read.source,
            "loads": loads,
            "K_n": law.stiffnesses,
            "K_n_by_spectrum": by_spectrum,
            "warnings": [str(each.message) for each in caught],
            "files": paths(arguments.out, [*files, "contact.csv"]),
        },
    )
    return 0
