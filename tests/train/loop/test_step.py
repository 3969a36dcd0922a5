"""Laws of one step: a mean over views, whatever the batches; what is not finite changes nothing.

A decision that only kernels know does what one of the host does; here on a processor. Compiled
layers compute what layers compute, from one graph for all of them and all lengths.
"""

import copy
import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch._dynamo.testing import CompileCounterWithBackend
from torch._inductor.utils import run_and_get_code

from model.layers import Norm
from model.open import path_of_step, saved_steps
from model.renderformer import RenderFormer
from model.scene_tensors import batch_scenes
from model.view_decoder import Fusion
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.model.kit import awake, picture_and_gradients, random_scene, tiny_config
from tests.train.kit import CPU, stepper, take_step, tiny_run, toy_batch, trained
from tests.train.loop.test_optimizer import with_gradients
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.buckets import TrainingBatch, bucket_scenes, collate_batch
from train.data.scenes import training_scene
from train.folder import RunFolder, read_rows
from train.loop import optimizer
from train.loop import step as step_module
from train.loop.checkpoints import read_checkpoint
from train.loop.optimizer import Optimizer, move_along, move_towards
from train.loop.step import Stepper, compile_parts, compiled_parts, predict_log10
from train.loop.train_state import TrainState, ema_step, new_state
from train.loss.training_loss import TrainingLoss
from train.settings import Compile, LossSettings, Precision

RESOLUTION = 16


def gradients(batches: list[TrainingBatch]) -> tuple[float, list[Tensor]]:
    state = new_state(tiny_run(grad_clip=1e9))
    report = take_step(state, batches)
    return report.loss, [w.grad.clone() for w in state.model.parameters() if w.grad is not None]


def test_buckets_of_any_size_give_the_gradient_of_one_batch() -> None:
    drawn = [training_scene(toy_sample(index), RESOLUTION) for index in range(5)]
    buckets = bucket_scenes(drawn, lambda num_triangles: 100.0 + num_triangles, 16)
    sizes = {len(batch.target_BVRR3) for batch in buckets}
    assert len(sizes) > 1, "equal buckets could not tell a mean over views from one over batches"
    loss, cut = gradients(buckets)
    whole_loss, whole = gradients([collate_batch(drawn)])
    # float32 sums in another order
    assert loss == pytest.approx(whole_loss, rel=1e-5)
    for a, b in zip(cut, whole, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


def ruin_target(state: TrainState, batch: TrainingBatch) -> None:
    batch.target_BVRR3[0, 0, 0, 0, 0] = math.inf


def ruin_weight(state: TrainState, batch: TrainingBatch) -> None:
    with torch.no_grad():
        state.model.decoder.token_W[0] = math.nan


def ruin_gradient(state: TrainState, batch: TrainingBatch) -> None:
    """The loss stays finite; a backward pass that overflows looks like this."""
    state.model.decoder.token_W.register_hook(lambda gradient: gradient * math.inf)


@for_each(("muon_rate", "precision"), [(0.0, "bfloat16"), (3.0, "bfloat16"), (3.0, "float32")])
@for_each("ruin", [ruin_target, ruin_weight, ruin_gradient])
def test_a_step_that_is_not_finite_changes_nothing(
    ruin: Callable[[TrainState, TrainingBatch], None], muon_rate: float, precision: Precision
) -> None:
    state = new_state(tiny_run(ema_decay=0.5, muon_rate=muon_rate), muon_precision=precision)
    batch = toy_batch(0, 1)
    assert take_step(state, [batch]).applied
    ruin(state, batch)
    before = copy.deepcopy(tensors(state))
    assert not take_step(state, [batch]).applied
    for name, each in tensors(state).items():
        torch.testing.assert_close(each, before[name], rtol=0, atol=0, equal_nan=True, msg=name)


def test_the_mean_follows_the_weights_faster_at_first() -> None:
    settings = tiny_run(ema_decay=0.5)
    state = new_state(settings)
    assert state.ema_model is not None and state.eval_model is state.ema_model
    batch = toy_batch(0, 1)
    by_hand = state.model.decoder.rays.weight.detach().clone()
    for updates in range(12):
        take_step(state, [batch])
        decay = min(0.5, (1 + updates) / (10 + updates))
        by_hand = decay * by_hand + (1 - decay) * state.model.decoder.rays.weight.detach()
    # float32, 12 updates
    torch.testing.assert_close(state.ema_model.decoder.rays.weight, by_hand, rtol=0, atol=1e-6)
    assert (by_hand - state.model.decoder.rays.weight).abs().max() > 1e-4
    assert new_state(tiny_run()).eval_model is not None and new_state(tiny_run()).ema_model is None


@for_each("family", ["linear", "dpt"])
def test_bfloat16_rounds_no_position_ray_or_material_nor_the_last_layers(family: str) -> None:
    """As model.precision says; norms keep the type that they get, and layers are rounded.

    The published training rounds positions too, to a grid of up to 0.004 m.
    """
    network, found = awake(tiny_config(family), torch.float32), dict[str, str]()
    positions, batch = list[Tensor](), toy_batch(0, 1)
    network.encoder.rotary.register_forward_pre_hook(lambda _, given: positions.append(given[0]))
    exact_picture = predict_log10(network, batch, RESOLUTION, "float32")

    def note(name: str, module: nn.Module, given: tuple[Tensor, ...], output: Tensor) -> None:
        kept = isinstance(module, Norm) and output.dtype == given[0].dtype
        found[name] = "kept" if kept else str(output.dtype).removeprefix("torch.")

    for name, module in network.named_modules():
        if isinstance(module, Norm | nn.Linear | nn.Conv2d):
            module.register_forward_hook(functools.partial(note, name))
    rounded = predict_log10(network, batch, RESOLUTION, "bfloat16")
    assert rounded.dtype == torch.float32 and not torch.equal(rounded, exact_picture)
    exact_ones, ours = positions[: len(positions) // 2], positions[len(positions) // 2 :]
    for one, other in zip(exact_ones, ours, strict=True):
        assert other.dtype == torch.float32 and torch.equal(one, other)
    exact = {"encoder.tokens.material", "encoder.tokens.normal", "decoder.rays"}
    exact |= {"decoder.head.last"} | ({"decoder.head.widen"} if family == "dpt" else set())
    assert {name: found[name] for name in exact} == dict.fromkeys(exact, "float32")
    norms = {name: kind for name, kind in found.items() if name.endswith("norm")}
    assert len(norms) > 10 and set(norms.values()) == {"kept"}
    assert found["decoder.layers.0.ffn.down"] == "bfloat16"


def test_a_step_asks_no_generator() -> None:
    """What does not exist need not be saved: a resumed run is the same whatever the state here."""
    state = new_state(tiny_run())
    before = torch.get_rng_state(), np.random.get_state(legacy=True)[1].copy()  # type: ignore[index] # noqa: NPY002
    take_step(state, [toy_batch(0, 1)])
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state(legacy=True)[1], before[1])  # type: ignore[index] # noqa: NPY002


def test_the_report_says_how_bright_and_how_long_before_clipping() -> None:
    batch = toy_batch(0, 1)
    state = new_state(tiny_run())
    report = take_step(state, [batch])
    mean = batch.target_BVRR3.mean().item()
    assert report.l1 == report.loss == pytest.approx(mean, rel=1e-4), "a black start"
    assert report.brightness == 0
    with torch.no_grad():
        last = state.model.decoder.head.last
        last.load_state_dict(
            {"weight": torch.zeros_like(last.weight), "bias": torch.full((192,), mean / 2)}
        )
    assert take_step(state, [batch]).brightness == pytest.approx(0.5, rel=1e-4)  # float32 sums
    lengths = []
    for clip in (1e-3, 1e9):
        state = new_state(tiny_run(grad_clip=clip))
        report = take_step(state, [batch])
        grads = [w.grad.flatten() for w in state.model.parameters() if w.grad is not None]
        lengths.append((report.grad_norm, torch.cat(grads).norm().item()))
    (free, shortened), (free_again, unclipped) = lengths
    assert free == pytest.approx(free_again, rel=1e-5)  # float32 norm
    assert shortened == pytest.approx(1e-3, rel=1e-3)  # clip_grad_norm_ divides by norm + 1e-6
    assert unclipped == pytest.approx(free, rel=1e-5)


LATE = tiny_run(ema_decay=0.9, muon_rate=3.0, muon_takes="hidden", weight_decay=0.1)


@pytest.fixture
def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a processor decide as a card does."""
    for module in (step_module, optimizer):
        monkeypatch.setattr(module, "defers_sync", lambda _: True)


def batch_of(index: int, *, bad: bool = False) -> TrainingBatch:
    made = toy_batch(index)
    if bad:
        made.target_BVRR3[0, 0, 0, 0, 0] = math.inf
    return made


def taken(batches: list[TrainingBatch]) -> tuple[TrainState, list[bool]]:
    """Take steps and learn only at the end what they did."""
    state = new_state(LATE, muon_precision="float32")
    late, unread = stepper(state), []
    for each in batches:
        unread.append(late.launch([each], 3e-3))
        state.step += 1
    return state, [report.applied for report in late.sync(unread)[0]]


def tensors(state: TrainState) -> dict[str, Tensor]:
    assert state.ema_model is not None
    return {
        **state.model.state_dict(),
        **{f"mean/{name}": each for name, each in state.ema_model.state_dict().items()},
        **state.optimizer.optimizer_state(),
    }


def test_steps_that_are_not_finite_leave_no_trace(late: None) -> None:
    """Not in weights, means, memories or counts, at the start of a training or within it."""
    with_bad, applied = taken(
        [batch_of(0, bad=True), batch_of(1), batch_of(0, bad=True), batch_of(2)]
    )
    without, _ = taken([batch_of(1), batch_of(2)])
    assert applied == [False, True, False, True]
    found, wanted = tensors(with_bad), tensors(without)
    assert found.keys() == wanted.keys()
    for name, each in wanted.items():
        assert torch.equal(found[name], each), name


def test_kernels_update_as_the_host_does_but_for_rounding(
    request: pytest.FixtureRequest,
) -> None:
    host, late = with_gradients(), with_gradients()
    Optimizer(host, LATE, "float32").step(3e-3)
    request.getfixturevalue("late")
    Optimizer(late, LATE, "float32").step(3e-3, torch.tensor(0.0))
    for found, wanted in zip(late.parameters(), host.parameters(), strict=True):
        # units of the last place: the fused kernels add up in another order
        torch.testing.assert_close(found, wanted, rtol=2e-6, atol=1e-8)


@for_each("applied", [True, False])
def test_kernels_move_as_the_host_does_or_touch_nothing(applied: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    x, goal = (torch.randn(5, 7, generator=generator) for _ in range(2))
    if not applied:
        goal[0, 0] = math.nan
    skip = torch.tensor(float(not applied))
    share = ema_step(0.99, torch.tensor(30.0, dtype=torch.float64))
    assert float(share) == pytest.approx(ema_step(0.99, 30), rel=1e-7)
    assert isinstance(share, torch.Tensor) and share.dtype == torch.float32
    for move, by_hand in (
        (lambda y, late: move_towards([y], [goal], 0.05, late), x + 0.05 * (goal - x)),
        (lambda y, late: move_towards([y], [goal], share, late), x + float(share) * (goal - x)),
        (lambda y, late: move_along([y], [goal], 0.1, 0.02, late), 0.98 * x - 0.1 * goal),
    ):
        y = x.clone()
        move(y, skip)
        torch.testing.assert_close(y, by_hand if applied else x, rtol=1e-6, atol=1e-7)


def test_a_run_that_learns_late_is_the_same_run(
    late: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the window; skipped steps are named with their scenes; resumed to the bit."""
    write_toy_dataset(tmp_path / "data", train=6, validation=1)
    original = Stepper.launch

    def spoilt(self: Stepper, batches: list[TrainingBatch], *given: Any, **rest: Any) -> Tensor:
        for each in batches if self._state.step in (1, 6) else ():
            each.target_BVRR3[:] = math.inf
        return original(self, batches, *given, **rest)

    monkeypatch.setattr(Stepper, "launch", spoilt)

    def run(log_every: int, *, resume: bool = False) -> RunFolder:
        settings = tiny_run(num_steps=8, schedule="wsd", decay_share=0.4, log_every=log_every)
        out = tmp_path / f"window {log_every}"
        return trained(settings, [str(tmp_path / "data")], out, resume=resume).folder

    each, window = run(1), run(4)
    rows = [row for row in read_rows(window.metrics) if "loss" in row]
    first = [row["loss"] for row in read_rows(each.metrics) if "loss" in row][:4]
    assert first[1] is None
    assert rows[0]["loss"] == pytest.approx(sum(loss or 0 for loss in first) / 3)
    assert [row["skipped_steps"] for row in rows] == [1, 2]
    skips = [note for note in read_rows(window.notes) if "was skipped" in note["text"]]
    assert [note["step"] for note in skips] == [2, 7]
    assert all("its scenes were 0000" in note["text"] for note in skips)

    last = path_of_step(window.checkpoints, 8)
    wanted = read_checkpoint(path_of_step(each.checkpoints, 8)).arrays
    found = [read_checkpoint(last).arrays]
    last.unlink()
    assert saved_steps(window.checkpoints)[-1] == 5, "where the rate begins to fall: in a window"
    run(4, resume=True)
    found.append(read_checkpoint(last).arrays)
    for arrays in found:
        assert arrays.keys() == wanted.keys()
        assert all(np.array_equal(arrays[name], wanted[name]) for name in wanted)


PASSES = ((3, 5), (4, 9, 2), (6, 6), (7,), (11, 2), (8, 3, 5, 1))
"""Lengths of the scenes of passes: padded, of one length, and one alone."""


@pytest.fixture(autouse=True)
def forgets() -> Iterator[None]:
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


OBJECTIVE = TrainingLoss(LossSettings(perceptual="none"), None)


def _compile_by(patch: pytest.MonkeyPatch, backend: Callable[..., Any]) -> None:
    """Have modules compile by a backend."""
    real = torch.compile
    patch.setattr(torch, "compile", lambda f, **_: real(f, backend=backend, dynamic=True))
    patch.setattr(
        torch.nn.Module,
        "compile",
        lambda module, **_: setattr(
            module, "_compiled_call_impl", real(module._call_impl, backend=backend, dynamic=True)
        ),
    )


def _results(model: RenderFormer, lengths: tuple[int, ...]) -> dict[str, Tensor]:
    scenes = [random_scene(n, num_views=1, seed=n, dtype=torch.float32) for n in lengths]
    return picture_and_gradients(model, batch_scenes(scenes))


@pytest.mark.slow("training")  # Dynamo traces every layer
@pytest.mark.parametrize(
    ("backend", "passes", "most_graphs"), [("eager", PASSES, 15), ("inductor", ((3, 5), (2, 7)), 9)]
)
def test_compiled_layers_compute_the_same_and_three_kinds_of_pass_are_few_graphs(
    monkeypatch: pytest.MonkeyPatch,
    backend: str,
    passes: tuple[tuple[int, ...], ...],
    most_graphs: int,
) -> None:
    """Layers of a stage share a graph for every length: four functions, two graphs more a kind.

    Inductor guards on more than the lengths' being variables: its second pass has graphs too.
    """
    model = awake(tiny_config("linear"), dtype=torch.float32)
    plain = [_results(model, lengths) for lengths in passes]
    counter = CompileCounterWithBackend(backend)
    _compile_by(monkeypatch, counter)
    names = [name for name, _ in model.named_parameters()]
    assert compile_parts(model, OBJECTIVE, "yes", CPU)
    assert [name for name, _ in model.named_parameters()] == names, "checkpoints stay"
    for lengths, wanted in zip(passes, plain, strict=True):
        for name, found in _results(model, lengths).items():
            scale = wanted[name].abs().max().clamp(min=1e-3)
            assert (found - wanted[name]).abs().max() <= 2e-5 * scale, (lengths, name)
    assert 0 < counter.frame_count <= most_graphs
    if backend != "eager":
        return
    before = counter.frame_count
    _results(model, (2, 10, 4))
    assert counter.frame_count == before, "another length is no other graph"


@pytest.mark.slow("training")
def test_no_way_back_of_the_head_is_a_scatter() -> None:
    """Sums by atomics were 17 of 195 ms of a step of Base on an H100, and in any order."""
    fusion = Fusion(4, deepest=True)

    def forth_and_back() -> None:
        torch.compile(fusion)(None, torch.randn(1, 4, 4, 4), (8, 8)).sum().backward()

    _, codes = run_and_get_code(forth_and_back)
    assert any("mm(" in code for code in codes), "the products are among what is looked through"
    assert not any("index_put" in code for code in codes)


def test_a_part_is_one_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in the eyes of torch 2.11, which cuts where it is asked whether a device has autocast.

    On an H200 it compiled each norm of each layer alone then, and was not done within minutes.
    """

    def cut(_: str) -> bool:
        raise AssertionError("torch 2.11 cannot trace this question")

    monkeypatch.setattr(torch.amp, "is_autocast_available", cut)
    layers = {"encoder_layers": 1, "decoder_layers": 1}
    model = awake(tiny_config("linear", **layers), dtype=torch.float32)
    for module, method in compiled_parts(model, OBJECTIVE):
        assert method in ("forward", "keys_values")
        whole = torch.compile(
            getattr(module, method), backend="eager", dynamic=True, fullgraph=True
        )
        setattr(module, method, whole)
    _results(model, (3, 5))


def test_what_is_compiled_where(monkeypatch: pytest.MonkeyPatch) -> None:
    model, objective, card = awake(tiny_config()), OBJECTIVE, torch.device("cuda")
    layers = len(model.encoder.layers) + len(model.decoder.layers)
    assert len(list(compiled_parts(model, objective))) == layers + 2
    assert not compile_parts(model, objective, "auto", CPU)
    assert not compile_parts(model, objective, "no", card)
    monkeypatch.setattr(step_module, "_has_triton", lambda: False)
    assert not compile_parts(model, objective, "auto", card)
    with pytest.raises(TrilightError, match="triton"):
        compile_parts(model, objective, "yes", card)
    monkeypatch.setattr(step_module, "_has_triton", lambda: True)
    assert compile_parts(model, objective, "auto", card)


def _fails_to_compile(graph: object, inputs: object) -> object:
    raise AssertionError("no kernel for this")


def _uncompilable(monkeypatch: pytest.MonkeyPatch, compile: Compile) -> Stepper:
    """Return a stepper on the processor whose compiler, as on some card, fails."""
    monkeypatch.setattr(step_module, "_is_worthwhile", lambda _: True)
    _compile_by(monkeypatch, _fails_to_compile)
    return stepper(new_state(tiny_run(compile=compile)))


def test_what_cannot_be_compiled_is_trained_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """On an H200 torch 2.11 failed to compile `smoke`, and the run ended before its first step."""
    batch = toy_batch(0, 1)
    plain = stepper(new_state(tiny_run()))
    wanted = plain.step([batch], 1e-3)
    with monkeypatch.context() as patch:
        failing = _uncompilable(patch, compile="auto")
        assert failing.step([batch], 1e-3) == wanted
        (remark,) = failing.remarks
        assert "cannot compile" in remark and not failing.is_compiled
        assert failing.step([batch], 1e-3) == plain.step([batch], 1e-3)
        assert len(failing.remarks) == 1
    torch._dynamo.reset()
    insisting = _uncompilable(monkeypatch, compile="yes")
    with pytest.raises(TrilightError, match="cannot compile the network.*--set compile=no"):
        insisting.step([batch], 1e-3)
