"""Choosing what Mitsuba runs on: by trying, once, without harm; what is wrong is found."""

import copy
import dataclasses
import json
import re
import subprocess
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import pytest

from pipeline.renders import mitsuba_variant as variant_module
from pipeline.renders import variant_probe, vector_tracer
from pipeline.renders.mitsuba_variant import (
    Device,
    Variant,
    _ProbeResult,
    activate,
    choose_variant,
    environment,
    llvm_libraries,
)
from pipeline.renders.variant_probe import (
    BLOCK,
    DEVIATION_RGB,
    MEAN_RGB,
    probe_scene,
    render_facts,
    wrong_picture,
)
from storage import denoiser
from storage.errors import EnvironmentFailure, TrilightError
from storage.records.scene_file import encode_scene
from tests.command_line import trilight
from tests.for_each import for_each
from tests.oracle.kernel_bsdf import exact_twin
from tests.pipeline.programs import printed_by
from tests.pipeline.renders.sampling import Estimate, assert_agree, render_blocks
from tests.scenes_by_hand import tiny_scene


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    return tmp_path


@pytest.mark.usefixtures("llvm")
def test_a_library_that_is_none_is_passed_over_and_success_is_remembered(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch, variant: Variant
) -> None:
    """The one in the environment is tried first; what cannot be loaded is a no, not a crash."""
    bogus = own_cache / "libLLVM-99.so"
    bogus.write_bytes(b"not a library")
    with monkeypatch.context() as patch:
        patch.setenv("DRJIT_LIBLLVM_PATH", str(bogus))
        assert llvm_libraries()[0] == bogus
        assert choose_variant() == variant
    memory = own_cache / "cache" / "probes.json"
    remembered = json.loads(memory.read_text())
    assert len(remembered) == 1  # what failed may work once its cause is mended
    with monkeypatch.context() as patch:
        patch.setattr(variant_module, "_probe", None)  # nothing is probed again
        assert choose_variant() == variant
    memory.write_text("damaged")
    monkeypatch.setattr(variant_module, "_probe", lambda variant: _ProbeResult())
    assert choose_variant() == variant
    assert json.loads(memory.read_text()) == remembered


def test_where_no_library_works_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, own_cache: Path
) -> None:
    library = own_cache / "libLLVM-1.so"
    library.touch()
    monkeypatch.setattr(variant_module, "llvm_libraries", lambda: [library])
    monkeypatch.setattr(variant_module, "_probe", lambda variant: _ProbeResult(problem="abort"))
    with pytest.raises(TrilightError, match=r"of libLLVM-1.so none works with Mitsuba; .*karellen"):
        choose_variant()
    monkeypatch.setattr(variant_module, "llvm_libraries", list)
    for asked in ("", "llvm_ad_rgb"):
        monkeypatch.setenv("TRILIGHT_VARIANT", asked)
        with pytest.raises(TrilightError, match="no LLVM library found; .*pip install karellen"):
            choose_variant()
    monkeypatch.setenv("TRILIGHT_VARIANT", "metal")
    with pytest.raises(TrilightError, match="'metal'; expected one of llvm_ad_rgb, cuda_ad_rgb"):
        choose_variant()


def test_commands_that_render_say_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(variant_module, "llvm_libraries", list)
    scene, out = str(tmp_path / "a.safetensors"), str(tmp_path / "out")
    Path(scene).write_bytes(encode_scene(tiny_scene()))
    for words in (
        ["generate", "smoke", "--out", out],
        ["render", scene, "--out", str(tmp_path / "a.exr")],
        ["render", scene, "--out", str(tmp_path / "a.exr"), "--seconds", "1"],
        ["inspect", scene, "--turntable", str(tmp_path / "a.png")],
        ["view", scene],
    ):
        assert "no LLVM library found; expected" in trilight(words).mistake, words
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.safetensors"]


@for_each("silent", [1, 2])
def test_a_probe_without_an_answer_is_tried_again_and_leads_to_no_other_library(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, silent: int
) -> None:
    ended = subprocess.CompletedProcess([], 0, stdout="", stderr="")
    run = Mock(side_effect=[subprocess.TimeoutExpired("probe", 1)] * silent + [ended])
    libraries = [tmp_path / f"libLLVM-{number}.so" for number in (1, 2)]
    for library in libraries:
        library.touch()
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    monkeypatch.setattr(variant_module, "llvm_libraries", lambda: libraries)
    monkeypatch.setattr(variant_module.subprocess, "run", run)
    if silent == 1:
        assert choose_variant().libllvm == str(libraries[0])
    else:
        with pytest.raises(EnvironmentFailure, match=r"libLLVM-1.so: .* no answer within 360 s"):
            choose_variant()
    assert [call.kwargs["timeout"] for call in run.call_args_list] == [180, 360]


CPU, GPU = "llvm_ad_rgb", "cuda_ad_rgb"
MISSING = "and no NVIDIA GPU is visible here; expected a GPU with CUDA and OptiX"
BEGUN, TO_CPU, UNSET = "begun on a GPU", "Choose --device cpu.", "Unset TRILIGHT_VARIANT."
ON_CPU = Variant(name="llvm_ad_rgb", libllvm="libLLVM.so", note="")


@for_each(
    ("named", "default", "device", "visible", "problem", "chosen"),
    [
        ("", "cpu", None, "0", "", CPU),
        ("", "auto", None, "0", "", GPU),
        ("", "auto", None, "0", "no OptiX", CPU),
        ("", "auto", None, "", "must not be probed", CPU),
        ("", "cpu", "gpu", "0", "", GPU),
        ("", "cpu", "gpu", "", "not probed", f"^--device is gpu, {MISSING}. {TO_CPU}$"),
        ("", "gpu", None, "", "not probed", f"^the dataset was {BEGUN}, {MISSING}. {TO_CPU}$"),
        (GPU, "cpu", None, "", "not probed", f"^TRILIGHT_VARIANT is {GPU}, {MISSING}. {UNSET}$"),
        ("", "cpu", "gpu", "0", "no OptiX", "no OptiX.*Choose --device cpu"),
        (GPU, "cpu", None, "0", "", GPU),
        (GPU, "cpu", "cpu", "0", "", CPU),
        (CPU, "auto", None, "0", "", CPU),
        (CPU, "auto", "gpu", "0", "", GPU),
    ],
)
def test_an_option_names_the_device_before_the_variable_and_the_default(
    named: str,
    default: Device,
    device: Device | None,
    visible: str,
    problem: str,
    chosen: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    monkeypatch.setenv("TRILIGHT_VARIANT", named)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr(variant_module, "_on_processor", lambda: ON_CPU)
    monkeypatch.setattr(variant_module, "_probe", lambda variant: _ProbeResult(problem=problem))
    if chosen not in (CPU, GPU):
        with pytest.raises(TrilightError, match=chosen):
            choose_variant(default, device=device)
        return
    variant = choose_variant(default, device=device)
    assert variant.name == chosen
    assert bool(variant.note) == (problem == "no OptiX")
    assert (variant.address_space(1) == 1) == (chosen == CPU)


@pytest.mark.usefixtures("own_cache")
def test_a_probe_of_a_gpu_is_remembered_for_its_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """A problem is remembered for `auto` alone: its cause may be fixed before `gpu` is named."""
    probe = Mock(side_effect=[_ProbeResult(problem=each) for each in ("no OptiX", "", "")])
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.setattr(variant_module, "_probe", probe)
    monkeypatch.setattr(variant_module, "_on_processor", lambda: ON_CPU)
    assert [choose_variant("auto").device for _ in range(2)] == ["cpu", "cpu"]
    assert probe.call_count == 1
    assert [choose_variant(device="gpu").device for _ in range(2)] == ["gpu", "gpu"]
    assert choose_variant("auto").device == "gpu"
    assert probe.call_count == 2
    monkeypatch.setattr(variant_module, "gpu_identity", lambda: ("another driver",))
    assert choose_variant("auto").device == "gpu"
    assert probe.call_count == 3


WARNING = "jit_eval(): more than one OptiX shader binding table. Disabling this ray tracing op"


@for_each(
    ("said", "printed", "refused", "note"),
    [
        ("", "", "", ""),
        ("another warning", "", "", ""),
        ("", "Open Image Denoise: out of memory (on CUDA)\n", "", "Open Image Denoise: out of"),
        (WARNING + "eration to avoid", "", "Dr.Jit left out some of the rays", ""),
    ],
)
def test_a_gpu_is_used_by_what_its_probe_says(
    said: str,
    printed: str,
    refused: str,
    note: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of rays that it leaves out Dr.Jit warns once, while it compiles, and goes on."""
    ended = subprocess.CompletedProcess([], 0, stdout=printed, stderr=said)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    monkeypatch.setenv("TRILIGHT_VARIANT", "cuda_ad_rgb")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.setattr(variant_module.subprocess, "run", lambda *_, **__: ended)
    if refused:
        with pytest.raises(TrilightError, match=refused):
            choose_variant()
        return
    chosen = choose_variant()
    assert chosen.denoiser == ("CPU" if printed else "CUDA")
    assert bool(chosen.note) == bool(note) and chosen.note.startswith(note)
    assert ("denoiser_device" in environment(chosen)) == (not printed)


def test_a_process_denoises_where_its_variant_says(variant: Variant) -> None:
    for device in ("CUDA", "CPU"):
        activate(dataclasses.replace(variant, denoiser=device))
        assert denoiser._device == device


def test_asking_does_not_import_mitsuba_nor_the_denoiser_torch() -> None:
    code = (
        "import sys; from pipeline.renders import mitsuba_variant as it; it.choose_variant(); "
        "import pipeline.renders.renderer, pipeline.renders.variant_probe; "
        "print(sorted({'mitsuba', 'drjit', 'pyoidn'} & set(sys.modules))); "
        "from storage.denoiser import load_oidn; load_oidn(); "
        "print('torch' in sys.modules)"
    )
    assert printed_by(code) == "[]\nFalse"


def test_facts_name_denoiser_and_threads_if_there_is_time(
    variant: Variant, monkeypatch: pytest.MonkeyPatch
) -> None:
    facts = render_facts(variant)
    assert facts["denoiser_device"] == "CPU"
    assert int(facts["threads"]) >= 1
    assert re.fullmatch(r"\d+\.\d+\.\d+", facts["denoiser"])
    assert float(facts["view_s"]) > 0
    monkeypatch.setattr("pipeline.renders.variant_probe._FACTS_S", 0.01)
    assert render_facts(variant) == {}


class _Blind:
    """A scene as Dr.Jit leaves it where it disables a ray tracing operation: nothing is hit."""

    def ray_intersect_preliminary(self, ray: Any, **_: Any) -> Any:
        missed = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray))
        assert not dr.any(missed.is_valid())
        return missed

    def ray_test(self, ray: Any, **_: Any) -> Any:
        return mi.Bool(False)


@pytest.mark.usefixtures("unrecorded")
@pytest.mark.parametrize("blind", ["surfaces", "everything"])
@pytest.mark.parametrize("kernel", ["trace", "trace_light"])
def test_a_kernel_that_misses_one_scene_is_found(
    kernel: str, blind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both kernels trace rays against both scenes, and Dr.Jit disables the second one it meets."""
    sighted = getattr(vector_tracer, kernel)

    def blinded(scene: Any, *arguments: Any) -> Any:
        seen = copy.copy(scene)
        setattr(seen, blind, _Blind())
        return sighted(seen, *arguments)

    monkeypatch.setattr(vector_tracer, kernel, blinded)
    assert wrong_picture().startswith("a wrong picture: block ")


def test_only_a_right_picture_on_a_card_leads_to_the_denoiser(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert wrong_picture() == ""
    monkeypatch.setattr(variant_probe.sys, "argv", ["variant_probe", "cuda_ad_rgb"])
    monkeypatch.setattr(mi, "set_variant", lambda name: None)
    monkeypatch.setattr(variant_probe, "denoiser_problem", lambda: "the card is too old")
    variant_probe.main()
    assert capsys.readouterr().out == "the card is too old"
    monkeypatch.setattr(variant_probe, "wrong_picture", lambda: "a wrong picture")
    with pytest.raises(SystemExit, match="a wrong picture"):
        variant_probe.main()
    assert capsys.readouterr().out == ""


@pytest.mark.slow("kills")
def test_another_integrator_agrees_with_the_stored_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mitsuba's own, around our BRDF: the stored numbers are not only what our kernels say."""
    scene = probe_scene()
    scene.check()
    twin = exact_twin(scene, monkeypatch, max_depth=10, rr_depth=2)
    theirs = render_blocks(scene, resolution=4 * BLOCK, block=BLOCK, passes=256, tracer=twin)
    # The twins of an emitter stand 1e-4 off, which moves direct light by about as much.
    assert_agree(theirs, Estimate(mean=MEAN_RGB, error=DEVIATION_RGB / 32), slack=1e-3)


def test_what_rays_of_one_kernel_meet_shares_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mi.Scene with another one as a child shares its OptiX table; two without have two."""
    scenes = list[tuple[dict[str, Any], Any]]()
    load = mi.load_dict

    def recorded(described: dict[str, Any]) -> Any:
        found = load(described)
        if described["type"] == "scene":
            scenes.append((described, found))
        return found

    monkeypatch.setattr(mi, "load_dict", recorded)
    vector_tracer.VectorTracer(probe_scene(), max_depth=10, rr_depth=2)
    (_, first), (given, _) = scenes
    assert any(child is first for child in given.values())
    assert [len(scene.shapes()) for _, scene in scenes] == [1, 1]  # and has no shape of it
