"""Reference page of commands: every command with its options, as --help shows them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from cyclopts import App

from infra.cli.commands import COMMANDS, app
from storage.markdown import table

_HEAD = """# Command line

Made from the classes of settings that the commands take, which are also what is
checked and what Prefect's forms show: an option has the name of the field that it fills, `-` for
`_`, and a second, shorter word where one is given. An option that may be repeated is written once
for each value: `--data A --data B`. What the settings within settings are, which `--set` changes,
is in [settings.md](settings.md).
"""


@dataclass(frozen=True)
class Option:
    """Option or positional argument of a command."""

    field: str
    """Name of the settings field that it fills."""
    names: tuple[str, ...]
    """Names of the option, or the argument's name in capitals."""
    takes: str
    """Name of the value, such as INT; empty for a switch."""
    help: str
    """Sentence, with choices, range and default in brackets."""


@dataclass(frozen=True)
class Command:
    """Command with its options."""

    name: str
    """Words after `trilight`, such as `shards merge`."""
    help: str
    """Help text of the command."""
    options: tuple[Option, ...]
    """Arguments and options in the order of the help."""


def every_command() -> list[Command]:
    """Return every command, those within groups included."""
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
