"""What remains of a scene after the view-independent stage: all that any view of it needs."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from model.attention import Keys
from model.packing import Packing, pack_lengths, takes_packed

if TYPE_CHECKING:
    from model.hits.lit_scene import LitScene
    from model.hits.tracing import TracedScene

KeysValues = tuple[Tensor, Tensor]
"""Keys, not yet rotated into a camera, and values of one layer; [B, H, N, D] each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TokenPlaces:
    """Where the tokens of scenes stand: registers first, then triangles."""

    positions_BN33: Tensor
    """Three vertices each, world space; a register stands at the mean vertex, three times over."""
    scale_BN11: Tensor
    """Factor of the positions in whatever frame they are asked for: 1 but for published registers,
    whose mean divides by a little more than the number of triangles."""
    is_key_BN: Tensor | None
    """bool, False in the padding; None where nothing is padded."""
    lengths: tuple[int, ...] | None = None
    """Tokens of each scene, where they are the first of each and `is_key_BN` says so too. The host
    knows them without waiting for the device."""

    def packing(self, x: Tensor, head_width: int) -> Packing | None:
        """Return where the tokens of scenes are when packed; None where masks are meant.

        Args:
            x: what attention is computed with.
            head_width: of that attention.
        """
        if self.lengths is None or not takes_packed(x, head_width):
            return None
        return pack_lengths(self.lengths, self.positions_BN33.shape[1], x.device)


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedScene:
    """A batch of scenes, ready to be seen from anywhere.

    Keys are kept before their rotation, since that carries the camera: rotated ones would be wrong
    for the next view.
    """

    places: TokenPlaces
    """Positions of the tokens."""
    keys_values: tuple[KeysValues, ...]
    """Keys and values for each layer of the view stage; for that of hits, keys are rotated into the
    world."""
    packing: Packing | None = None
    """Where their tokens are: scene after scene in one row [1, H, P, D]; None where scenes are
    padded."""
    traced: "tuple[TracedScene, ...]" = ()
    """Of the view stage of hits: each scene, ready for rays; none where its views come traced."""
    surfaces: "tuple[LitScene, ...]" = ()
    """Of demodulated bundles: each scene, whose albedo rays ask; none where it is known."""

    def keys(self, views: int = 1) -> Keys:
        """Return which keys exist; packed ones for each view, all scenes of a view together."""
        return self.places.is_key_BN if self.packing is None else self.packing.of_views(views)
