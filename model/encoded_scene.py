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
    """Where the tokens of scenes stand: registers first, cells of a sky, then triangles."""

    positions_BN33: Tensor
    """Three vertices each, world space; what is no triangle stands at the mean vertex, three times
    over."""
    scale_BN11: Tensor
    """Factor of the positions in whatever frame they are asked for: 1 but for published registers,
    whose mean divides by a little more than the number of triangles."""
    is_key_BN: Tensor | None
    """bool, False in the padding; None where nothing is padded."""
    num_registers: int
    """How many belong to no triangle: registers and cells of the sky, which come first."""
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

    def only(self, index: int) -> "EncodedScene":
        """Return one scene of the batch, without the padding that its company brought."""
        places = self.places
        is_key_N = None if places.is_key_BN is None else places.is_key_BN[index]
        num_registers = places.num_registers
        if is_key_N is not None:
            num_registers = int(is_key_N[:num_registers].sum())
        exists = slice(None) if is_key_N is None else is_key_N
        return EncodedScene(
            places=TokenPlaces(
                positions_BN33=places.positions_BN33[[index]][:, exists],
                scale_BN11=places.scale_BN11[[index]][:, exists],
                is_key_BN=None,
                num_registers=num_registers,
            ),
            keys_values=tuple(
                (self._of(index, k, exists), self._of(index, v, exists))
                for k, v in self.keys_values
            ),
            traced=self.traced[index : index + 1],
            surfaces=self.surfaces[index : index + 1],
        )

    def _of(self, index: int, x: Tensor, exists: Tensor | slice) -> Tensor:
        """Return keys or values [1, H, N, D] of one scene."""
        lengths = self.places.lengths
        if self.packing is None or lengths is None:
            return x[[index]][:, :, exists]
        first = sum(lengths[:index])
        return x[:, :, first : first + lengths[index]]
