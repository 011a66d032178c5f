"""Tables for people, in a terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.table import Table as RichTable

Table = tuple[list[str], list[list[str]]]
"""Headings and rows."""


def print_table(console: Console, title: str, table: Table) -> None:
    """Print one table; the first column is text, the others are numbers. A file gets whole lines, however long."""
    head, rows = table
    drawn = RichTable(title=title, title_justify="left", title_style="bold")
    for number, name in enumerate(head):
        drawn.add_column(name, justify="left" if number == 0 else "right", no_wrap=number == 0)
    for row in rows:
        drawn.add_row(*row)
    if not console.is_terminal:
        needed = console.measure(drawn, options=console.options.update(max_width=400)).maximum
        console = Console(file=console.file, width=max(console.width, needed))
    console.print(drawn)


def to_markdown(title: str, notes: Sequence[str], tables: Mapping[str, Table], pictures: Mapping[str, str]) -> str:
    """A report.

    Args:
        title: of the report.
        notes: paragraphs above the tables.
        tables: by title.
        pictures: file names by caption.
    """
    parts = [f"# {title}", *notes]
    for name, (head, rows) in tables.items():
        align = ["---", *["---:"] * (len(head) - 1)]
        lines = [f"| {' | '.join(cells)} |" for cells in [head, align, *rows]]
        parts += [f"## {name}", "\n".join(lines)]
    parts += [f"## {caption}\n\n![{caption}]({file})" for caption, file in pictures.items()]
    return "\n\n".join(parts) + "\n"
