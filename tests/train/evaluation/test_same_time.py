"""The path tracer in the network's time, as it is told: over the views that have both."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.dataset.training_data import open_training_data
from storage.records.sample import Sample
from tests.train.kit import tiny_run
from tests.train.toy import write_toy_dataset
from train.evaluation.evaluate import Contest, judged_views, sheet_views
from train.evaluation.judged_view import NETWORK, JudgedView
from train.evaluation.report import markdown, record
from train.evaluation.same_time import CAPTION, TRACER, Times, TracerTimes, same_time, sentences
from train.evaluation.sheet import drawn_sheet
from train.loop.state import new_state

TIMES = Times(
    network_first_s=0.12,
    network_further_s=0.06,
    scenes=4,
    preview=TracerTimes(samples=4, denoiser="fast", first_s=0.025, further_s=0.022, note=""),
)


class Target:
    """Shows the stored pictures themselves, of the first view alone."""

    def judged(self, sample: Sample, view: int) -> NDArray | None:
        return self.shown(sample, view) if view == 0 else None

    def shown(self, sample: Sample, view: int) -> NDArray:
        return sample.radiance_rgb[view]

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def judging(tmp_path_factory: pytest.TempPathFactory) -> tuple[Contest, list[JudgedView]]:
    dataset = write_toy_dataset(tmp_path_factory.mktemp("toy"), train=1, validation=3)
    contest = Contest(
        network=new_state(tiny_run()).model,
        shards=open_training_data([str(dataset.folder.root)]).split("validation"),
        resolution=32,
        rivals=None,
        lpips=None,
        most_scenes=99,
        traced=Target(),
    )
    return contest, judged_views(contest, lambda: None)


def test_both_are_judged_on_the_same_views(judging: tuple[Contest, list[JudgedView]]) -> None:
    _, views = judging
    assert [TRACER in view.scores for view in views] == [True, False] * 3
    found = same_time(views, TIMES, "the first view of each scene")
    assert found["views"] == 3
    assert found["tracer"]["psnr_log_db"]["median"] == 100.0, "it shows the target itself"
    leads = [view.scores[NETWORK]["psnr_log_db"] - 100.0 for view in views[::2]]  # type: ignore[operator]
    assert found["lead_db"]["mean"] == pytest.approx(np.mean(leads))
    assert found["lead_db"]["low"] <= found["lead_db"]["mean"] <= found["lead_db"]["high"]
    assert found["share_better"] == 0
    page = markdown(record(views, {}, found))
    assert "In the network's own time".lower() in page.lower()
    assert "takes 0.022 (0.025) with 4 samples a pixel and its fast filter." in page
    assert "takes the network 0.06 core-seconds, the first of a scene 0.12" in page
    assert list(record(views, {}, found)["contestants"]) == [NETWORK], "a column is of all views"


def test_what_takes_longer_and_what_is_missing_is_said(
    judging: tuple[Contest, list[JudgedView]],
) -> None:
    _, views = judging
    dearest = TracerTimes(samples=1, denoiser="fast", first_s=0.1, further_s=0.07, note="slow")
    dear = dataclasses.replace(TIMES, preview=dearest)
    told = " ".join(sentences(same_time(views, dear, "all")))
    assert "1 sample a pixel" in told and "longer than the network" in told and "slow." in told
    untraced = [dataclasses.replace(view, scores={NETWORK: view.scores[NETWORK]}) for view in views]
    own, line = sentences(same_time(untraced, TIMES, "all"))
    assert line.endswith("is not shown: none of the judged views could be traced.")
    lacking = dataclasses.replace(TIMES, preview=None, missing="no tracer here")
    page = markdown(record(views, {}, same_time(views, lacking, "all")))
    assert own in page and "is not shown: no tracer here." in page
    assert "own time" not in markdown(record(views, {}))


def test_sheets_show_it_beside_the_prediction(
    judging: tuple[Contest, list[JudgedView]], tmp_path: Path
) -> None:
    contest, views = judging
    alone = drawn_sheet(sheet_views(dataclasses.replace(contest, traced=None), views), ("title",))
    shown = sheet_views(contest, views)
    # the target went through float32 logarithms
    np.testing.assert_allclose(
        shown[1].beside_rgb[CAPTION], shown[1].target_rgb, rtol=1e-5, atol=1e-6
    )
    assert drawn_sheet(shown, ("title",)).width > alone.width
