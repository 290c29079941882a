"""NumPy files of real numbers from untrusted sources."""

import io
import math
import zipfile

import numpy as np
from numpy.lib import format as npy

from .parts import one_line


def read_npy(content: bytes, name: str, kinds: str = "iuf") -> np.ndarray:
    """The array in the bytes of a .npy file, in native byte order, of one of NumPy's `kinds`.

    The header is compared with the size of the content before any memory is allocated.

    **Raises:** `ValueError` that names the array `name`, unless the file is intact and holds such
    numbers, real ones by default.
    """
    file = io.BytesIO(content)
    try:
        # Version 3 (Unicode field names) has the header of version 2.
        first = npy.read_magic(file) == (1, 0)
        header = npy.read_array_header_1_0 if first else npy.read_array_header_2_0
        shape, columns_first, dtype = header(file)
    except Exception as error:  # of many kinds, even from Python's tokenizer
        raise _unsound(error) from None
    if dtype.kind not in kinds:
        raise ValueError(f"{name} must be real numbers, got {dtype}")
    start, size = file.tell(), math.prod(shape) * dtype.itemsize
    if size != len(content) - start:
        raise ValueError(
            f"{name} is damaged: {size} bytes were to follow its header, {len(content) - start} do"
        )
    array = np.frombuffer(content, dtype, offset=start) if size else np.empty(0, dtype)
    array = array.reshape(shape, order="F" if columns_first else "C")
    return array.astype(dtype.newbyteorder("="))


def read_npz(content: bytes, most: int, kinds: str = "iuf") -> dict[str, np.ndarray]:
    """The arrays in the bytes of a .npz file, by name, of at most `most` bytes in total.

    **Raises:** `ValueError` as `read_npy` and `read_members`.
    """
    members = read_members(content, most)
    return {name: read_npy(member, name, kinds) for name, member in members.items()}


def read_members(content: bytes, most: int) -> dict[str, bytes]:
    """The .npy files in the bytes of a .npz file, by name, of at most `most` bytes in total.

    **Raises:** `ValueError` if the archive is damaged, encrypted, too large or holds two arrays of
    the same name.
    """
    members = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            entries = packed.infolist()
            size = sum(member.file_size for member in entries)  # `read` never exceeds it
            if size > most:
                raise ValueError(f"it unpacks to {size} bytes, at most {most} are read")
            names = [member.filename.removesuffix(".npy") for member in entries]
            if len(set(names)) < len(names):
                raise ValueError(f"it holds two arrays of one name: {', '.join(names)}")
            end = content.rfind(b"PK\5\6")  # the end record holds the number of members
            if int.from_bytes(content[end + 10 : end + 12], "little") != len(names):
                raise ValueError("it is damaged: an array is lost")
            for name, member in zip(names, entries, strict=True):
                if member.flag_bits & 1:
                    raise ValueError(f"{name} is encrypted")
                members[name] = packed.read(member)
    except ValueError:
        raise
    except Exception as error:  # each decompressor raises its own kind
        raise _unsound(error) from None
    return members


def _unsound(error: Exception) -> ValueError:
    return ValueError(f"it is no sound file of numbers from NumPy: {one_line(error)}")
