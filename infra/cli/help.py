"""How help looks: sections of names and sentences without boxes, readable at 80 columns."""

from typing import Any

from cyclopts.help import HelpEntry, HelpPanel
from rich.console import Console
from rich.table import Table
from rich.text import Text

_NAMES_WIDTH = 27


class Sections:
    """Prints each section of a help page, as cyclopts asks its formatters to."""

    def render_usage(self, console: Console, options: Any, usage: Any) -> None:
        """Print how the words of a command are ordered."""
        console.print(Text(f"Usage: {usage}"))

    def __call__(self, console: Console, options: Any, panel: HelpPanel) -> None:
        """Print one section; none where it is empty."""
        if not panel.entries:
            return
        console.print(Text(f"{panel.title}:", style="bold"))
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1))
        table.add_column(width=1)
        table.add_column(style="cyan", max_width=_NAMES_WIDTH)
        table.add_column(ratio=1, overflow="fold")
        for entry in panel.entries:
            table.add_row("", Text(_names(entry)), entry.description or "")
        console.print(table)
        console.print()


def _names(entry: HelpEntry) -> str:
    """Return the names of an option, and what it takes."""
    return ", ".join(entry.display_labels_with_metavar)
