"""Format a table as lines of plain text, for the terminal and for log files."""

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

WIDTH = 1 << 20  # characters, so that no line is wrapped, whatever the terminal's width


def text_table(rows: Iterable[Sequence[str]], left_columns: int = 0) -> str:
    """Format rows as lines; the first `left_columns` are left-aligned, the others right-aligned."""
    table = Table.grid(padding=(0, 2))
    for row in rows:
        table.add_row(*map(Text, row))  # `Text` keeps brackets from being parsed as markup
    for column in table.columns[left_columns:]:
        column.justify = "right"
    lines = Console(width=WIDTH, color_system=None).render_lines(table, pad=False)
    return "\n".join("".join(segment.text for segment in line).rstrip() for line in lines)
