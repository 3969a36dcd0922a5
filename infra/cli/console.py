"""What people see: first words, tables, progress bars with rate and ETA, and what to do next."""

import json
import os
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType, TracebackType
from typing import Any, Literal

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

from infra.cli.extending import extend_words

_OBEYED = dict.fromkeys(
    [
        *(number for number in range(32) if chr(number) not in "\t\n"),
        *range(0x7F, 0xA0),
        *(0x61C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)),
    ]
)
"""Characters that a terminal obeys instead of showing them, such as ESC, and those that turn the
direction of writing; none has a width."""


class _TextConsole(Console):
    """Prints text as it is: names of strangers' files hold no colors, emojis or commands."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            inert = segment.text.translate(_OBEYED)
            yield segment if segment.control else segment._replace(text=inert)


console = _TextConsole(stderr=False, highlight=False, markup=False, emoji=False)
if not console.is_terminal and "COLUMNS" not in os.environ:
    console.width = 1000  # of a log, which is searched by whole words

_LEAST_RATED_S = 1.0
"""No rate is printed for tasks that are shorter."""


def first_words(text: str, *, silent: bool = False) -> None:
    """Print what begins now; call before anything slow is imported or read.

    Args:
        text: a sentence without its full stop.
        silent: whether the outcome is printed as JSON, beside which nothing is printed.
    """
    if not silent:
        console.print(Text(f"{text} ...", style="dim"), soft_wrap=True)


def next_step(*commands: Sequence[str], recorded: Mapping[str, str] = MappingProxyType({})) -> None:
    """Print commands that go on from here, one a line; each has to run as it is printed.

    Args:
        commands: the words of each without `trilight`; paths as they are, since they are quoted
            here.
        recorded: extensions of the dataset, as its manifest lists them; those that are loaded here
            are named anyway.
    """
    for row, words in enumerate(commands):
        lead = "     " if row else "\nNext:"
        line = f"{lead} {command_line(words, recorded)}"
        console.print(Text(line, style="bold"), soft_wrap=True)


def command_line(words: Sequence[str], recorded: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a command as it is typed, with the files of `extend_words`."""
    safe = [f"./{word}" if re.match("-[^-].*/", word) else word for word in words]
    return shlex.join(["trilight", *safe, *extend_words(recorded)])


def look_at(text: str) -> None:
    """Print where to look, or what else there is to do that is no command."""
    console.print(Text(f"\n{text}", style="bold"), soft_wrap=True)


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    for unit, size_s in (("hours", 3600), ("minutes", 60)):
        if seconds >= size_s:
            return f"{seconds / size_s:,.1f} {unit}"
    return f"{seconds:.0f} s"


def note(text: str) -> None:
    """Print what a person should know of an outcome; a sentence without its full stop."""
    console.print(Text(f"Note: {text}.", style="yellow"))


class RateColumn(ProgressColumn):
    """Items per minute, or per second where they are quick."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed or (task.elapsed or 0) < _LEAST_RATED_S:
            return Text("")
        what = task.description
        rate = f"{speed:.1f} {what}/s" if speed >= 1 else f"{60 * speed:.1f} {what}/min"
        return Text(rate, style="cyan")


class Bars(Progress):
    """Progress bars; each is drawn only once its total is known."""

    def add_task(self, *args: Any, **fields: Any) -> TaskID:
        task = super().add_task(*args, **fields)
        self._begin()
        return task

    def update(self, *args: Any, **fields: Any) -> None:
        super().update(*args, **fields)
        self._begin()

    def make_tasks_table(self, tasks: Iterable[Task]) -> Table:
        return super().make_tasks_table(list(filter(_is_drawn, tasks)))

    def __enter__(self) -> "Bars":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.live.is_started:
            self.stop()

    def _begin(self) -> None:
        if not self.live.is_started and any(map(_is_drawn, self.tasks)):
            self.start()


def _is_drawn(task: Task) -> bool:
    return task.visible and task.total is not None


def progress_bars() -> Bars:
    """Return progress bars with count, rate, elapsed time and ETA; silent without a terminal."""
    return Bars(
        TextColumn("{task.description:<8}", markup=False),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        RateColumn(table_column=Column(no_wrap=True)),
        TimeElapsedColumn(),
        TextColumn("left"),
        # a shard's scenes end together, so that the speed of the last seconds says little
        TimeRemainingColumn(compact=True),
        TextColumn("{task.fields[note]}", markup=False),
        console=console,
        speed_estimate_period=300,
    )


def print_rows(title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print (name, value) rows as a table without lines."""
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=None)
    table.show_header = False
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, Text(value))
    console.print(table)


def print_table(title: str, rows: Sequence[Mapping[str, object]]) -> None:
    """Print rows that have the same names as a table with these names above."""
    console.print(Text(title, style="bold"))
    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in rows[0] if rows else ():
        side: Literal["left", "right"] = "left" if isinstance(rows[0][name], str) else "right"
        table.add_column(name, justify=side, no_wrap=True)
    for row in rows:
        table.add_row(*(Text(str(value)) for value in row.values()))
    console.print(table)


def print_json(value: Any) -> None:
    """Print a value as one JSON document."""
    console.file.write(json.dumps(value, indent=1, sort_keys=True) + "\n")
