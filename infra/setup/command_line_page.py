"""Reference page of commands: every command with its options, as --help shows them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from cyclopts import App

from infra.cli.commands import COMMANDS, app
from infra.cli.options import PRESETS
from storage.markdown import table

_HEAD = """# Command line

Every command and option. `trilight COMMAND -h` shows the everyday options and examples, and
`--help-all` what is here. Where two names are given, both work. An option that may be repeated is
written once for each value: `--data A --data B`. `--set` changes the [settings](settings.md).
"""

_ORDER = "generate"
"""Command whose options others take too."""
_MANY = 10
"""Number of options that two commands share before they are printed once."""


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
        names=(PRESETS.get(name, name.upper()),) if by_place else tuple(argument.names),
        takes=argument.parameter.metavar or "",
        help=argument.parameter.help,
    )


def command_line_page() -> str:
    """Return every command with its options, as --help shows them."""
    parts = [_HEAD]
    commands = every_command()
    shared = next(set(command.options) for command in commands if command.name == _ORDER)
    for command in commands:
        parts.append(f"## `trilight {command.name}`\n\n{command.help}\n")
        options = command.options
        if command.name != _ORDER and len(shared.intersection(options)) > _MANY:
            parts.append(f"It takes these options of [generate](#trilight-{_ORDER}) too:\n")
            names = [option.names[0] for option in options if option in shared]
            parts.append(", ".join(f"`{name}`" for name in names) + "\n")
            options = tuple(option for option in options if option not in shared)
        rows = [
            (f"`{', '.join(option.names)}`", option.takes, option.help.replace("|", "\\|"))
            for option in options
        ]
        parts.append(table(("option", "takes", "meaning"), rows) + "\n")
    return "\n".join(parts)
