"""The paper's figures beside a network's: which set they are of, and never for another set."""

from pipeline.builds.judging import JUDGING_BUILDS
from tests.train.evaluation.test_evaluate import row
from train.evaluation.published import BENCHMARK
from train.evaluation.report import markdown, record


def test_the_benchmark_stands_beside_the_paper() -> None:
    assert record([row(0)], {"build": "smoke"})["published"] is None
    page = markdown(record([row(0)], {"build": BENCHMARK}))
    assert BENCHMARK in JUDGING_BUILDS
    assert "| psnr_linear_db | 29.77 | 30.00 |" in page and "| lpips | 0.0551 | n/a |" in page
    assert "400 scenes" in page and "256 x 256" in page
