"""`croissant.json`: the dataset in the Croissant 1.1 vocabulary of MLCommons, as JSON-LD.

It is written as plain JSON: mlcroissant, which validates it in the tests, would be a slower way to
write the same dictionary, and needs rdflib and pandas. It has no date of publication: equal
datasets give equal bytes.
"""

import json
from collections.abc import Mapping
from typing import Any

from pipeline.documents.rights import Rights
from storage.conventions import SPLITS
from storage.dataset.manifest import Manifest, ShardEntry
from storage.licences import licence_url

_TERMS = (
    "arrayShape citeAs column containedIn equivalentProperty extract field fileObject "
    "fileProperty fileSet format includes isArray isLiveDataset jsonPath key md5 parentField "
    "path recordSet references regex repeated replace samplingRate separator source subField "
    "transform"
).split()
_CONTEXT: Mapping[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    **{term: f"cr:{term}" for term in _TERMS},
}
"""The context that the specification prescribes."""

_SPLIT_URLS: Mapping[str, str] = {
    "train": "http://mlcommons.org/croissant/Training",
    "validation": "http://mlcommons.org/croissant/Validation",
    "test": "http://mlcommons.org/croissant/Test",
}
_RECORDS = "scene-records"


def encode_croissant(manifest: Manifest, rights: Rights) -> bytes:
    """Return the file of a dataset: every shard with its sha256, and a record for each scene.

    A licence without a known URL is stated by its name.
    """
    digest = manifest.dataset_digest
    shards = list(manifest.shards)
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": f"trilight-{manifest.build}",
        "description": (
            f"{manifest.num_samples} path-traced scenes of triangles with {manifest.num_views} HDR "
            "views each, every view with its own measured error, as WebDataset shards."
        ),
        "version": f"{manifest.schema_version}.0.0+{digest[:12]}",
        "identifier": f"sha256:{digest}",
        "keywords": ["neural rendering", "path tracing", "HDR", "WebDataset"],
        "license": [licence_url(name) or name for name in rights.licences],
        "distribution": _distribution(shards),
        "recordSet": [_splits(shards), _scenes()] if shards else [],
    }
    text = json.dumps(document, indent=1, sort_keys=True, ensure_ascii=True)
    return text.encode() + b"\n"


MOST_LISTED = 10_000
"""Most shards that are listed one by one; beyond that only `manifest.json` has their digests."""


def _distribution(shards: list[ShardEntry]) -> list[dict[str, Any]]:
    """Return the shards, and the kinds of members in all of them."""
    if len(shards) > MOST_LISTED:
        files = [
            _node(
                "cr:FileSet",
                "shards",
                description="manifest.json has the size and sha256 of each",
                encodingFormat="application/x-tar",
                includes="**/*.tar",
            )
        ]
    else:
        files = [
            _node(
                "cr:FileObject",
                shard.name,
                contentUrl=shard.name,
                contentSize=f"{shard.num_bytes} B",
                encodingFormat="application/x-tar",
                sha256=shard.sha256,
            )
            for shard in shards
        ]
    kinds = (
        (_RECORDS, "objects, provenance and the record of each view", "application/json", "*.json"),
        (
            "scene-arrays",
            "geometry, materials and cameras as safetensors, gzip where the name ends so",
            "application/octet-stream",
            "*.scene.safetensors*",
        ),
        ("pictures", "linear radiance of each view, half floats", "image/x-exr", "*.exr"),
    )
    archives = [{"@id": file["name"]} for file in files]
    members = [
        _node(
            "cr:FileSet",
            name,
            description=description,
            containedIn=archives,
            encodingFormat=encoding,
            includes=pattern,
        )
        for name, description, encoding, pattern in kinds
    ]
    return [*files, *members] if files else []


def _node(kind: str, name: str, **fields: Any) -> dict[str, Any]:
    return {"@type": kind, "@id": name, "name": name, **fields}


def _splits(shards: list[ShardEntry]) -> dict[str, Any]:
    used = [split for split in SPLITS if any(shard.split == split for shard in shards)]
    return _node(
        "cr:RecordSet",
        "splits",
        description="a shard holds one split; its name begins with it",
        dataType="cr:Split",
        key={"@id": "splits/name"},
        field=[_field("splits/name", "sc:Text"), _field("splits/url", "sc:URL")],
        data=[{"splits/name": split, "splits/url": _SPLIT_URLS[split]} for split in used],
    )


def _scenes() -> dict[str, Any]:
    """Return the records of scenes: key and JSON, which is all mlcroissant reads of many tars."""
    key = {"extract": {"fileProperty": "filename"}, "transform": {"regex": r"^([^.]+)\."}}
    content = {"extract": {"fileProperty": "content"}}
    return _node(
        "cr:RecordSet",
        "scenes",
        description="one record per scene; its arrays and pictures have the same key",
        key={"@id": "scenes/key"},
        field=[_field("scenes/key", "sc:Text", key), _field("scenes/json", "sc:Text", content)],
    )


def _field(name: str, data_type: str, source: Mapping[str, Any] | None = None) -> dict[str, Any]:
    field = _node("cr:Field", name, dataType=data_type)
    return field | ({"source": {"fileSet": {"@id": _RECORDS}, **source}} if source else {})
