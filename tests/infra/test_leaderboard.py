"""The command as a whole, its rows on disk, and the pictures of anybody."""

import csv
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch

from infra import judging as run_module
from infra.judging import (
    NEAREST_OTHER,
    NEAREST_TRAINED,
    Leaderboard,
    make_leaderboard,
    picture_folder,
    widths_of,
)
from infra.render.methods import DIRECT_LIGHT, TRACED_LIGHT
from infra.render.networks import NetworkRenderer
from model.open import save_published
from pipeline.exchange.exports.export import export_dataset, picture_name
from storage.errors import TrilightError, Unrenderable
from storage.records.exr import encode_channels
from storage.renderer import Renderer
from tests.command_line import trilight
from tests.for_each import case
from tests.model.kit import awake, publishable
from tests.train.toy import VIEWS, toy_sample, write_toy_dataset
from train.evaluation import leaderboard as board_module
from train.evaluation.evaluate import Price
from train.evaluation.leaderboard import (
    NOISE,
    UNKNOWN_MACHINE,
    Row,
    RowKey,
    Rows,
)
from train.evaluation.metrics import NETWORK
from train.evaluation.options import LeaderboardOptions
from train.evaluation.validation import PictureSource, nearest_view

PX = 16
SHIPPED = {"network builtin:", "network builtin:tokens"}
PERFECT = r"perfect $\nothing$"
"""Folder of the targets; matplotlib would refuse the end of its name as a formula."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a set, its targets as a folder of pictures, and published weights."""
    root = tmp_path_factory.mktemp("board")
    write_toy_dataset(root / "toy", train=3, validation=3, per_shard=3, resolution=PX)
    export_dataset(
        str(root / "toy"), "exr", root / PERFECT, split=None, scene=None, done=lambda _: None
    )
    save_published(awake(publishable("dpt"), torch.float32), root / "renderformer-v1-base")
    return root


@pytest.fixture
def order(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LeaderboardOptions:
    """Return an order of seconds: no path tracer, which the slow test has."""
    monkeypatch.setattr(run_module, "SAMPLES", ())
    monkeypatch.delenv("TRILIGHT_LPIPS", raising=False)
    return LeaderboardOptions(
        source=str(root / "toy"), split="validation", scenes=2, timed_scenes=1, out=tmp_path / "out"
    )


@pytest.fixture
def short(order: LeaderboardOptions, monkeypatch: pytest.MonkeyPatch) -> LeaderboardOptions:
    """Return an order of one network beside the nearest picture, without a chart."""
    monkeypatch.setattr(run_module, "BUILTIN_NETWORKS", ("builtin:tokens",))
    monkeypatch.setattr(run_module, "compared_renderers", networks_alone)
    monkeypatch.setattr(run_module, "plot_leaderboard", lambda *words: None)
    return order


def networks_alone(resolution: int, networks: Any, *more: Any) -> list[Renderer]:
    return [
        NetworkRenderer(
            name=name, checkpoint=name, resolution=resolution, threads=1, opened=network
        )
        for name, network in networks.items()
    ]


def board_of(order: LeaderboardOptions) -> Leaderboard:
    return make_leaderboard(order, lambda now, total, what: None)


def tables(folder: Path, name: str) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / name).open()))


def test_who_is_asked_for_stands_beside_those_who_never_lack(
    order: LeaderboardOptions, root: Path
) -> None:
    asked = dataclasses.replace(
        order, pictures=(root / PERFECT,), checkpoint=(str(root / "renderformer-v1-base"),)
    )
    board = board_of(asked)
    (one,) = board.widths
    assert (one.width, one.num_scenes, one.num_views) == (PX, 2, 2 * VIEWS)
    names = [each.name for each in one.standings]
    assert names[:2] == [NOISE, f"pictures of {PERFECT}"], "the best comes first"
    assert set(names[2:]) == SHIPPED | {
        DIRECT_LIGHT, TRACED_LIGHT, NEAREST_TRAINED, "network renderformer-v1-base",
    }  # fmt: skip
    assert board.rival == "network renderformer-v1-base"
    rows = {row["name"]: row for row in tables(asked.out, "leaderboard.csv")}
    assert float(rows[f"pictures of {PERFECT}"]["psnr_log_db_median"]) > 60, "half floats aside"
    assert rows[NOISE]["psnr_log_db_median"] == "100.0" and rows[NOISE]["lead_mean_db"] == ""
    for name in SHIPPED | {DIRECT_LIGHT, TRACED_LIGHT}:
        assert float(rows[name]["first_core_s"]) > 0 < float(rows[name]["further_core_s"]), name
    assert rows[f"pictures of {PERFECT}"]["first_core_s"] == ""
    pairs = {(row["name"], row["than"]): row for row in tables(asked.out, "pairs.csv")}
    lead = pairs[DIRECT_LIGHT, board.rival]
    assert float(lead["mean_db"]) == float(rows[DIRECT_LIGHT]["lead_mean_db"])
    assert float(lead["mean_db"]) == -float(pairs[board.rival, DIRECT_LIGHT]["mean_db"])
    assert float(lead["low_db"]) <= float(lead["mean_db"]) <= float(lead["high_db"])
    page = (asked.out / "leaderboard.md").read_text()
    assert "29.77" in page and "never released" in page and "16 x 16 pixels" in page
    assert "fewer than 10 scenes" in page and "LPIPS is n/a" in page
    assert (asked.out / "leaderboard.png").stat().st_size > 10_000


def test_nothing_is_judged_twice_and_what_changed_is_judged_again(
    short: LeaderboardOptions, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = shutil.copytree(root / PERFECT, tmp_path / "mine")
    asked = dataclasses.replace(short, pictures=(mine,))
    before = board_of(asked)
    lines = (asked.out / "rows.jsonl").read_text().splitlines()
    judged = mock.Mock(wraps=board_module.picture_scores)
    monkeypatch.setattr(board_module, "picture_scores", judged)
    assert board_of(asked).widths == before.widths and not judged.called
    assert (asked.out / "rows.jsonl").read_text().splitlines() == lines
    name = sorted(path.name for path in mine.glob("*.exr"))[-1]  # the scene before is not judged
    (mine / "000000003_view_0.exr").write_bytes((mine / name).read_bytes())
    board_of(asked)
    assert judged.call_count == VIEWS, "one picture is another: its scene is judged again"
    board_of(dataclasses.replace(asked, scenes=3))
    scenes = {json.loads(line).get("scene") for line in (asked.out / "rows.jsonl").open()}
    assert len(scenes - {None}) == 3


def test_a_set_without_training_split_looks_up_its_other_scenes(
    short: LeaderboardOptions, root: Path, tmp_path: Path
) -> None:
    write_toy_dataset(tmp_path / "bare", train=0, validation=3, per_shard=3, resolution=PX)
    bare = dataclasses.replace(short, source=str(tmp_path / "bare"))
    board = board_of(bare)
    found = {each.name: each for each in board.widths[0].standings}
    assert NEAREST_OTHER in found and NEAREST_TRAINED not in found
    assert found[NEAREST_OTHER].median_db < 60, "never its own target"
    assert any("no training split" in text for text in board.notes)
    known = dataclasses.replace(bare, train_data=(str(root / "toy"),), out=tmp_path / "other")
    assert NEAREST_TRAINED in {each.name for each in board_of(known).widths[0].standings}
    with pytest.raises(TrilightError, match=r"--train-data .*no training split"):
        board_of(dataclasses.replace(bare, train_data=(str(tmp_path / "bare"),)))


def test_a_scene_that_somebody_cannot_show_is_left_out_for_all(
    short: LeaderboardOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*words: Any, **more: Any) -> PictureSource:
        def pictures(sample: Any) -> Any:
            if sample.key.endswith("4"):
                raise Unrenderable("nothing shines")
            return found.pictures(sample)

        found = nearest_view(*words, **more)
        return dataclasses.replace(found, pictures=pictures)

    monkeypatch.setattr(run_module, "nearest_view", refused)
    board = board_of(short)
    assert board.widths[0].num_scenes == 1
    assert any("scene 000000004 is left out at 16 pixels" in text for text in board.notes)
    monkeypatch.setattr(run_module, "nearest_view", nearest_view)
    assert board_of(short).widths[0].num_scenes == 2, "and asked again"


def test_one_scene_has_its_table_without_intervals(
    short: LeaderboardOptions, tmp_path: Path
) -> None:
    write_toy_dataset(tmp_path / "one", train=0, validation=1, per_shard=1, resolution=PX)
    one = dataclasses.replace(short, source=str(tmp_path / "one"), checkpoint=("builtin:",))
    board = board_of(one)
    names = {each.name for each in board.widths[0].standings}
    assert names == {NOISE, *SHIPPED}, "there is no other scene to look up"
    for said in ("no scene beside", "there are no intervals"):
        assert said in str(board.notes)
    (row,) = [row for row in tables(one.out, "leaderboard.csv") if row["lead_mean_db"]]
    assert (row["lead_low_db"], row["lead_high_db"]) == ("", "")
    page = (one.out / "leaderboard.md").read_text()
    assert f"| {float(row['lead_mean_db']):+.2f} | n/a |" in page
    words = ["leaderboard", one.source, "--split", "validation", "--checkpoint", "builtin:"]
    words += ["--scenes", "2", "--timed-scenes", "1", "--out", str(one.out)]
    shown, told = trilight(words), trilight([*words, "--json"])
    assert shown.exit_code == 0 and "None" not in shown.stdout
    (plain,) = json.loads(told.stdout)["widths"]
    assert plain["scenes"] == 1
    leads = [each["lead"] for each in plain["standings"] if each["lead"]]
    assert leads and all(lead["low"] is lead["high"] is None for lead in leads)


def test_evaluate_is_a_leaderboard_without_a_network_and_beside_others(
    short: LeaderboardOptions, tmp_path: Path
) -> None:
    data = ["--data", short.source, "--split", "validation", "--most-scenes", "1"]
    words = [*data, "--resolution", str(PX), "--json"]
    without_effect = trilight(["evaluate", *words, "--tracer-views", "0"]).exception
    assert "--tracer-views is 0 and no network is named" in str(without_effect)
    alone = json.loads(trilight(["evaluate", *words, "--out", str(tmp_path / "alone")]).stdout)
    (one,) = alone["widths"]
    assert (one["width"], one["scenes"], alone["rival"]) == (PX, 1, "network builtin:tokens")
    words = ["evaluate", "builtin:tokens", *words, "--tracer-views", "0", "--beside", "builtin:"]
    both = json.loads(trilight([*words, "--out", str(tmp_path / "both")]).stdout)
    assert both["about"]["network"] == "builtin:tokens" and NETWORK in both["contestants"]
    names = {each["name"] for each in both["leaderboard"]["widths"][0]["standings"]}
    assert SHIPPED <= names and both["leaderboard"]["rival"] == "network builtin:tokens"
    written = {path.name for path in (tmp_path / "both").iterdir()}
    assert {"evaluation.json", "worst.png", "leaderboard.md", "pairs.csv", "rows.jsonl"} <= written
    refused = trilight([*words, "--data", short.source]).exception
    assert "--data is given 2 times; expected one dataset to compare methods on" in str(refused)


def test_prices_of_two_machines_do_not_mix(
    short: LeaderboardOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    def prices(machine: str, measured_s: float) -> tuple[dict[str, str], Leaderboard]:
        def timed(renderer: Any, scene: Any, name: str) -> Any:
            price = Price(first_s=measured_s, further_s=measured_s / 2)
            return dataclasses.replace(real(renderer, scene, name), price=price)

        monkeypatch.setattr(run_module, "processor", lambda: machine)
        monkeypatch.setattr(board_module, "time_scene", timed)
        board = board_of(short)
        rows = tables(short.out, "leaderboard.csv")
        (row,) = [row for row in rows if row["name"] == "network builtin:tokens"]
        return row, board

    real = board_module.time_scene
    first, _ = prices("Slow 1", 8.0)
    assert (first["first_core_s"], first["processor"]) == ("8.0", "Slow 1")
    second, board = prices("Quick 2", 2.0)
    assert (second["first_core_s"], second["processor"]) == ("2.0", "Quick 2"), "no price is old"
    assert any("CPU seconds of Slow 1, which are not in the table" in say for say in board.notes)
    again, _ = prices("Slow 1", 99.0)
    assert again["first_core_s"] == "8.0", "what was measured here before is still there"


def test_widths_are_those_that_the_set_has() -> None:
    assert widths_of((), 256) == [64, 256] and widths_of((), 512) == [64, 256, 512]
    assert widths_of((), 96) == [96] and widths_of((128, 64), 256) == [64, 128]
    with pytest.raises(TrilightError, match=r"the width is 512; expected a divisor of 256"):
        widths_of((512,), 256)


def test_mistakes_are_one_line(order: LeaderboardOptions, root: Path) -> None:
    twice = dataclasses.replace(order, checkpoint=(str(root / "renderformer-v1-base"),) * 2)
    with pytest.raises(TrilightError, match=r"is there twice"):
        board_of(twice)
    with pytest.raises(TrilightError, match="another folder has the same name"):
        board_of(dataclasses.replace(order, pictures=(root / PERFECT,) * 2))
    lacks = dataclasses.replace(order, pictures=(root / "toy",))
    with pytest.raises(TrilightError, match=r"4 of 4 pictures are missing"):
        board_of(lacks)
    with pytest.raises(TrilightError, match="the test split holds no scene"):
        board_of(dataclasses.replace(order, split="test"))


SHOWN = [("000000000", 0), ("000000000", 1), ("000000001", 0), ("000000001", 1)]
WIDTHS = [8, 16]


def picture(seed: int, width: int = 16) -> np.ndarray:
    return np.random.default_rng(seed).random((width, width, 3), np.float32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine").mkdir()
    for row, (key, view) in enumerate(SHOWN):
        write(tmp_path / "mine" / picture_name(key, view), picture(row))
    return tmp_path / "mine"


def encoded(rgb: np.ndarray) -> bytes:
    return encode_channels({"RGB": np.ascontiguousarray(rgb)})


def write(path: Path, rgb: np.ndarray) -> None:
    path.write_bytes(encoded(rgb))


def refusal(folder: Path) -> str:
    with pytest.raises(TrilightError) as refused:
        picture_folder(folder, SHOWN, WIDTHS)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_pictures_are_shown_as_they_are_at_their_one_width(folder: Path) -> None:
    rgb = picture(2)
    rgb[3, 4] = [-0.001, 0, 1e5]  # networks of logarithms give a little less than nothing
    alpha = np.full((16, 16), 0.5, np.float32)
    channels = dict(zip("RGB", np.moveaxis(rgb, -1, 0).copy(), strict=True)) | {"A": alpha}
    (folder / picture_name(*SHOWN[2])).write_bytes(encode_channels(channels))
    one = picture_folder(folder, SHOWN, WIDTHS)
    assert one.name == "pictures of mine" and one.resolution == 16
    shown = one.pictures(toy_sample(1))
    np.testing.assert_array_equal(shown[0], np.maximum(rgb, 0))
    np.testing.assert_array_equal(shown[1], picture(3))
    before = one.digest(*SHOWN[0])
    write(folder / picture_name(*SHOWN[0]), picture(9))
    after = picture_folder(folder, SHOWN, WIDTHS)
    assert after.digest(*SHOWN[0]) != before and after.digest(*SHOWN[1]) == one.digest(*SHOWN[1])


def test_what_is_no_picture_of_the_set_is_said(folder: Path, tmp_path: Path) -> None:
    third = folder / picture_name(*SHOWN[2])
    for data, said in [
        (encoded(picture(0)[:8]), ": 16 x 8 pixels; expected 8 x 8 or 16 x 16"),
        (encoded(picture(0, 8)), " has 8"),
        (b"\x76\x2f\x31\x01 cut", ": no readable OpenEXR picture of channels R, G"),
        (encode_channels({"Y": picture(0)[..., 0].copy()}), ": no readable OpenEXR picture"),
    ]:
        with case(said):
            third.write_bytes(data)
            assert f"{third.name}{said}" in refusal(folder)
    for bad in [np.nan, -1.0]:
        rgb = picture(0)
        rgb[5, 6, 1] = rgb[7, 8, 0] = bad
        write(third, rgb)
        said = refusal(folder)
        assert f"{third.name}: row 5, column 6" in said and "channel G" in said
        assert "2 pixels are like it; expected finite radiance of at least 0" in said
    for name in SHOWN[1:3]:
        (folder / picture_name(*name)).unlink()
    said = refusal(folder)
    assert "2 of 4 pictures are missing, the first is 000000000_view_1.exr" in said
    assert "--form exr" in said and "--scenes" in said
    assert "no such folder; expected one" in refusal(tmp_path / "nowhere")


KEY = RowKey(64, "000000001", 0, "somebody", "d")
ROW = Row(scores={"psnr_log_db": 30.0, "lpips": None}, first_s=0.5, further_s=0.25)


def test_rows_come_back_and_the_later_of_two_counts(tmp_path: Path) -> None:
    path = tmp_path / "board/rows.jsonl"
    rows = Rows(path, "set a")
    rows.add(KEY, Row(scores={"psnr_log_db": 29.0}))
    rows.add(KEY, ROW)
    again = Rows(path, "set a")
    assert again.get(KEY) == rows.get(KEY) == ROW
    assert again.get(KEY._replace(digest="e")) is None
    assert len(path.read_text().splitlines()) == 3
    # written before rows named their machine: a price of nowhere
    assert rows.price(KEY, "somewhere") is None and again.machines() == {UNKNOWN_MACHINE}
    # a line that a kill cut short is judged again
    path.unlink()
    Rows(path, "set a").add(KEY, ROW)
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"width": 64, "sce')
    assert Rows(path, "set a").get(KEY) == ROW
    path.write_bytes(whole[: whole.index(b"\n") + 20])
    cut = Rows(path, "set a")
    assert cut.get(KEY) is None
    cut.add(KEY, ROW)
    assert path.read_bytes() == whole


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    for text, said in [
        ('{"set": "another"}\n', r"are of the set another, and this set is set a.*another --out"),
        ("nothing\n", "not the rows of a leaderboard.*another --out, or delete the file"),
        ('{"set": "set a"}\n{"width": 64}\n', "not the rows of a leaderboard"),
        ("[" * 100_000 + "\n", "not the rows of a leaderboard"),
    ]:
        with case(text):
            (tmp_path / "rows.jsonl").write_text(text)
            with pytest.raises(TrilightError, match=said):
                Rows(tmp_path / "rows.jsonl", "set a")
