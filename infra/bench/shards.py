"""What a sample takes on disk, in memory and in time, by codec; and beside the published HDF5.

On rendered scenes of `smoke`. Times are processor time of one thread, bytes are in memory before a
side begins: neither disk nor network is measured. The HDF5 files are written by our own exporter
from the same scenes, packed as published.
"""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from infra.bench.harness import Comparison, Options, compare
from infra.bench.samples import rendered_samples
from infra.bench.shard_arrays import ARRAYS, COLOURS, SAMPLES, array_sides, sample_sides
from infra.bench.shard_pictures import codecs, picture_side
from pipeline.flows.training_builds import smoke

NAME = "shards"


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure; quickly 4 scenes once, otherwise 16 scenes three times."""
    samples = rendered_samples(smoke(), options, _num_scenes(options), round_done)
    sides: dict[str, Callable[[], Mapping[str, float]]] = {
        f"picture {name}": picture_side(codec, samples) for name, codec in codecs().items()
    }
    with tempfile.TemporaryDirectory() as work:
        sides |= array_sides(samples, Path(work)) | sample_sides(samples, Path(work))
    return compare(NAME, sides, repeats=_repeats(options), round_done=round_done)


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    sides = len(codecs()) + len(COLOURS) * len(ARRAYS) + len(SAMPLES)
    return _num_scenes(options) + sides * (1 + _repeats(options))


def _num_scenes(options: Options) -> int:
    return 4 if options.quick else 16


def _repeats(options: Options) -> int:
    return 1 if options.quick else 3
