"""`trilight status` and `trilight plan`, as a user calls them."""

import json
from pathlib import Path

from storage.dataset.scene_logs import log_scene
from tests.command_line import trilight
from tests.pipeline.making.test_publication import begin_tiny, make_tiny_shard


def test_status_says_how_far_and_what_next(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path, 12)
    make_tiny_shard(publication, 0)
    log_scene(publication.folder, "x", 0, seconds=1800.0, cores=2, num_rejected=0)
    shown = trilight(["status", str(tmp_path)], env={"COLUMNS": "200"})
    assert shown.exit_code == 0, shown.output
    for text in ("1 of 3", "4 of 12", "no_camera", "1.00 core-hours, 0.04 USD", "--scenes 12"):
        assert text in shown.output
    told = trilight(["status", str(tmp_path), "--json", "--price", "0.5"])
    row = json.loads(told.output)
    assert (row["shards_done"], row["scenes_planned"], row["finished"]) == (1, 12, False)
    assert row["cost_usd"] == 0.5
