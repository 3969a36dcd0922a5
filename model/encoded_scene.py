"""Encoded scenes: the output of the view-independent stage, which any view reads."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from model.attention import Keys
from model.packing import Packing, pack_lengths, supports_packed

if TYPE_CHECKING:
    from model.hits.lit_scene import LitScene
    from model.hits.tracing import TracedScene

KeysValues = tuple[Tensor, Tensor]
"""Keys, not yet rotated into a camera, and values of one layer; [B, H, N, D] each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TokenPositions:
    """Positions of the tokens of scenes: registers first, then triangles."""

    positions_BN33: Tensor
    """Three vertices each, world space; a register stands at the mean vertex, three times over."""
    scale_BN11: Tensor
    """Factor of the positions in any frame: 1 except for published registers, whose mean divides by
    slightly more than the number of triangles."""
    is_key_BN: Tensor | None
    """bool, False in the padding; None where nothing is padded."""
    lengths: tuple[int, ...] | None = None
    """Number of tokens of each padded scene, as in `is_key_BN`, but known to the host without a
    wait for the device; None if unknown."""

    def packing(self, x: Tensor, head_width: int) -> Packing | None:
        """Return the packing of the tokens, or None if attention uses masks.

        Args:
            x: tensor with the device and type of the attention.
        """
        if self.lengths is None or not supports_packed(x, head_width):
            return None
        return pack_lengths(self.lengths, self.positions_BN33.shape[1], x.device)


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedScene:
    """A batch of encoded scenes, for any number of views.

    Keys are stored before their rotation, since that depends on the camera.
    """

    places: TokenPositions
    """Positions of all tokens, registers included."""
    keys_values: tuple[KeysValues, ...]
    """Keys and values for each layer of the view stage; for `hits`, keys are rotated into world
    space."""
    packing: Packing | None = None
    """Packing of the tokens, scene after scene in one row [1, H, P, D]; None for padded scenes."""
    traced: "tuple[TracedScene, ...]" = ()
    """Scenes ready for ray casting, for `hits`; empty if the views are traced already."""
    surfaces: "tuple[LitScene, ...]" = ()
    """Scenes ready for albedo rays, for demodulated bundles; empty if the albedo is known."""

    def keys(self, views: int = 1) -> Keys:
        """Return the valid keys; packed ones are repeated for each view, view after view."""
        return self.places.is_key_BN if self.packing is None else self.packing.of_views(views)
