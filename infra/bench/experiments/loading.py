"""What a sample costs the loader, by threads and processes, and how far one process can go.

On the scenes of `--data`, or on rendered ones of `smoke`. Core-seconds are those of all threads and
children; the rate of eight cores is simulated, with a main thread that drives a card from the same
Python.
"""

import dataclasses
import itertools
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from infra.bench.experiment import (
    Column,
    Experiment,
    Figures,
    Point,
    one_by_one,
    repeats,
)
from infra.bench.sides.lock_simulation import Part, samples_a_second
from infra.bench.sides.lock_time import with_lock_time
from infra.bench.subjects.manifests import write_copies
from infra.bench.workshop import Workshop
from storage.dataset.training_data import open_training_data
from storage.errors import Rejected
from storage.records.sample import encode_sample

WIDTHS_PX = (64, 256)
RUN = "pretrain"
"""The run whose views and symmetries are drawn."""
BATCH, SAMPLES = 8, 480
"""Scenes of a batch, and scenes that are counted."""
AIM = 165
"""Samples a second that a card takes at 40 % of its peak."""
THREADS = (1, 2, 4, 7, 15)
"""Beside the main one: those of 2, 3, 5, 8 and 16 cores."""
PIECES = 64
"""How often a thread takes the lock in one sample, about: after each call that lets it go."""
SCENES, PASSES, LAUNCHES, MAIN_STEPS = 16, 5, 16_000, 4
"""Scenes of a step of one process, the passes that they take by their lengths, the kernels that are
launched for them, and steps that are counted."""

NARROW = {
    "model.width": 108,
    "model.num_heads": 6,
    "model.rope_num_freqs": 1,
    "model.hidden_width": 64,
    "model.dpt_features": 8,
    "model.dpt_channels": [8, 8, 8, 8],
    "resolution": 32,
    "views_per_scene": 1,
    "precision": "float32",
    "recompute_activations": False,
    "loss.perceptual": "none",
}
"""Makes Base cheap and leaves its depth."""


@dataclass(frozen=True, kw_only=True)
class Load:
    """How one point reads."""

    resolution: int
    """Pixels across."""
    threads: int = 0
    """Decoding threads; 0: the one that asks decodes."""
    processes: int = 1
    """Processes, each with its share of every batch."""


LOADS = {
    f"{px} px, {name}": Load(resolution=px, threads=threads, processes=processes)
    for px in WIDTHS_PX
    for name, threads, processes in (
        ("0 threads", 0, 1),
        ("1 thread", 1, 1),
        ("2 threads", 2, 1),
        ("2 processes", 1, 2),
    )
}


def _data(workshop: Workshop) -> str:
    def made() -> Path:
        root = workshop.folder() / "set"
        write_copies(root, [encode_sample(sample, "compact") for sample in workshop.samples])
        return root

    return workshop.asked.data or str(workshop.kept("loader", made))


def _read(data: str, load: Load, rank: int) -> Callable[[], int]:
    """Return what reads a share of SAMPLES as training does, but for the network."""
    import torch

    from train.data.order import RankShare
    from train.data.stream import stream_batches
    from train.data.unusable import Unusable
    from train.run import stream_settings
    from train.runs import changed_run

    torch.set_num_threads(1)
    settings = dataclasses.replace(
        stream_settings(changed_run(RUN, {"resolution": load.resolution})), batch_size=BATCH
    )

    def work() -> int:
        count = 0
        batches = stream_batches(
            open_training_data([data]).split("train"),
            settings,
            0,
            share=RankShare(rank=rank, world_size=load.processes),
            workers=load.threads,
            unusable=Unusable(0),
        )
        with closing(batches):
            for batch in itertools.islice(batches, SAMPLES // BATCH):
                count += len(batch)
        return count

    return work


def _launch() -> Callable[[], int]:
    """Return what takes steps of a network as deep as Base; so narrow, launching is all."""
    import torch

    from infra.bench.subjects.cost_scene import cost_scene
    from model.scene_tensors import scene_tensors
    from train.data.buckets import make_batch
    from train.data.scenes import TrainingScene
    from train.loop.crew import Crew
    from train.loop.state import new_state
    from train.loop.step import Stepper
    from train.loss.objective import Objective
    from train.runs import changed_run

    torch.set_num_threads(1)
    settings = changed_run(RUN, NARROW)
    tensors = scene_tensors(cost_scene(100, 1))
    scene = TrainingScene(
        key="",
        tensors=tensors,
        target_VRR3=torch.zeros(1, settings.resolution, settings.resolution, 3),
        noise_V=torch.zeros(1),
        light_T=torch.zeros(tensors.num_triangles, dtype=torch.int64),
    )
    objective = Objective(settings.loss, None)
    stepper = Stepper(new_state(settings), settings, objective, Crew(device=torch.device("cpu")))
    batches = [make_batch([scene])] * PASSES
    stepper.step(batches, 1e-6)

    def work() -> int:
        for _ in range(MAIN_STEPS):
            stepper.step(batches, 1e-6)
        return MAIN_STEPS * SCENES

    return work


def _point(workshop: Workshop, point: Point, turn: str) -> Figures:
    load, data = point.settings, _data(workshop)
    found = [with_lock_time(_read, data, load, rank) for rank in range(load.processes)]
    figures = {"core_s": sum(each["core_s"] for each in found) / len(found)}
    if load.threads < 2 and load.processes == 1 and "lock_s" in found[0]:
        figures["lock_s"] = found[0]["lock_s"]
    return figures


def _simulated(workshop: Workshop, point: Point, turn: str) -> Figures:
    """Simulate threads beside a main thread that launches what they decode."""
    load = Load(resolution=max(WIDTHS_PX), threads=1)
    read = workshop.kept(("read", turn), lambda: with_lock_time(_read, _data(workshop), load, 0))
    main = workshop.kept(("launch", turn), lambda: with_lock_time(_launch))
    if "lock_s" not in read or "lock_s" not in main:
        raise Rejected("no_lock", "this Python does not tell whether its lock is held")
    decoding = Part(free_s=read["core_s"] - read["lock_s"], locked_s=read["lock_s"], pieces=PIECES)
    launching = Part(free_s=0.0, locked_s=main["lock_s"], pieces=LAUNCHES // SCENES)
    rate = samples_a_second(decoding, launching, point.settings, ahead=2 * SCENES)
    return {
        "sample_s": 1 / rate,
        "core_ms": 1000 * read["core_s"],
        "lock_ms": 1000 * read["lock_s"],
        "main_ms": 1000 * main["lock_s"],
    }


def _milli(value: float) -> float:
    return 1000 * value


EXPERIMENTS = (
    Experiment(
        name="loader",
        title="What a sample costs the loader",
        about=(
            f"Core-seconds of the shards' bytes to batches of scenes with the views and symmetries "
            f"of `{RUN}`, one after another."
        ),
        cost=Column(name="core-ms a sample", figure="core_s", then=_milli),
        columns=(
            Column(name="samples a core-second", figure="core_s", then=lambda s: 1 / s),
            Column(name="under Python's lock, ms", figure="lock_s", then=_milli),
        ),
        points=lambda effort: [Point(name=name, settings=load) for name, load in LOADS.items()],
        turns=repeats,
        measure=one_by_one(_point),
        warm_up=True,
        needs=("torch",),
    ),
    Experiment(
        name="loader-cores",
        title="How far threads of one process go",
        about=(
            f"Simulated: threads that decode at {max(WIDTHS_PX)} pixels, a core for each, beside a "
            "main thread that launches the kernels of every sample from the same Python and waits "
            "for nothing else; from the measured seconds of both, and of both under its lock."
        ),
        cost=Column(name="seconds a sample", figure="sample_s"),
        columns=(
            Column(name="samples a second", figure="sample_s", then=lambda s: 1 / s),
            Column(name="core-ms a sample", figure="core_ms"),
            Column(name="its ms under the lock", figure="lock_ms"),
            Column(name="main thread's ms under the lock a sample", figure="main_ms"),
        ),
        points=lambda effort: [
            Point(name=f"{threads} threads", settings=threads) for threads in THREADS
        ],
        turns=repeats,
        measure=one_by_one(_simulated),
        because=(
            f"A card takes {AIM} samples a second at 40 % of its peak. The lock ends all at one "
            "sample in the sum of both times under it, however many cores there are: two threads "
            "reach that where everything is decoded, more help where they trace (the runs `hits`)."
        ),
        needs=("torch",),
    ),
)
