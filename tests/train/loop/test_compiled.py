"""Compiled layers compute what layers compute, from one graph for all of them and all lengths."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._dynamo.testing import CompileCounterWithBackend
from torch._inductor.utils import run_and_get_code

from model.image_head import Fusion
from model.renderformer import RenderFormer
from model.scene_tensors import batch_scenes
from storage.errors import TrilightError
from tests.model.kit import RESOLUTION, awake, random_scene, tiny_config
from tests.train.kit import CPU, stepper, tiny_run
from tests.train.toy import toy_sample
from train.data.buckets import collate_batch
from train.data.scenes import training_scene
from train.loop import compiled
from train.loop.compiled import compile_parts, compiled_parts, undo_compiling
from train.loop.state import new_state
from train.loop.step import Stepper
from train.loss.objective import TrainingLoss
from train.settings import Compile, LossSettings

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
    model.zero_grad()
    scenes = [random_scene(n, num_views=1, seed=n, dtype=torch.float32) for n in lengths]
    picture = model(batch_scenes(scenes), RESOLUTION)
    picture.square().sum().backward()
    grads = {name: weight.grad for name, weight in model.named_parameters()}
    return {"picture": picture.detach(), **{k: v for k, v in grads.items() if v is not None}}


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

    def step() -> None:
        torch.compile(fusion)(None, torch.randn(1, 4, 4, 4), (8, 8)).sum().backward()

    _, codes = run_and_get_code(step)
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
    for _, module, method in compiled_parts(model, OBJECTIVE):
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
    monkeypatch.setattr(compiled, "_has_triton", lambda: False)
    assert not compile_parts(model, objective, "auto", card)
    with pytest.raises(TrilightError, match="triton"):
        compile_parts(model, objective, "yes", card)
    monkeypatch.setattr(compiled, "_has_triton", lambda: True)
    assert compile_parts(model, objective, "auto", card)


def _fails_to_compile(graph: object, inputs: object) -> object:
    raise AssertionError("no kernel for this")


def _uncompilable(monkeypatch: pytest.MonkeyPatch, compile: Compile) -> Stepper:
    """Return a stepper on the processor whose compiler, as on some card, fails."""
    monkeypatch.setattr(compiled, "_is_worthwhile", lambda _: True)
    _compile_by(monkeypatch, _fails_to_compile)
    run = tiny_run(compile=compile)
    return stepper(new_state(run), run)


def test_what_cannot_be_compiled_is_trained_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """On an H200 torch 2.11 failed to compile `smoke`, and the run ended before its first step."""
    batch = collate_batch([training_scene(toy_sample(index), 16) for index in (0, 1)])
    plain = stepper(new_state(tiny_run()), tiny_run())
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


def test_compiling_is_undone() -> None:
    model, objective = awake(tiny_config()), OBJECTIVE
    compile_parts(model, objective, "yes", CPU)
    undo_compiling(model, objective)
    for _, module, method in compiled_parts(model, objective):
        assert module._compiled_call_impl is None and method not in vars(module)
