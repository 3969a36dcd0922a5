"""Writes the documents beside the shards of a finished dataset, for readers and hubs."""

import bisect
import dataclasses
import json
from collections import Counter
from collections.abc import Collection, Iterable
from typing import Any

from markupsafe import Markup

from pipeline.documents.checksums import renew_sums
from pipeline.documents.distributions import MEASURED, Distributions, dataset_distributions
from pipeline.documents.pages import render_markdown, render_page
from pipeline.documents.report import write_report
from pipeline.documents.rights import encode_attribution, hub_licence
from pipeline.documents.sheets import write_contact_sheet
from storage.atomic import write_atomically
from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import (
    Manifest,
    derivation_of,
    read_manifest,
    write_manifest,
)
from storage.dataset.statistics import Statistics, dataset_statistics
from storage.digests import sha256_hex, sha256_of_file
from storage.licences import licence_url
from storage.markdown import front_matter
from storage.records.profiles import PLAIN

_TAGS = (
    "neural-rendering", "path-tracing", "renderformer", "3d", "hdr", "openexr", "webdataset",
    "trilight",
)  # fmt: skip


def encode_card(folder: DatasetFolder, manifest: Manifest, distributions: Distributions) -> bytes:
    """Return the card; of `folder` only the names of the dataset's documents are used."""
    title = f"Trilight dataset {manifest.build}"
    licences = distributions.licences
    layouts = Counter[str]()
    for (template, _), count in sorted(distributions.scenes.items()):
        layouts[template] += count
    return render_markdown(
        "card.jinja",
        front=Markup(front_matter(_front(folder, manifest, licences, title))),
        title=title,
        folder=folder,
        manifest=manifest,
        found=distributions,
        layouts=layouts,
        derivation=derivation_of(manifest.settings),
        measured=list(MEASURED.values()),
        licences=licences,
        plain=PLAIN,
    )


def _front(
    folder: DatasetFolder, manifest: Manifest, licences: Collection[str], title: str
) -> dict[str, Any]:
    files = [
        {"split": split, "path": sorted(patterns, reverse=True)}
        for split in SPLITS
        if (
            patterns := {
                f"part-*/{split}-*.tar" if "/" in shard.name else f"{split}-*.tar"
                for shard in manifest.shards
                if shard.split == split
            }
        )
    ]
    return {
        **hub_licence(licences, link=folder.licences.name),
        "pretty_name": title,
        "size_categories": [_size_category(manifest.num_samples)],
        "task_categories": ["other"],
        "tags": list(_TAGS),
        "configs": [{"config_name": "default", "data_files": files}],
    }


def _size_category(num_scenes: int) -> str:
    """Return Hugging Face's name for a number of samples."""
    names = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "n>10M")
    return names[bisect.bisect_right([10**power for power in range(3, 8)], num_scenes)]


def write_documents(dataset: Dataset, out: DatasetFolder) -> Statistics:
    """Write card, licences, croissant, attribution, contact sheet and report of a dataset.

    Each file is written atomically. They depend on the dataset alone, so equal datasets have equal
    documents.

    They go into `out`; the dataset itself may be on a server.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    manifest = dataset.manifest
    statistics = dataset_statistics(dataset)
    distributions = dataset_distributions(dataset)
    licences = distributions.licences
    write_atomically(out.attribution, encode_attribution(distributions.locked, manifest.settings))
    write_atomically(out.licences, render_markdown("license.jinja", licences=licences))
    write_contact_sheet(dataset, statistics, out=out)
    write_report(dataset, distributions, out=out)
    write_atomically(out.croissant, encode_croissant(manifest, licences))
    card = encode_card(out, manifest, distributions)
    if out.manifest.exists():
        with out.mutex("manifest"):
            documents = {
                path.name: sha256_of_file(path)
                for path in (out.attribution, out.licences, out.croissant)
            }
            listed = read_manifest(out.manifest)
            documents[out.card.name] = sha256_hex(card)  # which is still to be written
            write_manifest(out.manifest, dataclasses.replace(listed, documents=documents))
    write_atomically(out.card, card)  # last: with it, the dataset is finished
    renew_sums(out.root)
    return statistics


MOST_LISTED = 10_000
"""Most shards that are listed one by one; beyond that only `manifest.json` has their digests."""


def encode_croissant(manifest: Manifest, licences: Iterable[str]) -> bytes:
    """Return `croissant.json`: every shard with its sha256, and a record for each scene.

    The vocabulary is Croissant 1.1 of MLCommons, as JSON-LD. mlcroissant, which validates it in the
    tests, would be a slower way to write the same document. It has no date of publication: equal
    datasets give equal bytes. A licence without a known URL is stated by its name.
    """
    shards = manifest.shards
    listed = shards if len(shards) <= MOST_LISTED else ()
    names = [shard.name for shard in listed] or (["shards"] if shards else [])
    document = render_page(
        "croissant.jinja",
        f"trilight-{manifest.build}",
        manifest=manifest,
        licences=[licence_url(name) or name for name in licences],
        listed=listed,
        archives=[{"@id": name} for name in names],
        splits=[split for split in SPLITS if any(shard.split == split for shard in shards)],
    )
    text = json.dumps(json.loads(document), indent=1, sort_keys=True, ensure_ascii=True)
    return text.encode() + b"\n"
