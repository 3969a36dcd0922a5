"""Many small trainings, one line each, to be continued by anybody at any time.

    python -m infra.bench.training_table --data SET --minutes 120

SET is a dataset with at least 960 training scenes and a validation split, which every job is judged
on. A job that is in the file already is skipped, one that was interrupted goes on, and no new one
begins when the budget is spent. `--report` only prints what the file says.
"""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, run

from infra.bench.harness import RESULTS, machine
from infra.bench.training_jobs import Job, all_jobs
from infra.bench.training_plot import plot
from infra.bench.training_report import report_lines
from infra.cli.console import console
from storage.dataset import Dataset, open_dataset
from storage.errors import TrilightError
from train.folder import RunFolder
from train.loop.checkpoints import saved_steps
from train.loop.crew import join_crew
from train.loop.metrics_log import read_rows
from train.run import train_run
from train.settings import TrainSettings
from train.start import Start

TABLE = RESULTS / "training_table.jsonl"


def main(
    data: Annotated[str, Parameter(help="root of the dataset")] = "",
    minutes: Annotated[float, Parameter(help="begin no job after so many")] = 60.0,
    plan: Annotated[str, Parameter(help="cpu or gpu")] = "cpu",
    only: Annotated[str, Parameter(help="jobs whose name holds this")] = "",
    work: Annotated[Path, Parameter(help="folder of the runs")] = Path("runs/table"),
    table: Annotated[Path, Parameter(help="file of the results")] = TABLE,
    device: Annotated[str | None, Parameter(help="cpu or cuda")] = None,
    report: Annotated[bool, Parameter(help="only print what the file says")] = False,
) -> None:
    """Run the jobs that are missing, within a budget."""
    jobs = [job for job in all_jobs(plan) if only in job.name]
    if not report:
        run_jobs(jobs, open_dataset(data), work, table, minutes=minutes, device=device)
    if rows := read_table(table):
        plot(rows, table.with_suffix(".png"))
    for line in report_lines(rows):
        console.print(line, soft_wrap=True)


def run_jobs(
    jobs: Sequence[Job],
    dataset: Dataset,
    work: Path,
    table: Path,
    *,
    minutes: float,
    device: str | None = None,
) -> int:
    """Run what is not in the table yet, append each result as it ends; return how many ran."""
    began, ran = time.monotonic(), 0
    for job in jobs:
        if is_done(job, dataset.digest, read_table(table)):
            continue
        if time.monotonic() - began > 60 * minutes:
            break
        row = run_job(job, dataset, work / _folder_name(job, dataset), device)
        table.parent.mkdir(parents=True, exist_ok=True)
        with table.open("a") as stream:
            stream.write(json.dumps(row, sort_keys=True) + "\n")
        ran += 1
        console.print(f"{job.name}: log L1 {row['scores']['log_l1']:.4f}, {row['seconds']:.0f} s")
    return ran


def _folder_name(job: Job, dataset: Dataset) -> str:
    """Return a name that another training never has: a run of other settings cannot go on."""
    return f"{job.name}-{job.digest()[:8]}-{dataset.digest[:8]}"


def read_table(table: Path) -> list[dict[str, Any]]:
    """Return the whole lines of the file; none where there is none."""
    return read_rows(table)


def is_done(job: Job, data_digest: str, rows: Sequence[dict[str, Any]]) -> bool:
    """Return whether a row holds this very training: the same settings on the same data."""
    known = {(row["job"], row["settings_sha256"], row["data_digest"]) for row in rows}
    return (job.name, job.digest(), data_digest) in known


def run_job(job: Job, dataset: Dataset, folder: Path, device: str | None) -> dict[str, Any]:
    """Train and return the row of the table."""
    shards, num_scenes = _shards(dataset, job.scenes)
    return {
        "job": job.name,
        "plan": job.plan,
        "scenes": num_scenes,
        "size": job.size,
        "change": job.change,
        "seed": job.seed,
        "settings_sha256": job.digest(),
        "data_digest": dataset.digest,
        **train_and_score(job.settings(), shards, folder, device),
    }


def train_and_score(
    settings: TrainSettings, shards: Sequence[str], folder: Path, device: str | None
) -> dict[str, Any]:
    """Train on shards, or go on, and return what every table says of a training."""
    resume = bool(saved_steps(RunFolder(folder).checkpoints))
    with join_crew(device) as crew:
        result = train_run(settings, data=shards, out=folder, start=Start(resume=resume), crew=crew)
    assert result is not None
    validations = [row for row in read_rows(result.folder.metrics) if "validation" in row]
    return {
        "num_parameters": result.num_parameters,
        "num_steps": result.num_steps,
        "scores": result.scores,
        "median_scores": result.median_scores,
        "curve": [[row["step"], row["validation"]["log_l1"]] for row in validations],
        "loss_at_end": result.loss_at_end,
        "seconds": result.seconds,
        "resumed": resume,
        "machine": machine(),
    }


def _shards(dataset: Dataset, scenes: int) -> tuple[list[str], int]:
    """Return the first training shards that hold so many scenes, the validation split, a count."""
    chosen, count = [], 0
    for shard in dataset.shards_of("train"):
        if count >= scenes:
            break
        chosen.append(shard.name)
        count += shard.num_samples
    if count < scenes:
        raise TrilightError(
            f"{dataset.shown}: {count} training scenes; expected at least {scenes}. Generate more, "
            "or choose smaller jobs with --only."
        )
    chosen += [shard.name for shard in dataset.shards_of("validation")]
    return [str(dataset.folder.shard(name)) for name in chosen], count


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        raise SystemExit(f"training table: {mistake}") from mistake
