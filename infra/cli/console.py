"""Output for people: first lines, tables, progress bars with rate and ETA, and next commands."""

import contextlib
import json
import os
import re
import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

from infra.cli.extend_option import extend_words
from storage.settings.fields import SHOWN, option_of

_OBEYED = dict.fromkeys(
    [
        *(number for number in range(32) if chr(number) not in "\t\n"),
        *range(0x7F, 0xA0),
        *(0x61C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)),
    ]
)
"""Control characters, such as ESC, and those that change the direction of writing; a terminal
obeys them instead of showing them."""


class _TextConsole(Console):
    """Console that prints text literally, so that file names cannot hold colors or commands."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            inert = segment.text.translate(_OBEYED)
            yield segment if segment.control else segment._replace(text=inert)


console = _TextConsole(stderr=False, highlight=False, markup=False, emoji=False)
if not console.is_terminal and "COLUMNS" not in os.environ:
    console.width = 1000  # a log is searched by whole words, so that no line is wrapped

_DIGEST = re.compile("[0-9a-f]{64}")

_DOCUMENTED = {option_of(field): name for field, name in SHOWN.items()}
"""Options that help shows, by the options of their fields."""

_LEAST_RATED_S = 1.0
"""Seconds before a task's rate is printed."""


@contextlib.contextmanager
def use_output(*, as_json: bool) -> Iterator[None]:
    """Print the text of the block, or with `as_json` only what `print_json` receives."""
    before = console.quiet
    console.quiet = as_json
    try:
        yield
    finally:
        console.quiet = before


def first_words(text: str) -> None:
    """Print what begins now, a sentence without its full stop, before slow imports and reads."""
    console.print(Text(f"{text} ...", style="dim"), soft_wrap=True)


def next_step(*commands: Sequence[str], recorded: Mapping[str, str] = MappingProxyType({})) -> None:
    """Print the next commands, one a line, each as it can be typed.

    Args:
        commands: words of each command without `trilight`, not quoted.
        recorded: extensions of the dataset by name, as its manifest lists them; those that this
            process loaded are named anyway.
    """
    for row, words in enumerate(commands):
        lead = "     " if row else "\nNext:"
        line = f"{lead} {command_line(words, recorded)}"
        console.print(Text(line, style="bold"), soft_wrap=True)


def command_line(words: Sequence[str], recorded: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a command as it is typed, by the options of help and with its `--extend` files."""
    words = [_DOCUMENTED.get(word, word) for word in words]
    safe = [f"./{word}" if re.match("-[^-].*/", word) else word for word in words]
    return shlex.join(["trilight", *safe, *extend_words(recorded)])


def suggest_look(text: str) -> None:
    """Print a file to look at, or a next step that is no command."""
    console.print(Text(f"\n{text}", style="bold"), soft_wrap=True)


def duration(seconds: float) -> str:
    """Return a time as text in hours, minutes or seconds."""
    for unit, size_s in (("hours", 3600), ("minutes", 60)):
        if seconds >= size_s:
            return f"{seconds / size_s:,.1f} {unit}"
    return f"{seconds:.0f} s"


def note(text: str) -> None:
    """Print a warning about a result: a sentence without its full stop."""
    console.print(Text(f"Note: {text}.", style="yellow"))


_LOG_S = 60.0
"""Seconds between two lines of progress in a log."""


class RateColumn(ProgressColumn):
    """Column with items per second, or per minute where they are slower."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed or (task.elapsed or 0) < _LEAST_RATED_S:
            return Text("")
        what = task.description
        rate = f"{speed:.1f} {what}/s" if speed >= 1 else f"{60 * speed:.1f} {what}/min"
        return Text(rate, style="cyan")


class Bars(Progress):
    """Progress bars with count, rate, elapsed time and ETA; without a terminal, a line a minute.

    A bar is drawn once its total is known.
    """

    def __init__(self) -> None:
        super().__init__(
            TextColumn("{task.description:<8}", markup=False),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            RateColumn(table_column=Column(no_wrap=True)),
            TimeElapsedColumn(),
            TextColumn("left"),
            # scenes of a shard end together, so that the speed of the last seconds means little
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[note]}", markup=False),
            console=console,
            speed_estimate_period=300,
        )
        self._next_line_s = time.monotonic() + _LOG_S

    def add_task(self, *args: Any, **fields: Any) -> TaskID:
        task = super().add_task(*args, **fields)
        self._begin()
        return task

    def update(self, *args: Any, **fields: Any) -> None:
        super().update(*args, **fields)
        self._begin()
        self._log()

    def advance(self, *args: Any) -> None:
        super().advance(*args)
        self._log()

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

    def _log(self) -> None:
        drawn = list(filter(_is_drawn, self.tasks))
        if self.console.is_terminal or not drawn or time.monotonic() < self._next_line_s:
            return
        self._next_line_s = time.monotonic() + _LOG_S
        for task in drawn:
            counts = f"{task.description} {task.completed:.0f} of {task.total:.0f}"
            note = task.fields["note"]
            self.console.print(f"{counts}, {note}" if note else counts, soft_wrap=True)

    def _begin(self) -> None:
        if not (self.live.is_started or self.console.quiet) and any(map(_is_drawn, self.tasks)):
            self.start()


def _is_drawn(task: Task) -> bool:
    return task.visible and task.total is not None


@contextlib.contextmanager
def progress(noun: str) -> Iterator[Callable[..., None]]:
    """Draw a bar of things called `noun` during the block; yield what moves it.

    That takes the number of finished ones, of all, and a note.
    """
    with Bars() as bars:
        task = bars.add_task(noun, total=None, note="")
        yield lambda done, total, note="": bars.update(task, completed=done, total=total, note=note)


def print_rows(title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print (name, value) rows as a table without lines."""
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=None)
    table.show_header = False
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows:
        if not _DIGEST.fullmatch(value):
            table.add_row(name, Text(value))
    console.print(table)
    for name, value in rows:
        if _DIGEST.fullmatch(value):  # on one line, however narrow, so that it can be copied
            console.print(Text(f"{name} {value}"), soft_wrap=True)


def print_table(title: str, rows: Sequence[Mapping[str, object]]) -> None:
    """Print rows with the same keys as a table whose header is these keys."""
    console.print(Text(title, style="bold"))
    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in rows[0] if rows else ():
        side: Literal["left", "right"] = "left" if isinstance(rows[0][name], str) else "right"
        table.add_column(name, justify=side, no_wrap=True)
    for row in rows:
        table.add_row(*(Text(str(value)) for value in row.values()))
    console.print(table)


def print_result(
    title: str,
    rows: Sequence[tuple[str, str]],
    record: Mapping[str, Any],
    *,
    notes: Iterable[str] = (),
) -> None:
    """Print a result: its record as JSON, or its notes and a table of (name, value) rows."""
    print_json(record)
    for text in notes:
        note(text)
    print_rows(title, rows)


def print_json(value: Any) -> None:
    """Print a value as one JSON document; nothing where text is printed."""
    if console.quiet:
        console.file.write(json.dumps(value, indent=1, sort_keys=True) + "\n")
