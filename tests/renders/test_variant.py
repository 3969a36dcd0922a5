"""Choosing what Mitsuba runs on: by trying, once, without harm."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

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
    answers = json.loads((own_cache / "cache" / "llvm_probes.json").read_text())
    assert next(iter(answers.values())) is False


@pytest.mark.usefixtures("llvm")
def test_probes_are_remembered_and_believed(own_cache: Path) -> None:
    chosen = choose_variant()
    memory = own_cache / "cache" / "llvm_probes.json"
    answers = json.loads(memory.read_text())
    assert True in answers.values()
    memory.write_text(json.dumps({name: False for name in answers}))
    assert choose_variant().libllvm != chosen.libllvm
    memory.write_text("damaged")
    assert choose_variant() == chosen


def test_without_any_library_the_fallback_says_how_to_mend_it(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = own_cache / "cache" / "llvm_probes.json"
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    fallback = choose_variant()
    while fallback.libllvm:
        answers = json.loads(memory.read_text())
        memory.write_text(json.dumps({name: False for name in answers}))
        fallback = choose_variant()
    assert fallback.name == "scalar_rgb" and fallback.libllvm == ""
    assert "apt-get install libllvm" in fallback.note


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
