"""Compression of samples: two named profiles, chosen from measured figures (study S47).

| profile | arrays | pictures |
|---|---|---|
| `lossless` | safetensors as they are | half floats, exact: OpenEXR ZIP |
| `compact` | the same behind gzip, exact | OpenEXR DWAB at the coarsest level that keeps the law |

**The law of the tenth**: a codec may add at most a tenth of the noise that is in a picture already.
As errors of log10(1 + radiance), its mean square is at most 0.1 of the stated error's, that is, its
`psnr_log_db` is at least the view's floor + 10 dB. As the two errors are independent, the recorded
floor is then at most 0.41 dB too high; where camera rays miss there is hardly any noise, so this
nearly holds over the pixels that show geometry too. It is tested on what comes back from each file;
a view that no level serves, or serves in fewer bytes, is packed without loss.
"""

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.exr import decode_exr, encode_exr
from storage.records.safe_read import pack_gzip, unpack_gzip

Profile = Literal["lossless", "compact"]
PROFILES: tuple[Profile, ...] = get_args(Profile)

LAW_DB = 10.0
"""Margin of a codec over the stated error: a tenth of its mean square."""

DWA_LEVELS = (200.0, 100.0, 45.0, 20.0, 10.0)
"""What `compact` tries, from coarse to fine. Coarser ones flatten what the eye sees, though the law
would let them."""

PLAIN = "scene.safetensors"
PACKED = "scene.safetensors.gz"
"""Suffixes of the member with a scene's arrays. WebDataset undoes `.gz` by itself."""

MAX_ARRAY_BYTES = 1 << 28
"""Maximum size of a scene's unpacked arrays; a million triangles take 68 MB."""


def pack_picture(
    radiance_rgb: NDArray[np.float32], noise_floor_db: float, profile: Profile
) -> bytes:
    """Return the OpenEXR file of a picture.

    Args:
        radiance_rgb: [R, R, 3] linear radiance, finite, in [0, 65504].
        noise_floor_db: error of the picture as psnr_log_db.
        profile: how to pack it.

    Raises:
        TrilightError: a value that half floats cannot hold.
    """
    exact = encode_exr(radiance_rgb)
    if profile == "lossless":
        return exact
    for level in DWA_LEVELS:
        data = encode_exr(radiance_rgb, level)
        if len(data) >= len(exact):
            break  # finer levels only grow
        if keeps_law(radiance_rgb, decode_exr(data), noise_floor_db):
            return data
    return exact


def keeps_law(
    radiance_rgb: NDArray[np.float32], stored_rgb: NDArray[np.float32], noise_floor_db: float
) -> bool:
    """Return whether a stored picture keeps the law of the tenth; NaN and infinity do not.

    No picture with a floor above 90 dB passes: psnr_log_db ends at 100 dB.
    """
    # NaN compares as false, and an infinite error is -inf dB
    return psnr_log_db(radiance_rgb, stored_rgb) >= noise_floor_db + LAW_DB


def pack_arrays(safetensors: bytes, profile: Profile) -> dict[str, bytes]:
    """Return the member of a scene's arrays, by suffix; equal bytes give equal bytes."""
    if profile == "lossless":
        return {PLAIN: safetensors}
    return {PACKED: pack_gzip(safetensors)}


def unpack_arrays(members: Mapping[str, bytes]) -> bytes:
    """Return a scene's safetensors from a sample's members, whichever way they are packed.

    Raises:
        TrilightError: missing, there in both ways, damaged, or larger than MAX_ARRAY_BYTES.
    """
    forms = [suffix for suffix in (PLAIN, PACKED) if suffix in members]
    if len(forms) != 1:
        raise TrilightError(
            f"member {PLAIN} is {'there in two forms' if forms else 'missing'}; expected it "
            f"or {PACKED}."
        )
    if forms == [PLAIN]:
        return members[PLAIN]
    return unpack_gzip(members[PACKED], MAX_ARRAY_BYTES, f"member {PACKED}")
