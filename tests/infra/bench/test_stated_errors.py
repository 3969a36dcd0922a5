"""The fit of stated errors: on made-up layouts whose true errors are known by their measures."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from infra.bench import stated_errors
from infra.bench.experiments.calibration import FIGURES, KINDS, LOOKS, has_wide, use_of
from infra.bench.stated_errors import (
    ALLOWED,
    Look,
    cross_fitted,
    filter_known,
    fit_metric,
    fit_weights,
    judge,
    largest_shift,
    main,
    read_looks,
    stated_by,
    stops,
    true_db,
)
from infra.bench.store import Store
from pipeline.renders.calibrated_error import load_statement, versions_of_pictures
from storage.errors import TrilightError

MEASURES = ("estimate", "agreement", "move", "surprise", "sure")


def made_up_looks(num_layouts: int, seed: int = 0) -> list[Look]:
    """Return looks whose true error is the geometric mean of two measures, times a factor."""
    rng = np.random.default_rng(seed)
    looks = []
    for layout in range(num_layouts):
        hardness = rng.normal(0, 4)
        for px in LOOKS:
            if px == 256 and not has_wide(layout):
                continue
            for spp in LOOKS[px]:
                figures = dict.fromkeys(FIGURES, 1.0) | {"spp": float(spp), "hits": 0.5}
                for metric in ("log", "linear", "object"):
                    errors = 10 ** ((hardness + rng.normal(0, 1, 5)) / 10) * 100 / spp * 64
                    figures |= {
                        f"{metric}_{name}": float(error)
                        for name, error in zip(MEASURES, errors, strict=True)
                    }
                    true = np.sqrt(errors[1] * errors[3]) * 10 ** (rng.normal(0, 0.5) / 10)
                    figures |= {f"{metric}_true": float(true), f"{metric}_open": 0.1 * float(true)}
                    figures[f"bound_{metric}"] = -10 * float(np.log10(2e-6 * true))
                looks.append(
                    Look(
                        layout=layout,
                        source="builtin:",
                        family="plane-single",
                        kind=KINDS[layout % len(KINDS)],
                        px=px,
                        figures=figures,
                    )
                )
    return looks


def test_the_fit_finds_what_matters_and_keeps_its_risk_on_other_layouts() -> None:
    looks = made_up_looks(240)
    found = fit_metric("log", looks)
    weights = found.weights
    assert min(weights[name] for name in MEASURES) >= 0
    assert min(weights["agreement"], weights["surprise"]) > 0.35
    assert max(weights["estimate"], weights["move"], weights["sure"]) < 0.1
    judging = [look for look in looks if look.use == "judge" and look.px > 64]
    result = judge("log", judging, stated_by("log", found, judging))
    assert result.over_1 <= 2 * ALLOWED["log"]["wide"], "0.5 dB of noise, of which 1.5 % may be out"
    assert 0 < result.caution_db < 2
    assert found.judged["128"].layouts == 120


def test_the_shift_keeps_the_risk_also_where_sampling_stops_and_a_larger_one_does_not() -> None:
    looks = [look for look in made_up_looks(200) if look.px == 128]
    center = cross_fitted("log", looks)

    def risk(shift_db: float) -> float:
        stated = center + shift_db
        wrong = stated - true_db("log", looks) > 1
        return max(wrong.mean(), wrong[stops("log", looks, stated)].mean())

    shift_db = largest_shift("log", looks, center, 0.015)
    assert risk(shift_db) <= 0.015 < risk(shift_db + 0.05)


def test_sampling_stops_at_the_first_look_that_states_the_target() -> None:
    looks = [look for look in made_up_looks(1) if look.px == 128]
    stated = np.array([33.0, 35.0, 39.0, 41.0])
    rows = stops("log", looks, stated)
    assert rows == [1, 2, 2, 3, 3, 3], "34 to 44 dB"


def test_what_the_reference_leaves_open_is_left_out() -> None:
    (look, *_) = made_up_looks(1)
    for figures in ({"log_open": 0.5, "log_true": 1.0}, {"log_true": -1.0}):
        assert not filter_known(
            "log", [dataclasses.replace(look, figures={**look.figures, **figures})]
        )
    assert filter_known("log", [look]) == [look]


def test_fitted_weights_do_not_depend_on_the_unit_of_a_measure() -> None:
    looks = [look for look in made_up_looks(40) if look.px == 64]
    other = [
        dataclasses.replace(
            look, figures={**look.figures, "log_move": 9 * look.figures["log_move"]}
        )
        for look in looks
    ]
    (_, ours), (_, theirs) = fit_weights("log", looks), fit_weights("log", other)
    assert ours == pytest.approx(theirs, abs=1e-6)


def _written(path: Path, looks: list[Look], versions: dict[str, str]) -> None:
    trials = {
        look.layout: f"layout {look.layout}, {look.source}, {look.family}, {look.kind}, "
        f"{use_of(look.layout)}"
        for look in looks
    }
    points = [f"{px} px, {spp} samples" for px, spps in LOOKS.items() for spp in spps]
    store = Store(path)
    run = store.begin(
        {
            "experiment": "calibration",
            "machine": {"versions": versions},
            "figures": list(FIGURES),
            "points": [{"name": name} for name in points],
            "trials": list(trials.values()),
        }
    )
    by_point = {
        (look.layout, f"{look.px} px, {look.figures['spp']:.0f} samples"): look for look in looks
    }
    for layout, trial in trials.items():
        for point in points:
            look = by_point.get((layout, point))
            store.add(run, trial, point, look.figures if look else {})


def test_rows_come_to_a_file_that_pictures_are_stated_by(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, file = tmp_path / "rows.jsonl", tmp_path / "stated_errors.json"
    page = tmp_path / "page.md"
    page.write_text("# Head\n\nMade by `python -m infra.bench.stated_errors`: stale\n")
    monkeypatch.setattr(stated_errors, "FILE", file)
    monkeypatch.setattr(stated_errors, "PAGE", page)
    looks = made_up_looks(33)
    _written(rows, looks, versions_of_pictures())
    assert len(read_looks(rows)) == len(looks)
    main([str(rows)])
    statement = load_statement(file)
    assert statement is not None and statement.spp == (32, 288) and statement.widths == (64, 256)
    text = page.read_text()
    assert text.startswith("# Head\n") and "stale" not in text and text.count("| six measures") == 2


def test_rows_of_other_versions_do_not_count(tmp_path: Path) -> None:
    rows = tmp_path / "rows.jsonl"
    _written(rows, made_up_looks(20), {**versions_of_pictures(), "denoiser": "0"})
    with pytest.raises(TrilightError, match="it has 0 layouts .* expected 8"):
        read_looks(rows)
