"""The chart of a leaderboard takes names as they are."""

from pathlib import Path

from infra.leaderboard.chart import plot_leaderboard
from infra.leaderboard.standings import Standing, WidthStandings
from train.evaluation.pairs import METRIC

FORMULA = r"runs of $\nothing$"
"""What matplotlib refuses as a formula."""


def test_dollar_signs_in_names_are_no_formula(tmp_path: Path) -> None:
    priced, unpriced = (
        Standing(
            name=FORMULA, kind="network", first_s=seconds, further_s=seconds, timed_scenes=1,
            scores={METRIC: {"median": 30.0}}, lead=None, on_front=None,
        )
        for seconds in (0.5, None)
    )  # fmt: skip
    one = WidthStandings(
        width=64, num_scenes=1, num_views=1, standings=(priced, unpriced), pairs={}
    )
    plot_leaderboard([one], FORMULA, tmp_path / "board.png")
    assert (tmp_path / "board.png").read_bytes().startswith(b"\x89PNG")
