"""Every subcommand of `trilight` (cyclopts); its module is imported when the command runs.

`-h` of a command shows its everyday options, and lines to copy; `--help-all` shows all.
"""

import sys
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from importlib import metadata
from typing import Any, ClassVar, NamedTuple

from cyclopts import App, CycloptsError, Group
from cyclopts.exceptions import (
    CoercionError,
    MissingArgumentError,
    RepeatArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)
from cyclopts.help import HelpEntry, HelpPanel
from rich.console import Console
from rich.table import Table
from rich.text import Text

from storage.errors import expected_one_of

ALL_OPTIONS = "--help-all"
HELP_FLAGS = ("--help", "-h", ALL_OPTIONS)

_DATASET = ("objects", "out", "scenes", "seed", "resolution", "noise_floor_db", "changes")
"""What DATASET stands for below."""

_PAGES = """
generate: DATASET workers
    generate tiny --out data/first
    generate tiny --objects FOLDER --scenes 64 --out data/mine
    generate pretrain-256 --noise-floor 46 --seed 7 --out data/big

assets: out budget epsilon own_materials licence
    assets FOLDER --out data/meshes
    assets FOLDER --budget 1024 --own-materials
    assets procedural:8 --epsilon 0.01

plan: DATASET samples cores price
    plan pretrain-256 --scenes 65536
    plan tiny --objects FOLDER --cores 16
    plan textured-256 --noise-floor 46 --price 0.04

status:
    status data/mine
    status s3://bucket/mine --price 0.04
    status data/mine --missing

verify:
    verify data/mine
    verify data/mine --fast
    verify data/mine --repair --objects FOLDER

view:
    view data/mine
    view data/mine/train-000000.tar::000000000
    view room.usdz --checkpoint runs/mine

inspect:
    inspect data/mine
    inspect data/mine --by-template 4
    inspect runs/mine

render: out engine checkpoint resolution noise_floor_db spp seconds view orbit
    render room.usdz --out room.exr
    render room.usdz --engine both --noise-floor 40 --out both.exr
    render room.usdz --orbit 24 --spp 64 --out orbit.mp4

train: data out resume steps changes device lpips begin_with
    train tiny --data data/mine --out runs/mine
    train tiny --data data/mine --out runs/mine --resume
    train pretrain --data data/big --set model=small

evaluate: data split resolution most_scenes lpips out
    evaluate runs/mine --data data/mine
    evaluate default --data data/mine --max-scenes 16
    evaluate runs/mine --data data/mine --split validation

leaderboard: checkpoint pictures width scenes out
    leaderboard data/mine
    leaderboard data/mine --checkpoint runs/mine
    leaderboard data/mine --pictures FOLDER --resolution 64

convert:
    convert room.usdz room.glb
    convert data/mine/train-000000.tar::000000000 room.usdz
    convert room.blend.usdc room.h5 --budget 1536

export:
    export data/mine --form h5 --out data/h5
    export data/mine --form nerfstudio --split test --out data/nerf
    export data/mine --form coco --out data/coco

passes:
    passes data/mine --out data/passes
    passes data/mine --passes depth,normal --out data/passes
    passes room.usdz --resolution 512 --out data/passes

push:
    push data/mine USER/NAME --dry-run
    push data/mine USER/NAME --private
    push runs/mine USER/NAME

submit: DATASET deployment no_watch
    submit slurm tiny --out /shared/mine --scenes 512
    submit kubernetes tiny --out s3://bucket/mine --scenes 512
    submit generate-scenes tiny --out data/mine --scenes 8

submit slurm: DATASET shards_per_task dry_run sbatch at_once
    submit slurm tiny --out /shared/mine --scenes 512 --dry-run
    submit slurm tiny --out /shared/mine --sbatch=--partition=cpu
    submit slurm tiny --out /shared/mine --device gpu --sbatch=--gpus=1

submit kubernetes: DATASET shards_per_task dry_run image where cores
    submit kubernetes tiny --out s3://bucket/mine --dry-run
    submit kubernetes tiny --out s3://bucket/mine --cores 16
    submit kubernetes tiny --out s3://bucket/mine --image REGISTRY/NAME

submit make-by-array: DATASET scheduler shards_per_task
    submit make-by-array tiny --out /shared/mine --scenes 512
    submit make-by-array tiny --out /shared/mine --at-once 8
    submit make-by-array tiny --out s3://bucket/mine --scheduler none

revisit: out cameras lights materials seed resolution noise_floor_db
    revisit data/mine --out data/views --cameras new:4
    revisit data/mine --out data/lit --lights new
    revisit data/mine --out data/sharp --resolution 512

shards list:
    shards list data/mine
    shards list data/mine --split test
    shards list data/mine --where 'lights_per_scene >= 3'

shards select:
    shards select data/mine --template corner --out data/corners
    shards select data/mine --min-noise-floor 40 --out data/clean
    shards select data/mine --where 'spp < 256' --out data/quick

shards merge:
    shards merge data/a data/b --out data/both
    shards merge data/a data/b data/c --out data/all
    shards merge data/a data/b --out data/both --json

shards reshard:
    shards reshard data/mine --scenes-per-shard 64 --out data/large
    shards reshard data/mine --scenes-per-shard 1 --out data/small
    shards reshard data/mine --scenes-per-shard 8 --out data/eight

bench: quick out show
    bench
    bench frontier --quick
    bench gpu

model:
    model small
    model large --triangles 4096 --resolution 512
    model runs/mine

presets:
    presets
    presets tiny
    presets --extend FILE.py

doctor:
    doctor
    doctor --measure
    doctor --json
"""
"""Of each command: its words, the fields of its everyday options (none: all), and examples."""


class Everyday(NamedTuple):
    """What a first month needs of a command."""

    options: Sequence[str]
    """Fields whose options `-h` shows beside the arguments; empty for all."""
    examples: Sequence[str]
    """Lines to copy, of at most 77 characters."""


EVERYDAY: Mapping[str, Everyday] = {
    name: Everyday(options.split(), [f"trilight {line.strip()}" for line in examples])
    for page in _PAGES.replace("DATASET", " ".join(_DATASET)).split("\n\n")
    for head, *examples in [page.strip().splitlines()]
    for name, _, options in [head.partition(":")]
}
"""By the words of a command."""


_NAMES_WIDTH = 27


class Sections:
    """Formatter of cyclopts that prints each section of a help page."""

    def __init__(self, options: Collection[str] = ()) -> None:
        """Begin a page.

        Args:
            options: names of the options that are printed; empty for all. Arguments always are.
        """
        self._options = options
        self.hides_some = False
        """True once an option was left out."""

    def render_usage(self, console: Console, options: Any, usage: Any) -> None:
        """Print the usage line of a command."""
        console.print(Text(f"Usage: {usage}"))

    def __call__(self, console: Console, options: Any, panel: HelpPanel) -> None:
        """Print one section; nothing where it is empty."""
        entries = [entry for entry in panel.entries if self._is_shown(panel, entry)]
        self.hides_some |= len(entries) < len(panel.entries)
        if not entries:
            return
        console.print(Text(f"{panel.title}:", style="bold"))
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1))
        table.add_column(width=1)
        table.add_column(style="cyan", max_width=_NAMES_WIDTH)
        table.add_column(ratio=1, overflow="fold")
        for entry in entries:
            names = ", ".join(entry.display_labels)
            if panel.format == "parameter":  # further names keep working, and would only be read
                metavar = "" if entry.positional_label else entry.metavar or ""
                names = f"{entry.display_labels[0]} {metavar}".rstrip()
            table.add_row("", Text(names), entry.description or "")
        console.print(table)
        console.print()

    def _is_shown(self, panel: HelpPanel, entry: HelpEntry) -> bool:
        is_option = panel.format == "parameter" and not entry.positional_label
        return not is_option or not self._options or entry.display_labels[0] in self._options


class Program(App):
    """The command line, whose help shows everyday options and examples first."""

    shows_all: ClassVar[bool] = False
    """True while a command is run that asks for all options."""

    def __call__(self, tokens: Any = None, **options: Any) -> Any:
        """Run a command; remembers whether all options are to be shown."""
        words = sys.argv[1:] if tokens is None else tokens
        Program.shows_all = ALL_OPTIONS in words
        return super().__call__(tokens, **options)

    def help_print(self, tokens: Any = None, *, console: Console | None = None) -> None:
        """Print the help page of a command, and its examples."""
        chain, apps, _ = self.parse_commands(tokens)
        name = " ".join(chain)
        page = EVERYDAY.get(name)
        names = set[str]()
        if page and page.options and not Program.shows_all:
            fields = (*page.options, "json")
            arguments = apps[-1].assemble_argument_collection()
            names = {each.names[0] for each in arguments if each.field_info.name in fields}
        sections = self.help_formatter = Sections(names)
        console = console or self.console
        super().help_print(tokens, console=console)
        if page:
            console.print(Text("Examples:", style="bold"))
            console.print("".join(f"   {line}\n" for line in page.examples), highlight=False)
        if sections.hides_some:
            console.print(f"All options: trilight {name} {ALL_OPTIONS}\n", highlight=False)


COMMANDS = {
    "generate": "Turn objects into a verified dataset; run it again to resume.",
    "assets": "Turn objects into clean meshes within a budget or an error; writes quality.html.",
    "plan": "Measure a few scenes and predict time, bytes and cost with intervals.",
    "status": "Report a dataset's progress, estimated finish and failures; needs no server.",
    "verify": "Check all hashes, members and rules of a dataset; exit 1 on problems."
    "\n\nAn unfinished dataset is checked as far as it exists; the exit status is 1 then too.",
    "view": "Open a local page: a scene in 3D with its images, or a dataset.",
    "inspect": "Rewrite report, gallery and contact sheet, and print a summary."
    "\n\nFor the folder of a training run, its progress and last figures are printed."
    "\n\nFor a dataset that is read-only or on a server, only a summary is printed, unless --out "
    "names a folder. For a scene file, a summary and what its format lost are printed.",
    "render": "Render scenes: path traced to a stated error, or by a network.",
    "train": "Train a model; writes checkpoints, TensorBoard curves and a sheet of images."
    "\n\nTo train with processes on several machines, run torchrun -m trilight train ...",
    "evaluate": "Evaluate a network; writes evaluation.json, evaluation.md and sheets of images.",
    "leaderboard": "Compare all methods and networks on one dataset by error and cost."
    "\n\nWrites a table, a chart and rows; an interrupted run resumes.",
    "convert": "Convert scenes by file extension, and report what is lost.",
    "export": "Write a dataset for other renderers, nerfstudio, COCO tools or Hugging Face.",
    "passes": "Write depth, normals, ids and more of stored scenes as OpenEXR.",
    "push": "Upload a finished dataset, a network or a page to Hugging Face.",
    "presets": "List presets, networks, sizes and sources of objects, or the settings of a preset.",
    "submit": "Run generate remotely: on Slurm, on Kubernetes, or by a Prefect server's workers.",
    "revisit": "Render a finished dataset's scenes again with new cameras, lights or materials."
    "\n\nPictures that stay the same are copied.",
    "shards": "Make new datasets from finished ones.",
    "bench": "Measure cost against error, or list the experiments; an interrupted run resumes.",
    "model": "Print parameters, FLOPs and memory of a model size or a checkpoint.",
    "doctor": "Check this machine: what is missing or slow, and how to fix it.",
}
"""Help by command. A command is the function of its name in the module of its name, or of a command
like it; a group of commands is the `app` in that module."""

SECTIONS = {
    "Make": ("generate", "assets", "plan", "status", "verify"),
    "Look": ("view", "inspect", "render"),
    "Learn": ("train", "evaluate", "leaderboard"),
    "Exchange": ("convert", "export", "passes", "push"),
    "More": ("presets", "submit", "revisit", "shards", "bench", "model", "doctor"),
}
"""Commands of each section of `trilight -h`."""

GROUPS = ("shards", "submit")
"""Commands with subcommands."""

app = Program(
    name="trilight",
    help="Make path-traced training data with a stated error; train and judge neural renderers.\n\n"
    "First time? trilight generate tiny --out data/first\n"
    "Then:       trilight view data/first",
    help_epilogue="Anywhere on the line: --extend FILE.py, a file of your own that adds layouts, "
    "presets, formats and more (docs/how-to).",
    help_flags=HELP_FLAGS,
    help_format="plaintext",
    group_commands=Group("Options", sort_key=99),
    version=lambda: f"trilight {metadata.version('trilight')}",
    version_format="plaintext",
    group_parameters=Group("Options"),
    suppress_keyboard_interrupt=False,
    result_action="return_value",
    exit_on_error=False,
    print_error=False,
)
"""The whole command line."""
_SECTION_OF = {
    name: section
    for rank, (title, names) in enumerate(SECTIONS.items())
    for section in [Group(title, sort_key=rank)]
    for name in names
}
_BESIDE = {
    "leaderboard": "evaluate",
    "plan": "generate",
    "revisit": "generate",
    "export": "convert",
    "push": "convert",
    "verify": "status",
}
"""Command beside which another one stands, in one module."""
for _rank, (_name, _help) in enumerate(COMMANDS.items()):
    _function = "app" if _name in GROUPS else _name
    _options: Any = {} if _name in GROUPS else {"help_epilogue": ""}  # groups state their own
    app.command(
        f"{__package__}.{_BESIDE.get(_name, _name)}:{_function}",
        name=_name,
        help=_help,
        sort_key=_rank,
        group=_SECTION_OF[_name],
        **_options,
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
