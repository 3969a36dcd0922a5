"""The sheet of a run's validation scenes."""

from PIL import Image

from train.evaluation.judge import Judge, ValidationJudgement
from train.evaluation.sheet import SheetView, drawn_sheet
from train.settings import TrainSettings

SHEET_SCENES = 8
"""Scenes on the sheet, one view each."""


def drawn_validation_sheet(
    settings: TrainSettings, judge: Judge, judgement: ValidationJudgement, step: int
) -> Image.Image:
    """Return the sheet of the first scenes after a step."""
    views, at = [], 0
    shown = zip(judge.scenes, judgement.pictures, strict=True)
    for judged, pictures in list(shown)[:SHEET_SCENES]:
        score, median = judgement.views[at], judge.median_views[at]
        at += len(pictures)
        views.append(
            SheetView(
                name=f"scene {judged.scene.key}, view 0",
                scores=(
                    f"log L1 {score.log_l1:.4f} (median picture {median.log_l1:.4f}), "
                    f"{score.psnr_log_db:.1f} dB log, {score.psnr_linear_db:.1f} dB linear"
                ),
                target_rgb=judged.target_VRR3[0],
                predicted_rgb=pictures[0],
                noise=float(judged.scene.noise_V[0]),
            )
        )
    title = (
        f"run {settings.run}, step {step} of {settings.num_steps}, {settings.resolution} pixels: "
        f"validation scenes, never trained on",
        f"log L1 {judgement.scores['log_l1']:.4f}, median picture of the training views "
        f"{judge.median_scores['log_l1']:.4f}, "
        f"{judgement.scores['better_than_median']:.0%} of views better than it",
    )
    return drawn_sheet(views, title)
