"""The package versions that results depend on: stored with a run, compared when it is read."""

from collections.abc import Mapping

import jax

from .._version import NEWEST_TESTED_JAX, __version__


def versions() -> dict[str, str]:
    """The version of each package."""
    return {"fractaljax": __version__, "jax": jax.__version__}


def version_text() -> str:
    """`versions` as text: `fractaljax 0.1.0, jax 0.10.2`."""
    return ", ".join(f"{name} {version}" for name, version in versions().items())


def versions_differ(recorded: Mapping[str, str]) -> str | None:
    """The versions in `recorded` that differ from the current ones, as text; None if none does."""
    others = [
        f"{name} {recorded[name]}"
        for name, current in versions().items()
        if recorded.get(name, current) != current
    ]
    return f"written by {', '.join(others)}, read by {version_text()}" if others else None


def untested_jax() -> str | None:
    """A note if JAX is newer than the newest with which this version was tested; else None."""
    if jax.__version_info__[:2] <= NEWEST_TESTED_JAX:
        return None
    newest = ".".join(map(str, NEWEST_TESTED_JAX))
    return f"JAX {jax.__version__} is newer than {newest}, the newest that was tested"
