"""HDR pictures (floats), OpenEXR or Radiance, recognized by their first bytes."""

from pipeline.foreign import openexr, radiance_hdr
from pipeline.foreign.linear_picture import LinearPicture
from storage.errors import Rejected
from storage.records.exr import MAGIC


def read_linear_picture(
    data: bytes, max_pixels: int, *, is_color: bool = True
) -> LinearPicture | None:
    """Return the picture of a file in linear Rec.709, or None where it is of another format.

    Args:
        data: the file.
        max_pixels: maximum number of pixels, checked before memory is allocated.
        is_color: whether its numbers are colors, which its primaries apply to.

    Raises:
        Rejected: not_hdr, load_error or too_many_pixels.
    """
    try:
        if data.startswith(MAGIC):
            return openexr.read_openexr(data, max_pixels, is_color=is_color)
        if data.startswith(radiance_hdr.MAGIC):
            return radiance_hdr.read_radiance_hdr(data, max_pixels, is_color=is_color)
    except (ValueError, LookupError, ArithmeticError) as error:  # such as names that are not UTF-8
        raise Rejected("load_error", "it is damaged; write it again") from error
    return None
