"""Which commands there are; the file of each is loaded when it is asked for."""

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

from infra.cli.help import Sections
from storage.errors import expected_one_of

COMMANDS = {
    "doctor": "Report what this machine has and lacks, what that slows down, and what fixes it.",
    "assets": "Turn objects into clean meshes within a budget or an error; writes quality.html.",
    "generate": "Turn objects into a verified, resumable dataset; run it again to resume after any "
    "stop.",
    "submit": "Do elsewhere what generate does: by a flow on the workers of a Prefect server, and "
    "watch it, or as an array of tasks on Slurm or Kubernetes.",
    "revisit": "Render the scenes of a finished dataset again, with new cameras, lights, materials "
    "or another resolution; pictures that stay the same are copied.",
    "plan": "Measure a few scenes and predict time, bytes and cost of all, each with an interval.",
    "render": "Render scenes: path traced to a measured noise floor, or by a trained network.",
    "convert": "Convert by extension, and report what could not be carried over.",
    "export": "Write a dataset as files that others' renderers, nerfstudio, COCO tools or Hugging "
    "Face datasets open.",
    "push": "Upload a finished dataset, a network or a page to the Hugging Face hub.",
    "passes": "Write depth, normals, ids and more of stored scenes as OpenEXR.",
    "verify": "Check every hash, member and law of a dataset; exit 1 with a list of what is wrong."
    "\n\nAn unfinished dataset is checked as far as it exists; the exit status is 1 then too.",
    "inspect": "Rewrite report, gallery and contact sheet, and print what the dataset holds."
    "\n\nFor the folder of a training run, its progress and last figures are printed."
    "\n\nFor a dataset that is read-only or on a server, only a summary is printed, unless --out "
    "names a folder. For a scene file, its summary and what could not be carried over are printed.",
    "view": "Open a page on this machine: turn a scene in 3D beside its path traced picture and "
    "those of networks, or browse a dataset.",
    "model": "Print parameters, FLOPs and memory by precision of a named size or of a checkpoint.",
    "status": "Report a dataset's progress, estimated finish and failures; needs no server.",
    "train": "Train a model; writes checkpoints, curves and pictures for TensorBoard, and a sheet."
    "\n\nTo train with processes on several machines, run torchrun -m trilight train ...",
    "evaluate": "Evaluate a network; writes evaluation.json, evaluation.md and sheets of pictures.",
    "leaderboard": "Judge every engine, rung and network on one set, with what each costs; writes "
    "table, chart and rows, and goes on where it stopped.",
    "bench": "Measure cost against error; an interrupted run resumes. Without a name, list all.",
    "shards": "Make new datasets from finished ones.",
}
"""The commands with their help. A command is the function of its name in the file of its name; a
group of commands is the `app` in that file."""

GROUPS = ("shards", "submit")
"""Commands with subcommands."""

app = App(
    name="trilight",
    help="Triangles in, light out: make data for, train and judge RenderFormer-style renderers.",
    help_epilogue="Anywhere on the line: --extend FILE.py, a file of your own that adds templates, "
    "builds, runs, formats and more (docs/how-to).",
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
for _place, (_name, _help) in enumerate(COMMANDS.items()):
    _found = "app" if _name in GROUPS else _name
    _own: Any = {} if _name in GROUPS else {"help_epilogue": ""}  # groups state their own
    app.command(f"{__package__}.{_name}:{_found}", name=_name, help=_help, sort_key=_place, **_own)
app.register_install_completion_command(
    help="Let the tab key complete commands and options: --shell bash, zsh or fish."
)


def complaint(mistake: CycloptsError) -> str:
    """Return what is wrong with the words of a command line: one line, with what was expected."""
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
        thing = mistake.keyword or _called(argument)
        lacks = "has no value" if mistake.keyword else "is missing"
        return f"{where}{thing} {lacks}; expected: {argument.parameter.help} {see}"
    if isinstance(mistake, CoercionError) and argument and mistake.token:
        choices = argument.get_choices(force=True) or ()
        expected = expected_one_of(mistake.token.value, choices) if choices else "expected no value"
        return f"{where}{_called(argument)} is {mistake.token.value!r}; {expected}. {see}"
    return f"{where}{' '.join(str(mistake).split())} {see}"


def _called(argument: Any) -> str:
    name: str = argument.name
    return name if name.startswith("--") else name.upper()
