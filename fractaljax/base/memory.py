"""What fits into memory, decided before any of it is taken: XLA ends the process otherwise."""

import os
from decimal import Decimal


def require_memory(what: str, size: int) -> None:
    """Refuse `what`, which takes `size` bytes, where the machine has less memory altogether.

    **Raises:** `ValueError` with both sizes.
    """
    try:
        available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not every system tells
        return
    if size > available:
        # A size can be beyond every float.
        raise ValueError(
            f"{what} would take {Decimal(size):.3g} bytes of memory; this machine has "
            f"{available:.3g}"
        )
