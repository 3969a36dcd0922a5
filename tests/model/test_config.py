"""Every named size builds, and the paper's size is the paper's."""

import pytest
import torch

from model.config import SIZES, ModelConfig, base
from model.renderformer import RenderFormer, count_parameters
from model.scene_tensors import SceneBatch
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.kit import tiny_config

PUBLISHED_BASE = 205_170_000
"""Parameters of the published network, to five digits."""

TEXTURE_ENCODER = 13 * 32 * 32 * 768 + 768
"""Its first layer, which reads 13 x 32 x 32 equal numbers per triangle..."""

MATERIAL_ENCODER = 10 * 768 + 768
"""...and ours, which reads ten."""


@for_each("name", sorted(SIZES))
def test_every_size_builds(name: str) -> None:
    with torch.device("meta"):
        assert count_parameters(RenderFormer(SIZES[name]())) > 0


def test_base_has_the_published_parameters_but_for_the_texture_encoder() -> None:
    with torch.device("meta"):
        got = count_parameters(RenderFormer(base()))
    expected = PUBLISHED_BASE - TEXTURE_ENCODER + MATERIAL_ENCODER
    # the published count is known to 5,000; the six frozen frequencies are not counted here
    assert abs(got - expected) < 5_000


def test_base_takes_a_batch_on_the_meta_device() -> None:
    with torch.device("meta"):
        batch = SceneBatch(
            triangles_BT33=torch.zeros(2, 1536, 3, 3),
            normals_BT33=torch.zeros(2, 1536, 3, 3),
            material_BTM=torch.zeros(2, 1536, 10),
            c2w_BV44=torch.zeros(2, 4, 4, 4),
            fov_deg_BV=torch.zeros(2, 4),
            is_triangle_BT=torch.ones(2, 1536, dtype=torch.bool),
        )
        assert RenderFormer(base())(batch, 256).shape == (2, 4, 256, 256, 3)


@for_each(
    ("changes", "message"),
    [
        ({"width": 50}, "heads of equal width"),
        ({"rope_num_freqs": 2}, "rope_num_freqs 2; expected at most 1"),
        ({"rope_num_freqs": 0}, "from 1"),
        ({"rope_max_freq": 0.5}, "from 1"),
        ({"dpt_features": 4}, "dpt fields beside a linear head"),
        ({"demodulated": True}, "hit_rays 0 with view_stage bundles; expected 1 or more"),
        ({"hit_rays": 1}, "hit_rays 1 with view_stage bundles; expected 0, or demodulated true"),
        ({"head": "mlp"}, "head is 'mlp'; expected dpt or linear"),
        ({"head": "dpt", "dpt_features": 4}, "four of each"),
    ],
)
def test_a_contradictory_config_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        ModelConfig(**vars(tiny_config()) | changes)


@for_each(
    ("changes", "message"),
    [
        ({"dpt_taps": (0, 1, 2, 3)}, "dpt_taps .* expected layers below 2"),
        ({"dpt_features": 3}, "dpt_features 3; expected an even number"),
        ({"patch_px": 4}, "patch_px 4 with a dpt head"),
    ],
)
def test_a_contradictory_dpt_is_refused(changes: dict[str, object], message: str) -> None:
    config = vars(tiny_config("dpt")) | changes
    with pytest.raises(TrilightError, match=message):
        ModelConfig(**config)
