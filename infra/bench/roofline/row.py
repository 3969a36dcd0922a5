"""`roofline`: what a step of a named run would take on a card, without one.

To be called in a process of `infra.fake_card.process.card_process`; `rooflines` starts one.
"""

import dataclasses
import functools
import tempfile
from collections.abc import Sequence
from pathlib import Path

from infra.bench.roofline.cards import CARDS
from infra.bench.roofline.case import Case
from infra.bench.roofline.fusion import fused
from infra.bench.roofline.prediction import Prediction, predicted
from infra.bench.roofline.trace import Traced
from storage.errors import TrilightError, expected_one_of

USABLE_SHARE = 0.9
"""Share of a card's memory that a step may take: libraries and fragments have the rest."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RooflineRow(Prediction):
    """A prediction with what it is for."""

    case: Case
    """What was asked."""
    scenes: int
    """Scenes of the pass."""
    scenes_that_fit: dict[str, int]
    """Most scenes of a pass by card, if what is held beyond the weights grows with the scenes."""


def roofline(case: Case) -> RooflineRow:
    """Return the row of a case.

    Raises:
        TrilightError: no such run, size or card.
    """
    if case.card not in CARDS:
        raise TrilightError(f"card {case.card!r}: {expected_one_of(case.card, sorted(CARDS))}.")
    traced, scenes = _traced(case.run, case.size, case.recomputes)
    if case.is_compiled:
        traced = fused(traced, lambda part: part[0] in COMPILED)
    found = predicted(traced, CARDS[case.card])
    held = sum(size for index, size in traced.born.values() if index == 0) / 2**30
    each = (found.peak_gib - held) / scenes
    fit = {
        name: max(0, int((USABLE_SHARE * card.memory_gib - held) / each))
        for name, card in CARDS.items()
    }
    return RooflineRow(**vars(found), case=case, scenes=scenes, scenes_that_fit=fit)


COMPILED = ("encoder layers", "decoder layers", "keys and values", "filter", "head", "LPIPS")
"""Parts of train.loop.compiled."""


def rooflines(cases: Sequence[Case]) -> list[RooflineRow]:
    """Return the rows of cases, in a process of their own.

    Raises:
        TrilightError: as `roofline`, or there is no compiler where torch has no CUDA.
    """
    from infra.fake_card.process import card_process

    with tempfile.TemporaryDirectory() as folder, card_process(Path(folder)) as process:
        return [process.submit(roofline, case).result() for case in cases]


@functools.lru_cache(maxsize=1)
def _traced(run: str, size: str | None, recomputes: bool | None) -> tuple[Traced, int]:
    """Return the kernels of a step, and its scenes."""
    from infra.bench.roofline.step import traced_step
    from train.runs import changed_run

    changes = {
        **({} if size is None else {"model": size}),
        **({} if recomputes is None else {"recompute_activations": recomputes}),
    }
    settings = changed_run(run, changes)
    scenes = min(settings.scenes_per_pass, settings.scenes_per_step)
    return traced_step(settings, scenes), scenes
