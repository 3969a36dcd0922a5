"""Table of the commands; the module of a command is imported when the command runs."""

from difflib import get_close_matches
from importlib import metadata
from typing import Any

from cyclopts import App, CycloptsError, Group
from cyclopts.exceptions import (
    CoercionError,
    MissingArgumentError,
    RepeatArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)
from cyclopts.help import HelpPanel
from rich.console import Console
from rich.table import Table
from rich.text import Text

from storage.errors import expected_one_of

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


COMMANDS = {
    "doctor": "Check this machine: what is missing or slow, and how to fix it.",
    "assets": "Turn objects into clean meshes within a budget or an error; writes quality.html.",
    "generate": "Turn objects into a verified dataset; run it again to resume.",
    "submit": "Run generate remotely: by a Prefect server's workers, on Slurm or on Kubernetes.",
    "revisit": "Render a finished dataset's scenes again with new cameras, lights or materials."
    "\n\nPictures that stay the same are copied.",
    "plan": "Measure a few scenes and predict time, bytes and cost with intervals.",
    "render": "Render scenes: path traced to a measured noise floor, or by a network.",
    "convert": "Convert scenes by file extension, and report what is lost.",
    "export": "Write a dataset for other renderers, nerfstudio, COCO tools or Hugging Face.",
    "push": "Upload a finished dataset, a network or a page to Hugging Face.",
    "passes": "Write depth, normals, ids and more of stored scenes as OpenEXR.",
    "verify": "Check all hashes, members and rules of a dataset; exit 1 on problems."
    "\n\nAn unfinished dataset is checked as far as it exists; the exit status is 1 then too.",
    "inspect": "Rewrite report, gallery and contact sheet, and print a summary."
    "\n\nFor the folder of a training run, its progress and last figures are printed."
    "\n\nFor a dataset that is read-only or on a server, only a summary is printed, unless --out "
    "names a folder. For a scene file, a summary and what its format lost are printed.",
    "view": "Open a local page: a scene in 3D with its pictures, or a dataset.",
    "model": "Print parameters, FLOPs and memory of a model size or a checkpoint.",
    "status": "Report a dataset's progress, estimated finish and failures; needs no server.",
    "train": "Train a model; writes checkpoints, TensorBoard curves and a sheet of pictures."
    "\n\nTo train with processes on several machines, run torchrun -m trilight train ...",
    "evaluate": "Evaluate a network; writes evaluation.json, evaluation.md and sheets of pictures.",
    "leaderboard": "Compare all methods and networks on one dataset by error and cost."
    "\n\nWrites a table, a chart and rows; an interrupted run resumes.",
    "bench": "Measure cost against error, or list the experiments; an interrupted run resumes.",
    "shards": "Make new datasets from finished ones.",
}
"""Help by command. A command is the function of its name in the module of its name; a group of
commands is the `app` in that module."""

GROUPS = ("shards", "submit")
"""Commands with subcommands."""

app = App(
    name="trilight",
    help="Make data for RenderFormer-style neural renderers, train them, and evaluate them.",
    help_epilogue="Anywhere on the line: --extend FILE.py, a file of your own that adds layouts, "
    "presets, formats and more (docs/how-to).",
    help_format="plaintext",
    help_formatter=Sections(),
    version=lambda: f"trilight {metadata.version('trilight')}",
    version_format="plaintext",
    group_parameters=Group("Options"),
    suppress_keyboard_interrupt=False,
    result_action="return_value",
    exit_on_error=False,
    print_error=False,
)
"""The whole command line."""
for _rank, (_name, _help) in enumerate(COMMANDS.items()):
    _function = "app" if _name in GROUPS else _name
    _options: Any = {} if _name in GROUPS else {"help_epilogue": ""}  # groups state their own
    app.command(
        f"{__package__}.{_name}:{_function}", name=_name, help=_help, sort_key=_rank, **_options
    )
app.register_install_completion_command(
    help="Let the tab key complete commands and options: --shell bash, zsh or fish."
)


def complaint(mistake: CycloptsError) -> str:
    """Return a one-line message for a wrong command line, with what was expected."""
    chain = list(mistake.command_chain or ())
    see = f"See trilight {' '.join([*chain, '--help'])}."
    where = f"{' '.join(chain)}: " if chain else ""
    if isinstance(mistake, UnusedCliTokensError) and mistake.unused_tokens:
        extra = mistake.unused_tokens[0]
        return f"{where}{extra!r} is one argument too many; expected an option. {see}"
    if isinstance(mistake, UnknownCommandError) and mistake.unused_tokens:
        known = [name for name in mistake.app or app if not name.startswith("-")]
        typed = mistake.unused_tokens[0]
        return f"{where}command {typed!r} is unknown; {expected_one_of(typed, known)}. {see}"
    if isinstance(mistake, UnknownOptionError):
        typed = mistake.token.keyword or mistake.token.value
        known = [name for each in mistake.argument_collection for name in each.names]
        near = "".join(f"; did you mean {name}?" for name in get_close_matches(typed, known, n=1))
        return f"{where}option {typed!r} is unknown{near or '.'} {see}"
    if isinstance(mistake, RepeatArgumentError):
        return f"{where}{mistake.token.keyword} is given twice; expected it once. {see}"
    argument: Any = mistake.argument
    if isinstance(mistake, MissingArgumentError) and argument:
        thing = mistake.keyword or _display_name(argument)
        lacks = "has no value" if mistake.keyword else "is missing"
        return f"{where}{thing} {lacks}; expected: {argument.parameter.help} {see}"
    if isinstance(mistake, CoercionError) and argument and mistake.token:
        choices = argument.get_choices(force=True) or ()
        expected = expected_one_of(mistake.token.value, choices) if choices else "expected no value"
        return f"{where}{_display_name(argument)} is {mistake.token.value!r}; {expected}. {see}"
    return f"{where}{' '.join(str(mistake).split())} {see}"


def _display_name(argument: Any) -> str:
    name: str = argument.name
    return name if name.startswith("--") else name.upper()
