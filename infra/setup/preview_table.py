"""Makes infra/rendering/previews.json, by which `trilight render --seconds` and `--error` choose.

trilight bench previews
python -m infra.setup.preview_table
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from infra.bench.experiments.previews import (
    NETWORK,
    PROBES,
    WIDTHS,
    ladder,
    part_name,
    preview_name,
    timed_names,
)
from infra.bench.run import RESULTS, store_of
from infra.bench.store import Run
from infra.rendering.way_table import SHIPPED, PartCost, PictureCosts, WayError, WayTable
from pipeline.renders.preview_parts import SCENE
from storage.atomic import write_atomically
from storage.errors import TrilightError
from storage.settings.described import settings_record

_SERIAL = (SCENE,)
"""Parts that one thread does, however many there are."""


def main() -> None:
    """Write the file."""
    import json

    text = json.dumps(settings_record(made_from(RESULTS)), indent=1, sort_keys=True)
    write_atomically(SHIPPED, f"{text}\n".encode())


def made_from(results: Path) -> WayTable:
    """Return the table of the newest results in a folder.

    Errors are of the scenes that were judged at every width that has results, so that widths differ
    by nothing else. At a width that has none, errors are those of the nearest one that has.

    Raises:
        TrilightError: there are no costs or no errors, or no scene was judged at every width.
    """
    parts = _newest(results, "preview-parts")
    found = {px: _newest(results, f"previews-{px}") for px in WIDTHS}
    runs = {px: run for px, run in found.items() if run is not None}
    if parts is None or not runs:
        raise TrilightError(
            f"{results} holds no results of previews and their parts; run: trilight bench previews"
        )
    turns = sorted(set.intersection(*(set(run.whole_turns()) for run in runs.values())))
    if not turns:
        raise TrilightError(f"{results}: no scene was judged at every width; measure more of them.")
    about = parts.plan["machine"]
    machine = f"{about['processor']}, one thread"
    return WayTable(
        scenes=len(turns),
        errors=tuple(error for px, run in runs.items() for error in _errors(run, turns, px)),
        costs=_costs(machine, parts, parts.whole_turns(), lambda found: float(np.median(found))),
        probe=_costs(machine, parts, PROBES, lambda found: float(np.mean(found))),
    )


def _errors(run: Run, turns: Sequence[str], px: int) -> Iterator[WayError]:
    def of(point: str) -> dict[str, float]:
        found = [run.turns[turn][point]["db"] for turn in turns]
        return {"median_db": round(float(np.median(found)), 2), "least_db": round(min(found), 2)}

    yield WayError(rung="network", spp=0, denoiser="off", width=px, **of(NETWORK))
    for spp, denoiser in ladder(px):
        name = preview_name(spp, denoiser)
        yield WayError(rung="traced", spp=spp, denoiser=denoiser, width=px, **of(name))


def _costs(
    machine: str, run: Run, turns: Sequence[str], over: Callable[[list[float]], float]
) -> PictureCosts:
    rows = []
    for px in WIDTHS:
        for part in timed_names():
            found = [run.turns[turn][part_name(part, px)]["core_s"] for turn in turns]
            core_s = float(f"{over(found):.4g}")
            serial_s, parallel_s = (core_s, 0.0) if part in _SERIAL else (0.0, core_s)
            rows.append(PartCost(part=part, width=px, serial_s=serial_s, parallel_s=parallel_s))
    return PictureCosts(machine=machine, rows=tuple(rows))


def _newest(results: Path, name: str) -> Run | None:
    """Return the run of most scenes; one that was interrupted counts for those that it has."""
    runs = [
        run for effort in ("careful", "quick") for run in store_of(results, name, effort).runs()
    ]
    begun = [run for run in runs if run.whole_turns()]
    return max(begun, key=lambda run: (len(run.whole_turns()), run.date), default=None)


if __name__ == "__main__":
    main()
