"""Random seeds by name: every draw depends on its purpose, never on earlier draws.

A stage asks for the generator of (seed, purpose, index, attempt, ...). Scene 7 is therefore the
same scene whether it is made first, last, alone, or on another machine. Seed 0 is an ordinary seed.
"""

import hashlib
from dataclasses import dataclass

import numpy as np


def rng_for(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """Return the generator that belongs to one purpose.

    Args:
        seed: the seed of the whole dataset, any integer from 0.
        purpose: what the numbers are for, such as "scene" or "camera".
        indices: what tells this use from others, such as scene index and attempt.

    Returns:
        An independent PCG64 generator; equal arguments always give equal streams.
    """
    return np.random.default_rng(np.frombuffer(_name_digest(seed, purpose, indices), np.uint32))


def seed_for(seed: int, purpose: str, *indices: int) -> int:
    """Return a 31-bit seed for libraries that want a number, by the same rule as `rng_for`."""
    return int.from_bytes(_name_digest(seed, purpose, indices)[:4], "little") & 0x7FFFFFFF


def _name_digest(seed: int, purpose: str, indices: tuple[int, ...]) -> bytes:
    name = "/".join([str(int(seed)), purpose, *(str(int(index)) for index in indices)])
    return hashlib.sha256(name.encode()).digest()


@dataclass(frozen=True)
class SceneKey:
    """The numbers that a composed scene follows from, beside settings and objects."""

    seed: int
    index: int
    """Index of the scene in the dataset, from 0."""
    attempt: int = 0
    """Number of earlier rejections of this scene."""

    def rng(self, purpose: str, *indices: int) -> np.random.Generator:
        """Return the generator of this attempt for one purpose; arguments as `rng_for`."""
        return rng_for(self.seed, purpose, self.index, self.attempt, *indices)
