"""What a folder tells of its run."""

from pathlib import Path

from infra.run_page.record import facts_of, is_run, read_record
from tests.infra.run_page.run_by_hand import write_run


def test_the_facts_are_the_last_figures_and_points_leave_out_what_is_none(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    assert is_run(tmp_path / "run") and not is_run(tmp_path)
    record = read_record(tmp_path / "run")
    assert facts_of(record) == {
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
    assert [step for step, _ in record.points("grad_norm")] == [2, 6, 8, 10, 12]
    assert record.points("time_s", "no such part") == []
