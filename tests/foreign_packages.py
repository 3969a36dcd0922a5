"""Packages of other projects that read our data, installed once, apart from Trilight's own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from storage.cache import cache_folder
from storage.digests import sha256_of_file
from tests.conftest import ROOT

LOCK = ROOT / "requirements/readers.txt"
_INSTALL_S = 600


def foreign_packages() -> Path:
    """Return a folder for `sys.path` with the packages of the lock, about 200 MB.

    The test skips where they cannot be fetched.
    """
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    folder = cache_folder("readers") / f"{sha256_of_file(LOCK)[:16]}-{python}"
    if folder.is_dir():
        return folder
    partial = folder.with_name(f"{folder.name}.{os.getpid()}")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--require-hashes"]
    command = [*pip, "--only-binary", ":all:", "--target", str(partial), "-r", str(LOCK)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=_INSTALL_S, check=False)
    if ended.returncode:
        pytest.skip(f"other projects' readers cannot be installed: {ended.stderr[-300:]}")
    if not folder.is_dir():
        partial.rename(folder)  # last: an interrupted installation begins anew
    return folder
