"""Short trainings of any settings, evaluated scene by scene on held-out scenes."""

import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial

import numpy as np
import torch

from storage.dataset.shard_set import ShardSet
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from train.data.bad_samples import BadSampleCounter, first_samples
from train.data.buckets import bucket_scenes
from train.data.loader import load_batches
from train.evaluation.validation import Judge
from train.loop.distributed import DistributedContext
from train.loop.optimizer import choose_muon_precision
from train.loop.step import Stepper
from train.loop.train_state import new_state
from train.loop.trainer import scene_flops
from train.loss.training_loss import TrainingLoss
from train.settings import TrainSettings, learning_rate


def scenes_of(data: str, held_out: int, resolution: int) -> tuple[ShardSet, Judge, str]:
    """Return the training scenes of a dataset, and its first validation scenes to judge on.

    A note on both comes third.

    Raises:
        TrilightError: the validation split is empty.
    """
    opened = open_training_data([data])
    samples = list(first_samples(opened.split("validation"), held_out, BadSampleCounter(0)))
    if not samples:
        raise TrilightError(
            f"--data {opened.display_name}: its validation split is empty; expected scenes to "
            "judge on."
        )
    train = opened.split("train")
    count = sum(train.num_samples(number) for number in range(len(train.names)))
    note = f"{count} scenes seen, {len(samples)} judged on, data {opened.digest[:8]}"
    return train, Judge(samples, resolution, np.zeros((resolution, resolution, 3))), note


def training_figures(
    train: ShardSet, judge: Judge, settings: TrainSettings, device: torch.device
) -> Sequence[Mapping[str, float]]:
    """Train a network from the start and return the figures of each judged scene.

    `percent` is 100 times the logarithm of the error, so that differences are per cent of it.
    """
    began = time.perf_counter()
    crew = DistributedContext(device=device)
    state = new_state(settings, device, muon_precision=choose_muon_precision(crew))
    stepper = Stepper(state, TrainingLoss(settings.loss, None), crew)
    cost = partial(scene_flops, settings)
    stream = load_batches(
        train, settings, 0, rank_slice=crew, workers=1, unusable=state.bad_samples
    )
    with closing(stream) as batches:
        for step in range(settings.num_steps):
            buckets = bucket_scenes(next(batches), cost, settings.scenes_per_pass)
            stepper.launch(buckets, learning_rate(step, settings))  # no step waits for its figures
            state.step += 1
    model = state.model.eval()
    del state, stepper, buckets  # the optimizer's memory is free before pictures are judged
    seconds = time.perf_counter() - began
    views = iter(judge.judge(model).views)
    scores_by_view = []
    for judged in judge.scenes:
        mine = [next(views) for _ in judged.target_VRR3]
        l1 = float(np.mean([view["log_l1"] for view in mine]))
        figures = {"seconds": seconds, "step_s": seconds / settings.num_steps}
        if np.isfinite(l1) and l1 > 0:
            db = float(np.mean([view["psnr_log_db"] for view in mine]))
            figures |= {"log_l1": l1, "percent": 100 * float(np.log(l1)), "db": db}
        scores_by_view.append(figures)
    return scores_by_view
