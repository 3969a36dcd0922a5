"""The documentation builds strictly as a site that needs no network to be read."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

for needed in ("mkdocs", "material", "mkdocstrings"):
    pytest.importorskip(
        needed, reason="the site needs requirements/docs.txt; `make docs` installs it"
    )

LOADED = re.compile(r'<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)="(?:https?:)?//')
"""What a browser would fetch from a server; links that a person may click are not among it."""


def build(project: Path, site: Path) -> subprocess.CompletedProcess[str]:
    """Build the site of a project as `make docs` does, into a folder of ours."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(
        command, cwd=project, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow("packaging")
def test_every_page_is_built_and_nothing_is_fetched_from_a_server(tmp_path: Path) -> None:
    """Every page is in the navigation; files beside docs are pages too."""
    site = tmp_path / "site"
    done = build(ROOT, site)
    assert done.returncode == 0, done.stdout + done.stderr
    shown = (site / "index.html").read_text()
    for page in (ROOT / "docs").rglob("*.md"):
        name = "index.md" if page.name == "README.md" else page.name
        uri = page.relative_to(ROOT / "docs").with_name(name).with_suffix(".html").as_posix()
        assert (site / uri).exists(), uri
        assert f'href="{uri}"' in shown or uri == "index.html", uri
    pages = list(site.rglob("*.html"))
    assert len(pages) > 60
    for page in pages:
        assert not (found := LOADED.search(page.read_text())), (page, found)
    index = (site / "search" / "search_index.js").read_text()
    assert "var __index" in index[:20]
    assert "results/studies.html" not in index  # a row's words would hide the pages for users
    servers = (site / "how-to" / "servers-and-clusters.html").read_text()
    assert 'href="../source/infra/slurm/generate.sbatch.html"' in servers
    assert "SHARDS_PER_TASK" in (site / "source/infra/slurm/generate.sbatch.html").read_text()


@pytest.mark.slow("packaging")
def test_a_link_that_leads_nowhere_is_found(tmp_path: Path) -> None:
    for name in ("docs", "infra", "storage"):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    page = tmp_path / "docs" / "tutorials" / "index.md"
    page.write_text(page.read_text() + "\n[gone](no-such-page.md)\n")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert "no-such-page.md" in done.stdout + done.stderr
