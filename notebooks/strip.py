"""Notebooks as the repository keeps them: no outputs, no counts, no metadata but the language.

`python notebooks/strip.py` rewrites those beside it, or the files named, after work in Jupyter.
"""

import sys
from pathlib import Path

import nbformat

METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def stripped(text: str) -> str:
    """The text of a notebook as the repository keeps it; cells keep their ids."""
    notebook = nbformat.reads(text, as_version=4)
    notebook.metadata = nbformat.from_dict(METADATA)
    notebook.nbformat_minor = 5
    for cell in notebook.cells:
        cell.metadata = nbformat.NotebookNode()
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    return nbformat.writes(notebook) + "\n"


def main(paths: list[Path]) -> None:
    """Rewrite the notebooks that are not stripped."""
    for path in paths:
        text = path.read_text(encoding="utf-8")
        if text != (wanted := stripped(text)):
            path.write_text(wanted, encoding="utf-8")
            print(f"stripped {path}")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]] or sorted(Path(__file__).parent.glob("*.ipynb")))
