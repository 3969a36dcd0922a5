"""What was drawn on the way to a sky or a surface."""

from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar
from unittest import mock

import numpy as np

from scene_templates.recorded_sampler import RecordedSampler

Made = TypeVar("Made")
Args = ParamSpec("Args")


def with_draws(
    draw: Callable[Args, Made], *args: Args.args, **options: Args.kwargs
) -> tuple[Made, Mapping[str, tuple[Any, ...]]]:
    """Return what a function makes, and the values that it drew, by name."""
    samplers: list[RecordedSampler] = []
    begin = RecordedSampler.__init__

    def noted(self: RecordedSampler, rng: np.random.Generator) -> None:
        begin(self, rng)
        samplers.append(self)

    with mock.patch.object(RecordedSampler, "__init__", noted):
        made = draw(*args, **options)
    return made, samplers[-1].parameters()
