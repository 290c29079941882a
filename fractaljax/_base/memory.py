"""Memory, checked before it is allocated: XLA would abort the process."""

import os
from decimal import Decimal


def require_memory(what: str, size: int) -> None:
    """Refuse `what`, which takes `size` bytes, if the machine has less memory than that.

    **Raises:** `ValueError` with both sizes.
    """
    try:
        available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # unknown on some systems
        return
    if size > available:
        # Decimal, since a size can exceed every float.
        raise ValueError(
            f"{what} would take {Decimal(size):.3g} bytes of memory; this machine has "
            f"{available:.3g}"
        )
