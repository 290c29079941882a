"""Instrument files, byte by byte from the definitions of their formats."""

import io
import struct
import zipfile

import numpy as np


def bcr(z, dx, dy, step) -> bytes:
    """BCR-STM: a header of 2048 characters in nanometres, 16-bit heights, 32767 for a gap."""
    n, m = z.shape
    header = ["fileformat = bcrstm", "headersize = 2048", f"xpixels = {n}", f"ypixels = {m}"]
    header += [f"xlength = {n * dx * 1e9!r}", f"ylength = {m * dy * 1e9!r}"]
    header += [f"{axis}unit = nm" for axis in "xyz"]
    header += [f"bit2nm = {step * 1e9!r}", "intelmode = 1"]
    whole = np.where(np.isnan(z), 32767, np.round(np.nan_to_num(z) / step))
    return "\n".join(header).ljust(2048).encode() + whole.T.astype("<i2").tobytes()


def x3p(z, dx, dy) -> bytes:
    """ISO 5436-2: a zip of XML and bytes, in metres, with one bit a point that is valid."""
    n, m = z.shape
    axis = "<{0}><AxisType>I</AxisType><DataType>D</DataType><Increment>{1!r}</Increment></{0}>"
    xml = f"""<?xml version="1.0" encoding="UTF-8"?>
<p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2">
<Record1><Revision>ISO5436 - 2000</Revision><FeatureType>SUR</FeatureType><Axes>
{axis.format("CX", dx)}{axis.format("CY", dy)}
<CZ><AxisType>A</AxisType><DataType>D</DataType></CZ></Axes></Record1>
<Record2><Date>2026-01-01T00:00:00</Date><Instrument><Manufacturer>Test</Manufacturer>
<Model>Profiler</Model><Serial>7</Serial><Version>1</Version></Instrument></Record2>
<Record3><MatrixDimension><SizeX>{n}</SizeX><SizeY>{m}</SizeY><SizeZ>1</SizeZ></MatrixDimension>
<DataLink><PointDataLink>bindata/data.bin</PointDataLink>
<ValidPointsLink>bindata/valid.bin</ValidPointsLink></DataLink></Record3></p:ISO5436_2>"""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("main.xml", xml)
        archive.writestr("bindata/data.bin", np.nan_to_num(z).T.astype("<f8").tobytes())
        valid = np.packbits(~np.isnan(z).T.ravel(), bitorder="little")
        archive.writestr("bindata/valid.bin", valid.tobytes())
    return content.getvalue()


def gwy(channels) -> bytes:
    """Gwyddion's own: {title: (z, dx, dy, unit of z)} in metres, nested named and typed items."""

    def item(name, kind, value):
        return name.encode() + b"\0" + kind + value

    def text(words):
        return words.encode() + b"\0"

    def box(name, items):
        content = b"".join(items)
        return text(name) + struct.pack("<I", len(content)) + content

    def unit(name):
        return box("GwySIUnit", [item("unitstr", b"s", text(name))])

    items = []
    for i, (title, (z, dx, dy, z_unit)) in enumerate(channels.items()):
        n, m = z.shape
        heights = struct.pack("<I", z.size) + np.nan_to_num(z).T.astype("<f8").tobytes()
        field = [
            item("xres", b"i", struct.pack("<i", n)),
            item("yres", b"i", struct.pack("<i", m)),
            item("xreal", b"d", struct.pack("<d", n * dx)),
            item("yreal", b"d", struct.pack("<d", m * dy)),
            item("si_unit_xy", b"o", unit("m")),
            item("si_unit_z", b"o", unit(z_unit)),
            item("data", b"D", heights),
        ]
        items += [
            item(f"/{i}/data/title", b"s", text(title)),
            item(f"/{i}/data", b"o", box("GwyDataField", field)),
        ]
    return b"GWYP" + box("GwyContainer", items)
