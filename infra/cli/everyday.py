"""What `-h` of a command shows: its everyday options, and lines to copy; `--help-all` shows all."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

ALL_OPTIONS = "--help-all"
HELP_FLAGS = ("--help", "-h", ALL_OPTIONS)

_DATASET = ("objects", "out", "scenes", "seed", "resolution", "noise_floor_db", "changes")
_ARRAY = (*_DATASET, "shards_per_task", "dry_run")


class Everyday(NamedTuple):
    """What a first month needs of a command."""

    examples: Sequence[str]
    """Command lines."""
    options: Sequence[str] = ()
    """Fields whose options `-h` shows beside the arguments; empty for all."""


EVERYDAY: Mapping[str, Everyday] = {
    "generate": Everyday(
        (
            "trilight generate tiny --out data/first",
            "trilight generate tiny --objects FOLDER --scenes 64 --out data/mine",
            "trilight generate pretrain-256 --noise-floor 46 --seed 7 --out data/big",
        ),
        (*_DATASET, "workers"),
    ),
    "assets": Everyday(
        (
            "trilight assets FOLDER --out data/meshes",
            "trilight assets FOLDER --budget 1024 --own-materials",
            "trilight assets procedural:8 --epsilon 0.01",
        ),
        ("out", "budget", "epsilon", "own_materials", "licence"),
    ),
    "plan": Everyday(
        (
            "trilight plan pretrain-256 --scenes 65536",
            "trilight plan tiny --objects FOLDER --cores 16",
            "trilight plan textured-256 --noise-floor 46 --price 0.04",
        ),
        (*_DATASET, "samples", "cores", "price"),
    ),
    "status": Everyday(
        (
            "trilight status data/mine",
            "trilight status s3://bucket/mine --price 0.04",
            "trilight status data/mine --missing",
        )
    ),
    "verify": Everyday(
        (
            "trilight verify data/mine",
            "trilight verify data/mine --fast",
            "trilight verify data/mine --repair --objects FOLDER",
        )
    ),
    "view": Everyday(
        (
            "trilight view data/mine",
            "trilight view data/mine/train-000000.tar::000000000",
            "trilight view room.usdz --checkpoint runs/mine",
        )
    ),
    "inspect": Everyday(
        (
            "trilight inspect data/mine",
            "trilight inspect data/mine --by-template 4",
            "trilight inspect runs/mine",
        )
    ),
    "render": Everyday(
        (
            "trilight render room.usdz --out room.exr",
            "trilight render room.usdz --engine both --noise-floor 40 --out both.exr",
            "trilight render room.usdz --orbit 24 --spp 64 --out orbit.mp4",
        ),
        (
            *("out", "engine", "checkpoint", "resolution", "noise_floor_db", "spp", "seconds"),
            *("view", "orbit"),
        ),
    ),
    "train": Everyday(
        (
            "trilight train tiny --data data/mine --out runs/mine",
            "trilight train tiny --data data/mine --out runs/mine --resume",
            "trilight train pretrain --data data/big --set model=small",
        ),
        ("data", "out", "resume", "steps", "changes", "device", "lpips", "begin_with"),
    ),
    "evaluate": Everyday(
        (
            "trilight evaluate runs/mine --data data/mine",
            "trilight evaluate default --data data/mine --max-scenes 16",
            "trilight evaluate runs/mine --data data/mine --split validation",
        ),
        ("data", "split", "resolution", "most_scenes", "lpips", "out"),
    ),
    "leaderboard": Everyday(
        (
            "trilight leaderboard data/mine",
            "trilight leaderboard data/mine --checkpoint runs/mine",
            "trilight leaderboard data/mine --pictures FOLDER --resolution 64",
        ),
        ("checkpoint", "pictures", "width", "scenes", "out"),
    ),
    "convert": Everyday(
        (
            "trilight convert room.usdz room.glb",
            "trilight convert data/mine/train-000000.tar::000000000 room.usdz",
            "trilight convert room.blend.usdc room.h5 --budget 1536",
        )
    ),
    "export": Everyday(
        (
            "trilight export data/mine --form h5 --out data/h5",
            "trilight export data/mine --form nerfstudio --split test --out data/nerf",
            "trilight export data/mine --form coco --out data/coco",
        )
    ),
    "passes": Everyday(
        (
            "trilight passes data/mine --out data/passes",
            "trilight passes data/mine --passes depth,normal --out data/passes",
            "trilight passes room.usdz --resolution 512 --out data/passes",
        )
    ),
    "push": Everyday(
        (
            "trilight push data/mine USER/NAME --dry-run",
            "trilight push data/mine USER/NAME --private",
            "trilight push runs/mine USER/NAME",
        )
    ),
    "submit": Everyday(
        (
            "trilight submit slurm tiny --out /shared/mine --scenes 512",
            "trilight submit kubernetes tiny --out s3://bucket/mine --scenes 512",
            "trilight submit generate-scenes tiny --out data/mine --scenes 8",
        ),
        (*_DATASET, "deployment", "no_watch"),
    ),
    "submit slurm": Everyday(
        (
            "trilight submit slurm tiny --out /shared/mine --scenes 512 --dry-run",
            "trilight submit slurm tiny --out /shared/mine --sbatch=--partition=cpu",
            "trilight submit slurm tiny --out /shared/mine --device gpu --sbatch=--gpus=1",
        ),
        (*_ARRAY, "sbatch", "at_once"),
    ),
    "submit kubernetes": Everyday(
        (
            "trilight submit kubernetes tiny --out s3://bucket/mine --dry-run",
            "trilight submit kubernetes tiny --out s3://bucket/mine --cores 16",
            "trilight submit kubernetes tiny --out s3://bucket/mine --image REGISTRY/NAME",
        ),
        (*_ARRAY, "image", "where", "cores"),
    ),
    "submit make-by-array": Everyday(
        (
            "trilight submit make-by-array tiny --out /shared/mine --scenes 512",
            "trilight submit make-by-array tiny --out /shared/mine --at-once 8",
            "trilight submit make-by-array tiny --out s3://bucket/mine --scheduler none",
        ),
        (*_DATASET, "scheduler", "shards_per_task"),
    ),
    "revisit": Everyday(
        (
            "trilight revisit data/mine --out data/views --cameras new:4",
            "trilight revisit data/mine --out data/lit --lights new",
            "trilight revisit data/mine --out data/sharp --resolution 512",
        ),
        ("out", "cameras", "lights", "materials", "seed", "resolution", "noise_floor_db"),
    ),
    "shards list": Everyday(
        (
            "trilight shards list data/mine",
            "trilight shards list data/mine --split test",
            "trilight shards list data/mine --where 'lights_per_scene >= 3'",
        )
    ),
    "shards select": Everyday(
        (
            "trilight shards select data/mine --template corner --out data/corners",
            "trilight shards select data/mine --min-noise-floor 40 --out data/clean",
            "trilight shards select data/mine --where 'spp < 256' --out data/quick",
        )
    ),
    "shards merge": Everyday(
        (
            "trilight shards merge data/a data/b --out data/both",
            "trilight shards merge data/a data/b data/c --out data/all",
            "trilight shards merge data/a data/b --out data/both --json",
        )
    ),
    "shards reshard": Everyday(
        (
            "trilight shards reshard data/mine --scenes-per-shard 64 --out data/large",
            "trilight shards reshard data/mine --scenes-per-shard 1 --out data/small",
            "trilight shards reshard data/mine --scenes-per-shard 8 --out data/eight",
        )
    ),
    "bench": Everyday(
        (
            "trilight bench",
            "trilight bench frontier --quick",
            "trilight bench gpu",
        ),
        ("quick", "out", "show"),
    ),
    "model": Everyday(
        (
            "trilight model small",
            "trilight model large --triangles 4096 --resolution 512",
            "trilight model runs/mine",
        )
    ),
    "presets": Everyday(
        (
            "trilight presets",
            "trilight presets --json",
            "trilight presets --extend FILE.py",
        )
    ),
    "doctor": Everyday(
        (
            "trilight doctor",
            "trilight doctor --measure",
            "trilight doctor --json",
        )
    ),
}
"""By the words of a command."""
