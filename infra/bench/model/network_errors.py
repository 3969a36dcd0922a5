"""How far two outputs of a network are apart, as pictures."""

from torch import Tensor

from storage.conventions import radiance_from_log10
from storage.metrics import psnr_log_db


def log10_psnr_db(picture: Tensor, reference: Tensor) -> float:
    """Return psnr_log_db of two outputs, log10(1 + radiance) of any sign and one shape.

    Before the ELU, which would hide what is wrong in the dark.
    """
    a, b = (radiance_from_log10(one.double().numpy()) for one in (picture, reference))
    return psnr_log_db(a, b)
