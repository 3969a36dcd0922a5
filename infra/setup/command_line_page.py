"""The page of commands: every command with its options, as --help shows them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from cyclopts import App

from infra.cli.commands import COMMANDS, app
from pipeline.documents.markdown import table

_HEAD = """# Command line

Made from the classes of settings that the commands take, which are also what is
checked and what Prefect's forms show: an option has the name of the field that it fills, `-` for
`_`, and a second, shorter word where one is given. An option that may be repeated is written once
for each value: `--data A --data B`. What the settings within settings are, which `--set` changes,
is in [settings.md](settings.md).
"""


@dataclass(frozen=True)
class Option:
    """An option of a command, or an argument that is given by its place."""

    field: str
    """Name of the field that it fills."""
    names: tuple[str, ...]
    """Its words; of an argument, its name in capitals."""
    takes: str
    """What stands after it; empty for a switch."""
    help: str
    """Sentence, and in brackets range, choices and default."""


@dataclass(frozen=True)
class Command:
    """A command with its options."""

    name: str
    """What is typed after trilight."""
    help: str
    """What it does."""
    options: tuple[Option, ...]
    """In the order of the help."""


def every_command() -> list[Command]:
    """Return every command that does something, those within groups included."""
    return [command for name in COMMANDS for command in _commands(app[name], name)]


def _commands(group: App, name: str) -> Iterator[Command]:
    if group.default_command is not None:
        options = tuple(map(_option, group.assemble_argument_collection()))
        yield Command(name=name, help=group.help, options=options)
    for inner in group:
        if not inner.startswith("-"):
            yield from _commands(group[inner], f"{name} {inner}")


def _option(argument: Any) -> Option:
    by_place = argument.index is not None
    name: str = argument.field_info.name
    return Option(
        field=name,
        names=(name.upper(),) if by_place else tuple(argument.names),
        takes=argument.parameter.metavar or "",
        help=argument.parameter.help,
    )


def command_line_page() -> str:
    """Return every command with its options, as --help shows them."""
    parts = [_HEAD]
    for command in every_command():
        parts.append(f"## `trilight {command.name}`\n\n{command.help}\n")
        rows = [
            (f"`{', '.join(option.names)}`", option.takes, option.help.replace("|", "\\|"))
            for option in command.options
        ]
        parts.append(table(("option", "takes", "meaning"), rows) + "\n")
    return "\n".join(parts)
