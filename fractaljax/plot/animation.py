"""Animations as files: GIFs, and pages that need no network."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .axes import Figure

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation

_SIGNS = {  # on matplotlib's buttons, instead of a font from the network
    "minus": "-",
    "fast-backward": "⏮",
    "step-backward": "⏪",
    "play fa-flip-horizontal": "◀",
    "pause": "⏸",
    "play": "▶",
    "step-forward": "⏩",
    "fast-forward": "⏭",
    "plus": "+",
}


def animation_path(path: str | os.PathLike | None) -> Path | None:
    """A `Path`, or None. **Raises:** `ValueError` unless it ends in .gif or .html."""
    path = None if path is None else Path(path)
    if path is not None and path.suffix not in (".gif", ".html"):
        raise ValueError(f"path must end in .gif or .html, got {str(path)!r}")
    return path


def animated(
    figure: Figure, draw: Callable[[float], Any], frames: int, fps: int, path: Path | None
) -> "FuncAnimation":
    """An animated period, of which `draw` takes shares from 0 on; with a path also a file."""
    from matplotlib.animation import FuncAnimation, PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    draw(0.0)
    FigureCanvasAgg(figure)
    shares = np.arange(frames) / frames
    moving = FuncAnimation(figure, draw, shares, interval=1000 / fps, cache_frame_data=False)
    if path is not None and path.suffix == ".gif":
        moving.save(path, PillowWriter(fps))
    elif path is not None:
        path.write_text(animation_page(moving, fps), encoding="utf-8")
    return moving


def animation_page(moving: "FuncAnimation", fps: int) -> str:
    """One HTML page with all frames and its buttons inside."""
    import matplotlib as mpl

    # Frames of a large mesh exceed matplotlib's limit of 20 MB.
    with mpl.rc_context({"animation.embed_limit": 500.0}):
        body = moving.to_jshtml(fps, embed_frames=True, default_mode="loop")
    body = re.sub(r"<link\b[^>]*>", "", body)
    for name, sign in _SIGNS.items():
        body = body.replace(f'<i class="fa fa-{name}"></i>', sign)
    head = '<!DOCTYPE html>\n<html lang="en">\n<head><meta charset="utf-8"></head>\n'
    return f"{head}<body>{body}</body>\n</html>\n"
