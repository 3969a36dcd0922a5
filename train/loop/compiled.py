"""The parts of a step that torch.compile makes fewer and longer kernels of.

Layer by layer, not the whole network: the layers of a stage share their code, so it is compiled
once for all of them. Lengths and numbers of scenes are variables in it; what is compiled anew is
one scene beside several, a mask or none, and judging beside training. CUDA graphs are not used: a
step's kernels take longer than their launches (study S88).
"""

from collections.abc import Iterator

import torch
from torch import nn

from model.hits.decoder import HitDecoder
from model.renderformer import RenderFormer
from storage.errors import TrilightError
from train.loss.lpips import Lpips
from train.loss.objective import Objective
from train.settings import Compile

MOST_GRAPHS = 32
"""Variants of one function that torch keeps before it gives up on it; eight are its default. A few
are met: see above, twice for windows, which are cut in two ways."""


def compile_parts(
    model: RenderFormer, objective: Objective, wanted: Compile, device: torch.device
) -> bool:
    """Have the parts compiled, in place, when they are first used; return whether they will be.

    Names and values of weights stay, so checkpoints do.

    Raises:
        TrilightError: it is wanted and this torch cannot.
    """
    if wanted == "no" or (wanted == "auto" and not _worth_it(device)):
        return False
    if device.type == "cuda" and not _has_triton():
        raise TrilightError(
            "compile is yes, but torch finds no Triton, which it needs on a card; expected the "
            "package triton. Install it, or --set compile=no."
        )
    torch._dynamo.config.recompile_limit = max(MOST_GRAPHS, torch._dynamo.config.recompile_limit)
    if device.type == "cuda":
        _without_tiling_analysis()
    for _, module, method in compiled_parts(model, objective):
        if method == "forward":
            module.compile(dynamic=True)
        else:
            setattr(module, method, torch.compile(getattr(module, method), dynamic=True))
    return True


def undo_compiling(model: RenderFormer, objective: Objective) -> None:
    """Have the parts run as they were before `compile_parts`, kernel by kernel."""
    for _, module, method in compiled_parts(model, objective):
        if method == "forward":
            module._compiled_call_impl = None
        elif method in vars(module):
            delattr(module, method)


def is_of_the_compiler(error: Exception) -> bool:
    """Return whether an error says that torch could not compile, not that a step went wrong."""
    from torch._dynamo.exc import TorchDynamoException
    from torch._inductor.exc import InductorError

    return isinstance(error, TorchDynamoException | InductorError)


def _without_tiling_analysis() -> None:
    """Switch off an analysis that does not know variable lengths, which ours are.

    On an H200, torch 2.11 ended there with an assertion in the way back of `smoke` and `pretrain`
    (pytorch/pytorch issues 181563 and 197077); the second is open in later versions too.
    """
    import torch._inductor.config as inductor

    inductor.triton.coalesce_tiling_analysis = False


def compiled_parts(
    model: RenderFormer, objective: Objective
) -> Iterator[tuple[str, nn.Module, str]]:
    """Yield what is compiled: the name of the part, its module, and the method that is called."""
    if model.encoder is not None:
        for layer in model.encoder.layers:
            yield "encoder layers", layer, "forward"
        yield "keys and values", model.decoder, "keys_values"
    for layer in model.decoder.layers:
        yield "decoder layers", layer, "forward"
    if isinstance(model.decoder, HitDecoder) and model.decoder.filter is not None:
        yield "filter", model.decoder.filter, "mixed"
    yield "head", model.decoder.head, "forward"
    for module in objective.modules():
        if isinstance(module, Lpips):
            yield "LPIPS", module, "forward"


def _worth_it(device: torch.device) -> bool:
    return device.type == "cuda" and _has_triton()


def _has_triton() -> bool:
    from torch.utils._triton import has_triton

    return has_triton()
