"""Everything that stands beside the shards of a finished dataset, for people and for hubs."""

from pipeline.documents.attribution import attribution_of
from pipeline.documents.card import encode_card
from pipeline.documents.contact_sheet import write_contact_sheet
from pipeline.documents.croissant import encode_croissant
from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.report import write_report
from pipeline.documents.rights import encode_licences, rights_of
from storage.atomic import write_atomically
from storage.dataset import Dataset
from storage.statistics import Statistics, dataset_statistics


def write_documents(dataset: Dataset) -> Statistics:
    """Write card, licences, croissant, attribution, contact sheet and report of a dataset.

    Each appears whole or not at all. They depend on the dataset alone, so equal datasets have equal
    documents whoever made them.

    Raises:
        TrilightError: a shard is missing, a sample unreadable, or the folder cannot be written.
    """
    folder, manifest = dataset.folder, dataset.manifest
    statistics, found = dataset_statistics(dataset), dataset_distributions(dataset)
    rights = rights_of(found.objects)
    write_atomically(folder.attribution, attribution_of(found.objects, manifest.settings))
    write_atomically(folder.licences, encode_licences(rights))
    write_contact_sheet(dataset, statistics)
    write_report(dataset, found)
    write_atomically(folder.croissant, encode_croissant(manifest, rights))
    write_atomically(folder.card, encode_card(folder, manifest, found, rights))
    return statistics
