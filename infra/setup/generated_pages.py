"""Reference pages that each build of the site generates from the program's declarations."""

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from cyclopts import App

from infra.cli.commands import COMMANDS, app
from infra.cli.options import PRESETS
from infra.render.plan import RenderOptions
from infra.serving.train_model import TrainOptions
from pipeline.flows.forms import DatasetInRuns
from pipeline.generation.generate_options import CorePrice, RevisitOptions
from pipeline.presets.settings import DatasetSettings
from pipeline.shards.expression import TEXTS
from scene_templates.recorded_sampler import RecordedDraw
from scene_templates.skies.procedural_skies import (
    OUR_SKIES,
    PALEST,
    SKIES,
    SkyDraws,
    SkyMapSettings,
    SkyTexels,
)
from scene_templates.surfaces.maps import LEAST_TINT, SurfaceDraws, Texels
from scene_templates.surfaces.procedural_textures import OUR_SURFACES, SURFACES, SurfaceMapSettings
from storage.markdown import table
from storage.records.material import PUBLISHED_COLUMNS, laid_out
from storage.records.passes import MOTION, declared_passes
from storage.records.quantities import QUANTITIES
from storage.records.scene import Scene
from storage.seeds import rng_for
from storage.settings.fields import (
    default_text,
    describe_fields,
    group_of,
    parts_of,
)
from train.evaluation.options import EvaluationOptions, LeaderboardOptions
from train.settings import TrainSettings, WatchSettings

_COMMANDS = """# Command line

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
        options = []
        for argument in group.assemble_argument_collection():
            field = argument.field_info.name
            by_place = argument.index is not None
            names = (PRESETS.get(field, field.upper()),) if by_place else tuple(argument.names)
            takes = argument.parameter.metavar or ""
            options.append(Option(field, names, takes, str(argument.parameter.help)))
        yield Command(name, group.help, tuple(options))
    for inner in group:
        if not inner.startswith("-"):
            yield from _commands(group[inner], f"{name} {inner}")


def command_line_page() -> str:
    """Return every command with its options, as --help shows them."""
    parts = [_COMMANDS]
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


ROOTS: dict[str, tuple[type, ...]] = {
    "Scene": (Scene,),
    "Generate": (DatasetInRuns, DatasetSettings),
    "Revisit": (RevisitOptions,),
    "Render": (RenderOptions,),
    "Plan": (CorePrice,),
    "Train": (TrainOptions, TrainSettings, WatchSettings),
    "Evaluate": (EvaluationOptions,),
    "Leaderboard": (LeaderboardOptions,),
}
"""Settings classes by command; `reachable` finds the classes within them."""

_HEAD = """# Settings

Made from the descriptions at the fields (`storage/settings/described.py`), which
are also what is checked and what the command line and Prefect's forms show: a value outside is
refused in one line that names the field. Tests go to both ends of every range and one step outside
(`tests/extremes/test_ranges.py`), and run what both ends make where that is cheap. Laws between
fields, such as `min_spp` of at most `max_spp`, are not here: the complaint about one says what it
expects. Every setting of a preset can be changed with `--set NAME=VALUE`, by its dotted
name, such as `--set scenes.lights.count=[2,4]`, `--set scenes.families.0.weight=2` or `--set
model=large`. Settings of a run that say *free* are how it is executed: the weights do not depend on
them, or by rounding alone. All others are what the run means, and change by `--change`, which the
run records ([Carry on a run](../how-to/carry-on-a-run.md)).
"""


def settings_page() -> str:
    """Return every setting with its meaning, range and default."""
    parts = [_HEAD]
    for command, roots in ROOTS.items():
        parts.append(f"## {command}\n")
        for settings in reachable(*roots):
            if rows := list(_rows(settings)):
                first = _first_sentence(inspect.getdoc(settings) or "")
                parts.append(f"### `{settings.__name__}`\n\n{first}\n")
                head = ("field", "meaning", "expected", "default", "when a run goes on")
                parts.append(table(head[: len(rows[0])], rows) + "\n")
    return "\n".join(parts)


def reachable(*roots: type) -> list[type]:
    """Return dataclasses and those in their fields, each once, outer ones first."""
    kinds: dict[type, None] = {}
    for root in roots:
        kinds[root] = None
        for field in describe_fields(root):
            kinds |= dict.fromkeys(reachable(*filter(group_of, parts_of(field.hint))))
    return list(kinds)


def _rows(kind: type) -> Iterator[tuple[str, ...]]:
    if kind is Scene:  # its fields are arrays, and no settings
        for field in describe_fields(Scene):
            ranges = {"": field.within}
            if field.name == "materials":
                columns = laid_out(PUBLISHED_COLUMNS)
                ranges = {f", {column.name}": column.within for column, _ in columns}
            for part, within in ranges.items():
                if within is not None:
                    yield f"`{field.name}`{part}", _first_sentence(field.sentence), str(within), ""
        return
    fields = describe_fields(kind) if hasattr(kind, "__pydantic_fields__") else ()
    is_marked = any(field.is_execution for field in fields)
    for field in fields:
        named = [name for kind in parts_of(field.hint) for name in getattr(kind, "PRESETS", ())]
        presets = f", or one of {', '.join(named)}" if named else ""
        yield (
            f"`{field.name}`",
            _first_sentence(field.sentence).replace("|", "\\|"),
            (field.expected + presets).replace("|", "\\|"),
            _default_text(field.default),
            *(["free" if field.is_execution else ""] if is_marked else []),
        )


def _default_text(default: Any) -> str:
    if default is dataclasses.MISSING or dataclasses.is_dataclass(default):
        return ""
    if default is None or default in ((), {}):
        return "none"
    if isinstance(default, bool):
        return str(default).lower()
    return default_text(default, quote="`")


def _first_sentence(doc: str) -> str:
    """Return a text up to its first full stop before a space, as one line."""
    match = re.match(r".*?(?<! al)\.(?=\s|$)", " ".join(doc.split()))
    return match[0] if match else doc


_PASSES = """# Passes: what a pixel sees

Made from the table in `storage/records/passes.py`. Passes are functions
of a stored scene and a camera, so that they need not be stored: `trilight.view_passes(scene)`
returns them as arrays, with row 0 on top, in the conventions of [Formats](formats.md).

- Emitters are hidden from cameras, as in the pictures: rays pass through them. So the emission of
  what is seen is always 0.
- Embree finds the triangle that a ray meets, in single precision. The point on the triangle is then
  computed in double precision from its stored corners. `trilight passes` traces on a GPU where one
  passes the probe: a pixel on a rim may then show the neighboring triangle.
- By default a pixel has one ray, through its centre, and every pass is exactly what that ray meets.
  With `rays_a_side=4`, a pixel has 4 x 4 rays on a regular grid. A pass whose averaging is
  `surfaces` is then the mean over the rays that meet a surface; times `coverage` it is the mean
  over the whole pixel, which other renderers write. A pass whose averaging is `centre ray` is never
  averaged.
- Means of normals are shorter than 1 where a pixel sees several normals. Means of depths and
  positions may lie between surfaces: for geometry, take one ray and more pixels.
- Where nothing is met, ids are -1, depths infinite, and other quantities NaN.
- Material columns are those of the point that is seen, with its textures. Scenes without textures
  have no texture coordinates: there, the pass `uv` is NaN, and left out where all passes are asked
  for, and of files: a file has the channels `uv.U` and `uv.V` exactly where its scene has textures.

A view of 256 x 256 pixels of a scene with 1,500 triangles takes 0.04 CPU seconds with all passes,
and 0.9 with 4 x 4 rays a pixel: 1.3 to 1.5 million rays a core-second; making Embree's
tree adds 0.2 CPU seconds for 100,000 triangles. Passes were compared with
Mitsuba's `aov` integrator: positions differ by 0.7 micrometres at most and normals by 5e-6, which
is its single precision. Two of its passes mean something else. Its depth begins at the near plane
of the camera. Its albedo leaves out the specular lobe where that is narrow: it is wrong on glossy
surfaces (`tests/pipeline/renders/test_passes.py`). Beside Blender's Cycles (four RenderFormer
scenes, 128 x 128, one ray a pixel) positions differ by 7 micrometres at most, normals by 0.02
degrees in 99 of 100 pixels, and diffuse colours not at all; Cycles turns normals at rims by up to
26 degrees, and counts what is scattered more than once into its glossy colour.

## Asked for, or stored

`trilight passes SRC --passes depth,normal,object --out FOLDER` writes one OpenEXR file a view, of a
dataset or of any scene that `trilight convert` reads. `--set storage.passes=[depth,normal,object]`
makes `trilight generate` store the bytes of `--device cpu` in the shards, as
`000000123.0.passes.exr`; by default nothing is stored. `sample.view_passes(["depth_axis_m"])` of a
sample of a dataset returns the same numbers, whether they are stored or not: ids as int32, others
as float32. `motion_px` needs a second moment or camera and is not stored. The pages of a dataset's
report show small pictures of depth, normals, object ids, diffuse albedo and roughness, computed
when they are written.

- All channels are 32-bit floats, compressed without loss (ZIP). Ids below 2^24 are exact in them;
  scenes with more triangles are refused.
- `Z`, `A`, `N`, `P` and `Ng` are the names that compositors and viewers of OpenEXR use for depth,
  alpha and layers of normals and positions. Other layers have the name of the pass, and channels
  have one letter. Blender 4.5 opens the files as layers and takes `Depth` and `Alpha` from them
  (`tests/pipeline/renders/test_passes_beside_cycles.py`); they have not been tested in Nuke.
- `A` is `coverage`, and is in every file. Numbers are not multiplied by it. Where it is 0, nothing
  is met: ids are -1, depths infinite, and other channels 0 instead of NaN.

The table says how many kB of a view of 256 x 256 pixels each pass takes (mean of 6 views of 3
scenes with about 1,500 triangles, 2026-11-23). Depth, normal and object together take 400 kB, and
all passes 2,450 kB, which is many times the compact picture. Computing and writing takes 0.05
CPU seconds a view for the three and 0.12 for all; reading a stored file takes 0.004 and 0.03. So
storing pays where many readers want one pass without Embree. ZSTD would save a quarter, but only
readers of OpenEXR from 3.4 on know it.

## The passes
"""

_STORED_KB = {
    "triangle": 24,
    "object": 8,
    "barycentric": 731,
    "hit": 3,
    "coverage": 2,
    "depth_axis_m": 219,
    "depth_ray_m": 242,
    "position_m": 635,
    "geometric_normal": 62,
    "geometric_normal_camera": 61,
    "shading_normal": 173,
    "shading_normal_camera": 170,
    "material_diffuse": 31,
    "material_specular": 16,
    "material_roughness": 9,
    "material_emission": 5,
}
"""Measured size of a file with the pass and `coverage`."""

_QUANTITIES = """# What can be asked of a scene

Made from `storage/records/quantities.py` and `pipeline/shards/expression.py`.

```sh
trilight shards list DATA --where 'max(roughness) < 0.3 and lights_per_scene > 1'
trilight shards select DATA --out NEW --where 'template in ("plane", "room") and min(coverage) > 0'
trilight shards select DATA --out NEW --where 'min(noise_floor_linear_db) >= 35 and not any(at_cap)'
```

A condition compares numbers (`<`, `<=`, `>`, `>=`, `==`, `!=`, with `+`, `-`, `*`, `/`) and texts
(`==`, `!=`, `in`), joined by `and`, `or` and `not`. What a scene has several of goes through
`min(...)`, `max(...)` or `mean(...)`, truths through `any(...)` or `all(...)`. Of no values at all
these are not a number, and no comparison with that holds. Nothing else is carried out.
"""

_KINDS = {"text": "a text", "texts": "texts", "truths": "truths"}

_MAPS = """# Surfaces and skies: what they are drawn from

Made from the draws themselves: `scene_templates/surfaces` and
`scene_templates/skies` state each range where they draw from it, and tests compare what comes out
with it. [Surfaces and skies](../explanation/surfaces-and-skies.md) says how they are made. Colours
are linear, with Rec.709 primaries.

The tables are those of natural colours (`SurfaceMapSettings.natural_share`,
`SkyMapSettings.coloured_share`). A natural base colour is the stated one times a tint, whose
channels are uniform from {least_tint:g} to 1. In the other surfaces, each channel of each base
colour is uniform in `SurfaceMapSettings.albedo`. Natural lights are black bodies; a mired is a
million over the temperature in kelvin. In the other skies, each channel of each light is uniform
from {palest:g} to 1, and the colour is then scaled to a mean of 1. What is drawn several times,
such as the power of each lamp, stands once.
"""

_SEEDS = 32
"""Number of seeds for each family, so that rare draws are listed, too."""


def passes_page() -> str:
    """Return the page of passes, with meaning, channels, unit and averaging."""
    rows = [
        (
            f"`{each.name}`",
            f"`{each.short}`" if each.short and stored else "",
            each.means,
            " ".join(each.channels) or "1",
            *(each.unit, each.frame, each.averaging),
            " ".join(f"`{channel}`" for channel in each.exr_channels) if stored else "",
            str(_STORED_KB.get(each.name, "")),
        )
        for each in declared_passes()
        for stored in [each.name != MOTION]
    ]
    columns = (
        *("pass", "shorter", "what it means", "channels", "unit", "frame", "averaging"),
        *("in OpenEXR", "kB"),
    )
    return f"{_PASSES}\n{table(columns, rows)}\n"


def quantities_page() -> str:
    """Return the page of quantities that `--where` accepts."""
    numbers = [
        (f"`{name}`", "a number" if each.per == "scene" else f"numbers, for each {each.per}",
         each.label)
        for name, each in QUANTITIES.items()
    ]  # fmt: skip
    texts = [(f"`{name}`", _KINDS[kind], means) for name, (kind, means) in TEXTS.items()]
    return f"{_QUANTITIES}\n{table(('name', 'what it is', 'of what'), [*numbers, *texts])}\n"


def maps_page() -> str:
    """Return the page of the distributions of procedural surfaces and skies, in natural colors."""
    albedo = SurfaceMapSettings().albedo
    skies = SkyMapSettings(coloured_share=0.0)
    parts = [_MAPS.format(least_tint=LEAST_TINT, palest=PALEST), "## Surfaces\n"]
    for name in OUR_SURFACES:
        parts += _family(
            name, SURFACES[name], Texels(1), ("natural colours", ": tint"),
            lambda rng: SurfaceDraws(rng, natural_share=1.0, albedo=albedo),
        )  # fmt: skip
    parts.append("## Skies\n")
    for name in OUR_SKIES:
        parts += _family(
            name, SKIES[name], SkyTexels(1), ("coloured lights",),
            lambda rng: SkyDraws(rng, skies),
        )  # fmt: skip
    return "\n".join(parts)


def _family(
    name: str,
    family: Callable[..., object],
    texels: object,
    said_above: tuple[str, ...],
    new_draws: Callable[[np.random.Generator], Any],
) -> Iterator[str]:
    """Yield the section of a family, with all draws by their labels."""
    made: dict[str, RecordedDraw] = {}
    for seed in range(_SEEDS):
        draws = new_draws(rng_for(seed, "page"))
        family(draws, texels)
        made |= draws.made
    rows = [(label, str(draw)) for label, draw in made.items() if not label.endswith(said_above)]
    yield f"### `{name}`\n\n{' '.join((inspect.getdoc(family) or '').split())}\n"
    yield table(("drawn", "distribution"), rows)
    yield ""


PAGES: dict[str, Callable[[], str]] = {
    "settings": settings_page,
    "command-line": command_line_page,
    "passes": passes_page,
    "quantities": quantities_page,
    "surfaces-and-skies": maps_page,
}
"""Function that returns each page below docs/reference, by the page's name."""
