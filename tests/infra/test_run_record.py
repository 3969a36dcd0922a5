"""What a folder tells of its run."""

from pathlib import Path

import pytest

from infra.run_record import is_run, run_facts
from storage.errors import TrilightError
from tests.infra.run_by_hand import write_run


def test_the_facts_are_the_last_figures_that_are_numbers(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    assert is_run(tmp_path / "run") and not is_run(tmp_path)
    facts = {
        "run": "tiny",
        "steps": 12,
        "steps_planned": 12,
        "finished": False,
        "spikes": 1,
        "training_loss": 1 / 12,
        "validation_log_l1": 0.1,
        "validation_psnr_log_db_median": 20.0,
        "views_per_s": 3.0,
    }
    assert run_facts(tmp_path / "run") == facts
    with (tmp_path / "run/metrics.jsonl").open("a") as log:
        log.write('{"step": 12, "loss": null, "validation": {"log_l1": NaN}}\n')
    (tmp_path / "run/summary.json").write_text("{}")
    assert run_facts(tmp_path / "run") == facts | {"finished": True}
    (tmp_path / "run/metrics.jsonl").write_text("")
    assert run_facts(tmp_path / "run")["steps"] == 0


def test_other_folders_and_damage_are_named(tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="no run here; expected a folder that `trilight train`"):
        run_facts(tmp_path)
    write_run(tmp_path / "run")
    for damaged in ("{\n", "[]\n", '{"loss": 1}\n', "3\n"):
        (tmp_path / "run/metrics.jsonl").write_text(damaged)
        with pytest.raises(TrilightError, match="is not readable .* Restore it from a copy"):
            run_facts(tmp_path / "run")
