"""What a round taught: the network before and after it on the held-out scenes, and its costs."""

from collections.abc import Mapping

import torch

from infra.improve.held_out import HeldOutScene, by_stratum, held_out, losses
from infra.improve.weights import Lesson
from model.open import open_network
from storage.dataset.training_data import open_training_data
from train.data.unusable import Unusable, first_samples
from train.loop.checkpoints import network_of_run
from train.loop.state import new_state
from train.settings import TrainSettings

_EVERY = 10**7
"""Scenes of a split: all."""


class Judged:
    """The held-out scenes of a loop, for its network."""

    def __init__(self, dataset: str, settings: TrainSettings) -> None:
        """Open the validation split of the first round's dataset.

        Raises:
            TrilightError: it is damaged, or lacks the run's resolution.
        """
        shards = open_training_data([dataset]).split("validation")
        samples = first_samples(shards, _EVERY, Unusable(0))
        self.scenes: list[HeldOutScene] = held_out(samples, settings.model, settings.resolution)
        self._settings = settings

    def untrained(self) -> dict[str, float]:
        """Return the loss by stratum of the run's network before its first step."""
        network = new_state(self._settings, torch.device("cpu")).shown.eval()
        return by_stratum(self.scenes, losses(network, self.scenes))

    def trained(self, run: str) -> dict[str, float]:
        """Return the loss of each held-out scene, by key, of the network that a run has now."""
        return losses(open_network(run, network_of_run), self.scenes)

    def lessons(
        self, before: Mapping[str, float], now: Mapping[str, float], core_s: Mapping[str, float]
    ) -> dict[str, Lesson]:
        """Return what a round taught by stratum.

        Args:
            before: loss of each stratum before the round.
            now: loss of each scene after it.
            core_s: cost of a scene of each stratum.
        """
        return {
            name: Lesson(loss_before=before[name], loss=loss, core_s=core_s[name])
            for name, loss in by_stratum(self.scenes, now).items()
        }
