"""Modules of a training step that torch.compile fuses into fewer kernels.

Layers are compiled one by one, not the whole network: the layers of a stage share their code, which
is compiled once for all of them. Lengths and numbers of scenes are dynamic; separate variants are
compiled for one or several scenes, with or without a mask, and for training and evaluation. CUDA
graphs are not used: a step's kernels take longer than their launches (study S88).
"""

from collections.abc import Iterator

import torch
from torch import nn

from model.hits.decoder import HitDecoder
from model.renderformer import RenderFormer
from storage.errors import TrilightError
from train.loss.lpips import Lpips
from train.loss.training_loss import TrainingLoss
from train.settings import Compile

MAX_GRAPHS = 32
"""Maximum number of variants of one function before torch stops compiling it; its default is eight.
See above for the variants; windows, which are cut in two ways, double them."""


def compile_parts(
    model: RenderFormer, objective: TrainingLoss, mode: Compile, device: torch.device
) -> bool:
    """Enable compilation in place, at first use; return whether it is enabled.

    Names and values of weights do not change, so that checkpoints stay valid.

    Raises:
        TrilightError: `mode` is yes and this torch cannot compile.
    """
    if mode == "no" or (mode == "auto" and not _is_worthwhile(device)):
        return False
    if device.type == "cuda" and not _has_triton():
        raise TrilightError(
            "compile is yes, but torch finds no Triton, which it needs on a GPU; expected the "
            "package triton. Install it, or --set compile=no."
        )
    torch._dynamo.config.recompile_limit = max(MAX_GRAPHS, torch._dynamo.config.recompile_limit)
    if device.type == "cuda":
        import torch._inductor.config as inductor

        # It fails on dynamic lengths: on an H200, torch 2.11 failed there with an assertion in the
        # backward pass of `smoke` and `pretrain` (pytorch/pytorch issues 181563 and 197077); the
        # second is open in later versions too.
        inductor.triton.coalesce_tiling_analysis = False
    for module, method in compiled_parts(model, objective):
        if method == "forward":
            module.compile(dynamic=True)
        else:
            setattr(module, method, torch.compile(getattr(module, method), dynamic=True))
    return True


def undo_compiling(model: RenderFormer, objective: TrainingLoss) -> None:
    """Disable the compilation that `compile_parts` enabled."""
    for module, method in compiled_parts(model, objective):
        if method == "forward":
            module._compiled_call_impl = None
        elif method in vars(module):
            delattr(module, method)


def is_compiler_error(error: Exception) -> bool:
    """Return whether an error comes from torch's compiler and not from the step."""
    from torch._dynamo.exc import TorchDynamoException
    from torch._inductor.exc import InductorError

    return isinstance(error, TorchDynamoException | InductorError)


def compiled_parts(model: RenderFormer, objective: TrainingLoss) -> Iterator[tuple[nn.Module, str]]:
    """Yield what is compiled: the module, and the method that is called."""
    if model.encoder is not None:
        yield from ((layer, "forward") for layer in model.encoder.layers)
        yield model.decoder, "keys_values"
    yield from ((layer, "forward") for layer in model.decoder.layers)
    if isinstance(model.decoder, HitDecoder) and model.decoder.filter is not None:
        yield model.decoder.filter, "mix_level"
    yield model.decoder.head, "forward"
    yield from ((each, "forward") for each in objective.modules() if isinstance(each, Lpips))


def _is_worthwhile(device: torch.device) -> bool:
    return device.type == "cuda" and _has_triton()


def _has_triton() -> bool:
    from torch.utils._triton import has_triton

    return has_triton()
