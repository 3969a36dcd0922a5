"""Settings of generate, render and train that no knob of this benchmark covers, and why.

`tests/architecture/test_knobs.py` holds every public setting to be either covered by a knob, or
here, so that none is forgotten silently. Names are dotted: `build.` as in `--set` of generate,
`order.` what a dataset order says, `train.` as in `--set` of train, `render.` an option of
`trilight render`. A group that occurs in several places is named where it comes first.
"""

from collections.abc import Mapping

IN_SECTION: Mapping[str, str] = {
    "build.scenes.lights.count": "Noise floor against cost",
    "build.scenes.lights.scale": "Noise floor against cost",
    "build.scenes.materials.roughness_clip": "Noise floor against cost",
}
"""Settings whose trade stands in a section of docs/tradeoffs.md written by hand: its heading."""


def _named(prefix: str, names: str) -> tuple[str, ...]:
    return tuple(f"{prefix}{name}" for name in names.split())


_BY_REASON: tuple[tuple[str, tuple[str, ...]], ...] = (
    (
        "Says which scenes there are, not how exactly they are made: a wider range is another "
        "distribution, and its worth is what a network trained on it can do.",
        (
            *_named("build.scenes.families.", "name template weight num_objects object_scale"),
            "build.scenes.families.smooth_share",
            *_named("build.scenes.families.shell.", "square_share scale shift raise_z tilt_deg"),
            *_named("build.scenes.families.shell.floor.", "spin_deg tilt_deg scale"),
            *_named("build.scenes.families.shell.floor.", "shift_x shift_y shift_z"),
            "build.scenes.families.shell.wall2_faces_out",
            *_named("build.scenes.", "families_in_turn centring"),
            *_named("build.scenes.placement.", "orientation resting_share overlap_share inside"),
            *_named("build.scenes.materials.", "albedo_sum specular_ratio roughness_log"),
            *_named("build.scenes.materials.", "roughness_bias coloured_share smooth_angle_deg"),
            *_named("build.scenes.materials.", "triangle_colours_share coloured_specular_share"),
            *_named("build.scenes.lights.", "total_emission distance target_jitter spacing"),
            *_named("build.scenes.lights.", "orientation coloured_share reflectance num_inside"),
            *_named("build.scenes.cameras.", "distance target_jitter up_jitter fov_deg"),
            *_named("build.scenes.excursions.", "axis value changes"),
        ),
    ),
    (
        "A law that an object, scene or view keeps or is replaced for: what it refuses is not made "
        "worse, it is not there.",
        (
            *_named("build.assets.gate.", "max_error_p99 max_outside area_ratio"),
            *_named("build.assets.gate.", "max_normal_error_deg min_silhouette_iou max_lost_area"),
            *_named("build.assets.", "max_source_bytes max_source_faces max_instances"),
            *_named("build.scenes.views.", "coverage_grid min_coverage min_lit max_shell_back"),
            "build.scenes.views.min_depth",
            "build.renders.min_mean_radiance",
            "order.failure_budget",
            *("order.albedo_over_one", "render.albedo_over_one"),
        ),
    ),
    (
        "Names what is read or written, or which draws: every value costs the same and is as "
        "exact.",
        (
            *_named("build.", "seed source allowed_licences"),
            *_named("order.", "objects out seed allow_licences licence scenes_from shards"),
            *_named("order.", "accept_environment changes"),
            *_named("train.", "run from_weights seed"),
            *_named("render.", "source out view orbit arc cameras seed json"),
        ),
    ),
    (
        "How many scenes, in what pieces: cost and bytes are proportional, and each scene is as "
        "exact; what more scenes are worth is in the table of small trainings.",
        (
            "order.scenes",
            *_named("build.splits.", "scenes_per_shard shards_per_cycle held_out_objects"),
            *_named("build.splits.", "one_split listed_scenes"),
        ),
    ),
    (
        "Shares the work among processes or threads: the bytes are the same, whatever it is "
        "(DESIGN section 4).",
        ("order.workers", "render.threads"),
    ),
    (
        "Of how pictures are shown, not of how they are made.",
        _named("render.", "fps tone_map exposure"),
    ),
    (
        "One of the changes of the table of small trainings (infra.bench.training_table), which "
        "judges it by the held-out error of whole trainings.",
        (
            *_named("train.augmentation.", "rotation mirror channels vertex_order"),
            *_named("train.", "learning_rate warmup_steps final_rate_share betas muon_rate"),
        ),
    ),
    (
        "A change of that table that was not run yet.",
        (
            "train.augmentation.light_scale",
            *_named("train.loss.", "perceptual perceptual_weight noise_half"),
            "train.ema_decay",
        ),
    ),
    (
        "As published (Zeng et al. 2025), or fixed by it: another value is another architecture or "
        "recipe, whose worth only long trainings tell; none was run.",
        (
            *_named("train.model.", "num_registers rope_num_freqs rope_max_freq register_eps"),
            *_named("train.model.", "normal_octaves patch_px window_bundles material_columns"),
            *_named("train.", "weight_decay grad_clip"),
        ),
    ),
    (
        "Changes nothing in a network that is exact under translation of the world; it is there to "
        "repeat the published recipe.",
        ("train.augmentation.translation",),
    ),
    (
        "How long and on how much: cost is proportional, and the error of each run along its steps "
        "is in its own metrics.jsonl.",
        _named("train.", "num_steps scenes_per_step"),
    ),
    (
        "Exact either way, up to the order of sums: memory is traded for time, or for nothing.",
        _named("train.", "scenes_per_pass recompute_activations"),
    ),
    (
        "How often something is written or looked at, and what is kept; weights do not depend on "
        "it.",
        (
            *_named("train.", "log_every validate_every checkpoint_every checkpoints_kept"),
            *_named("train.", "keep_every validation_scenes"),
        ),
    ),
    (
        "How well samples are mixed, and how much damage is put up with: memory for open shards "
        "against an order that was not measured.",
        _named("train.", "shuffle_shards most_unusable"),
    ),
    (
        "Passes for more lights than a network has seen: time is proportional to the groups, and "
        "what they gain depends on the network; 0.2 dB from a second render in path traced "
        "pictures (DECISIONS.md).",
        ("render.lights_per_pass",),
    ),
)

WITHOUT_CURVE: Mapping[str, str] = {name: why for why, names in _BY_REASON for name in names}
"""The reason by setting."""
