"""`README.md` of a dataset: the dataset card, with the front matter that Hugging Face reads.

It holds no time, machine or order of work: equal datasets give equal cards.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from pipeline.documents.distributions import MEASURED, Distributions
from pipeline.documents.report_maps import maps_in_words
from pipeline.documents.rights import Rights, hub_licence, rights_markdown
from storage.dataset.derived import Derivation, derivation_of
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest
from storage.markdown import code, front_matter, table, text
from storage.records.objects import SKY, TEXTURE
from storage.records.profiles import PLAIN
from storage.records.quantities import summary

_TAGS = (
    "neural-rendering", "path-tracing", "renderformer", "3d", "hdr", "openexr", "webdataset",
    "trilight",
)  # fmt: skip
_SETTINGS = (
    ("seed", "seed"),
    ("objects from", "source"),
    ("picture width, pixels", "renders.resolution"),
    ("target noise floor, dB", "renders.noise_floor_db"),
    ("target as linear PSNR, dB", "renders.noise_floor_linear_db"),
    ("target over geometry, dB", "renders.noise_floor_objects_db"),
    ("most samples per pixel", "renders.max_spp"),
    ("longest light path", "renders.max_depth"),
    ("views of a scene", "scenes.num_views"),
    ("most triangles of a scene", "scenes.max_triangles"),
    ("scenes of a shard", "splits.scenes_per_shard"),
    ("profile", "storage.profile"),
)
"""Labels and names of the settings that the card shows; the manifest has all of them."""


def encode_card(
    folder: DatasetFolder, manifest: Manifest, distributions: Distributions, rights: Rights
) -> bytes:
    """Return the card.

    Args:
        folder: folder of the dataset; only the names of its documents are used.
        manifest: manifest of the dataset.
        distributions: distributions of the dataset.
        rights: rights to its objects.
    """
    title = f"Trilight dataset {manifest.build}"
    parts = [
        front_matter(_front(folder, manifest, rights, title)),
        f"# {text(title)}",
        _lead(manifest),
        f"![some of the scenes]({folder.contact_sheet.name})",
        "## What it holds",
        f"Views, errors and contents are those {distributions.sample}."
        if distributions.sample
        else "",
        _by_split(manifest, distributions),
        _NOISE_FLOOR,
        _contents(manifest, distributions),
        "## How it was made",
        _generation(manifest),
        "## Licences",
        rights_markdown(rights),
        "## How to read it",
        _reading(manifest, distributions.packings),
        "## How to check it",
        _CHECK.format(digest=manifest.dataset_digest),
    ]
    return ("\n\n".join(part for part in parts if part) + "\n").encode(errors="replace")


_NOISE_FLOOR = (
    "The **noise floor** of a view is the measured error of its picture, as the PSNR of "
    "log10(1 + radiance): differences below it say nothing about a model. The same error is also "
    "stated as PSNR of linear radiance clamped to [0, 1] (linear), and over the pixels that show "
    "geometry (objects). All three stand in each scene's JSON; `report.html` shows all "
    "distributions."
)
_PICTURES = (
    "Pictures are path-traced with Mitsuba 3 and denoised. The noise floor comes from two "
    "independent halves of the samples, each denoised by itself."
)
_CHECK = """The dataset digest covers shards, objects and settings:

    {digest}

`trilight verify .` checks every hash, member and law. Without Trilight, `manifest.json` has size
and sha256 of each shard."""


def _front(folder: DatasetFolder, manifest: Manifest, rights: Rights, title: str) -> dict[str, Any]:
    files = [
        {"split": split, "path": _patterns(manifest, split)}
        for split in ("train", "validation", "test")
        if any(shard.split == split for shard in manifest.shards)
    ]
    return {
        **hub_licence(rights, link=folder.licences.name),
        "pretty_name": title,
        "size_categories": [_size_category(manifest.num_samples)],
        "task_categories": ["other"],
        "tags": list(_TAGS),
        "configs": [{"config_name": "default", "data_files": files}],
    }


def _patterns(manifest: Manifest, split: str) -> list[str]:
    names = [shard.name for shard in manifest.shards if shard.split == split]
    patterns = {f"part-*/{split}-*.tar" if "/" in name else f"{split}-*.tar" for name in names}
    return sorted(patterns, reverse=True)


def _size_category(num_scenes: int) -> str:
    """Return Hugging Face's name for a number of samples."""
    bounds = [(1_000, "1K"), (10_000, "10K"), (100_000, "100K"), (1_000_000, "1M"), (10**7, "10M")]
    below = "n"
    for bound, name in bounds:
        if num_scenes < bound:
            return f"n<{name}" if below == "n" else f"{below}<n<{name}"
        below = name
    return "n>10M"


def _lead(manifest: Manifest) -> str:
    resolution = _setting(manifest.settings, "renders.resolution")
    size = f" of {text(resolution)} x {text(resolution)} pixels" if resolution else ""
    pictures = "picture" if manifest.num_views == 1 else "pictures"
    return (
        f"{manifest.num_samples} scenes of triangles with materials, lights and cameras, and "
        f"{text(manifest.num_views)} path-traced HDR {pictures}{size} of each, to train and judge "
        f"neural renderers in the manner of RenderFormer. {manifest.num_bytes / 1e6:.1f} MB in "
        f"{len(manifest.shards)} shards. Made by Trilight."
    )


def _by_split(manifest: Manifest, distributions: Distributions) -> str:
    rows: list[Sequence[object]] = []
    for split in distributions.splits:
        floors = {name: summary(distributions.values[split][name]) for name in MEASURED.values()}
        num_views = int(floors["noise_floor_db"]["count"])
        shards = [shard for shard in manifest.shards if shard.split == split]
        reached = distributions.reaches_targets(split)
        rows.append(
            (
                split,
                sum(shard.num_samples for shard in shards),
                num_views,
                len(shards),
                *(_three(floors, name) if num_views else "" for name in ("median", "p5")),
                f"{reached.mean():.0%}" if reached is not None and num_views else "",
                f"{distributions.views_at_cap.get(split, 0) / max(num_views, 1):.0%}",
            )
        )
    head = (
        "split", "scenes", "views", "shards", "median noise floor, dB (linear, objects)",
        "5th percentile", "reach the target", "stopped at the cap",
    )  # fmt: skip
    return table(head, rows, numbers=7)


def _three(floors: Mapping[str, Mapping[str, float]], statistic: str) -> str:
    log, linear, objects = (numbers[statistic] for numbers in floors.values())
    return f"{log:.1f} ({linear:.1f}, {objects:.1f})"


def _contents(manifest: Manifest, distributions: Distributions) -> str:
    templates: dict[str, int] = {}
    for (template, _), count in sorted(distributions.scenes.items()):
        templates[template] = templates.get(template, 0) + count
    triangles = summary(distributions.all("triangles_per_scene"))
    layouts = ", ".join(f"{count} {code(name)}" for name, count in templates.items())
    rows = [
        ("scenes by layout", layouts or "none"),
        (
            "objects",
            f"{len(distributions.objects)}, of which {len(distributions.placements)} stand in "
            "scenes",
        ),
        *_user_maps(distributions),
        (
            "rejected on the way",
            f"{len(distributions.failures)}, each with its reason in failures.jsonl",
        ),
    ]
    rows[1:1] = list(maps_in_words(distributions).items())
    if triangles["count"]:
        spread = f"median {triangles['median']:.0f}, most {triangles['max']:.0f}"
        rows.insert(1, ("triangles of a scene", spread))
    return table(("", ""), rows)


def _user_maps(distributions: Distributions) -> list[tuple[str, str]]:
    """Return a row for the user's textures, and one for the user's maps, if there are any."""
    rows = []
    for kind, name in ((TEXTURE, "textures, not procedural"), (SKY, "skies, not procedural")):
        uids = {entry.uid for entry in distributions.user_maps if entry.kind == kind}
        if uids:
            rows.append(
                (name, f"{len(uids)}, of which {len(uids & set(distributions.map_uses))} are used")
            )
    return rows


def _generation(manifest: Manifest) -> str:
    derivation = derivation_of(manifest.settings)
    how = _derivation(derivation) if derivation else code(f"trilight generate {manifest.build}")
    rows = []
    for label, name in _SETTINGS:
        value = _setting(manifest.settings, name)
        if value is not None:
            cell = value if isinstance(value, int | float) else code(value)
            rows.append((label, cell))
    for label, name in (("Mitsuba variant", "mitsuba_variant"), ("processor", "processor")):
        if name in manifest.environment:
            rows.append((label, code(manifest.environment[name])))
    more = "All settings and library versions stand in `manifest.json`."
    return "\n\n".join([how, _PICTURES, table(("setting", "value"), rows), more])


def _derivation(derivation: Derivation) -> str:
    rows = [
        (code(source["build"]), source["num_scenes"], source["key_offset"], code(source["digest"]))
        for source in derivation.sources
    ]
    arguments = ", ".join(code(f"{name}={value}") for name, value in derivation.arguments.items())
    of = f" with {arguments}" if arguments else ""
    head = ("made of build", "its scenes", "added to keys", "its dataset digest")
    command = code(f"trilight shards {derivation.operation}")
    return f"{command}{of}.\n\n{table(head, rows)}"


def _reading(manifest: Manifest, packings: Collection[str]) -> str:
    if not manifest.shards:
        return "There is no shard yet."
    split = manifest.shards[0].split
    arrays = " or ".join(_arrays(packings))
    return f"""Any WebDataset reader opens the shards:

```python
import glob, io, OpenEXR, webdataset
from safetensors.numpy import load

shards = sorted(glob.glob("**/{split}-*.tar", recursive=True))
for sample in webdataset.WebDataset(shards, shardshuffle=False).decode():
    arrays = load({arrays})
    picture = OpenEXR.File(io.BytesIO(sample["0.exr"])).channels()["RGB"].pixels
```

`sample["json"]` holds the objects with their licences, and for each view its samples and noise
floor. Lengths are metres, +Z is up, colours are linear Rec.709 radiance, cameras look along -Z.
`trilight train RUN --data .` trains on it."""


def _arrays(packings: Collection[str]) -> list[str]:
    """Return expressions for a sample's arrays; a merged dataset may have both packings."""
    *rest, last = sorted(packings) or [PLAIN]
    return [*(f'sample.get("{packing}")' for packing in rest), f'sample["{last}"]']


def _setting(settings: Mapping[str, Any], name: str) -> Any:
    """Return a setting by its dotted name; None if the manifest lacks it."""
    value: Any = settings
    for part in name.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value
