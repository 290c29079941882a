"""What the commands share in writing files: whole or not at all, and no empty folder left."""

import contextlib
import csv
import io
import tempfile
from pathlib import Path


@contextlib.contextmanager
def output(folder: Path):
    """Make sure that files can be written to `folder`, and offer to write {name: content} there.

    Where nothing has been written at the end, folders made for it are removed.
    """
    from ..base.scene_file import write_whole

    def write(files):
        for name, content in files.items():
            write_whole(folder / name, content)

    created = _make_folder(folder)
    try:
        yield write
    finally:
        with contextlib.suppress(OSError):  # no longer empty
            for made in created:
                made.rmdir()


def _make_folder(path: Path) -> list[Path]:
    """Make sure that files can be written to a folder; returns those it made, innermost first."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=path):
        return missing


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
