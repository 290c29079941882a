"""The versions that numbers depend on: written into the files of a run, compared on reading."""

from collections.abc import Mapping
from typing import Any

import jax

from .._version import __version__


def versions() -> dict[str, str]:
    """Those of this run, by package."""
    return {"fractaljax": __version__, "jax": jax.__version__}


def version_text() -> str:
    """`versions` in words: `fractaljax 0.1.0, jax 0.10.2`."""
    return ", ".join(f"{name} {version}" for name, version in versions().items())


def versions_differ(found: Mapping[str, Any]) -> str | None:
    """By which other versions a file was written, in words; None for these or none at all."""
    others = [
        f"{name} {found[name]}"
        for name, own in versions().items()
        if name in found and found[name] != own
    ]
    return f"written by {', '.join(others)}, read by {version_text()}" if others else None
