"""An object source of your own: `dice:N`, boxes of N different shapes.

    trilight generate tiny --extend object_source.py --objects dice:40 --out data/dice

A source returns a record for each object, with its licence: what states none is not used. It may
write files, as here, or leave them where they are; what is far away is fetched later, and only what
may be used (`Listing.fetch`). The same words must always stand for the same objects.
"""

import itertools

import numpy as np

from trilight.extend import (
    SOURCES,
    Listing,
    ObjectRecord,
    ObjectSource,
    SourceQuery,
    TrilightError,
    encode_ply,
    rng_for,
    write_atomically,
)

CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
FACES = np.array(
    [list(map(int, face)) for face in "013 032 467 475 045 051 237 276 026 064 157 173".split()]
)


def list_dice(asked: SourceQuery) -> Listing:
    """Write the boxes that a person asks for, and return what they are."""
    if not (asked.after_colon.isdecimal() and 1 <= int(asked.after_colon) <= 1000):
        raise TrilightError(f"objects is {asked.source!r}; expected dice:N with N from 1 to 1000.")
    records = []
    for number in range(int(asked.after_colon)):
        half_sizes = rng_for(0, "dice", number).uniform(0.3, 1.0, size=3)
        path = asked.work_dir / "dice" / f"{number:04d}.ply"
        write_atomically(path, encode_ply(CORNERS * half_sizes, FACES))
        records.append(
            ObjectRecord(
                uid=f"dice/{number:04d}",
                path=str(path.resolve()),
                title=f"die {number}",
                licence="CC0-1.0",
                licence_source="examples/object_source.py",
                attribution="",
                source_url="",
            )
        )
    return Listing(records=records, failures=[])


SOURCES.register("dice", ObjectSource(list=list_dice))
