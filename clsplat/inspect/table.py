"""An inspection as a table for the terminal."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from clsplat.inspect.figures import figures
from clsplat.inspect.inspection import Inspection

STYLES = {"error": "bold red", "warning": "yellow", "note": "cyan"}


def show(inspection: Inspection, console: Console) -> None:
    """Print figures, findings and the verdict."""
    table = Table.grid(padding=(0, 2))
    for name, value in figures(inspection.facts).items():
        table.add_row(Text(name, "bold"), Text(value))
    for finding in inspection.findings:
        table.add_row(Text(finding.level, STYLES[finding.level]), Text(finding.text))
    console.print(table, soft_wrap=not console.is_terminal)
    if inspection.trainable:
        ready = inspection.verdict.startswith("ready")
        console.print(Text(inspection.verdict, "bold green" if ready else "bold yellow"))
