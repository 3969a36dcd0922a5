"""A small Objaverse, served in the place of the real one."""

import gzip
import hashlib
import json
from typing import Any

from pipeline.objects.sources import FoundObjects
from tests.http_server import Site
from tests.pipeline.objects import find_kit

HOST = "https://huggingface.co/datasets/allenai/objaverse/resolve/main"


def uid_of(name: str) -> str:
    return hashlib.md5(name.encode(), usedforsecurity=False).hexdigest()


NAMES = ("a", "b", "c", "d", "paid", "mute")
UID = {name: uid_of(name) for name in NAMES}
NAME = {uid: name for name, uid in UID.items()}
IN_ORDER = [NAME[uid] for uid in sorted(NAME)]
FREE = [name for name in IN_ORDER if name not in ("paid", "mute")]


def glb(name: str) -> str:
    return f"/glbs/000-00{NAMES.index(name) % 3}/{UID[name]}.glb"


def annotation(name: str) -> dict[str, Any]:
    return {
        "uid": UID[name],
        "name": f"The {name}\n",
        "license": {"paid": "by-nc", "b": "by-sa", "c": "cc0"}.get(name, "by"),
        "user": {"displayName": "Ada", "username": "ada1", "profileUrl": "https://p/ada"},
        "viewerUrl": f"https://v/{name}",
        "publishedAt": "2019-05-03T01:02:03.456",
    }


def packed(value: object) -> bytes:
    return gzip.compress(json.dumps(value).encode())


def fill_site(site: Site) -> None:
    """Serve the metadata and the objects."""
    site.files["/object-paths.json.gz"] = packed({UID[name]: glb(name)[1:] for name in NAMES})
    for number in range(3):
        rows = {UID[name]: annotation(name) for name in NAMES if NAMES.index(name) % 3 == number}
        rows.pop(UID["mute"], None)
        site.files[f"/metadata/000-00{number}.json.gz"] = packed(rows)
    site.files["/lvis-annotations.json.gz"] = packed(
        {"chair": [UID[name] for name in ("d", "paid", "a", "mute")], "sofa_bed": [UID["b"]],
         "vase": [UID["c"], UID["a"]]}
    )  # fmt: skip
    for name in NAMES:
        site.files[glb(name)] = f"glTF {name}".encode()


def find(text: str, **options: Any) -> FoundObjects:
    return find_kit.find(f"objaverse:{text}", **options)


def found_names(found: FoundObjects) -> list[str]:
    return [NAME[record.uid.removeprefix("objaverse/")] for record in found.records]


def reasons(found: FoundObjects) -> dict[str, str]:
    return {
        NAME.get(one.item.removeprefix("objaverse/"), one.item): one.reason
        for one in found.failures
    }
