"""When sampling ends: after which samples floors are measured again, by the targets that count."""

from hypothesis import given
from hypothesis import strategies as st

from pipeline.renders.stopping import Goal, expected_spp, gaps_db, next_spp, slope_db


def log_goal(target_db: float, step: int, max_spp: int) -> Goal:
    return Goal(targets_db={"psnr_log_db": target_db}, step=step, max_spp=max_spp)


def logs(*measured: tuple[int, float]) -> list[tuple[int, dict[str, float]]]:
    return [(spp, {"psnr_log_db": floor_db}) for spp, floor_db in measured]


@given(st.integers(1, 62), st.floats(1e-6, 60), st.floats(1e-6, 60), st.sampled_from([8, 32, 128]))
def test_samples_grow_in_whole_steps_up_to_the_cap(
    steps: int, gap_db: float, wider_gap_db: float, step: int
) -> None:
    spp, cap = steps * step, 64 * step
    chosen = next_spp(logs((spp, 0.0)), log_goal(gap_db, step, cap))
    assert chosen % step == 0
    assert spp < chosen <= cap
    assert chosen <= max(2 * spp, spp + step)
    if wider_gap_db >= gap_db:
        assert chosen <= next_spp(logs((spp, 0.0)), log_goal(wider_gap_db, step, cap))


def test_a_gap_of_one_slope_doubles_the_samples() -> None:
    first = logs((128, 0.0))
    assert next_spp(first, log_goal(1.2, 128, 4096)) == 256
    assert next_spp(first, log_goal(2.4, 128, 4096)) == 256
    assert next_spp(first, log_goal(99.0, 128, 4096)) == 256
    assert next_spp(logs((512, 0.0)), log_goal(99.0, 128, 640)) == 640


def test_two_floors_say_what_the_next_doubling_buys() -> None:
    fast = logs((128, 40.0), (256, 42.0))
    assert slope_db(fast, "psnr_log_db") == 2.0
    assert next_spp(fast, log_goal(44.0, 128, 4096)) == 512
    slow = logs((128, 40.0), (512, 42.0))
    assert slope_db(slow, "psnr_log_db") == 1.0
    assert next_spp(slow, log_goal(43.0, 128, 4096)) == 1024
    assert expected_spp(slow, log_goal(44.0, 128, 4096)) == 2048


def test_a_floor_that_fell_is_not_believed_to_fall_on() -> None:
    fell = slope_db(logs((128, 40.0), (256, 39.0)), "psnr_log_db")
    assert 0 < fell < slope_db(logs((128, 40.0), (256, 50.0)), "psnr_log_db") <= 3.0


def test_the_expected_number_of_samples_looks_past_the_next_step() -> None:
    first = logs((128, 0.0))
    assert expected_spp(first, log_goal(1.2, 128, 4096)) == 256
    assert expected_spp(first, log_goal(4.8, 128, 4096)) == 2048
    assert next_spp(first, log_goal(4.8, 128, 4096)) == 256
    assert expected_spp(first, log_goal(1e9, 128, 4096)) == 4096


TWICE = [
    (128, {"psnr_log_db": 40.0, "psnr_linear_db": 30.0, "object_psnr_log_db": 38.0}),
    (256, {"psnr_log_db": 42.0, "psnr_linear_db": 31.0, "object_psnr_log_db": 39.0}),
]


def test_only_targets_that_are_missed_leave_a_gap() -> None:
    floors_db = TWICE[-1][1]
    targets_db = {"psnr_log_db": 42.0, "psnr_linear_db": 35.0}
    assert gaps_db(targets_db, floors_db) == {"psnr_linear_db": 4.0}
    assert gaps_db({"psnr_log_db": 41.0}, floors_db) == {}


def test_the_target_that_needs_most_samples_governs() -> None:
    # 2 dB a doubling of the log floor, 1 dB of both others
    both = Goal(targets_db={"psnr_log_db": 45.0, "psnr_linear_db": 33.0}, step=128, max_spp=8192)
    assert expected_spp(TWICE, both) == 1024  # two doublings: the gap of 3 dB takes 1.5
    alone = Goal(targets_db={"psnr_log_db": 46.0}, step=128, max_spp=8192)
    assert expected_spp(TWICE, alone) == 1024


def test_a_target_that_is_reached_costs_nothing() -> None:
    alone = Goal(targets_db={"psnr_log_db": 44.0}, step=128, max_spp=8192)
    beside = Goal(
        targets_db={"psnr_log_db": 44.0, "psnr_linear_db": 31.0, "object_psnr_log_db": 39.0},
        step=128,
        max_spp=8192,
    )
    assert expected_spp(TWICE, beside) == expected_spp(TWICE, alone) == 512
    assert next_spp(TWICE, beside) == next_spp(TWICE, alone) == 512
