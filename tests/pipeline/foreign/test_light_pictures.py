"""OpenEXR and Radiance pictures of strangers, by writers of the tests' own: read back equal."""

import io
import itertools
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.foreign.linear_picture import (
    REC709,
    LinearPicture,
    luminance_weights,
    rec709_from,
)
from pipeline.foreign.picture import read_linear_picture
from storage.errors import Rejected, TrilightError
from storage.records.exr import decode_exr, read_header
from tests.for_each import for_each

ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33766)
MOST = 1 << 16

Window = tuple[int, int, int, int]
"""Left, top, width and height."""


def read(data: bytes, *, is_color: bool = True) -> LinearPicture:
    picture = read_linear_picture(data, MOST, is_color=is_color)
    assert picture is not None
    return picture


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value


def _box(window: Window) -> bytes:
    left, top, width, height = window
    return struct.pack("<4i", left, top, left + width - 1, top + height - 1)


def raw_exr(
    channels: Mapping[str, tuple[NDArray[Any], int]],
    data_window: Window,
    display: Window,
    extra: bytes = b"",
    *,
    is_decreasing: bool = False,
) -> bytes:
    """Return an uncompressed file of scanlines by the format's text; channels with samplings."""
    kinds = {"u": 0, "f2": 1, "f4": 2}
    names, (_, top, _, height) = sorted(channels), data_window

    def kind(values: NDArray[Any]) -> int:
        return kinds["u" if values.dtype.kind == "u" else values.dtype.str[1:]]

    listed = b"".join(
        f"{name}\0".encode() + struct.pack("<iiii", kind(values), 0, step, step)
        for name, (values, step) in sorted(channels.items())
    )
    head = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    head += _attribute("channels", "chlist", listed + b"\0")
    head += _attribute("compression", "compression", b"\0")
    head += _attribute("dataWindow", "box2i", _box(data_window))
    head += _attribute("displayWindow", "box2i", _box(display))
    head += _attribute("lineOrder", "lineOrder", bytes([is_decreasing]))
    for name, value in (("pixelAspectRatio", 1.0), ("screenWindowWidth", 1.0)):
        head += _attribute(name, "float", struct.pack("<f", value))
    head += _attribute("screenWindowCenter", "v2f", bytes(8)) + extra + b"\0"
    lines = {
        y: b"".join(
            values[y // step - -(-top // step)].tobytes()
            for values, step in (channels[name] for name in names)
            if y % step == 0
        )
        for y in range(top, top + height)
    }
    body, offsets = b"", {}
    for y in sorted(lines, reverse=is_decreasing):
        offsets[y] = len(head) + 8 * height + len(body)
        body += struct.pack("<ii", y, len(lines[y])) + lines[y]
    return head + b"".join(struct.pack("<Q", offsets[y]) for y in sorted(lines)) + body


def of_library(channels: Mapping[str, NDArray[Any]], **header: Any) -> bytes:
    stream = io.BytesIO()
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, dict(channels)).write(stream)
    return stream.getvalue()


def noise(*shape: int, seed: int = 0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).random(shape, np.float32)


_CORNERS = st.integers(-9, 9)
_SIZES = st.integers(1, 12)
_WINDOWS = st.tuples(_CORNERS, _CORNERS, _SIZES, _SIZES)


@given(
    window=_WINDOWS,
    display=_WINDOWS,
    names=st.sampled_from(["RGB", "rgb", "BGRA", ("beauty.R", "beauty.G", "beauty.B"), "Y", "L"]),
    kind=st.sampled_from([np.float16, np.float32, np.uint32]),
    is_decreasing=st.booleans(),
)
def test_any_windows_channels_and_types_give_the_picture_that_is_displayed(
    window: Window, display: Window, names: Any, kind: Any, is_decreasing: bool
) -> None:
    left, top, width, height = window
    stored = (noise(height, width, len(names)) * 1000).astype(kind)
    order = ["RGBA".find(name[-1].upper()) for name in names]
    planes = {name: (stored[..., max(at, 0)], 1) for name, at in zip(names, order, strict=True)}
    picture = read(raw_exr(planes, window, display, is_decreasing=is_decreasing))
    expected = np.zeros((display[3], display[2], len(names)), np.float32)
    for row, column in itertools.product(range(display[3]), range(display[2])):
        y, x = row + display[1] - top, column + display[0] - left
        if 0 <= y < height and 0 <= x < width:
            expected[row, column] = stored[y, x]
    np.testing.assert_array_equal(picture.values, expected)
    assert picture.unread == ()


@for_each("name", [name for name in dir(OpenEXR) if name.endswith("_COMPRESSION")])
def test_every_compression_and_tiles_are_read(name: str) -> None:
    rgb = np.linspace(0.2, 0.8, 24 * 40 * 3, dtype=np.float32).reshape(24, 40, 3)
    for more in ({}, {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}):
        data = of_library({"RGB": rgb}, compression=getattr(OpenEXR, name), **more)
        np.testing.assert_allclose(read(data).values, rgb, atol=0.02)  # some lose


def test_luminance_and_chroma_are_colors() -> None:
    """Chroma of every second pixel both ways; a picture of one color but for its brightness."""
    brightness = noise(10, 14) + 0.5
    rgb = brightness[..., None] * np.array([0.7, 0.4, 0.2], np.float32)
    luminance = (rgb @ luminance_weights(REC709)).astype(np.float32)
    chroma = {
        name: ((rgb[..., at] - luminance)[::2, ::2] / luminance[::2, ::2], 2)
        for name, at in (("RY", 0), ("BY", 2))
    }
    window = (-4, 2, 14, 10)
    data = raw_exr({"Y": (luminance, 1), **chroma}, window, window)
    np.testing.assert_allclose(read(data).values, rgb, rtol=1e-5)


@for_each("attributes", [
    {"chromaticities": ACESCG}, {"colorInteropID": "lin_ap1_scene"}, {"oiio:ColorSpace": "ACEScg"}
])  # fmt: skip
def test_one_picture_in_two_color_spaces_is_one_picture(attributes: Mapping[str, Any]) -> None:
    rgb = noise(4, 8, 3)
    matrix = rec709_from(ACESCG)
    np.testing.assert_allclose(matrix @ np.ones(3), 1, atol=1e-6)  # white stays white
    twin = (rgb @ np.linalg.inv(matrix).T).astype(np.float32)
    data = of_library({"RGB": twin}, **attributes)
    np.testing.assert_allclose(read(data).values, rgb, atol=1e-4)  # digits of primaries
    np.testing.assert_array_equal(read(data, is_color=False).values, twin)


def test_what_is_not_read_is_named_and_an_environment_fills_its_data() -> None:
    channels = {name: noise(2, 4) for name in "RGBZ"}
    data = of_library(channels, whiteLuminance=100.0, pixelAspectRatio=2.0, owner="Ada")
    header = "header attributes 'pixelAspectRatio', 'whiteLuminance'"
    assert read(data).unread == ("channels 'Z'", header)
    planes = {name: (noise(2, 4), 1) for name in "RGB"}
    sky = _attribute("envmap", "envmap", b"\0")
    assert read(raw_exr(planes, (1, 1, 4, 2), (0, 0, 9, 9), sky)).values.shape == (2, 4, 3)
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"RGB": noise(2, 4, 3)}, "left"),
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"Z": noise(2, 4)}, "depth"),
    ]
    stream = io.BytesIO()
    OpenEXR.File(parts).write(stream)
    assert read(stream.getvalue()).unread == ("channels 'Z'",)
    named = {name: noise(2, 4) for name in ("red", "green", "blue")}
    np.testing.assert_array_equal(read(of_library(dict(named))).values[..., 0], named["red"])


def test_files_of_openexr_that_are_not_read_say_why() -> None:
    rgb = noise(4, 4, 3)
    deep: NDArray[Any] = np.full((2, 2), None, object)
    for at in np.ndindex(2, 2):
        deep[at] = np.ones(1, np.float32)
    layers = {f"{layer}.{letter}": noise(4, 4) for layer in "ab" for letter in "RGB"}
    planes = {name: (noise(2, 4), 1) for name in "RGB"}
    window = (0, 0, 4, 2)
    deep_header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    for data, message in (
        (of_library(dict.fromkeys("RGB", deep), **deep_header), "it is deep"),
        (of_library(layers), "its layers 'a', 'b' are pictures each"),
        (of_library({"Z": noise(4, 4)}), "its channels are Z; expected R, G and B"),
        (of_library({"a.Depth.V": noise(4, 4)}), "its channels are a.Depth.V; expected"),
        (of_library({"X": noise(4, 4), "Y": noise(4, 4), "Z": noise(4, 4)}), "are X, Y, Z"),
        (of_library({"RGB": rgb}, envmap=OpenEXR.ENVMAP_CUBE), "it is a cube map"),
        (of_library({"RGB": rgb}, colorInteropID="srgb_rec709_scene"), "'srgb_rec709_scene'"),
        (of_library({"RGB": rgb}, chromaticities=(0.0,) * 8), "its primaries are"),
        (raw_exr(planes, window, (0, 0, 1 << 12, 1 << 12)), "4096 x 4096; expected at most 65536"),
    ):
        with pytest.raises(Rejected, match=message):
            read(data)


@for_each("flag", [0, 0x1000])
@for_each("what", ["attributes", "channels", "value"])
def test_a_header_is_counted_before_the_library_reads_it(what: str, flag: int) -> None:
    channels = b"".join(b"c%d\0" % row + struct.pack("<4i", 1, 0, 1, 1) for row in range(100_000))
    extra = {
        "attributes": b"".join(_attribute(f"a{row}", "string", b"abcd") for row in range(150_000)),
        "channels": _attribute("more", "chlist", channels + b"\0"),
        "value": _attribute("a", "string", b"")[:-4] + struct.pack("<I", 2**31 - 1),
    }[what]
    data = raw_exr({name: (noise(2, 4), 1) for name in "RGB"}, (0, 0, 4, 2), (0, 0, 4, 2), extra)
    data = data[:4] + struct.pack("<I", 2 | flag) + data[8:]
    began = time.process_time()
    with pytest.raises(Rejected, match="expected at most 4096, 262144 and 16777216"):
        read(data)
    for decode in (decode_exr, read_header):
        with pytest.raises(TrilightError, match="picture: its header has"):
            decode(data)
    assert time.process_time() - began < 1


@for_each("tiled", [False, True])
def test_a_file_that_ends_early_is_refused_wherever_it_ends(tiled: bool) -> None:
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    data = of_library({"RGB": noise(40, 40, 3)}, **(tiles if tiled else {}))
    for length in (*range(8, len(data), 97), len(data) - 1):
        with pytest.raises(Rejected, match="cut off"):
            read(data[:length])


def radiance_hdr(
    texels: NDArray[np.uint8], coding: str = "flat", header: str = "", size: str = "-Y {} +X {}"
) -> bytes:
    """Return a Radiance picture of scanlines [H, W, 4] in runs, runs of the old kind, or flat."""
    rows, columns = texels.shape[:2]
    out = io.BytesIO()
    out.write(f"#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\n{header}\n".encode())
    out.write(f"{size.format(rows, columns)}\n".encode())
    for row in texels:
        if coding == "flat":
            out.write(row.tobytes())
        elif coding == "old":
            for texel, run in itertools.groupby(row.tolist()):
                count = len(list(run)) - 1
                out.write(bytes(texel))
                while count:  # the least significant eight bits first
                    out.write(bytes([1, 1, 1, count & 255]))
                    count >>= 8
        else:
            out.write(bytes([2, 2, columns >> 8, columns & 255]))
            for channel in range(4):
                at = 0
                while at < columns:
                    values = row[at : at + 127, channel]
                    is_run = bool((values == values[0]).all())
                    out.write(bytes([len(values) + 128 * is_run]))
                    out.write(bytes([values[0]]) if is_run else values.tobytes())
                    at += len(values)
    return out.getvalue()


def _texels(rows: int, columns: int) -> NDArray[np.uint8]:
    texels = np.random.default_rng(1).integers(2, 256, (rows, columns, 4)).astype(np.uint8)
    texels[..., 3] = 120 + texels[..., 3] % 30
    texels[0, : columns // 2] = (7, 9, 11, 130)  # a run
    texels[1, 1] = (200, 100, 50, 0)  # an exponent of 0 is black
    return texels


def _radiance(texels: NDArray[np.uint8]) -> NDArray[np.float64]:
    radiance = texels[..., :3] / 256 * 2.0 ** (texels[..., 3:].astype(int) - 128)
    radiance[texels[..., 3] == 0] = 0
    return np.asarray(radiance)


@for_each("order, columns", [
    *((order, 12) for order in itertools.product("-+", "+-", [False, True])),
    *((("-", "+", False), columns) for columns in (8, 300, 1200)),
])  # fmt: skip
def test_values_are_mantissa_times_a_power_of_two_in_every_orientation(
    order: tuple[str, str, bool], columns: int
) -> None:
    down, right, by_columns = order
    upright = _texels(9, columns)
    turned = upright[:: 1 if down == "-" else -1, :: 1 if right == "+" else -1]
    size = f"{down}Y {{}} {right}X {{}}"
    if by_columns:
        turned, size = turned.transpose(1, 0, 2), f"{right}X {{}} {down}Y {{}}"
    for coding in ("runs", "old", "flat"):
        data = radiance_hdr(np.ascontiguousarray(turned), coding, size=size)
        values = read(data).values
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values, _radiance(upright))  # powers of two: exact


def test_factors_of_the_header_are_divided_out_and_ones_change_nothing() -> None:
    texels = _texels(3, 16)
    plain = _radiance(texels)
    one = "EXPOSURE=1\nEXPOSURE= 1.000000e+00\nCOLORCORR=1 1 1\nPIXASPECT=1\nSOFTWARE=x\nGAMMA=1\n"
    plain_too = read(radiance_hdr(texels, header=one + "PRIMARIES=0 0 0 0 0 0 0 0\n"))  # Photoshop
    np.testing.assert_array_equal(plain_too.values, plain)
    one += "PRIMARIES=0.640 0.330 0.290 0.600 0.150 0.060 0.333 0.333\n"
    picture = read(radiance_hdr(texels, header=one))
    np.testing.assert_array_equal(picture.values, plain)
    assert picture.unread == ()
    more = "EXPOSURE=2\nEXPOSURE=4\nCOLORCORR=1 2 4\nVIEW= -vtv -vh 40\nPIXASPECT=2\n"
    picture = read(radiance_hdr(texels, header=more))
    np.testing.assert_allclose(picture.values, plain / [8, 16, 32], rtol=1e-6)
    assert picture.unread == ("header variable VIEW", "header variable PIXASPECT")
    wide = "PRIMARIES=" + " ".join(map(str, ACESCG)) + "\n"
    moved = np.maximum(plain @ rec709_from(ACESCG).T, 0)
    values = read(radiance_hdr(texels, header=wide)).values
    np.testing.assert_allclose(values, moved, rtol=1e-4, atol=1e-4)


def test_damaged_and_foreign_radiance_files_are_refused_with_a_reason() -> None:
    whole, flat = radiance_hdr(_texels(4, 16), "runs"), radiance_hdr(_texels(4, 16))
    at = whole.index(b"+X 16") + 10
    cases = {
        "not_hdr": [
            b"#?RADIANCE",
            b"#?RADIANCE\n\n" + b"\r" * 65_000,  # a search took 6 s
            radiance_hdr(_texels(2, 16), header="EXPOSURE=0\n"),
            radiance_hdr(_texels(2, 16), header="COLORCORR=1 1\n"),
            whole.replace(b"32-bit_rle_rgbe", b"32-bit_rle_xyze"),
            whole.replace(b"-Y 4", b"+X 4"),
        ],
        "too_many_pixels": [
            whole.replace(b"-Y 4", b"-Y 99999"),
            whole.replace(b"+X 16", b"+X 99999"),
            whole.replace(b"-Y 4", b"-Y 0"),
        ],
        "load_error": [
            *(data[:length] for data in (whole, flat) for length in range(at - 4, len(data), 7)),
            whole.replace(b"-Y 4", b"-Y 40"),
            whole.replace(b"+X 16", b"+X 17"),
            whole[:at] + b"\xff" * 400,
            whole[:at] + b"\x00" * 400,
            radiance_hdr(np.full((2, 4, 4), 1, np.uint8)),
            radiance_hdr(np.array([[[9, 9, 9, 130], [1, 1, 1, 200]]] * 2, np.uint8)),
        ],
    }
    for reason, files in cases.items():
        for number, data in enumerate(files):
            with pytest.raises(Rejected) as caught:
                read_linear_picture(data, 1000)
            assert caught.value.reason == reason, (reason, number)


@for_each("name, expected", [
    ("33a-sky-data-window/in/cropped.exr", (0.4875, 0.4094, 0.2531)),
    ("33b-sky-overscan/in/overscan.exr", (0.5250, 0.4469, 0.2906)),
    ("34-sky-chromaticities/in/acescg.exr", (1.4019, 0.1099, 0.0679)),
    ("35a-hdr-exposure-one/in/exposure-one.hdr", (0.5245, 0.4463, 0.2901)),
])  # fmt: skip
def test_reported_skies(shared: Path, name: str, expected: tuple[float, ...]) -> None:
    values = read((shared / "cases" / name).read_bytes()).values
    assert values.shape == (32, 64, 3)
    np.testing.assert_allclose(values.mean(axis=(0, 1)), expected, atol=1e-4)
    assert ((values == 0).all(axis=-1).mean() == 0.75) == ("33a" in name)
