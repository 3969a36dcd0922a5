"""Writes docs/sbom.cdx.json: all packages of the locks, as a bill of materials in CycloneDX 1.6.

The form is a list of names, versions and licences, and the locks are complete: a generator would
bring more packages to list than lines of this file. The same locks give the same bytes, so there
is neither a time nor a serial number in it.
"""

import json
import re
from pathlib import Path
from typing import Any

from infra.setup.locks import read_lock
from infra.setup.third_party import THREE_SHA256

ROOT = Path(__file__).parents[2]
PLACE = "docs/sbom.cdx.json"
_ROW = re.compile(r"^\| ([^|]+) \| [^|]+ \| ([^|]+) \|$", re.MULTILINE)


def bill_of_materials(root: Path) -> dict[str, Any]:
    """Return the bill of a checkout; ValueError where a lock cannot be read."""
    locks: dict[tuple[str, str], list[str]] = {}
    for path in sorted((root / "requirements").glob("*.txt")):
        for row in read_lock(path):
            locks.setdefault((_plain(row.name), row.version), []).append(path.stem)
    licences = _licences((root / "docs/third_party.md").read_text())
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": {"type": "application", "name": "trilight", "bom-ref": "trilight"}
        },
        "components": [
            *(_component(*pin, licences, locks[pin]) for pin in sorted(locks)),
            _three(),
        ],
    }


def write_bill(root: Path) -> None:
    """Write the bill of a checkout in its place."""
    text = json.dumps(bill_of_materials(root), indent=1, ensure_ascii=False)
    (root / PLACE).write_text(text + "\n")


def _component(
    name: str, version: str, licences: dict[str, str], locks: list[str]
) -> dict[str, Any]:
    reference = f"pkg:pypi/{name}@{version}"
    found: dict[str, Any] = {
        "type": "library",
        "bom-ref": reference,
        "name": name,
        "version": version,
        "purl": reference,
        "scope": "required" if "dataset" in locks else "optional",
        "properties": [{"name": "trilight:lock", "value": lock} for lock in locks],
    }
    if name in licences:
        found["licenses"] = [{"license": {"name": licences[name]}}]
    return found


def _three() -> dict[str, Any]:
    reference = "pkg:npm/three@0.180.0"
    files = [
        {
            "type": "file",
            "name": name,
            "bom-ref": f"{reference}#{name}",
            "hashes": [{"alg": "SHA-256", "content": digest}],
        }
        for name, digest in THREE_SHA256.items()
    ]
    return {
        "type": "library",
        "bom-ref": reference,
        "name": "three",
        "version": "0.180.0",
        "purl": reference,
        "licenses": [{"license": {"id": "MIT"}}],
        "components": files,
    }


def _licences(page: str) -> dict[str, str]:
    """Return what docs/third_party.md says by package; files of three.js have more columns."""
    return {_plain(name.strip()): licence.strip() for name, licence in _ROW.findall(page)}


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    write_bill(ROOT)
