"""Held-out scenes by stratum, and how a network does on them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.config import ModelConfig
from model.renderformer import RenderFormer
from storage.errors import TrilightError
from storage.records.sample import Sample
from train.evaluation.evaluate import with_traced_views
from train.evaluation.judge import JudgedScene, judged_scene, predict, score_pictures


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutScene:
    """One scene that no training sees."""

    key: str
    """Key of the sample."""
    stratum: str
    """The part of the build that it was drawn from."""
    judged: JudgedScene
    """Tensors and targets."""


def stratum_of_sample(sample: Sample) -> str:
    """Return the name of a sample's stratum.

    Raises:
        TrilightError: it has none, since its build has no strata.
    """
    name = sample.scene.provenance.get("stratum")
    if not isinstance(name, str):
        raise TrilightError(
            f"scene {sample.key}: it has no stratum; expected a dataset whose build has "
            "scenes.strata, as `trilight improve` makes them."
        )
    return name


def held_out(samples: Iterable[Sample], config: ModelConfig, resolution: int) -> list[HeldOutScene]:
    """Return samples as held-out scenes of a network, at a resolution in pixels.

    What a network of hits is given of them is traced here, once for all its judgements.
    """
    found = []
    for sample in samples:
        judged = judged_scene(sample, resolution)
        if config.view_stage == "hits":
            judged = with_traced_views(judged, config, resolution)
        stratum = stratum_of_sample(sample)
        found.append(HeldOutScene(key=sample.key, stratum=stratum, judged=judged))
    return found


def losses(network: RenderFormer, scenes: Sequence[HeldOutScene]) -> dict[str, float]:
    """Return the mean log L1 of each scene's views, by key, in the order of the scenes."""
    found = {}
    for scene in scenes:
        views = score_pictures([predict(network, scene.judged.scene)], [scene.judged])
        found[scene.key] = float(np.mean([view.log_l1 for view in views]))
    return found


def by_stratum(scenes: Sequence[HeldOutScene], of_scene: Mapping[str, float]) -> dict[str, float]:
    """Return the mean over the scenes of each stratum."""
    parts: dict[str, list[float]] = {}
    for scene in scenes:
        parts.setdefault(scene.stratum, []).append(of_scene[scene.key])
    return {name: float(np.mean(values)) for name, values in parts.items()}
