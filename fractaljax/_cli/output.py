"""How the commands write files: all or none, with no empty folder left behind."""

import contextlib
import csv
import importlib
import io
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path


@contextlib.contextmanager
def output(folder: Path) -> Iterator[Callable[[Mapping[str, bytes]], str]]:
    """Check that `folder` can be written, and yield a function that writes {name: content} there.

    It writes all files or none, and returns a line that says which, and which it replaced. It
    makes the folder only then, so that a command that is killed before leaves none.
    """
    from .._base.files import write_together

    def write(files):
        with _made(folder):
            replaced = write_together({folder / name: files[name] for name in files})
        line = f"written to {folder}: {', '.join(files)}"
        if not replaced:
            return line
        names = "all" if len(replaced) == len(files) else ", ".join(p.name for p in replaced)
        return f"{line} ({names} replaced)"

    with _made(folder), tempfile.TemporaryFile(dir=folder):
        pass
    yield write


@contextlib.contextmanager
def _made(folder: Path):
    """Make a folder and its parents, and remove those that are empty at the end."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for made in missing:
            with contextlib.suppress(OSError):  # not empty, or never made
                made.rmdir()


def csv_text(titles: list[str], rows: Iterable[Iterable]) -> str:
    """A table as the text of a CSV file."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([titles, *rows])
    return text.getvalue()


def npy(array) -> bytes:
    """An array as the content of an NPY file."""
    import numpy as np

    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def import_pictures() -> None:
    """Import matplotlib in another thread: programs are compiled or loaded meanwhile."""

    def begin():
        importlib.import_module("matplotlib.backends.backend_agg")
        importlib.import_module("fractaljax.plot.figure")

    threading.Thread(target=begin).start()


def picture(figure) -> bytes:
    """A figure as the content of a PNG file."""
    return figure.png(150)
