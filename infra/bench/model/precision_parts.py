"""What rounding does to a trained network, whole and part by part, on scenes it has not seen.

    python -m infra.bench.model.precision_parts CHECKPOINT --data SET [--write]

Each part of the network is rounded alone, and the other way round: bfloat16 as `set_precision`
chooses it, with that part's choice reversed. Beside it the same configuration with random weights.
`--write` keeps the result under docs/bench and puts the table into docs/tradeoffs.md.
"""

import copy
import hashlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated

import torch
from cyclopts import Parameter, run
from torch import Tensor

from infra.bench.harness import ROOT, save
from infra.bench.marked_block import write_block
from infra.bench.model.contenders import bright_network
from infra.bench.model.network_errors import log10_psnr_db
from infra.bench.model.precision_report import (
    AS_CHOSEN,
    EMULATED,
    MARK,
    Decibels,
    PartErrors,
    PrecisionParts,
    decibels,
    lines,
)
from infra.bench.model.rounded_parts import Part, parts_of, rounded
from infra.cli.console import console, progress_bars
from model.open import BUILTIN, open_network
from model.precision import set_precision
from model.renderformer import RenderFormer
from model.scene_tensors import batch_scenes
from storage.errors import TrilightError
from storage.training_data import open_training_data
from train.data.scenes import TrainingScene, training_scene
from train.data.splits import first_samples
from train.data.unusable import Unusable
from train.networks import network_of_run

NARROW = torch.bfloat16
SPLIT = "test"

Pictures = list[Tensor]
"""log10(1 + radiance) before the ELU, [R, R, 3] each: view by view, scene by scene."""


def main(
    checkpoint: Annotated[str, Parameter(help="builtin:, or any trained network")],
    data: Annotated[str, Parameter(help="dataset; its test split is used")],
    scenes: Annotated[int, Parameter(help="the first so many of the split")] = 16,
    resolution: Annotated[int, Parameter(help="pixels across")] = 64,
    write: Annotated[bool, Parameter(help="write docs/bench and docs/tradeoffs.md")] = False,
) -> None:
    """Measure and print."""
    torch.set_num_threads(1)  # a small network: threads would wait for each other
    opened = open_training_data([data])
    samples = first_samples(opened.split(SPLIT), scenes, Unusable(0))
    judged = [training_scene(sample, resolution) for sample in samples]
    model = open_network(checkpoint, network_of_run)
    with progress_bars() as bars:
        task = bars.add_task("networks", total=num_rounds(model), note="")
        result = measure(
            model,
            judged,
            network=f"{_shown(checkpoint)}, weights {_digest(model)[:8]}",
            dataset=f"the {SPLIT} split of the dataset {opened.digest[:8]}",
            round_done=lambda: bars.advance(task),
        )
    text = "\n".join(lines(result)) + "\n"
    console.print(text, soft_wrap=True, markup=False)
    if write:
        save(result, quick=False)
        write_block(ROOT / "docs" / "tradeoffs.md", MARK, text)


def num_rounds(model: RenderFormer) -> int:
    """Return how often `measure` calls `round_done`."""
    return 3 * len(parts_of(model)) + len(_WHOLES) + 4


def measure(
    model: RenderFormer,
    scenes: Sequence[TrainingScene],
    *,
    network: str,
    dataset: str,
    round_done: Callable[[], None] = lambda: None,
) -> PrecisionParts:
    """Return the errors of a float32 network on scenes with pictures.

    Args:
        model: the trained network; it stays as it is.
        scenes: of one resolution.
        network: its name, for people.
        dataset: where the scenes are from, for people.
        round_done: called after each of the networks that are looked at.
    """
    targets = [view for scene in scenes for view in scene.target_VRR3]

    def pictures(one: RenderFormer) -> Pictures:
        found = _pictures(one, scenes)
        round_done()
        return found

    exact, chosen = pictures(model), pictures(_in_bfloat16(model))
    other = bright_network(model.config)
    exact_other, chosen_other = pictures(other), pictures(_in_bfloat16(other))
    wholes = {AS_CHOSEN: _errors(chosen, exact)}
    for name, (dtype, names) in _WHOLES.items():
        wholes[name] = _errors(pictures(rounded(model, names(parts_of(model)), dtype)), exact)
    parts = [_part(part, model, exact, other, exact_other, pictures) for part in parts_of(model)]
    return PrecisionParts(
        name="model-precision",
        network=network,
        dataset=dataset,
        scenes=len(scenes),
        views=len(exact),
        resolution=exact[0].shape[0],
        own_error=_errors(exact, targets),
        own_error_in_bfloat16=_errors(chosen, targets),
        wholes=wholes,
        random_bfloat16=_errors(chosen_other, exact_other),
        parts=tuple(parts),
    )


def _in_bfloat16(model: RenderFormer) -> RenderFormer:
    return set_precision(copy.deepcopy(model), "bfloat16")


def _part(
    part: Part,
    model: RenderFormer,
    exact: Pictures,
    other: RenderFormer,
    exact_other: Pictures,
    pictures: Callable[[RenderFormer], Pictures],
) -> PartErrors:
    """Return what one part does, in the network and in one with random weights."""
    reversed_choice = set(_narrow(parts_of(model))) ^ {part.name}
    return PartErrors(
        part=part.name,
        narrow=part.narrow,
        alone=_errors(pictures(rounded(model, [part.name], NARROW)), exact),
        reversed_choice=_errors(pictures(rounded(model, reversed_choice, NARROW)), exact),
        alone_in_random_weights=_errors(pictures(rounded(other, [part.name], NARROW)), exact_other),
    )


def _narrow(parts: Iterable[Part]) -> list[str]:
    return [part.name for part in parts if part.narrow]


def _all(parts: Iterable[Part]) -> list[str]:
    return [part.name for part in parts]


def _stage(stage: str) -> Callable[[Iterable[Part]], list[str]]:
    return lambda parts: [part.name for part in parts if part.name.startswith(stage)]


_WHOLES: dict[str, tuple[torch.dtype, Callable[[Iterable[Part]], list[str]]]] = {
    EMULATED: (NARROW, _narrow),
    "bfloat16, the encoder's layers only": (NARROW, _stage("encoder")),
    "bfloat16, the decoder's layers only": (NARROW, _stage("decoder")),
    "bfloat16, every part": (NARROW, _all),
    "float16, the same parts rounded one by one": (torch.float16, _narrow),
    "float16, every part": (torch.float16, _all),
}
"""What is rounded together, beside bfloat16 as `set_precision` has it."""


@torch.no_grad()
def _pictures(model: RenderFormer, scenes: Sequence[TrainingScene]) -> Pictures:
    found: Pictures = []
    for scene in scenes:
        found += model(batch_scenes([scene.tensors]), scene.target_VRR3.shape[1])[0].float()
    return found


def _errors(pictures: Pictures, others: Pictures) -> Decibels:
    return decibels([log10_psnr_db(a, b) for a, b in zip(pictures, others, strict=True)])


def _shown(checkpoint: str) -> str:
    """Return what names a network without naming a folder of this machine."""
    return f"`{checkpoint}`" if checkpoint == BUILTIN else f"`{Path(checkpoint).name}`"


def _digest(model: RenderFormer) -> str:
    """Return a digest of the weights, however they are kept."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        raise SystemExit(f"precision_parts: {mistake}") from mistake
