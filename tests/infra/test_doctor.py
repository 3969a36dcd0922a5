"""`trilight doctor` finds what is there, and says how to mend what is not."""

import pytest

from infra import doctor
from pipeline.isolation import confinement
from tests.for_each import case


def _responds(name: str, code: str, *, found: str, **_: str) -> doctor.Finding:
    compile(code, name, "exec")
    return doctor.Finding(name=name, state="ok", found=found)


@pytest.fixture(scope="module")
def findings() -> list[doctor.Finding]:
    """What is found where every probe ends well: each would take seconds in its process."""
    facts = {"denoiser": "2.5.1", "denoiser_device": "CPU", "threads": "2"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(doctor, "_probe", _responds)
        patch.setattr(doctor, "render_facts", lambda variant: facts)
        return list(doctor.examine())


def test_a_machine_on_which_all_probes_end_well_lacks_nothing(
    findings: list[doctor.Finding],
) -> None:
    assert {finding.name for finding in findings} >= {"renderer", "mesh filters", "orchestrator"}
    assert [finding for finding in findings if finding.state == "missing"] == []


@pytest.mark.slow("packaging")
def test_a_machine_that_passes_tests_lacks_nothing() -> None:
    assert [finding for finding in doctor.examine() if finding.state == "missing"] == []


def test_each_finding_comes_before_the_next_look() -> None:
    """The probes take seconds each; who waits sees the first at once, and what is looked at."""
    told: list[str] = []
    found = doctor.examine(told.append)
    assert next(found).name == "machine"
    assert told == ["machine"]
    assert next(found).name == "disk"
    assert told == ["machine", "disk"]


def test_what_is_looked_at_is_called_as_what_is_found(findings: list[doctor.Finding]) -> None:
    assert [finding.name for finding in findings] == list(doctor.CHECKS)


def test_whatever_is_not_well_names_its_consequence_and_cure(
    findings: list[doctor.Finding],
) -> None:
    for finding in findings:
        assert bool(finding.consequence) == bool(finding.mend) == (finding.state != "ok")


CONFINED = [
    ("auto", 7, "ok", "Landlock 7, seccomp"),
    ("off", 7, "slower", "TRILIGHT_CONFINE=off"),
    ("auto", 0, "slower", "seccomp"),
    ("required", 0, "missing", "seccomp"),
]


def test_what_confines_children_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for word, version, state, said in CONFINED:
        with case(said):
            monkeypatch.setenv("TRILIGHT_CONFINE", word)
            for module in (doctor, confinement):
                monkeypatch.setattr(module, "landlock_version", lambda version=version: version)
                monkeypatch.setattr(module, "seccomp_works", lambda: True)
            finding = doctor._confinement()
            assert (finding.state, finding.found.endswith(said)) == (state, True)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("raise SystemExit('filters are gone')", "filters are gone"),
        ("import os; os.abort()", "ended with status -6"),
        ("import nothing_of_that_name", "No module named 'nothing_of_that_name'"),
    ],
)
def test_a_probe_that_fails_is_missing(code: str, said: str) -> None:
    finding = doctor._probe("x", code, found="x 1", consequence="no x", mend="get x")
    assert finding.state == "missing"
    assert said in finding.found


def test_no_llvm_is_missing_and_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.renders.variant.llvm_libraries", list)
    monkeypatch.setattr(doctor, "_probe", _responds)
    monkeypatch.setattr(doctor, "CHECKS", {"renderer": doctor._renderer})
    (finding,) = doctor.examine()
    assert finding.state == "missing"
    assert "no LLVM library found" in finding.found and "libllvm19" in finding.found


@pytest.mark.parametrize("note", ["", "the card is too old, so pictures are denoised elsewhere"])
def test_a_graphics_card_is_well_or_says_what_it_lacks(
    note: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipeline.renders.variant import Variant

    card = Variant(name="cuda_ad_rgb", libllvm="", note=note, denoiser="CPU" if note else "CUDA")
    facts = {"denoiser": "2.5.1", "denoiser_device": card.denoiser, "threads": "2"}
    monkeypatch.setattr(doctor, "choose_variant", lambda: card)
    monkeypatch.setattr(doctor, "_probe", _responds)
    monkeypatch.setattr(doctor, "render_facts", lambda variant: facts)
    assert doctor._renderer().state == "ok"
    finding = doctor._denoiser()
    assert (finding.state, finding.consequence) == ("slower" if note else "ok", note)
    assert card.denoiser in finding.found
