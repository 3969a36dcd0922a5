"""Choosing what Mitsuba runs on: by trying, once, without harm."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.renders import variant as variant_module
from pipeline.renders.facts import render_facts
from pipeline.renders.llvm_libraries import llvm_libraries
from pipeline.renders.variant import Variant, choose_variant
from tests.conftest import ROOT


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    return tmp_path


def test_candidates_are_files_each_named_once_newest_first() -> None:
    found = llvm_libraries()
    assert all(path.is_file() for path in found)
    assert len({path.resolve() for path in found}) == len(found)


def test_a_library_that_is_none_is_passed_over(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch, variant: Variant
) -> None:
    """The one in the environment is tried first; what cannot be loaded is a no, not a crash."""
    bogus = own_cache / "libLLVM-99.so"
    bogus.write_bytes(b"not a library")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(bogus))
    assert llvm_libraries()[0] == bogus
    assert choose_variant() == variant
    remembered = (own_cache / "cache" / "llvm_probes.json").read_text()
    assert len(json.loads(remembered)) == 1  # what failed may work once its cause is mended


@pytest.mark.usefixtures("llvm")
def test_success_is_remembered_and_believed(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = choose_variant()
    memory = own_cache / "cache" / "llvm_probes.json"
    assert len(json.loads(memory.read_text())) == 1
    monkeypatch.setattr(variant_module, "_probe", _must_not_be_asked)
    assert choose_variant() == chosen
    monkeypatch.undo()
    memory.write_text("damaged")
    assert choose_variant() == chosen


def _must_not_be_asked(library: Path) -> bool:
    raise AssertionError(f"{library} was probed again")


def test_where_no_library_works_the_fallback_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant_module, "_probe", lambda library: False)
    monkeypatch.setattr(variant_module, "_remembered", lambda memory: [])
    fallback = choose_variant()
    assert (fallback.name, fallback.libllvm) == ("scalar_rgb", "")
    assert "none works with Mitsuba" in fallback.note
    monkeypatch.setattr(variant_module, "llvm_libraries", list)
    assert choose_variant().note.startswith("no LLVM library found")


def test_asking_does_not_import_mitsuba() -> None:
    code = (
        "import sys; from pipeline.renders.variant import choose_variant; choose_variant(); "
        "import pipeline.renders.renderer, pipeline.renders.facts; "
        "print(sorted({'mitsuba', 'drjit', 'pyoidn'} & set(sys.modules)))"
    )
    child = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=dict(os.environ),
        capture_output=True,
        text=True,
        check=True,
    )
    assert child.stdout.strip() == "[]"


def test_facts_name_versions_device_and_threads(variant: Variant) -> None:
    facts = render_facts(variant)
    assert facts["variant"] == variant.name
    assert facts["denoiser_device"] == "CPU"
    assert int(facts["threads"]) >= 1
    assert {"mitsuba", "drjit", "pyoidn", "llvm", "denoiser"} <= facts.keys()
