"""What to spend core-seconds on: training sets of one price, made in different ways.

    python -m infra.bench.equal_sets --work FOLDER --core-seconds 500

Every recipe (infra.bench.equal_set_recipes) makes scenes until the price is reached, and once more
is cut at a quarter of it; the same small network learns from each, twice, and is judged on one set
that none of them holds. A set or a training that is there already is kept. `--report` only prints
what the file of results says.
"""

import json
import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter, run

from infra.bench.equal_set_plot import plot
from infra.bench.equal_set_recipes import JUDGE, JUDGE_ARGUMENTS, RECIPES, USUAL, Recipe
from infra.bench.harness import RESULTS
from infra.bench.training_jobs import BASELINE, SEEDS, Job
from infra.bench.training_table import read_table, train_and_score
from infra.cli.console import console
from storage.errors import TrilightError
from storage.layout import DatasetFolder
from storage.scene_log import read_shard_log

TABLE = RESULTS / "equal_sets.jsonl"
SHARES = (0.25, 1.0)
"""Of the price: the smaller set is the beginning of the larger."""
_PILOT_SHARDS = 12
_SCENES = 40_000
"""Of the plan; nobody makes so many."""


@dataclass(frozen=True, kw_only=True)
class BoughtSet:
    """The first training shards of a recipe that a price pays for."""

    shards: tuple[str, ...]
    """Paths."""
    num_scenes: int
    """In them."""
    core_s: float
    """What they took, attempts that were rejected included."""


def main(
    work: Annotated[Path, Parameter(help="folder of sets and runs")] = Path("runs/equal"),
    core_seconds: Annotated[float, Parameter(help="price of every set")] = 500.0,
    only: Annotated[str, Parameter(help="this recipe alone")] = "",
    size: Annotated[str, Parameter(help="network: small or large")] = "small",
    sets_only: Annotated[bool, Parameter(help="make the sets, train nothing")] = False,
    table: Annotated[Path, Parameter(help="file of the results")] = TABLE,
    report: Annotated[bool, Parameter(help="only print what the file says")] = False,
) -> None:
    """Make the sets, train on them, append a row for each training, print the table."""
    if only and only not in RECIPES:
        raise TrilightError(f"--only {only!r}: no such recipe; expected {' or '.join(RECIPES)}.")
    if not report:
        judge = judging_shards(work / "judge")
        for name in [only] if only else RECIPES:
            grown = grow_set(RECIPES[name], work / name, core_seconds)
            for share in SHARES if not sets_only else ():
                bought = cut_set(grown, share * core_seconds)
                if not bought.shards:
                    raise TrilightError(
                        f"--core-seconds {core_seconds:g}: {share:.0%} of it pays for no shard of "
                        f"{name}, whose first one takes a compilation too. Give more."
                    )
                for seed in SEEDS:
                    job = Job(
                        plan="cpu",
                        scenes=bought.num_scenes,
                        size=size,
                        change=BASELINE,
                        seed=seed,
                    )
                    add_row(name, job, bought, judge, work / "runs", table, share * core_seconds)
    if rows := read_table(table):
        plot(rows, table.with_suffix(".png"))
    for line in report_lines(rows):
        console.print(line, soft_wrap=True)


def judging_shards(out: Path) -> list[str]:
    """Make, or find, the scenes that every training is judged on."""
    _generate(out, [*JUDGE.arguments, *JUDGE_ARGUMENTS])
    return [str(path) for path in sorted(out.rglob("validation-*.tar"))]


def grow_set(recipe: Recipe, out: Path, core_s: float) -> DatasetFolder:
    """Make training scenes until they have taken `core_s`; what is there already is kept."""
    folder, shards = DatasetFolder(out), _PILOT_SHARDS
    while True:
        _generate(out, [*recipe.arguments, "--shards", f"0:{shards}"])
        spent = cut_set(folder, math.inf)
        if spent.core_s >= core_s:
            return folder
        # a little more than the mean says, so that a second pass is enough
        shards = math.ceil(1.03 * shards * core_s / spent.core_s) + 2


def cut_set(folder: DatasetFolder, core_s: float) -> BoughtSet:
    """Return the first training shards that `core_s` pays for, as their logs say."""
    bought: list[str] = []
    scenes, spent = 0, 0.0
    for path in sorted(folder.root.rglob("train-*.tar")):
        rows = read_shard_log(folder, str(path.relative_to(folder.root)))
        price = sum(row.seconds * row.cores for row in rows)
        if spent + price > core_s:
            break
        bought.append(str(path))
        scenes, spent = scenes + len(rows), spent + price
    return BoughtSet(shards=tuple(bought), num_scenes=scenes, core_s=spent)


def add_row(
    recipe: str,
    job: Job,
    bought: BoughtSet,
    judge: Sequence[str],
    runs: Path,
    table: Path,
    price: float,
) -> None:
    """Train unless the table has it, and append what came out."""
    known = {
        "recipe": recipe,
        "size": job.size,
        "seed": job.seed,
        "price_core_s": price,
        "settings_sha256": job.digest(),
    }
    if any(all(row[name] == value for name, value in known.items()) for row in read_table(table)):
        return
    folder = runs / f"{recipe}-{price:.0f}-{job.size}-{job.seed}-{job.digest()[:8]}"
    result = train_and_score(job.settings(), [*bought.shards, *judge], folder, None)
    facts = {name: value for name, value in asdict(bought).items() if name != "shards"}
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("a") as stream:
        stream.write(json.dumps({**known, **facts, **result}, sort_keys=True) + "\n")
    console.print(f"{folder.name}: log L1 {result['scores']['log_l1']:.4f}", soft_wrap=True)


def report_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the results as a Markdown table: a line for each recipe and price."""
    lines = [
        "Held-out log L1, mean over seeds (half the range), ratio to `usual` at the same price.",
        "",
        "| price, core-seconds | set | scenes | core-seconds a scene | error | training, s |",
        "|---|---|---|---|---|---|",
    ]
    for price in sorted({row["price_core_s"] for row in rows}):
        usual = _errors(rows, price, USUAL)
        for name, recipe in RECIPES.items():
            own = _errors(rows, price, name)
            if not own:
                continue
            first, *_ = (row for row in rows if _place(row) == (price, name))
            ratio = f", x{np.mean(own) / np.mean(usual):.3f}" if usual and name != USUAL else ""
            seconds = [row["seconds"] for row in rows if _place(row) == (price, name)]
            lines.append(
                f"| {price:.0f} | {name}: {recipe.words} | {first['num_scenes']} "
                f"| {first['core_s'] / first['num_scenes']:.2f} "
                f"| {np.mean(own):.4f} ({np.ptp(own) / 2:.4f}){ratio} | {np.mean(seconds):.0f} |"
            )
    return lines


def _place(row: Mapping[str, Any]) -> tuple[float, str]:
    return row["price_core_s"], row["recipe"]


def _errors(rows: Sequence[Mapping[str, Any]], price: float, recipe: str) -> list[float]:
    return [row["scores"]["log_l1"] for row in rows if _place(row) == (price, recipe)]


def _generate(out: Path, arguments: Sequence[str]) -> None:
    command = [sys.executable, "-m", "trilight", "generate", "smoke", "--out", str(out)]
    command += ["--objects", "builtin:", "--scenes", str(_SCENES), *arguments]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        raise SystemExit(f"equal sets: {mistake}") from mistake
