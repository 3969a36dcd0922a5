"""At which number of samples a path tracer is as good as something else, and what that takes.

Of one picture, or of the worst of many with costs shared out: the sums are the same.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Bound = Literal["exactly", "at most", "more than"]
"""`at most` where the cheapest is better already, `more than` where none is as good."""


@dataclass(frozen=True, kw_only=True)
class Priced:
    """One picture of a path tracer."""

    spp: float
    """Samples per pixel."""
    core_s: float
    """Core-seconds."""
    db: float
    """psnr_log_db to the reference."""


@dataclass(frozen=True, kw_only=True)
class EqualError:
    """The path tracer at the error of another picture."""

    bound: Bound
    """Whether it has that error."""
    spp: float
    """Samples per pixel, between measured levels."""
    core_s: float
    """Core-seconds of those."""


def at_error(levels: Sequence[Priced], db: float) -> EqualError:
    """Return the samples at which a path tracer first has an error of `db`.

    Between two levels dB are taken linear in log2 of the samples, and core-seconds linear in the
    samples.

    Args:
        levels: rising in samples; one at least.
        db: psnr_log_db of the other picture, to the same reference.
    """
    row = next((row for row, level in enumerate(levels) if level.db >= db), None)
    if row is None:
        return EqualError(bound="more than", spp=levels[-1].spp, core_s=levels[-1].core_s)
    above = levels[row]
    if row == 0:
        bound: Bound = "exactly" if above.db == db else "at most"
        return EqualError(bound=bound, spp=above.spp, core_s=above.core_s)
    below = levels[row - 1]
    share = (db - below.db) / (above.db - below.db)
    spp = below.spp * 2 ** (share * math.log2(above.spp / below.spp))
    slope = (above.core_s - below.core_s) / (above.spp - below.spp)
    core_s = below.core_s + slope * (spp - below.spp)
    return EqualError(bound="exactly", spp=spp, core_s=core_s)
