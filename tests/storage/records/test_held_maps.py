"""Held maps: what unpacking gives, once, in bounded memory, and never in the place of a refusal."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from storage.errors import TrilightError
from storage.records import packed_maps
from storage.records.environment import Environment
from storage.records.held_maps import HeldMaps, with_same_content
from storage.records.map_references import map_member
from storage.records.sample import decode_sample, encode_sample
from storage.records.texture import MapSource, Texture
from tests.textured_by_hand import colour_texture, sky, textured_sample, textured_scene

KEY = "000000000"


def test_equal_members_give_equal_samples_with_and_without_what_is_held() -> None:
    """Another name and another turn of the same maps: both are the entry's, not the held one's."""
    turned = sky(rotation=np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32), is_seen=True)
    renamed = dataclasses.replace(turned, source=MapSource(name="dusk", licence="CC-BY-4.0"))
    first = encode_sample(textured_sample(KEY))
    scene = textured_scene(environment=renamed)
    second = encode_sample(dataclasses.replace(textured_sample(KEY), scene=scene))
    held = HeldMaps()
    for members in (first, second, first):
        found, plain = decode_sample(KEY, members, held), decode_sample(KEY, members)
        found.check()
        assert encode_sample(found) == encode_sample(plain) == members
        assert found.scene.environment is not None and plain.scene.environment is not None
        assert found.scene.environment.source == plain.scene.environment.source
        assert found.scene.environment.is_seen == plain.scene.environment.is_seen


def test_a_map_is_unpacked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    members, unpacked = encode_sample(textured_sample(KEY)), list[str]()
    values = packed_maps._Packed.values

    def counted(packed: packed_maps._Packed) -> np.ndarray:
        unpacked.append(packed.name)
        return values(packed)

    monkeypatch.setattr(packed_maps._Packed, "values", counted)
    held = HeldMaps()
    scenes = [decode_sample(KEY, members, held).scene for _ in range(3)]
    assert len(unpacked) == len(set(unpacked)) == 3
    one, other = scenes[0].textures[0], scenes[2].textures[0]
    assert one.texels is other.texels
    with pytest.raises(ValueError, match="read-only"):
        one.texels[0] = 0


def test_memory_is_bounded_and_the_oldest_goes() -> None:
    held, made = HeldMaps(most_bytes=1000), list[int]()

    def asked(number: int, side: int = 10) -> Texture:
        def unpack() -> Texture:
            made.append(number)
            return Texture(texels=np.full((side, side, 3), number, np.uint8))

        return held.found(Texture, f"{number:064x}", b"%d" % number, unpack)

    for number in (1, 2, 3, 1, 4, 1, 2):  # 300 bytes each: 4 takes the place of 2
        assert asked(number).texels[0, 0, 0] == number
        assert held.num_bytes <= 1000
    assert made == [1, 2, 3, 4, 2]
    asked(9, side=20)
    asked(9, side=20)  # larger than all that may be held
    assert made[-2:] == [9, 9] and held.num_bytes <= 1000


def test_what_is_refused_stays_refused() -> None:
    """A damaged copy of a held map, a held map under another name, and one of another kind."""
    held = HeldMaps()
    members = encode_sample(textured_sample(KEY))
    decode_sample(KEY, members, held)
    name, other = map_member(colour_texture().sha256), map_member(sky().sha256)
    for wrong in (members[name][:-9], members[other], encode_sample(textured_sample(KEY, 1))):
        swapped = wrong if isinstance(wrong, bytes) else wrong[map_member(colour_texture(1).sha256)]
        for _ in range(2):
            with pytest.raises(TrilightError):
                decode_sample(KEY, {**members, name: swapped}, held)
    decode_sample(KEY, members, held)


def test_threads_share_it() -> None:
    members, held = encode_sample(textured_sample(KEY)), HeldMaps()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: decode_sample(KEY, members, held), range(16)))
    assert all(encode_sample(each) == members for each in found)
    assert held.num_bytes == sum(
        each.nbytes for each in (*(t.texels for t in found[0].scene.textures), sky().radiance_rgb)
    )


def test_what_is_known_of_a_content_stays_known() -> None:
    one = colour_texture()
    digest, mean = one.sha256, one.mean
    other = with_same_content(one, source=MapSource(name="another"))
    assert vars(other)["sha256"] == digest and vars(other)["mean"] is mean
    assert other.source.name == "another" and one.source.name != "another"
    turned = with_same_content(sky(), is_seen=True)
    assert isinstance(turned, Environment) and turned.is_seen
