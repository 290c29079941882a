"""NumPy's own files: real numbers, none of which is read before their size and kind are known."""

import io
import math
import zipfile

import numpy as np
from numpy.lib import format as npy

from .parts import one_line

# The header of version 3, for names in structured arrays, is read like that of version 2.
_HEADERS = {(1, 0): npy.read_array_header_1_0}


def read_npy(content: bytes, name: str) -> np.ndarray:
    """The array in the bytes of a .npy file, in this machine's order of bytes.

    **Raises:** `ValueError` if it is none, for anything but real numbers, and unless as many bytes
    as its header says follow it; `name` is what the message calls it.
    """
    file = io.BytesIO(content)
    try:
        header = _HEADERS.get(npy.read_magic(file), npy.read_array_header_2_0)
        shape, columns_first, dtype = header(file)
    except Exception as error:  # of many kinds, down to those of Python's tokenizer
        raise _unsound(error) from None
    if dtype.kind not in "iuf":
        raise ValueError(f"{name} must be real numbers, got {dtype}")
    start, size = file.tell(), math.prod(shape) * dtype.itemsize
    if size != len(content) - start:
        raise ValueError(
            f"{name} is damaged: {size} bytes were to follow its header, {len(content) - start} do"
        )
    array = np.frombuffer(content, dtype, offset=start) if size else np.empty(0, dtype)
    array = array.reshape(shape, order="F" if columns_first else "C")
    return array.astype(dtype.newbyteorder("="))


def read_npz(content: bytes, most: int) -> dict[str, np.ndarray]:
    """The arrays in the bytes of a .npz file, by name, together of no more than `most` bytes.

    **Raises:** `ValueError` as `read_npy`, and if the archive is damaged, encrypted, larger or
    holds two arrays of one name.
    """
    members = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            found = packed.infolist()
            size = sum(member.file_size for member in found)  # no more will be read
            if size > most:
                raise ValueError(f"it unpacks to {size} bytes, at most {most} are read")
            names = [member.filename.removesuffix(".npy") for member in found]
            if len(set(names)) < len(names):
                raise ValueError(f"it holds two arrays of one name: {', '.join(names)}")
            end = content.rfind(b"PK\5\6")  # where the archive counts its members
            if int.from_bytes(content[end + 10 : end + 12], "little") != len(names):
                raise ValueError("it is damaged: an array is lost")
            for name, member in zip(names, found, strict=True):
                if member.flag_bits & 1:
                    raise ValueError(f"{name} is encrypted")
                members[name] = packed.read(member)
    except ValueError:
        raise
    except Exception as error:  # of every decompressor's own kind
        raise _unsound(error) from None
    return {name: read_npy(member, name) for name, member in members.items()}


def _unsound(error: Exception) -> ValueError:
    return ValueError(f"it is no sound file of numbers from NumPy: {one_line(error)}")
