"""What people see: tables, progress bars with rate and ETA, and nothing else on stdout."""

import json
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

console = Console(stderr=False, highlight=False)


class RateColumn(ProgressColumn):
    """Items per minute, or per second where they are quick."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("")
        return Text(f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min", style="cyan")


def progress_bars() -> Progress:
    """Return progress bars with count, rate, elapsed time and ETA; silent without a terminal."""
    return Progress(
        TextColumn("{task.description:<8}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        RateColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        # a shard's scenes end together, so that the speed of the last seconds says little
        TimeRemainingColumn(compact=True),
        TextColumn("{task.fields[note]}"),
        console=console,
        speed_estimate_period=300,
    )


def print_rows(title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print (name, value) rows as a table without lines."""
    table = Table(
        title=title, title_justify="left", title_style="bold", box=None, show_header=False
    )
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, Text(value))
    console.print(table)


def print_json(value: Any) -> None:
    """Print a value as one JSON document."""
    console.file.write(json.dumps(value, indent=1, sort_keys=True) + "\n")
