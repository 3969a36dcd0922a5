"""Format of help pages: sections without boxes, readable at 80 columns."""

from typing import Any

from cyclopts.help import HelpPanel
from rich.console import Console
from rich.table import Table
from rich.text import Text

_NAMES_WIDTH = 27


class Sections:
    """Formatter of cyclopts that prints each section of a help page."""

    def render_usage(self, console: Console, options: Any, usage: Any) -> None:
        """Print the usage line of a command."""
        console.print(Text(f"Usage: {usage}"))

    def __call__(self, console: Console, options: Any, panel: HelpPanel) -> None:
        """Print one section; nothing where it is empty."""
        if not panel.entries:
            return
        console.print(Text(f"{panel.title}:", style="bold"))
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1))
        table.add_column(width=1)
        table.add_column(style="cyan", max_width=_NAMES_WIDTH)
        table.add_column(ratio=1, overflow="fold")
        for entry in panel.entries:
            names = ", ".join(entry.display_labels_with_metavar)
            table.add_row("", Text(names), entry.description or "")
        console.print(table)
        console.print()
