"""What `-h` of a command shows: its everyday options, and lines to copy; `--help-all` shows all."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

ALL_OPTIONS = "--help-all"
HELP_FLAGS = ("--help", "-h", ALL_OPTIONS)

_DATASET = ("objects", "out", "scenes", "seed", "resolution", "noise_floor_db", "changes")
"""What DATASET stands for below."""

_PAGES = """
generate: DATASET workers
    generate tiny --out data/first
    generate tiny --objects FOLDER --scenes 64 --out data/mine
    generate pretrain-256 --noise-floor 46 --seed 7 --out data/big

assets: out budget epsilon own_materials licence
    assets FOLDER --out data/meshes
    assets FOLDER --budget 1024 --own-materials
    assets procedural:8 --epsilon 0.01

plan: DATASET samples cores price
    plan pretrain-256 --scenes 65536
    plan tiny --objects FOLDER --cores 16
    plan textured-256 --noise-floor 46 --price 0.04

status:
    status data/mine
    status s3://bucket/mine --price 0.04
    status data/mine --missing

verify:
    verify data/mine
    verify data/mine --fast
    verify data/mine --repair --objects FOLDER

view:
    view data/mine
    view data/mine/train-000000.tar::000000000
    view room.usdz --checkpoint runs/mine

inspect:
    inspect data/mine
    inspect data/mine --by-template 4
    inspect runs/mine

render: out engine checkpoint resolution noise_floor_db spp seconds view orbit
    render room.usdz --out room.exr
    render room.usdz --engine both --noise-floor 40 --out both.exr
    render room.usdz --orbit 24 --spp 64 --out orbit.mp4

train: data out resume steps changes device lpips begin_with
    train tiny --data data/mine --out runs/mine
    train tiny --data data/mine --out runs/mine --resume
    train pretrain --data data/big --set model=small

evaluate: data split resolution most_scenes lpips out
    evaluate runs/mine --data data/mine
    evaluate default --data data/mine --max-scenes 16
    evaluate runs/mine --data data/mine --split validation

leaderboard: checkpoint pictures width scenes out
    leaderboard data/mine
    leaderboard data/mine --checkpoint runs/mine
    leaderboard data/mine --pictures FOLDER --resolution 64

convert:
    convert room.usdz room.glb
    convert data/mine/train-000000.tar::000000000 room.usdz
    convert room.blend.usdc room.h5 --budget 1536

export:
    export data/mine --form h5 --out data/h5
    export data/mine --form nerfstudio --split test --out data/nerf
    export data/mine --form coco --out data/coco

passes:
    passes data/mine --out data/passes
    passes data/mine --passes depth,normal --out data/passes
    passes room.usdz --resolution 512 --out data/passes

push:
    push data/mine USER/NAME --dry-run
    push data/mine USER/NAME --private
    push runs/mine USER/NAME

submit: DATASET deployment no_watch
    submit slurm tiny --out /shared/mine --scenes 512
    submit kubernetes tiny --out s3://bucket/mine --scenes 512
    submit generate-scenes tiny --out data/mine --scenes 8

submit slurm: DATASET shards_per_task dry_run sbatch at_once
    submit slurm tiny --out /shared/mine --scenes 512 --dry-run
    submit slurm tiny --out /shared/mine --sbatch=--partition=cpu
    submit slurm tiny --out /shared/mine --device gpu --sbatch=--gpus=1

submit kubernetes: DATASET shards_per_task dry_run image where cores
    submit kubernetes tiny --out s3://bucket/mine --dry-run
    submit kubernetes tiny --out s3://bucket/mine --cores 16
    submit kubernetes tiny --out s3://bucket/mine --image REGISTRY/NAME

submit make-by-array: DATASET scheduler shards_per_task
    submit make-by-array tiny --out /shared/mine --scenes 512
    submit make-by-array tiny --out /shared/mine --at-once 8
    submit make-by-array tiny --out s3://bucket/mine --scheduler none

revisit: out cameras lights materials seed resolution noise_floor_db
    revisit data/mine --out data/views --cameras new:4
    revisit data/mine --out data/lit --lights new
    revisit data/mine --out data/sharp --resolution 512

shards list:
    shards list data/mine
    shards list data/mine --split test
    shards list data/mine --where 'lights_per_scene >= 3'

shards select:
    shards select data/mine --template corner --out data/corners
    shards select data/mine --min-noise-floor 40 --out data/clean
    shards select data/mine --where 'spp < 256' --out data/quick

shards merge:
    shards merge data/a data/b --out data/both
    shards merge data/a data/b data/c --out data/all
    shards merge data/a data/b --out data/both --json

shards reshard:
    shards reshard data/mine --scenes-per-shard 64 --out data/large
    shards reshard data/mine --scenes-per-shard 1 --out data/small
    shards reshard data/mine --scenes-per-shard 8 --out data/eight

bench: quick out show
    bench
    bench frontier --quick
    bench gpu

model:
    model small
    model large --triangles 4096 --resolution 512
    model runs/mine

presets:
    presets
    presets tiny
    presets --extend FILE.py

doctor:
    doctor
    doctor --measure
    doctor --json
"""
"""Of each command: its words, the fields of its everyday options (none: all), and examples."""


class Everyday(NamedTuple):
    """What a first month needs of a command."""

    examples: Sequence[str]
    """Lines to copy, of at most 77 characters."""
    options: Sequence[str]
    """Fields whose options `-h` shows beside the arguments; empty for all."""


def _pages() -> Iterator[tuple[str, Everyday]]:
    for page in _PAGES.replace("DATASET", " ".join(_DATASET)).split("\n\n"):
        head, *examples = page.strip().splitlines()
        name, _, options = head.partition(":")
        yield name, Everyday([f"trilight {line.strip()}" for line in examples], options.split())


EVERYDAY: Mapping[str, Everyday] = dict(_pages())
"""By the words of a command."""
