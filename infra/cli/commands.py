"""Which commands there are; the file of each is loaded when it is asked for."""

from importlib import import_module, metadata
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

_NAMES = (
    "doctor",
    "assets",
    "generate",
    "plan",
    "render",
    "convert",
    "verify",
    "inspect",
    "model",
    "status",
    "train",
    "evaluate",
    "bench",
    "shards",
)
"""Each is the function of its name, or for a group of commands `app`, in the file of its name."""


class _Commands(TyperGroup):
    """Loads a command when it is first named: one needs other libraries than the others."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(_NAMES)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in _NAMES and cmd_name not in self.commands:
            self.commands[cmd_name] = _loaded(cmd_name)
        return self.commands.get(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if self.get_command(ctx, args[0]) is None:
            for name in _NAMES:  # whichever may have been meant
                self.get_command(ctx, name)
        return super().resolve_command(ctx, args)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"trilight {metadata.version('trilight')}")
        raise typer.Exit


def _before_a_command(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="print the version and end"
        ),
    ] = False,
) -> None:
    pass


def _loaded(name: str) -> Any:
    """Return a command, or a group of them, from the file of its name."""
    module = import_module(f"{__package__}.{name}")
    found = getattr(module, "app", None)
    if found is None:
        found = typer.Typer(add_completion=False)
        found.command(name)(getattr(module, name))
    command = typer.main.get_command(found)
    command.name = name
    _keep_brackets(command)
    return command


def _keep_brackets(command: Any) -> None:
    """Let help texts say `[builtin:]`: Rich takes what stands in brackets for a style."""
    for parameter in command.params:
        parameter.help = escape(parameter.help or "")
    command.help = escape(command.help or "")
    for each in getattr(command, "commands", {}).values():
        _keep_brackets(each)


app = typer.Typer(
    name="trilight",
    cls=_Commands,
    help="Triangles in, light out: make data for, train and judge RenderFormer-style renderers. "
    "With --extend FILE.py, anywhere on the line, a file of your own adds to them: docs/how-to.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
"""The whole command line."""
app.callback()(_before_a_command)
