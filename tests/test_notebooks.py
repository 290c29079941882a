"""Every notebook runs in a fresh kernel without a warning, and is kept without its outputs."""

import itertools
import os
import time
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from tools import ROOT, load_script

FOLDER = ROOT / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LIMIT = 600  # s: against one that hangs; what they take is in notebooks/README.md
PNG = "iVBORw0KGgo"  # how the picture begins in base 64


stripped = load_script(FOLDER / "strip.py").stripped


def execute(notebook, folder, limit=LIMIT):
    """Run the cells in `folder`, in a new kernel; an error or the end of the time is raised."""
    end = time.monotonic() + limit
    NotebookClient(
        notebook,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
        timeout_func=lambda cell: max(1, round(end - time.monotonic())),
    ).execute()
    assert time.monotonic() < end


def faults(notebook):
    """What is wrong with a notebook that has been executed, in words."""
    found, cells = [], [*notebook.cells, new_markdown_cell()]
    for cell, following in itertools.pairwise(cells):
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if output.get("name") == "stderr":
                found.append(f"{cell.id} says on stderr: {output.text}")
            if "image/png" not in data and "<Axes" in data.get("text/plain", ""):
                found.append(f"{cell.id} shows no picture: end the cell in ax.figure")
            words = following.source.split() if following.cell_type == "markdown" else []
            if "image/png" in data and (not words or words[0].startswith("#")):
                found.append(f"{cell.id} has a picture without a sentence below it")
        if "pyplot" in cell.source:
            found.append(f"{cell.id} uses pyplot")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    """In a fresh kernel that no profile of a user configures: no error, no warning, pictures."""
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(FOLDER), prepend=os.pathsep)  # as if it ran there
    notebook = nbformat.read(path, as_version=4)
    execute(notebook, tmp_path)
    assert faults(notebook) == []
    shown = [o.get("data", {}) for cell in notebook.cells for o in cell.get("outputs", ())]
    assert any(data.get("image/png", "").startswith(PNG) for data in shown)
    if folder := os.environ.get("FRACTALJAX_EXECUTED"):  # for the documentation site
        Path(folder).mkdir(parents=True, exist_ok=True)
        nbformat.write(notebook, Path(folder) / path.name)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_kept_stripped(path):
    """No outputs, no counts, no metadata but the language; `python notebooks/strip.py` does it."""
    text = path.read_text(encoding="utf-8")
    assert text == stripped(text)
    notebook = nbformat.reads(text, as_version=4)
    nbformat.validate(notebook)
    ids = [cell.id for cell in notebook.cells]
    assert len(set(ids)) == len(ids)
    assert notebook.cells[0].source.startswith("# ")


def test_stripping_leaves_the_cells():
    """Outputs, counts and metadata go; sources and ids stay; twice is as once."""
    cell = new_code_cell("1 + 1", id="sum", execution_count=3, metadata={"tags": ["x"]})
    cell.outputs = [new_output("stream", text="2")]
    notebook = new_notebook(cells=[new_markdown_cell("# A", id="head"), cell])
    notebook.metadata["widgets"] = {}
    once = stripped(nbformat.writes(notebook))
    assert stripped(once) == once
    head, cell = nbformat.reads(once, as_version=4).cells
    assert (head.source, head.id, cell.source, cell.id) == ("# A", "head", "1 + 1", "sum")
    assert (cell.outputs, cell.execution_count, cell.metadata) == ([], None, {})
    assert "widgets" not in once and "tags" not in once
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert all(f"({path.name})" in page for path in NOTEBOOKS)


@pytest.mark.slow
def test_faults_errors_and_long_cells_are_seen(tmp_path):
    """A warning, an Axes in place of its picture, a picture without a sentence, pyplot."""
    picture = new_output("display_data", {"image/png": PNG, "text/plain": "<Axes: >"})
    axes = new_output("execute_result", {"text/plain": "<Axes: >"})
    warning = new_output("stream", name="stderr", text="UserWarning: no")

    def found(output, source="1", below="One sees a line."):
        cell = new_code_cell(source, id="here", outputs=[output])
        return faults(new_notebook(cells=[cell, new_markdown_cell(below)]))

    assert found(picture) == found(new_output("stream", text="fine")) == []
    assert found(warning) == ["here says on stderr: UserWarning: no"]
    assert found(axes) == ["here shows no picture: end the cell in ax.figure"]
    for below in ("", "## Next"):
        (fault,) = found(picture, below=below)
        assert fault == "here has a picture without a sentence below it"
    assert found(picture, "import matplotlib.pyplot") == ["here uses pyplot"]
    with pytest.raises(CellExecutionError, match="ZeroDivisionError"):
        execute(new_notebook(cells=[new_code_cell("1 / 0")]), tmp_path)
    with pytest.raises(CellTimeoutError):
        execute(new_notebook(cells=[new_code_cell("while True: pass")]), tmp_path, limit=2)
    warns = new_notebook(cells=[new_code_cell("import warnings\nwarnings.warn('oh')", id="w")])
    execute(warns, tmp_path)
    (fault,) = faults(warns)
    assert "UserWarning: oh" in fault
