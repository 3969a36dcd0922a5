"""Published sets stay what they are, whatever is registered, added or given another default later.

If a number here has to change, the set is another one: give it, or the template, a new name.
"""

import dataclasses
import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from pipeline.presets.frozen_v1 import PRESETS_FOR_JUDGING
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.presets.renderformer import RENDERFORMER_PRESETS
from scene_templates import placement
from scene_templates import sample_emitters as emitters
from scene_templates.rooms import PATCH_FACES, QUADS, SIDES
from scene_templates.sample_camera import sample_camera
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.digests import sha256_hex
from storage.seeds import rng_for
from tests.scene_templates.balls import one_drawn

FROZEN = {
    "renderformer-v1-256": "c801823b57cd8d06e93cba5fce8c7756882a27e5667863d8fb6da20fd71181d3",
    "renderformer-v1-512": "f107b27071d2194d773ff7b3a8d9c565741415f9aaf8b29816b9ec01db4f3e2b",
    "renderformer-v1-256-original": (
        "2b136d532d19a8018413a37c8a74656f8495878c9cca02de8e0768e20a7dbfb3"
    ),
    "renderformer-v1-512-original": (
        "56426772c2a91bbfecdea829bb87538a282a5a0f46ccb7b21d20fc19825fbcc6"
    ),
    "out-of-range": "c2a748aa52a8ef6b87a608ff6ff736f252915de5a32a176561d77e18755013e8",
    "out-of-range-2": "eb1172a3f84644efdf864e36b152c463f080d15c203b1397acff1421a0277754",
    "benchmark-v1": "74bfa7914c6aa4d7e94ec60ecd0f3530e9cec5d091d47e6aad54549bce36e5fd",
    "benchmark-v1-mini": "74bfa7914c6aa4d7e94ec60ecd0f3530e9cec5d091d47e6aad54549bce36e5fd",
}
"""Digest of each set's settings."""

LAYOUTS = {
    "plane": (("floor",), (0, 180, (3, 87)), (0, 180, (10, 90))),
    "wall": (("floor", "wall1"), (180, 75, (3, 87)), (180, 90, (10, 90))),
    "corner": (("floor", "wall0", "wall1"), (225, 45, (3, 87)), (225, 90, (10, 90))),
    "open_box": (("floor", "wall0", "wall1", "wall2"), (270, 30, (3, 87)), (270, 75, (15, 90))),
}
"""Parts, and azimuth, half width and elevations in degrees of where cameras and lights are."""


def test_the_settings_of_a_frozen_set_stay_what_they_are() -> None:
    assert {name: preset_settings(name).digest for name in FROZEN} == FROZEN
    assert set(FROZEN) == {*PRESETS_FOR_JUDGING, *RENDERFORMER_PRESETS}


def test_the_layouts_of_a_frozen_set_stay_what_they_are() -> None:
    used = {family.template for name in FROZEN for family in preset_settings(name).scenes.families}
    assert used == set(LAYOUTS)
    for name, (parts, *sectors) in LAYOUTS.items():
        template = TEMPLATES[name]
        found = [dataclasses.astuple(sector) for sector in (template.cameras, template.lights)]
        assert (template.parts, found) == (parts, sectors), name
    assert [(name, side.axis, side.sign) for name, side in SIDES.items()] == [
        ("floor", 2, -1),
        ("wall0", 1, 1),
        ("wall1", 0, 1),
        ("wall2", 0, -1),
    ]
    assert (QUADS, len(PATCH_FACES)) == (8, 128)
    assert PATCH_FACES[:3].tolist() == [[0, 9, 10], [0, 10, 1], [1, 10, 11]]
    assert (placement.ARRANGEMENT_TRIES, placement.PLACE_TRIES) == (100, 16)
    assert emitters.TRIANGLE.tolist() == [
        [-0.025, 0.025, 0.025],
        [0.025, -0.025, 0.025],
        [0.025, 0.025, -0.025],
    ]
    assert (
        emitters.SPACING_RADIUS**2,
        emitters.SPACING_TRIES,
        emitters.PALEST,
    ) == (
        pytest.approx(0.75),
        256,
        0.2,
    )


DRAWN = {
    "renderformer-v1-256": "1191dc2fb8d3dcc7",
    "renderformer-v1-512": "734e2aa70a627316",
    "renderformer-v1-256-original": "b714a23cd3b0c8fc",
    "renderformer-v1-512-original": "0904cc37f3c68d75",
    "out-of-range": "8dfb2892883d2baa",
    "out-of-range-2": "8dfb2892883d2baa",
    "benchmark-v1": "d5aea36fd1efd811",
}
"""Digest of the numbers of the first layouts of each set, balls in place of objects."""


def test_what_is_drawn_from_them_stays_what_it_is() -> None:
    """So that the code, too, which draws a layout from its data, changes no published set."""
    for name, digest in DRAWN.items():
        build = preset_settings(name)
        numbers = [_numbers(build.scenes, build.seed, index) for index in range(12)]
        # to a millionth: exp, sin and cos differ between processors in their sixteenth digit
        rounded = np.round(np.concatenate(numbers) * 1e6).astype(np.int64)
        assert sha256_hex(rounded.tobytes())[:16] == digest, name


def _numbers(settings: SceneSettings, seed: int, index: int) -> np.ndarray:
    drawn = one_drawn(settings, index, seed)
    layout, after = drawn.layout, settings.of_scene(index)
    sector = TEMPLATES[drawn.plan.family.template].cameras
    camera = sample_camera(rng_for(seed, "camera of a test", index), after.cameras, sector)
    found: list[Any] = [part.positions for part in layout.shell]
    for placed in layout.objects:
        found += [placed.pose.centre, placed.pose.radius, placed.pose.rotation]
    surfaces = [part.surface for part in layout.shell] + [one.surface for one in layout.objects]
    found += [surface.diffuse_rgb for surface in surfaces]
    found += [surface.roughness for surface in surfaces]
    found += [value for lamp in layout.emitters for value in (lamp.triangle, lamp.radiance_rgb)]
    return np.concatenate([np.ravel(value) for value in (*found, camera.c2w, camera.fov_deg)])


def test_a_layout_that_is_registered_later_changes_no_build() -> None:
    """Nor those that networks are trained on: it joins them where its name is written."""
    found = _digests_after("""
        from storage.extensions import load_extension
        for name in ("template", "family", "object_source"):
            load_extension(f"examples/{name}.py")
        from scene_templates.families import TEMPLATES, Family
        assert "corridor" in TEMPLATES and "crowd" in Family.PRESETS
        from pipeline.presets.registry import DATASET_PRESETS
        """)
    assert found == {name: build.settings().digest for name, build in DATASET_PRESETS.items()}


def test_a_default_that_is_changed_later_changes_no_frozen_set() -> None:
    """They are made where no field of any group of settings has a default to fall back on."""
    found = _digests_after("""
        from pipeline.assets import settings as assets
        from pipeline.presets import settings as presets
        from pipeline.renders import settings as renders
        from scene_templates import settings as scenes
        from scene_templates import families
        from scene_templates import rooms
        from storage.dataset import settings as dataset_settings
        modules = (assets, presets, renders, scenes, families, rooms)
        kinds = {kind for module in (*modules, dataset_settings) for kind in vars(module).values()
                 if hasattr(kind, "__pydantic_fields__")}
        assert len(kinds) > 14
        def without_defaults(kind):
            plain, names = kind.__init__, set(kind.__pydantic_fields__)
            def stating_all(self, **values):
                if missing := names - set(values):
                    raise TypeError(f"{kind.__name__} lacks {missing}")
                plain(self, **values)
            kind.__init__ = stating_all
        for kind in kinds:
            without_defaults(kind)
        try:
            scenes.ViewLaws()
        except TypeError:
            pass
        else:
            raise AssertionError("a default is still there")
        from pipeline.presets.frozen_v1 import PRESETS_FOR_JUDGING
        from pipeline.presets.renderformer import RENDERFORMER_PRESETS
        DATASET_PRESETS = PRESETS_FOR_JUDGING | RENDERFORMER_PRESETS
        """)
    assert found == {name: DATASET_PRESETS[name].settings().digest for name in FROZEN}


def _digests_after(code: str) -> dict[str, str]:
    """Return the digests of `DATASET_PRESETS`, which the code imports, in a process of its own."""
    lines = "\n".join(line.removeprefix(" " * 8) for line in code.splitlines())
    digests = "{n: b.settings().digest for n, b in DATASET_PRESETS.items()}"
    tail = f"import json\nprint(json.dumps({digests}))"
    ran = subprocess.run(
        [sys.executable, "-c", f"{lines}\n{tail}"], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    found: dict[str, str] = json.loads(ran.stdout)
    return found
