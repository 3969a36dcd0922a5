"""Training step: one update of the weights, or none if it is not finite.

`Stepper.launch` enqueues a step and returns its statistics on the device; `Stepper.sync` waits for
them. On a CPU a step is synced at once, on a GPU once per window (loop.trainer), so that the host
keeps the GPU's queue full. Torch fuses the modules of a step into fewer kernels (`compile_parts`).
"""

import contextlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from model.hits.decoder import HitDecoder
from model.precision import fast_float32_products
from model.renderformer import RenderFormer
from storage.errors import TrilightError
from train.data.buckets import TrainingBatch
from train.loop.distributed import DistributedContext
from train.loop.optimizer import defers_sync
from train.loop.train_state import TrainState
from train.loss.training_loss import Lpips, TrainingLoss
from train.monitoring.process_monitor import Activity, LayerNorms
from train.settings import Compile, Precision, TrainSettings


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """Statistics of one step over all processes."""

    loss: float
    """Mean of the total loss over the views of the step."""
    l1: float
    """Mean of the L1 term of the loss, unweighted."""
    brightness: float
    """Mean log10(1 + radiance) of the predicted pictures, divided by that of the targets."""
    grad_norm: float
    """L2 norm of the gradient before clipping."""
    applied: bool
    """False if loss or gradient was not finite and the weights stayed unchanged."""


PendingStats = Tensor
"""Statistics of a step, float64 [7] on the device: loss, L1, predicted and target brightness,
gradient norm, 1 if it was applied, above 0 if a process was asked to stop."""


class Stepper:
    """Takes optimizer steps of a state's network, together with the other processes."""

    def __init__(
        self,
        state: TrainState,
        objective: TrainingLoss,
        dist_context: DistributedContext,
    ) -> None:
        self._state = state
        self._settings = settings = state.settings
        self._objective = objective
        self._dist_context = dist_context
        self.defer_sync = defers_sync(dist_context.device)
        self._updates = torch.full(
            (), float(state.updates), dtype=torch.float64, device=dist_context.device
        )
        self.activity = Activity()
        self.layers = LayerNorms(state.model)
        self.is_compiled = compile_parts(
            state.model, objective, settings.compile, dist_context.device
        )
        self.remarks: list[str] = []  # for the notes of the run
        self._net: nn.Module = state.model
        if dist_context.world_size > 1:
            # Every weight is used. With find_unused_parameters=False torch would regroup the
            # gradients after the first step and sum them in another order from then on: a resumed
            # run would differ in the last bits.
            with warnings.catch_warnings():  # torch 2.13 has another name, which 2.11 lacks
                warnings.filterwarnings("ignore", "`broadcast_buffers` is", FutureWarning)
                self._net = DistributedDataParallel(
                    state.model, broadcast_buffers=False, find_unused_parameters=True
                )

    def step(self, batches: Sequence[TrainingBatch], learning_rate: float) -> StepReport:
        """Launch a step, wait for it, and return its report; see `launch`."""
        (report,), _ = self.sync([self.launch(batches, learning_rate)])
        return report

    def launch(
        self,
        batches: Sequence[TrainingBatch],
        learning_rate: float,
        *,
        asked_to_stop: bool = False,
    ) -> PendingStats:
        """Enqueue one step: the mean gradient over all views of all processes, and the update.

        The host does not wait for a GPU; `sync` reads the returned statistics.

        Args:
            batches: batches of this process; every process must hold equally many views.
            asked_to_stop: True if this process received a signal; the statistics carry it to all.

        Raises:
            TrilightError: torch cannot compile the network, and `compile` is yes or there are
                several processes. Otherwise the step runs without compilation.
        """
        try:
            return self._launch_once(batches, learning_rate, asked_to_stop=asked_to_stop)
        except Exception as error:
            if not (self.is_compiled and is_compiler_error(error)):
                raise
            what = f"torch {torch.__version__} cannot compile the network ({type(error).__name__})"
            if self._settings.compile == "yes" or self._dist_context.world_size > 1:
                raise TrilightError(
                    f"training: {what}; expected a version that can. Say --set compile=no, with "
                    "--resume where there is a checkpoint, or install another torch."
                ) from error
        undo_compiling(self._state.model, self._objective)  # the weights have not moved yet
        self.is_compiled = False
        self.remarks.append(f"{what}: it runs kernel by kernel, which takes longer")
        return self._launch_once(batches, learning_rate, asked_to_stop=asked_to_stop)

    def _launch_once(
        self, batches: Sequence[TrainingBatch], learning_rate: float, *, asked_to_stop: bool
    ) -> PendingStats:
        state = self._state
        activity = self.activity
        state.optimizer.zero_grad()
        num_views = sum(batch.noise_BV.numel() for batch in batches)
        sums = torch.zeros(4, dtype=torch.float64, device=self._dist_context.device)
        for index, batch in enumerate(batches):
            last = index == len(batches) - 1
            net = self._net  # the gradients are exchanged with the last batch's
            distributed_net = not last and isinstance(net, DistributedDataParallel) and net
            with distributed_net.no_sync() if distributed_net else contextlib.nullcontext():
                sums += self._add_gradient(
                    batch.to(self._dist_context.device), num_views, last=last
                )
        activity.begin("optimiser")
        with self.layers.measured_update():
            norm = nn.utils.clip_grad_norm_(state.model.parameters(), self._settings.grad_clip)
            activity.begin("exchange")
            stop_flag = torch.full_like(sums[:1], float(asked_to_stop))
            means = self._dist_context.mean_on_device(torch.cat([sums / num_views, stop_flag]))
            activity.begin("optimiser")
            applied = self._move(means[0], norm, learning_rate)
        activity.begin("other")
        return torch.cat([means[:4], torch.stack([norm.to(means), applied.to(means)]), means[4:]])

    @torch.no_grad()
    def _move(self, loss: Tensor, norm: Tensor, learning_rate: float) -> Tensor:
        """Update weights and EMA if the step is finite; return whether it is, bool []."""
        state = self._state
        applied = torch.isfinite(loss) & torch.isfinite(norm)
        if self.defer_sync:  # the kernels read whether the step is skipped
            skip = (~applied).float()
            state.optimizer.step(learning_rate, skip)
            state.update_ema(self._updates, skip)
        elif applied:
            state.optimizer.step(learning_rate)
            state.update_ema(state.updates, None)
        self._updates += applied
        return applied

    def sync(self, steps: Sequence[PendingStats]) -> tuple[list[StepReport], bool]:
        """Wait for steps with a single copy to the host.

        Returns:
            The report of each step, in their order, and whether any process received a signal
            before one of them, which is equal in all processes.
        """
        self.activity.begin("device")
        rows = torch.stack([*steps]).tolist()
        self.activity.begin("other")
        reports = [
            StepReport(
                loss=loss,
                l1=l1,
                brightness=predicted_mean / target_mean if target_mean > 0 else 1.0,
                grad_norm=grad_norm,
                applied=bool(applied),
            )
            for loss, l1, predicted_mean, target_mean, grad_norm, applied, _ in rows
        ]
        return reports, any(row[-1] > 0 for row in rows)

    def _add_gradient(self, batch: TrainingBatch, num_views: int, *, last: bool) -> Tensor:
        """Add one batch's gradient; return its sums of loss, L1, and both brightnesses."""
        self.activity.begin("forward")
        resolution = batch.target_BVRR3.shape[2]
        prediction = predict_log10(self._net, batch, resolution, self._settings.precision)
        total_BV, l1_BV = self._objective(prediction, batch.target_BVRR3, batch.noise_BV)
        self.activity.begin("backward")
        if last and self._dist_context.world_size > 1:
            prediction.register_hook(self._note_exchange)
        with fast_float32_products(
            self._dist_context.device, enabled=self._settings.precision == "bfloat16"
        ):
            (total_BV.sum() / num_views).backward()
        self.activity.begin("other")
        predicted_BV = prediction.detach().clamp(min=0).mean(dim=(2, 3, 4))
        target_BV = batch.target_BVRR3.mean(dim=(2, 3, 4))
        parts = [total_BV.detach(), l1_BV, predicted_BV, target_BV]
        return torch.stack([part.sum() for part in parts]).double()

    def _note_exchange(self, _: Tensor) -> None:
        """Mark when this process's gradient is complete, before it waits for the others'.

        Torch runs queued callbacks of a backward pass in order, and DistributedDataParallel queues
        its wait later, when the last gradient is complete.
        """
        queue = torch.autograd.Variable._execution_engine.queue_callback
        queue(lambda: self.activity.begin("exchange"))


def predict_log10(
    net: Callable[..., Tensor], batch: TrainingBatch, resolution: int, precision: Precision
) -> Tensor:
    """Return log10(1 + radiance) [B, V, R, R, 3] before the ELU, float32.

    With bfloat16 the products of the network are rounded to it, positions are not.
    """
    reduced = precision == "bfloat16"
    with torch.autocast(batch.noise_BV.device.type, torch.bfloat16, enabled=reduced):
        prediction = net(batch.scenes, resolution)
    return prediction.float()


_SAID_ON_CPU = "can't allocate memory"
"""Text of torch's error on a CPU without enough memory; on a GPU the error has its own class."""


@contextmanager
def explain_out_of_memory(settings: TrainSettings, step: int) -> Iterator[None]:
    """Convert out-of-memory errors of the block into a TrilightError with remedies.

    Args:
        step: number of steps that are done.
    """
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError, RuntimeError) as error:
        of_memory = isinstance(error, torch.OutOfMemoryError | MemoryError)
        if not of_memory and _SAID_ON_CPU not in str(error):
            raise
        most = min(settings.scenes_per_pass, settings.scenes_per_step)
        advice = (
            "One scene at a time and without its activations needs less than any setting can save; "
            "expected a machine with more memory."
        )
        if most > 1:
            advice = (
                f"Go on with --resume --set scenes_per_pass={most // 2} instead of {most}, which "
                "adds up the same gradients; --set recompute_activations=true takes less memory "
                "too."
            )
        elif not settings.recompute_activations:
            advice = "Go on with --resume --set recompute_activations=true, which takes longer."
        raise TrilightError(
            f"training: too little memory in step {step + 1}; the newest checkpoint is safe. "
            f"{advice}"
        ) from error


MAX_GRAPHS = 32
"""Maximum number of variants of one function before torch stops compiling it; its default is eight.
Lengths and numbers of scenes are dynamic; separate variants are compiled for one or several scenes,
with or without a mask, and for training and evaluation. Windows, which are cut in two ways, double
them. CUDA graphs are not used: a step's kernels take longer than their launches (study S88)."""


def compile_parts(
    model: RenderFormer, objective: TrainingLoss, mode: Compile, device: torch.device
) -> bool:
    """Enable compilation in place, at first use; return whether it is enabled.

    Layers are compiled one by one, not the whole network: the layers of a stage share their code,
    which is compiled once for all of them. Names and values of weights do not change, so that
    checkpoints stay valid.

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
