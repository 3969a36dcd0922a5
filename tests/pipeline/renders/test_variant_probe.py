"""A kernel on a graphics card that does not see one of its two scenes must not pass for right."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pipeline.renders import variant_probe, vector_tracer
from pipeline.renders.probe_picture import DEVIATION_RGB, MEAN_RGB
from pipeline.renders.variant_probe import BLOCK, probe_scene, wrong_picture
from tests.oracle.kernel_bsdf import exact_twin
from tests.pipeline.renders.sampling import Estimate, assert_agree, camera_of, render_blocks
from tests.pipeline.renders.stored_pictures import scenes

pytestmark = pytest.mark.usefixtures("llvm")


class _Blind:
    """A scene as Dr.Jit leaves it where it disables a ray tracing operation: nothing is hit."""

    def ray_intersect_preliminary(self, ray: Any, **_: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        missed = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray))
        assert not dr.any(missed.is_valid())
        return missed

    def ray_test(self, ray: Any, **_: Any) -> Any:
        import mitsuba as mi

        return mi.Bool(False)


def _with_blind(kernel: Callable[..., Any], name: str) -> Callable[..., Any]:
    def run(scene: Any, *arguments: Any) -> Any:
        blinded = copy.copy(scene)
        setattr(blinded, name, _Blind())
        return kernel(blinded, *arguments)

    return run


def test_the_right_picture_passes() -> None:
    assert wrong_picture() == ""


@pytest.mark.parametrize("blind", ["surfaces", "everything"])
@pytest.mark.parametrize("kernel", ["trace", "trace_light"])
def test_a_kernel_that_misses_one_scene_is_found(
    kernel: str, blind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both kernels trace rays against both scenes, and Dr.Jit disables the second one it meets."""
    sighted = getattr(vector_tracer, kernel)
    monkeypatch.setattr(vector_tracer, kernel, _with_blind(sighted, blind))
    assert wrong_picture().startswith("a wrong picture: block ")


def test_only_a_right_picture_on_a_card_leads_to_the_denoiser(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(variant_probe.sys, "argv", ["variant_probe", "cuda_ad_rgb"])
    monkeypatch.setattr(variant_probe.mitsuba, "set_variant", lambda name: None)
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


@pytest.mark.parametrize("name", sorted(scenes()))
def test_scenes_that_share_a_table_give_the_bits_of_scenes_apart(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scenes()[name]
    pictures = [_picture_of(scene)]
    load = vector_tracer._load
    monkeypatch.setattr(
        vector_tracer, "_load", lambda scene, triangles, **_: load(scene, triangles)
    )
    pictures.append(_picture_of(scene))
    np.testing.assert_array_equal(*pictures)
    assert pictures[0].any()


def _picture_of(scene: Any) -> Any:
    tracer = vector_tracer.VectorTracer(scene, max_depth=10, rr_depth=2)
    return tracer.radiance(camera_of(scene, 32), seed=3, spp=16)


def test_what_rays_of_one_kernel_meet_shares_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mi.Scene with another one as a child shares its OptiX table; two without have two."""
    import mitsuba as mi

    given = list[dict[str, Any]]()
    made = list[Any]()
    load = mi.load_dict

    def recorded(described: dict[str, Any]) -> Any:
        found = load(described)
        if described["type"] == "scene":
            given.append(described)
            made.append(found)
        return found

    monkeypatch.setattr(mi, "load_dict", recorded)
    vector_tracer.VectorTracer(probe_scene(), max_depth=10, rr_depth=2)
    assert len(made) == 2
    assert any(child is made[0] for child in given[1].values())
    assert [len(scene.shapes()) for scene in made] == [1, 1]  # and has no shape of it
