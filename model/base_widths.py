"""Base widths of the maximal update parametrization (muP). Imports no torch.

Learning rates and initial weights are stated at these widths; at other widths they follow the rules
of model.width_scales. With a width of 0 they are the same at every width, as in the paper's recipe.
"""

import dataclasses
from typing import Annotated

from model.config import VERTEX_COORDINATES, ModelConfig
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked("base widths")
class BaseWidths:
    """Widths of the network at which learning rates and initial weights are stated."""

    width: Annotated[int, Within(0, 16_384)] = 0
    """Width of tokens at which the rates were measured; at other widths they and the initial
    weights follow the maximal update parametrisation (Yang et al. 2021), and with 0 no width."""
    head_width: Annotated[int, Within(2 * VERTEX_COORDINATES, 16_384)] = 64
    """Width of an attention head there; it divides `width`."""
    pixel_width: Annotated[int, Within(1, 4096)] = 64
    """hits: width of the network that each pixel passes there."""
    filter_width: Annotated[int, Within(1, 1024)] = 32
    """hits: width of the filter's network there."""

    def __post_init__(self) -> None:
        if self.head_width % 2 or self.width % self.head_width:
            raise TrilightError(
                f"base widths: width is {self.width} and head_width {self.head_width}; expected "
                "an even head_width that divides width."
            )

    def of(self, config: ModelConfig) -> ModelConfig:
        """Return the configuration `config` at these widths.

        Widths without a field here keep their ratio to the tokens' width. The number of
        frequencies, on which no weight's shape depends, is 1, so that it fits any head.

        Args:
            config: network that is trained; `self.width` is above 0.
        """

        def in_proportion(wide: int) -> int:
            return 2 * max(1, round(wide * self.width / config.width / 2)) if wide else 0

        return dataclasses.replace(
            config,
            width=self.width,
            num_heads=self.width // self.head_width,
            hidden_width=in_proportion(config.hidden_width),
            rope_num_freqs=1,
            dpt_features=in_proportion(config.dpt_features),
            dpt_channels=tuple(map(in_proportion, config.dpt_channels)),
            pixel_width=self.pixel_width if config.pixel_width else 0,
            filter_width=self.filter_width if config.filter_width else 0,
        )
