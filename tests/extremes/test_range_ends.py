"""What settings make at the ends of their ranges: something right, or a rejection with reason.

Training at the ends of targets, losses, weights and symmetries: finite, or a skipped step. And the
network at the ends of what it may be given, and in few bits.
"""

import dataclasses
import functools
import math
import warnings
from collections.abc import Collection
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from model.attention import attend
from model.config import SIZES, ModelConfig
from model.layers import LAYER_NORM_EPS, Norm
from model.open import BUILTIN_TOKENS, open_network
from model.positions import TriangleRotary
from model.renderformer import RenderFormer
from model.scene_tensors import MAX_NETWORK_M, SceneBatch, batch_scenes, scene_tensors
from pipeline.renders.renderer import RenderedView
from pipeline.renders.settings import MAX_SPP
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.families import Family
from scene_templates.placement import PlacementSettings
from scene_templates.rooms import SharedRoom
from scene_templates.sample_camera import CameraSettings
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings
from scene_templates.settings import SceneSettings, ViewLaws
from storage.conventions import HALF_FLOAT_MAX
from storage.dataset.settings import MOST_SCENES, SplitSettings
from storage.dataset.splits import MOST_SHARDS, scenes_of_shard, shard_name, shards_for
from storage.errors import Rejected, TrilightError
from storage.seeds import SceneKey
from storage.settings.overrides import apply_overrides
from tests.extremes.test_ranges import FIELDS, SMOKE, End
from tests.extremes.test_scenes import FLOOR, LAMP, require_laws
from tests.for_each import case, for_each
from tests.model.kit import (
    FAMILIES,
    attend_reference,
    awake,
    random_scene,
    tensors_of,
    tiny_config,
)
from tests.pipeline.renders.sampling import render_view, view_settings
from tests.pipeline.renders.scene_kit import join, light, material, quad
from tests.pipeline.scenes.small_pool import BLIND, composed
from tests.train.kit import stepper, tiny_run
from tests.train.toy import toy_sample, toy_scene
from train.data.augment import augment_scene
from train.data.buckets import TrainingBatch, collate_batch
from train.data.scenes import training_scene
from train.loop.train_state import new_state
from train.loss.training_loss import TrainingLoss
from train.settings import AugmentationSettings, LossSettings, TrainSettings, learning_rate

GROUPS: dict[type, str] = {
    SceneSettings: "",
    Family: "families.",
    SharedRoom: "families.shell.",
    PlacementSettings: "placement.",
    MaterialSettings: "materials.",
    LightSettings: "lights.",
    CameraSettings: "cameras.",
    ViewLaws: "views.",
}
"""Under which name a group of scene settings stands."""

BESIDE: dict[tuple[str, End], dict[str, Any]] = {
    ("max_triangles", "low"): {
        "families.template": "plane", "families.num_objects": [0, 0], "lights.count": [1, 1],
    },
    ("fill_to", "high"): {"max_triangles": 65535, "num_views": 1},
    ("num_views", "high"): {"views.coverage_grid": 2},
    ("families.num_objects", "high"): {
        "families.object_scale": [0.2, 0.2], "max_triangles": 16384, "num_views": 1,
    },
    # 64 lights do not find places so far apart, and look 256 times for each
    ("lights.count", "high"): {"lights.spacing": 0.0},
    ("lights.count", "low"): {"skies.share": 1.0},
    ("materials.roughness_log", "low"): {"materials.roughness_bias": 0.0},
    ("materials.roughness_bias", "high"): {"materials.roughness_log": [1.0, 2.0]},
}  # fmt: skip
"""What laws between fields, or time, want beside an end."""

NO_SCENE: dict[tuple[str, End], str] = {
    ("families.object_scale", "high"): "no_room",
    ("families.shell.scale", "low"): "no_room",
    ("families.shell.shift", "high"): "no_room",
    ("lights.scale", "high"): "emitter_inside",
    ("lights.distance", "low"): "emitter_inside",
    ("views.min_coverage", "high"): "no_camera",
    ("views.min_depth", "high"): "no_camera",
}
"""Ends at which some scenes cannot be, with everything else as it is: why they are rejected."""

SCENE_FIELDS = {GROUPS[group] + field.name: field for group, field in FIELDS if group in GROUPS}
ONE_FAMILY = dataclasses.replace(SMOKE.scenes, families=SMOKE.scenes.families[:1])


def _value(name: str, end: End) -> Any:
    field = SCENE_FIELDS[name]
    number = getattr(field.within, end)
    return [number, number] if field.shape == "pair" else number


@pytest.mark.parametrize(
    ("names", "end"),
    [
        (SCENE_FIELDS.keys(), "low"),
        (SCENE_FIELDS.keys() - {"fill_to"}, "high"),
        pytest.param({"fill_to"}, "high", marks=pytest.mark.slow("memory")),
    ],
    ids=["low", "high", "filled to the most triangles"],
)
def test_scenes_at_an_end_keep_their_laws(
    pool: list[PooledAsset], names: Collection[str], end: End
) -> None:
    for name in sorted(names):
        blind = {} if name.startswith("views.") else BLIND
        beside = BESIDE.get((name, end), {})
        wanted = apply_overrides(ONE_FAMILY, {**blind, **beside, name: _value(name, end)})
        with case((name, end)):
            try:
                scene = composed(wanted, pool, SceneKey(0, 0))
            except Rejected as rejection:
                assert rejection.reason == NO_SCENE.get((name, end)), rejection
            else:
                assert (name, end) not in NO_SCENE
                require_laws(scene, wanted)


SLOW = {"num_views", "fill_to", "views.coverage_grid", "lights.count", "families.num_objects"}
CHEAP = [name for name in SCENE_FIELDS if name not in SLOW]


@settings(max_examples=15, derandomize=True)
@given(st.dictionaries(st.sampled_from(CHEAP), st.sampled_from(["low", "high"]), min_size=2))
def test_scenes_at_several_ends_keep_their_laws_or_have_a_reason(
    pool: list[PooledAsset], ends: dict[str, End]
) -> None:
    changes = {name: _value(name, end) for name, end in ends.items()}
    try:
        wanted = apply_overrides(ONE_FAMILY, {"num_views": 1, **changes})
    except TrilightError:
        reject()  # laws between fields
    try:
        require_laws(composed(wanted, pool, SceneKey(0, 0)), wanted)
    except Rejected as rejection:
        possible = ("no_room", "over_budget", "no_faces", "no_camera", "emitter_inside")
        assert rejection.reason in possible, rejection


RENDER = view_settings(8, resolution=8, noise_floor_db=1.0, aux_spp=4, min_mean_radiance=0.0)
WALL = quad([[-1, 1, 0], [1, 1, 0], [1, 1, 2], [-1, 1, 2]], material(diffuse=0.8))


def _render(**changes: Any) -> RenderedView:
    lamp = light(LAMP * [5, 5, 1], 10.0)
    scene = join([quad(FLOOR, material(diffuse=0.8)), WALL, lamp], fov_deg=60)
    view = render_view(scene, dataclasses.replace(RENDER, **changes))
    assert np.isfinite(view.radiance_rgb).all() and (view.radiance_rgb >= 0).all()
    return view


def test_pictures_at_the_ends_of_depth_samples_and_floors() -> None:
    """One edge sees emitters alone, which cameras do not: black. 1024 are as bright as 10, but for
    what 10 cut away."""
    assert _render(max_depth=1).radiance_rgb.max() == 0
    usual = _render(min_spp=128, max_spp=128, denoiser="off").radiance_rgb.mean()
    for depths in ({"max_depth": 1024}, {"max_depth": 1024, "rr_depth": 1024}, {"rr_depth": 1}):
        deep = _render(min_spp=128, max_spp=128, denoiser="off", **depths).radiance_rgb.mean()
        # the cut leaves out less than 0.8^10; 64 pixels of 128 samples have 3 % of noise, measured
        assert deep == pytest.approx(usual, rel=0.1), depths
    assert _render().spp == 8
    assert _render(max_spp=MAX_SPP).spp < MAX_SPP
    for floor_db, at_cap in ((np.nextafter(0, 1), False), (np.nextafter(100, 0), True)):
        view = _render(noise_floor_db=float(floor_db))
        assert (view.spp, view.at_cap) == (8, at_cap)
    _render(aux_spp=64)


LEAST = ModelConfig(
    width=18, num_heads=1, encoder_layers=1, decoder_layers=1, hidden_width=1, num_registers=0,
    rope_num_freqs=1, rope_max_freq=1.0, normal_octaves=0, patch_px=1, head="linear",
)  # fmt: skip
NETWORKS: dict[str, ModelConfig] = {
    "least of everything": LEAST,
    "largest bundles": dataclasses.replace(LEAST, patch_px=64),
    "largest windows": dataclasses.replace(LEAST, window_bundles=64),
    "most octaves, fastest rotation": dataclasses.replace(
        LEAST, normal_octaves=16, rope_max_freq=1000.0, register_eps=1.0, num_registers=64
    ),
    "most frequencies": dataclasses.replace(LEAST, width=18 * 64, rope_num_freqs=64),
    "most rays of demodulated pixels": dataclasses.replace(LEAST, demodulated=True, hit_rays=8),
    "narrowest dpt": tiny_config("dpt", dpt_features=2, dpt_channels=(1, 1, 1, 1)),
}


def require_learning(model: nn.Module, scenes: SceneBatch, px: int) -> None:
    """Require a finite picture, and finite gradients of every weight."""
    model.zero_grad()
    picture = model(scenes, px)
    (picture - 6.0).square().mean().backward()
    assert picture.shape[2:] == (px, px, 3) and torch.isfinite(picture).all()
    for name, weight in model.named_parameters():
        assert weight.grad is not None and torch.isfinite(weight.grad).all(), name


@pytest.mark.parametrize("config", NETWORKS.values(), ids=NETWORKS.keys())
def test_networks_at_an_end_see_and_learn(config: ModelConfig) -> None:
    scene = random_scene(5, num_views=1, dtype=torch.float32)
    require_learning(awake(config, torch.float32), batch_scenes([scene]), config.picture_px)


def test_the_largest_networks_can_be_described() -> None:
    """None fits into a memory; their parts fit together."""
    wide = dataclasses.replace(LEAST, width=16_384, num_heads=512, hidden_width=65_536)
    deep = dataclasses.replace(
        tiny_config("dpt"), encoder_layers=256, decoder_layers=256, num_registers=4096,
        dpt_features=4096, dpt_channels=(8192,) * 4, dpt_taps=(0, 1, 254, 255),
    )  # fmt: skip
    with torch.device("meta"):
        for config in (wide, deep):
            RenderFormer(config)


STEPS: dict[str, dict[str, Any]] = {
    "lows": {
        "learning_rate": 5e-324, "final_rate_share": 0.0, "weight_decay": 0.0, "betas": (0.0, 0.0),
        "grad_clip": 5e-324, "ema_decay": 0.0, "muon_rate": 5e-324,
        "loss": LossSettings(perceptual="ms_ssim", perceptual_weight=0.0, noise_half=0.0),
    },
    "highs": {
        "learning_rate": 1.0, "final_rate_share": 1.0, "weight_decay": 10.0, "muon_rate": 100.0,
        "betas": (float(np.nextafter(1, 0)),) * 2, "grad_clip": 1e9,
        "ema_decay": float(np.nextafter(1, 0)),
        "loss": LossSettings(perceptual="ms_ssim", perceptual_weight=1000.0, noise_half=10.0),
        "seed": 2**256 - 1,
    },
}  # fmt: skip


@pytest.mark.parametrize("changes", STEPS.values(), ids=STEPS.keys())
def test_weights_stay_finite_at_the_ends_of_training(changes: dict[str, Any]) -> None:
    """At the least rate nothing moves; at the greatest, much does, and nothing breaks."""
    run = tiny_run(**changes)
    state = new_state(run)
    before = [weight.detach().clone() for weight in state.model.parameters()]
    moving = stepper(state)
    for number in range(4):
        report = moving.step([batch()], learning_rate(number, run))
        assert report.applied
    after = list(state.model.parameters())
    assert all(torch.isfinite(weight).all() for weight in after)
    same = all(torch.equal(old, new) for old, new in zip(before, after, strict=True))
    assert same == (run.learning_rate < 1e-300)


def test_the_strongest_augmentation_leaves_scenes_finite() -> None:
    strongest = AugmentationSettings(
        rotation="uniform", translation=100.0, mirror=True, channels=True, vertex_order=True,
        light_scale=1000.0,
    )  # fmt: skip
    scene = training_scene(toy_sample(0), 16)
    for seed in range(20):
        shown = augment_scene(scene, strongest, np.random.default_rng(seed))
        assert torch.isfinite(shown.target_VRR3).all()
        for tensor in tensors_of(shown.tensors).values():
            assert torch.isfinite(tensor).all()


@pytest.mark.parametrize("per_shard", [1, 1_000_000])
@pytest.mark.parametrize("per_cycle", [6, 1_000_000])
def test_shards_at_the_ends_hold_every_scene_once(per_shard: int, per_cycle: int) -> None:
    """Up to the last of a billion scenes, or of a million shards."""
    splits = SplitSettings(scenes_per_shard=per_shard, shards_per_cycle=per_cycle)
    most = min(MOST_SCENES, MOST_SHARDS * per_shard)
    count = shards_for(most, splits)
    assert scenes_of_shard(count - 1, splits).stop == most
    listed = dataclasses.replace(splits, listed_scenes=most)
    assert scenes_of_shard(count - 1, listed).stop == most
    names = {shard_name(index, splits).split("-")[0] for index in range(6)}
    assert names == {"train", "validation", "test"}


BRIGHTEST = math.log10(1 + HALF_FLOAT_MAX)
"""The largest target: pictures are stored as half floats."""

TERMS = [
    LossSettings(perceptual="none"),
    LossSettings(perceptual="ms_ssim"),
    LossSettings(perceptual="none", noise_half=1e-6),
    LossSettings(perceptual="none", noise_half=10.0),
]


def batch() -> TrainingBatch:
    """Return two toy scenes."""
    return collate_batch([training_scene(toy_sample(index), 16) for index in range(2)])


@for_each("run", [*(tiny_run(loss=terms) for terms in TERMS), tiny_run(precision="bfloat16")])
def test_every_target_that_can_be_stored_gives_a_step(run: TrainSettings) -> None:
    usual = batch()
    for target, noise in ((0.0, 0.0), (0.0, 10.0), (1e-7, 1e-5), (BRIGHTEST, 0.0)):
        ends = dataclasses.replace(
            usual,
            target_BVRR3=torch.full_like(usual.target_BVRR3, target),
            noise_BV=torch.full_like(usual.noise_BV, noise),
        )
        state = new_state(run)
        report = stepper(state).step([ends], 1e-3)
        finite = math.isfinite(report.loss) and math.isfinite(report.grad_norm)
        assert report.applied and finite, (target, noise)
        assert all(torch.isfinite(weight).all() for weight in state.model.parameters())


@given(
    shown=st.floats(-40, 40, width=32),
    wanted=st.floats(0, BRIGHTEST),
    noise=st.floats(0, 100, width=32),
    terms=st.sampled_from(TERMS),
)
@settings(max_examples=40, deadline=None)
def test_losses_and_their_gradients_are_finite_wherever_predictions_are(
    shown: float, wanted: float, noise: float, terms: LossSettings
) -> None:
    size = (1, 1, 32, 32, 3)
    prediction = torch.full(size, shown, requires_grad=True)
    total, _ = TrainingLoss(terms, None)(
        prediction, torch.full(size, wanted), torch.full((1, 1), noise)
    )
    total.sum().backward()
    assert prediction.grad is not None and torch.isfinite(prediction.grad).all()
    assert total.item() >= 0


EMISSIONS = [0.0, 1e-6, 1.0, 1e6]

WHOLE_NETWORKS = {
    "random": lambda: awake(SIZES["tiny"](), torch.float32),
    "trained": lambda: open_network(BUILTIN_TOKENS),
}
"""One with every part of the large ones, and the one that is shipped."""


def lit(emission: float) -> SceneBatch:
    """Return a scene all of whose triangles emit so much, and the brightest other materials."""
    scene = random_scene(20, num_views=1, dtype=torch.float32)
    material = torch.ones_like(scene.material_TM)
    material[:, 7:] = math.log10(1 + emission)
    return batch_scenes([dataclasses.replace(scene, material_TM=material)])


@pytest.mark.parametrize("name", WHOLE_NETWORKS)
def test_no_matrix_product_comes_near_the_end_of_float16(name: str) -> None:
    """Of every linear layer and convolution, so of every type with fewer digits after it."""
    network, peaks = WHOLE_NETWORKS[name](), dict[str, float]()

    def note(name: str, module: nn.Module, given: object, output: Tensor) -> None:
        peaks[name] = output.abs().max().item()

    kinds = nn.Linear | nn.Conv2d | nn.ConvTranspose2d
    layers = {name: each for name, each in network.named_modules() if isinstance(each, kinds)}
    for name, layer in layers.items():
        layer.register_forward_hook(functools.partial(note, name))
    for emission in EMISSIONS:
        with torch.no_grad():
            network(lit(emission), 64)
        assert peaks.keys() == layers.keys()
        highest = max(peaks, key=lambda name: peaks[name])
        # norms keep every sum near its inputs' size; a hundredth of the range leaves room for
        # training
        assert peaks[highest] < HALF_FLOAT_MAX / 100, (emission, highest)


@pytest.mark.parametrize("family", FAMILIES)
def test_pictures_and_gradients_are_finite(family: str) -> None:
    model = awake(tiny_config(family), torch.float32)
    for emission in EMISSIONS:
        with case(emission):
            require_learning(model, lit(emission), 32)


@pytest.mark.parametrize("distance", [1.0, 30.0, MAX_NETWORK_M])
def test_angles_keep_their_digits_to_the_farthest_position(distance: float) -> None:
    rotary = TriangleRotary(num_freqs=6, max_freq=11.0, head_width=128)
    exact = TriangleRotary(num_freqs=6, max_freq=11.0, head_width=128).double()
    positions = distance * torch.linspace(-1, 1, 9 * 64).reshape(64, 3, 3)
    for got, expected in zip(rotary(positions), exact(positions.double()), strict=True):
        # half an ulp of the angle, distance x 11, and one of the sine
        bound = distance * 11 * 2.0**-24 + 1.2e-7
        assert (got - expected).abs().max() < bound


def test_a_vertex_beyond_is_refused_with_its_distance() -> None:
    scene = toy_scene(0)
    beyond = np.nextafter(np.float32(MAX_NETWORK_M), np.float32(np.inf))
    positions = scene.vertex_positions.copy()
    positions[0, 0] = -MAX_NETWORK_M
    scene_tensors(dataclasses.replace(scene, vertex_positions=positions))
    for value, said in ((beyond, "1000 m"), (np.nan, "nan m")):
        positions[0, 0] = value
        with pytest.raises(TrilightError, match=f"a vertex stands {said} from the origin"):
            scene_tensors(dataclasses.replace(scene, vertex_positions=positions))


@pytest.mark.parametrize("keys", [1, 16384])
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    # a mean over all keys, in each type's own rounding of numbers of size 1
    [(torch.float32, 1e-6), (torch.bfloat16, 1e-2)],
)
def test_attention_over_one_and_over_16384_keys(
    keys: int, dtype: torch.dtype, tolerance: float
) -> None:
    generator = torch.Generator().manual_seed(keys)
    q = torch.randn(1, 2, 3, 16, generator=generator).to(dtype)
    k, v = (torch.randn(1, 2, keys, 16, generator=generator).to(dtype) for _ in range(2))
    expected = attend_reference(q.double(), k.double(), v.double(), None)
    got = attend(q, k, v, None)
    assert got.dtype == dtype
    torch.testing.assert_close(got.double(), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_saturated_softmax_picks_one_key(dtype: torch.dtype) -> None:
    """Scores apart by far more than a type's exponent range in exp()."""
    q = torch.full((1, 1, 2, 4), 300.0, dtype=dtype)
    k = torch.stack([torch.full((4,), x) for x in (-300.0, 0.0, 300.0)])[None, None].to(dtype)
    v = torch.eye(3)[None, None].to(dtype)
    q.requires_grad_()
    got = attend(q, k, v, None)
    got.float().square().sum().backward()
    assert got[0, 0].tolist() == [[0, 0, 1], [0, 0, 1]]
    assert q.grad is not None and torch.isfinite(q.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_norms_of_nothing_and_of_the_largest_are_finite(dtype: torch.dtype) -> None:
    norm = Norm(64, eps=LAYER_NORM_EPS)
    for size in (0.0, 1e-7, 1.0, 1e4):
        x = torch.full((2, 64), size, dtype=dtype, requires_grad=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # torch warns where it leaves its fused kernel
            got = norm(x)
        got.float().sum().backward()
        assert got.dtype == dtype, "the type of the input, whatever that of the weight"
        assert torch.isfinite(got).all()
        assert x.grad is not None and torch.isfinite(x.grad).all()
    assert torch.all(norm(torch.zeros(2, 64, dtype=dtype)) == 0)
