"""Locks: a digest for every package, one script that demands them, and the bill made of them."""

import json
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from infra.setup.locks import LockedPackage, read_lock, write_lock
from infra.setup.sbom import plain_name
from tests.conftest import ROOT
from tests.for_each import case

LOCKS = sorted((ROOT / "requirements").glob("*.txt"))


def test_every_package_of_a_lock_has_a_digest() -> None:
    assert LOCKS
    for path in LOCKS:
        with case(path.name):
            rows = read_lock(path)
            assert rows
            assert [row.name for row in rows if not row.sha256] == []
            assert len({row.name for row in rows}) == len(rows)
            assert "://" not in path.read_text()


def test_locks_that_share_a_package_share_its_version_and_its_digests() -> None:
    seen: dict[str, LockedPackage] = {}
    for path in LOCKS:
        for row in read_lock(path):
            assert seen.setdefault(row.name, row) == row, path.name


def test_a_lock_is_read_as_it_was_written(tmp_path: Path) -> None:
    rows = [LockedPackage(name="a-b", version="1.0", sha256=("0" * 64, "1" * 64))]
    write_lock(tmp_path / "x.txt", rows)
    assert read_lock(tmp_path / "x.txt") == rows
    (tmp_path / "x.txt").write_text("a-b>=1\n")
    with pytest.raises(ValueError, match="NAME==VERSION"):
        read_lock(tmp_path / "x.txt")


def test_a_lock_has_what_its_packages_ask_for_on_every_python() -> None:
    """It is written on one; Debian 12 has 3.11.2, and packages ask for more there."""
    names = {canonicalize_name(row.name) for row in read_lock(ROOT / "requirements" / "all.txt")}
    names.add(canonicalize_name("pip"))  # venv brings it
    pythons = ("3.11.2", "3.11.9", "3.12.3", "3.13.1")
    places = [
        {"python_full_version": python, "python_version": python.rpartition(".")[0], "extra": ""}
        for python in pythons
    ]
    for found in metadata.distributions():
        if canonicalize_name(found.metadata["Name"]) in names:
            for line in found.requires or ():
                asked = Requirement(line)
                if asked.marker is None or any(map(asked.marker.evaluate, places)):
                    assert canonicalize_name(asked.name) in names, f"{found.name}: {line}"


def test_pip_refuses_a_file_of_another_digest(tmp_path: Path) -> None:
    wheel = tmp_path / "a-1.0-py3-none-any.whl"
    wheel.write_bytes(b"not what was locked")
    write_lock(tmp_path / "x.txt", [LockedPackage(name="a", version="1.0", sha256=("0" * 64,))])
    command = [sys.executable, "-m", "pip", "install", "--no-index", "--find-links", str(tmp_path)]
    command += ["--require-hashes", "--target", str(tmp_path / "t")]
    command += ["--requirement", str(tmp_path / "x.txt")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode and "DO NOT MATCH" in done.stderr


def test_nothing_installs_a_lock_but_the_script_that_demands_digests() -> None:
    script = (ROOT / "infra/setup/install.sh").read_text()
    assert re.search(
        r"--require-hashes --no-build-isolation --no-deps \\\n\s+--only-binary :all:", script
    )
    for path in [ROOT / "Makefile", *(ROOT / "infra/images").glob("*.Dockerfile")]:
        text = path.read_text()
        assert "infra/setup/install.sh" in text
        assert not re.search(r"pip install[^\n]*(--requirement|-r )", text), path.name
        for line in re.findall(r"pip install[^\n]*", text):
            assert "--no-deps --no-build-isolation --editable ." in line, path.name


def test_the_bill_of_materials_is_that_of_the_locks(tmp_path: Path) -> None:
    done = [sys.executable, "-m", "infra.setup.sbom", str(tmp_path / "sbom.cdx.json")]
    subprocess.run(done, cwd=ROOT, check=True)
    bill = json.loads((tmp_path / "sbom.cdx.json").read_text())
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    names = [row["bom-ref"] for row in bill["components"]]
    assert len(set(names)) == len(names)
    listed = {name.removeprefix("pkg:pypi/") for name in names if "pypi" in name}
    rows = [row for path in LOCKS for row in read_lock(path)]
    assert listed == {f"{plain_name(row.name)}@{row.version}" for row in rows}
    (pymeshlab,) = [row for row in bill["components"] if row["name"] == "pymeshlab"]
    assert "GPL" in pymeshlab["licenses"][0]["license"]["name"] or "GNU" in str(pymeshlab)
