"""Writes the documents beside the shards of a finished dataset, for readers and hubs."""

import dataclasses

from pipeline.documents.card import encode_card
from pipeline.documents.checksums import renew_sums
from pipeline.documents.croissant import encode_croissant
from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.report import write_report
from pipeline.documents.rights import attribution_of, encode_licences, rights_of
from pipeline.documents.sheets import write_contact_sheet
from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest, write_manifest
from storage.dataset.statistics import Statistics, dataset_statistics
from storage.digests import sha256_hex, sha256_of_file


def write_documents(dataset: Dataset, out: DatasetFolder | None = None) -> Statistics:
    """Write card, licences, croissant, attribution, contact sheet and report of a dataset.

    Each file is written atomically. They depend on the dataset alone, so equal datasets have equal
    documents.

    They go into `out`, by default the dataset's folder; the dataset may be on a server.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    out = out or dataset.folder
    manifest = dataset.manifest
    statistics = dataset_statistics(dataset)
    distributions = dataset_distributions(dataset)
    rights = rights_of(distributions.locked)
    write_atomically(out.attribution, attribution_of(distributions.locked, manifest.settings))
    write_atomically(out.licences, encode_licences(rights))
    write_contact_sheet(dataset, statistics, out=out)
    write_report(dataset, distributions, out=out)
    write_atomically(out.croissant, encode_croissant(manifest, rights))
    card = encode_card(out, manifest, distributions, rights)
    if out.manifest.exists():
        _write_digests(out, card)
    write_atomically(out.card, card)  # last: with it, the dataset is finished
    renew_sums(out.root)
    return statistics


def _write_digests(folder: DatasetFolder, card: bytes) -> None:
    """Store the digests of the documents in the manifest; `card` is still to be written."""
    with folder.mutex("manifest"):
        written = (folder.attribution, folder.licences, folder.croissant)
        documents = {path.name: sha256_of_file(path) for path in written}
        documents[folder.card.name] = sha256_hex(card)
        manifest = read_manifest(folder.manifest)
        write_manifest(folder.manifest, dataclasses.replace(manifest, documents=documents))
