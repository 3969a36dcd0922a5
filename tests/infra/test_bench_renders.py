"""`trilight bench render` without waiting for it: its pieces, its options, and its pictures."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.bench.harness import Comparison, Options, Spread
from infra.bench.renders import cost, frontier, frontier_report, throughput, throughput_report
from infra.bench.renders.claims import Shot
from infra.bench.renders.cost_scene import MAX_LIGHTS, cost_scene
from infra.bench.renders.kept import Kept
from infra.bench.renders.remembering_tracer import RememberingTracer
from pipeline.renders.camera import Camera
from pipeline.renders.tracer import Features, HostSum
from tests.command_line import trilight

OPTIONS = Options(quick=True, objects=("builtin:",), allowed_licences=())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["render", "--part", "speed"], "expected one of frontier, throughput, cost"),
        (["shards", "--part", "cost"], "it has no parts"),
        (["render", "--cycles", "128,x"], "--cycles '128,x'"),
        (["render", "--cycles", "0"], "--cycles '0'"),
        (["nothing"], "NAME is 'nothing'; expected one of assets,"),
    ],
)
def test_mistakes_are_told_before_anything_is_measured(words: list[str], said: str) -> None:
    assert said in trilight(["bench", *words]).mistake


def test_an_interrupted_run_goes_on_where_it_is_asked_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    plan = {"spp": (64, 128)}  # a tuple, which JSON gives back as a list
    kept = Kept("x", plan, resume=False)
    assert kept.item("a", lambda: [1.5]) == [1.5]
    assert kept.item("a", lambda: [9.0]) == [1.5]
    again = Kept("x", plan, resume=True)
    assert (again.num_resumed, again.item("a", lambda: [9.0])) == (1, [1.5])
    for other in (
        Kept("x", {"spp": (64,)}, resume=True),
        Kept("x", plan, resume=False),
        Kept("y", plan, resume=True),
    ):
        assert other.num_resumed == 0
    again.forget()
    assert Kept("x", plan, resume=True).num_resumed == 0
    again.forget()  # twice does no harm


class _Counting:
    """A tracer that counts, and takes processor time."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []

    def only_light(self, row: int) -> "_Counting":
        raise NotImplementedError

    def radiance(self, camera: Camera, *, seed: int, spp: int) -> NDArray[np.float32]:
        self.calls.append(("radiance", seed))
        sum(range(2_000_000))
        return np.full((camera.resolution, camera.resolution, 3), float(seed), np.float32)

    def pass_sum(self, camera: Camera) -> HostSum:
        raise NotImplementedError

    def features(self, camera: Camera, *, seed: int, spp: int) -> Features:
        self.calls.append(("features", seed))
        black = np.zeros((camera.resolution, camera.resolution, 3), np.float32)
        return Features(albedo=black, normal=black)

    def hits(self, camera: Camera) -> NDArray[np.bool_]:
        self.calls.append(("hits", 0))
        return np.ones((camera.resolution, camera.resolution), np.bool_)


def test_nothing_is_traced_twice_and_all_is_charged() -> None:
    counting = _Counting()
    tracer = RememberingTracer(counting)
    camera = Camera(c2w=np.eye(4), fov_deg=45, resolution=8)
    for _ in range(3):
        tracer.owed_core_s = 0.0
        assert tracer.radiance(camera, seed=1, spp=64)[0, 0, 0] == 1
        assert tracer.radiance(camera, seed=2, spp=64)[0, 0, 0] == 2
        tracer.features(camera, seed=1, spp=64)
        tracer.hits(camera)
    assert sorted(counting.calls) == [
        ("features", 1),
        ("hits", 0),
        ("radiance", 1),
        ("radiance", 2),
    ]
    assert tracer.owed_core_s > 0  # two sums over two million numbers are not free


def test_the_scene_family_changes_one_quantity_at_a_time() -> None:
    base = cost_scene(1000, 4)
    for wanted in cost.AXES["triangles"]:
        scene = cost_scene(wanted, 4)
        assert abs(scene.num_triangles / wanted - 1) < 0.1  # as its docstring promises
        assert scene.triangle_emits.sum() == 4
        np.testing.assert_array_equal(scene.materials, base.materials)
        np.testing.assert_array_equal(scene.c2w, base.c2w)
    for count in cost.AXES["lights"]:
        scene = cost_scene(1000, count)
        emission = scene.materials[:, 7:].sum(axis=0)
        # shared out in float32 and summed again
        np.testing.assert_allclose(emission, base.materials[:, 7:].sum(axis=0), rtol=1e-5)
        assert scene.triangle_emits.sum() == count
        lit = scene.vertex_positions[scene.faces[scene.triangle_emits]].mean(axis=1)
        apart = np.linalg.norm(lit[:, None] - lit[None], axis=-1) + 10 * np.eye(count)
        assert apart.min() > 0.05
    assert max(cost.AXES["lights"]) == MAX_LIGHTS


def _is_drawn(path: Path) -> bool:
    return path.stat().st_size > 10_000


def frontier_by_hand(cycles_spp: tuple[int, ...]) -> frontier.Frontier:
    plan = frontier.Plan(
        scenes=("a", "b"),
        resolution=16,
        targets_db=(38.0, 42.0),
        max_spp=256,
        mitsuba_spp=(64, 128, 256),
        cycles_spp=cycles_spp,
        threads=1,
    )
    sides = [(frontier.our_side(t), 1.0 + t / 40, t + 2) for t in plan.targets_db]
    sides += [(frontier.mitsuba_side(spp), spp / 50, 30 + spp / 20) for spp in plan.mitsuba_spp]
    sides += [(frontier.cycles_side(spp), spp / 10, 30 + spp / 100) for spp in cycles_spp]
    shots = tuple(
        Shot(
            scene=scene,
            side=side,
            spp=int(side.split()[1]),
            core_s=core_s,
            load_s=0.1,
            log_db=log_db + place,
            linear_db=log_db - 10,
            noise_floor_db=log_db if side.startswith("trilight") else None,
        )
        for place, scene in enumerate(plan.scenes)
        for side, core_s, log_db in sides
    )
    return frontier.judged(plan, shots, {"a": 50.0, "b": 60.0})


def test_the_frontier_is_told_and_drawn(tmp_path: Path) -> None:
    result = frontier_by_hand(cycles_spp=(128, 4096))
    lines = dict(frontier_report.rows(result))
    assert "true error median 40.5, p5 40.0" in lines["trilight 38 dB"]
    assert lines["mitsuba / trilight 38 dB"] == "1.9 x at equal worst error (189 spp)"
    assert lines["mitsuba / trilight 42 dB"].startswith("more than 2.5 x")
    assert lines["cycles 128 / trilight 38 dB"].startswith("6.6 x")
    assert lines["cycles 4096"].endswith("no target of ours is as good over this set")
    assert lines["references"].startswith("own floors 50.0 to 60.0 dB")
    # stated 40 and 44 dB: the reference of 50 dB is firm for both, at 6 dB as well
    assert "of our pictures 4 of 4" in lines["references"]
    unsure = dataclasses.replace(result, reference_floors_db={"a": 49.9, "b": 60.0})
    assert "of our pictures 3 of 4" in dict(frontier_report.rows(unsure))["references"]
    frontier_report.plot(result, tmp_path / "with.png")
    frontier_report.plot(frontier_by_hand(cycles_spp=()), tmp_path / "without.png")
    assert _is_drawn(tmp_path / "with.png") and _is_drawn(tmp_path / "without.png")


def test_the_throughput_is_told_and_drawn(tmp_path: Path) -> None:
    plan = throughput.Plan(
        scenes=("a", "b"), resolutions=(256, 512), targets_db=(38.0, 46.0), max_spp=512, threads=1
    )
    views = tuple(
        throughput.View(
            scene=scene,
            resolution=resolution,
            target_db=target_db,
            noise_floor_db=target_db + 1,
            reached=scene == "a" or target_db < 40,
            spp=128,
            core_s=resolution / 256 * (1.0 if scene == "a" else 3.0),
            load_core_s=0.25,
        )
        for scene in plan.scenes
        for resolution in plan.resolutions
        for target_db in plan.targets_db
    )
    result = throughput.Throughput(
        name=throughput.NAME,
        plan=plan,
        views=views,
        economies=throughput.economies(views, plan, 0.09),
        usd_per_core_hour=0.09,
        num_resumed=0,
    )
    lines = dict(throughput_report.rows(result))
    # two core-seconds a view: eight million of them are 4444 core-hours
    assert lines["256 x 256 to 38 dB"].startswith("1800 views per core-hour; 100% of 2")
    assert lines["256 x 256 to 46 dB"].endswith("8 million views 400 USD")
    assert "50% of 2" in lines["512 x 512 to 46 dB"]
    assert lines["price"] == "0.09 USD per core-hour"
    throughput_report.plot(result, tmp_path / "figure.png")
    assert _is_drawn(tmp_path / "figure.png")


def test_the_cost_is_told_and_drawn(tmp_path: Path) -> None:
    def spread(value: float) -> Spread:
        return Spread(median=value, low=0.9 * value, high=1.2 * value)

    sides: Mapping[str, Mapping[str, Spread]] = {
        f"{axis} {value}": {"core_s_per_megapath": spread(0.3), "load_core_s": spread(0.01)}
        for axis, values in cost.AXES.items()
        for value in values
    }
    result = Comparison(name=cost.NAME, sides=sides, repeats=1)
    lines = dict(cost.rows(result))
    assert lines["lights 32"].startswith("0.300 core-s per million paths (0.270 to 0.360)")
    cost.plot(result, tmp_path / "figure.png")
    assert _is_drawn(tmp_path / "figure.png")


def test_rounds_are_those_that_will_come() -> None:
    careful = dataclasses.replace(OPTIONS, quick=False)
    assert (frontier.num_rounds(OPTIONS), frontier.num_rounds(careful)) == (4, 20)
    assert (throughput.num_rounds(OPTIONS), throughput.num_rounds(careful)) == (6, 24)
    values = sum(len(values) for values in cost.AXES.values())
    assert (cost.num_rounds(OPTIONS), cost.num_rounds(careful)) == (2 * values, 6 * values)
