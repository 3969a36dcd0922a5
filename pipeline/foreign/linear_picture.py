"""What a picture of floats is, whichever format it has."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearPicture:
    """A picture of floats."""

    values: NDArray[np.float32]
    """[H, W, C], the top row first: grey, grey and alpha, RGB or RGBA. Alpha is not divided out."""
    unread: tuple[str, ...] = ()
    """What of the file is not read, in short sentences."""
