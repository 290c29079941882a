"""Aligned text."""


def table(titles: list[str], columns: list[dict[str, str]], most_columns: int = 5) -> str:
    """Columns with common row names as aligned text; more than `most_columns` become rows."""
    if len(titles) > most_columns:
        cells = (
            [title, *(c[name] for name in columns[0])]
            for title, c in zip(titles, columns, strict=True)
        )
        return aligned([["", *columns[0]], *cells])
    lines = [["", *titles], *([name, *(c[name] for c in columns)] for name in columns[0])]
    return aligned(lines if any(titles) else lines[1:])


def aligned(lines: list[list[str]]) -> str:
    """Rows with equal numbers of cells as aligned text."""
    widths = [max(len(cell) for cell in cells) for cells in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
