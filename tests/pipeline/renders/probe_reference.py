"""Prints PROBE_PICTURE of pipeline.renders.mitsuba_variant.

python -m tests.pipeline.renders.probe_reference
"""

import sys

import numpy as np

from pipeline.renders.mitsuba_variant import activate, choose_variant

if __name__ == "__main__":
    activate(choose_variant())
    from pipeline.renders.variant_probe import probe_blocks  # which needs a variant

    taken = np.stack([probe_blocks(seed)[0] for seed in range(1, 1025)])
    mean, deviation = taken.mean(axis=0), taken.std(axis=0, ddof=1)
    for row in np.concatenate([mean, deviation], axis=-1).reshape(16, 6):
        sys.stdout.write(" ".join(f"{number:#.4g}" for number in row) + "\n")
