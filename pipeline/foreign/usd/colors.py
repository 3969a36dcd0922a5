"""Conversion of the colors of a stage to linear Rec.709, which all code here computes in."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def convert_to_rec709(attribute: Any, stated: NDArray) -> NDArray:
    """Return the colors [..., 3 or 4] of an attribute, converted from the color space of USD.

    Colors without a space, and those declared as data, stay as they are.
    """
    from pxr import Gf, Usd, Vt

    is_color = attribute.GetTypeName().scalarType.role == "Color" and stated.shape[-1:] != ()
    space = Usd.ColorSpaceAPI.ComputeColorSpace(attribute, None) if is_color else None
    ours = Gf.ColorSpace(Gf.ColorSpaceNames.LinearRec709)
    if space is None or space.IsData() or space.GetName() in ("", ours.GetName()):
        return stated
    rows = np.ascontiguousarray(stated[..., :3], np.float32)
    span = Vt.FloatArray.FromNumpy(rows.reshape(-1))
    space.ConvertRGBSpan(ours, span)
    return np.concatenate([np.array(span).reshape(rows.shape), stated[..., 3:]], axis=-1)
