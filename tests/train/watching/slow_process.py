"""One of two processes that train together; the second one's loader sleeps in one step."""

import sys
import time
from pathlib import Path

from tests.train.kit import tiny_run
from train.data import stream
from train.data.scenes import TrainingScene
from train.loop.crew import Crew, join_crew
from train.progress import TrainProgress
from train.run import train_run
from train.watching.settings import WatchSettings

SLEEP_S = 4.0


class Said(TrainProgress):
    """Prints notes."""

    def noted(self, text: str) -> None:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def slow_from(crew: Crew) -> None:
    """Let the second process's loader sleep a little at each scene, and once for long."""
    made, count = stream._SceneMaker.scene, 0

    def sleeping(maker: stream._SceneMaker, place: stream.Place) -> TrainingScene:
        nonlocal count
        count += 1
        time.sleep(SLEEP_S if count == 12 else 0.2)
        return made(maker, place)

    if not crew.is_first:
        setattr(stream._SceneMaker, "scene", sleeping)  # noqa: B010


def main(data: str, out: Path) -> None:
    settings = tiny_run(
        scenes_per_step=2, num_steps=16, log_every=4, validate_every=16, checkpoint_every=16
    )
    stream.PREFETCHED_SCENES = 1
    with join_crew("cpu") as crew:
        slow_from(crew)
        watched = WatchSettings(hang_after_s=1.0, hang_factor=2.0)
        train_run(settings, data=[data], out=out, crew=crew, watched=watched, progress=Said())


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
