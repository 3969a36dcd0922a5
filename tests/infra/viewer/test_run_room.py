"""The page of a run: its pictures by step, and nothing beside them."""

from pathlib import Path

import pytest

from infra.viewer.run_room import RunRoom
from storage.errors import TrilightError
from tests.infra.run_page.run_by_hand import write_run
from tests.infra.viewer.served_kit import served


def test_pictures_over_steps(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    pictures = tmp_path / "run" / "pictures"
    (pictures / "step-000000012.png").write_bytes((pictures / "target.png").read_bytes())
    (pictures / "step-000000008.png").symlink_to(tmp_path / "elsewhere.png")
    (tmp_path / "elsewhere.png").write_bytes(b"secret")
    with served(RunRoom(tmp_path / "run"), "run.html") as asker:
        facts = asker.ask("api/run")[1]
        assert facts["steps"] == [4, 12] and facts["target"]
        assert facts["curves"][0]["name"] == "training loss"
        assert facts["curves"][0]["points"][0] == [2, 0.5]
        assert asker.ask("api/step/4")[1][:4] == asker.ask("api/step/target")[1][:4] == b"\x89PNG"
        for wrong in ("8", "5", "-1", "x", "../settings.json", "4.png", ""):
            assert asker.ask(f"api/step/{wrong}")[0] == 404, wrong
        assert asker.ask("api/step/4", {})[0] == 404


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="no run here"):
        RunRoom(tmp_path)
