"""What the commands share in writing files: whole or not at all, and no empty folder left."""

import contextlib
import csv
import io
import tempfile
from pathlib import Path


@contextlib.contextmanager
def output(folder: Path):
    """Make sure that files can be written to `folder`, and offer to write {name: content} there.

    All of them or none; what writes them returns a line that says so, and what it replaced. The
    folder is made when they are written, so that a command that is killed leaves none behind.
    """
    from ..base.scene_file import write_together

    def write(files) -> str:
        with _made(folder):
            replaced = write_together({folder / name: files[name] for name in files})
        said = f"written to {folder}: {', '.join(files)}"
        if not replaced:
            return said
        names = "all" if len(replaced) == len(files) else ", ".join(p.name for p in replaced)
        return f"{said} ({names} replaced)"

    with _made(folder), tempfile.TemporaryFile(dir=folder):
        pass
    yield write


@contextlib.contextmanager
def _made(folder: Path):
    """A folder that is made if missing, and gone again if it is empty at the end."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for made in missing:
            with contextlib.suppress(OSError):  # not empty, or never made
                made.rmdir()


def csv_text(titles, rows) -> str:
    """A table as the text of a CSV file."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(titles)
    writer.writerows(rows)
    return text.getvalue()


def npy(array) -> bytes:
    """An array as the content of an NPY file."""
    import numpy as np

    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def picture(figure) -> bytes:
    """A figure as the content of a PNG file."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=150)
    return content.getvalue()
