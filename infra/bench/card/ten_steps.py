"""Steps of a named run on the card, at its own size or with fewer scenes where memory lacks."""

import dataclasses
import gc
import statistics
import time
from typing import Any

import torch

from infra.bench.card.drawn_batch import drawn_batch, drawn_lpips, unweighted, workloads
from infra.bench.card.effort import CardEffort, sized
from infra.bench.card.probe import wait_for
from infra.bench.card.step_profile import marked_parts, profiled
from model.costs import training_flops
from model.renderformer import count_parameters
from train.loop.crew import Crew
from train.loop.state import new_state
from train.loop.step import Stepper
from train.loss.objective import Objective
from train.runs import named_run
from train.settings import TrainSettings

THIN = (4, 8, 16, 16, 16)
"""Channels of LPIPS where runs are shrunk."""


def steps_of_run(run: str, effort: CardEffort, device: torch.device) -> dict[str, Any]:
    """Return what steps of a run take, with one pass of as many scenes as it has or memory holds.

    A run that fails has `failed`, with why: the others are measured all the same.
    """
    settings = unweighted(sized(named_run(run), effort))
    asked = min(settings.scenes_per_pass, settings.scenes_per_step)
    record = {"run": run, "asked_scenes": asked, "pixels": settings.resolution,
              "triangles": workloads(settings, 1)[0].triangles, "views": settings.views_per_scene,
              "precision": settings.precision}  # fmt: skip
    scenes, why = asked, ""
    while scenes:
        try:
            found = _measured(settings, scenes, effort, device)
            if device.type == "cuda" and settings.compile == "auto":
                found["not_compiled"] = _not_compiled(settings, scenes, effort, device)
            return record | found
        except torch.OutOfMemoryError:
            why = "too little memory, even for one scene a pass"
            scenes //= 2
        except Exception as error:  # of torch's compiler too, which has classes of its own
            return record | {"failed": f"{type(error).__name__}: {str(error)[:500]}"}
        finally:
            _give_back(device)
    return record | {"failed": why}


def _give_back(device: torch.device) -> None:
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def _not_compiled(
    settings: TrainSettings, scenes: int, effort: CardEffort, device: torch.device
) -> dict[str, Any] | None:
    """Return times, kernels and memory without torch.compile; None where memory lacks."""
    _give_back(device)
    try:
        found = _measured(dataclasses.replace(settings, compile="no"), scenes, effort, device)
    except torch.OutOfMemoryError:
        return None
    kept = {name: found[name] for name in ("first_step_s", "step_ms", "peak_gib")}
    return kept | {"kernels": found["profile"]["kernels"]}


def _measured(
    settings: TrainSettings, scenes: int, effort: CardEffort, device: torch.device
) -> dict[str, Any]:
    state = new_state(settings, device)
    lpips = drawn_lpips(settings, THIN) if effort.shrunk else drawn_lpips(settings)
    objective = Objective(settings.loss, lpips).to(device)
    stepper = Stepper(state, settings, objective, Crew(device=device))
    batch = drawn_batch(settings, scenes).to(device)  # a run sends the next while one is computed

    def step() -> None:
        report = stepper.step([batch], settings.learning_rate)
        state.step += 1
        state.skipped_steps += not report.applied

    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    first, times = _timed(step, effort, device)
    peak = torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else None
    with marked_parts(state.model, objective, state.updater):
        profile = profiled(step, device)
    step_s = statistics.median(times)
    flops = sum(training_flops(settings.model, each) for each in workloads(settings, scenes))
    return {
        "scenes": scenes,
        "parameters": count_parameters(state.model),
        "muon": settings.muon_rate > 0,
        "lpips": lpips is not None,
        "first_step_s": first,
        "step_ms": [round(1e3 * each, 3) for each in times],
        "views_per_s": scenes * settings.views_per_scene / step_s,
        "teraflop": flops / 1e12,
        "teraflop_per_s": flops / step_s / 1e12,
        "peak_gib": peak,
        "skipped_steps": state.skipped_steps,
        "profile": profile,
    }


def _timed(step: Any, effort: CardEffort, device: torch.device) -> tuple[float, list[float]]:
    """Return the seconds of the first step, and of each that counts."""
    times = []
    for _ in range(effort.warm_steps + effort.steps):
        began = time.perf_counter()
        step()
        wait_for(device)
        times.append(time.perf_counter() - began)
    return times[0], times[effort.warm_steps :]
