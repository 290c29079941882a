"""Compiled programs kept on disk: nearly all of a command's first run is compilation."""

import contextlib
import os
import sys
import warnings
from pathlib import Path

# Older ones print notes on the processor whenever they load a program from the cache.
FIRST_QUIET_JAX = (0, 10, 2)
_FOLDER = "jax_compilation_cache_dir"  # the setting


@contextlib.contextmanager
def keep_compiled():
    """Let JAX cache compiled programs in the user's cache folder, or in JAX_COMPILATION_CACHE_DIR.

    Within the context whole programs are kept there too (`kept.py`). Without a folder that can be
    written, or with a JAX before 0.10.2, there is no cache. That is never an error.
    """
    import jax

    from .._base.kept import keep_in

    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    if getattr(jax.config, _FOLDER) is None and jax.__version_info__ >= FIRST_QUIET_JAX:
        with contextlib.suppress(OSError, RuntimeError):  # not writable, or no home
            folder = _cache_folder()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK):
                jax.config.update(_FOLDER, str(folder))
                jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    given = getattr(jax.config, _FOLDER)
    if given is not None and jax.__version_info__ >= FIRST_QUIET_JAX:
        programs = Path(given) / "programs"
        first = not programs.exists()
        with contextlib.suppress(OSError):
            keep_in(programs)
            if first and sys.stderr is not None and sys.stderr.isatty():
                print(f"first run: compiled programs are kept in {given}", file=sys.stderr)
    try:
        yield
    finally:
        keep_in(None)


def _cache_folder() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "fractaljax" / "compiled"
