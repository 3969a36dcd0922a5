"""Writes the software bill of materials of a release: the packages of all locks in CycloneDX 1.6.

    python -m infra.setup.sbom FILE

Equal locks give equal bytes: the file holds neither a time nor a serial number. Licenses are those
that pip-licenses reports for the installed packages.
"""

import json
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from infra.setup.locks import read_lock

ROOT = Path(__file__).parents[2]
THREE_VERSION = "0.180.0"
THREE_SHA256 = {
    "three.core.min.js": "61ba0df005b05991361d040d8ff670e1aadfd0ce7aeebd1fdb0725957a8957de",
    "three.module.min.js": "e2b5ee6bccd38fd6d8a2428546b83c5f2426d84b152ef82be8055556e3b40eb6",
}
"""Files of three.js (MIT) in infra/viewer/static/three, from `build/` of its npm package."""


def bill_of_materials(root: Path, licenses: Mapping[str, str]) -> dict[str, Any]:
    """Return the bill of materials of a checkout; raises ValueError if a lock cannot be read."""
    locks: dict[tuple[str, str], list[str]] = {}
    for path in sorted((root / "requirements").glob("*.txt")):
        for row in read_lock(path):
            locks.setdefault((plain_name(row.name), row.version), []).append(path.stem)
    components = []
    for (name, version), listed in sorted(locks.items()):
        components.append(_component("pypi", name, version, licenses.get(name)))
        components[-1]["scope"] = "required" if "dataset" in listed else "optional"
    three = _component("npm", "three", THREE_VERSION, "MIT")
    three["components"] = [
        {"type": "file", "name": name, "hashes": [{"alg": "SHA-256", "content": digest}]}
        for name, digest in THREE_SHA256.items()
    ]
    about = {"component": {"type": "application", "name": "trilight", "bom-ref": "trilight"}}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": about,
        "components": [*components, three],
    }


def installed_licenses() -> dict[str, str]:
    """Return the license of each installed package, the first line of a whole text."""
    command = [sys.executable, "-m", "piplicenses", "--format=json", "--from=mixed"]
    rows = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return {plain_name(row["Name"]): row["License"].strip().splitlines()[0][:80] for row in rows}


def plain_name(name: str) -> str:
    """Return the normalized name of a package (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _component(source: str, name: str, version: str, license_name: str | None) -> dict[str, Any]:
    url = f"pkg:{source}/{name}@{version}"
    component: dict[str, Any] = {
        "type": "library",
        "bom-ref": url,
        "name": name,
        "version": version,
    }
    component["purl"] = url
    if license_name:
        component["licenses"] = [{"license": {"name": license_name}}]
    return component


if __name__ == "__main__":
    bill = bill_of_materials(ROOT, installed_licenses())
    Path(sys.argv[1]).write_text(json.dumps(bill, indent=1, ensure_ascii=False) + "\n")
