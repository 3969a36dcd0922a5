"""Statement of a picture's error that is calibrated on other scenes of known error.

Six measures that the halves of a picture give (`ErrorMeasures`) are put together as a weighted
geometric mean, in dB: no single noisy one carries the statement, and each error that grows lowers
it. Weights and shifts are read from stated_errors.json, which `python -m infra.bench.stated_errors`
fits on the rows of `trilight bench calibration`. With other versions than those rows have, and
outside of their range, the bound of pipeline.renders.noise_floor is stated instead.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.noise_floor import BLOCK_PX, FLOOR_METRICS, ErrorMeasures, by_metric
from pipeline.renders.samples import TILE_PX, DualBuffer, gaps_db
from pipeline.renders.settings import FIRST_SPP, PASS_SPP, RenderSettings
from pipeline.renders.view_pictures import (
    DARKER,
    GLINT,
    LEAST_PASSES,
    MOST_APART,
    STANDARD_ERRORS,
    STANDS_OUT,
)
from storage.digests import canonical_json, sha256_hex
from storage.metrics import MAX_DB
from storage.records.sample import PictureErrors
from storage.settings.ranges import Within
from storage.typed_json import Sha256, ShortText, read_json

_CODE = 1
"""Number to raise where pictures or measures change without a change of a constant below."""

FILE = Path(__file__).with_name("stated_errors.json")
_FIELDS = dict(zip(("log", "linear", "object"), FLOOR_METRICS, strict=True))
"""Field of PictureErrors by metric."""

METRICS = tuple(_FIELDS)
MEASURES = ("estimate", "agreement", "move", "surprise", "sure")
"""Measures whose weights are at least 0; the share of hits, samples and width come beside them."""

LEAST_ERROR = 1e-10
"""Squared errors below this count as this: 100 dB."""

_LEAST_HITS = 1e-3
_NARROW_PX = 128
"""Narrower pictures have shifts of their own."""
_WIDE_PX = 256
"""Pictures from this width on have shifts of their own."""

Number = Annotated[float, Within(-1e3, 1e3)]


@dataclass(frozen=True, kw_only=True)
class JudgedShare:
    """Record of a metric on layouts that neither fitted nor calibrated it, at one width."""

    pictures: int
    layouts: int
    over_1: Number
    """Share of the pictures that are more than 1 dB worse than stated."""
    over_3: Number
    """The same for 3 dB."""
    caution_db: Number
    """Median of true over stated errors, in dB."""


@dataclass(frozen=True, kw_only=True)
class MetricStatement:
    """The statement of one metric, in dB."""

    intercept: Number
    weights: Mapping[str, Number]
    """Weights of MEASURES in dB, of `hits` (10 log10 of the share), and of `samples` and `width`
    (log2 of their ratios to 64 samples and 128 pixels)."""
    bound: Mapping[str, Number]
    """Shifts of the bound by group of widths (`group_of`)."""
    expected: Mapping[str, Number]
    """Shifts of the expected error by group of widths."""
    judged: Mapping[str, JudgedShare]
    """Records by width in pixels."""

    def center_db(self, measures: ErrorMeasures, resolution: int, spp: float) -> float:
        """Return the weighted mean in dB, without a shift."""
        terms = terms_of(measures, resolution, spp)
        return self.intercept + sum(self.weights[name] * terms[name] for name in terms)


@dataclass(frozen=True, kw_only=True)
class CalibratedStatement:
    """Content of stated_errors.json."""

    rows: ShortText
    """File of the rows, in the repository."""
    rows_sha256: Sha256
    layouts: int
    """Number of layouts that fitted and calibrated it."""
    versions: Mapping[str, ShortText]
    """Versions of the pictures in the rows, as `versions_of_pictures` returns them."""
    spp: tuple[int, int]
    """Range of samples per pixel."""
    widths: tuple[int, int]
    """Range of widths in pixels."""
    metrics: Mapping[str, MetricStatement]

    def state(
        self, measures: Mapping[str, ErrorMeasures], resolution: int, spp: int
    ) -> tuple[PictureErrors, PictureErrors]:
        """Return what a picture's errors are calibrated to keep, and what they are expected to be.

        Args:
            measures: of the picture by metric.
            resolution: width of the picture in pixels.
            spp: samples per pixel.
        """
        group = group_of(resolution)
        bound = dict[str, float]()
        expected = dict[str, float]()
        for name, measured in measures.items():
            metric = self.metrics[name]
            is_empty = name == "object" and not measured.hits
            center_db = MAX_DB if is_empty else metric.center_db(measured, resolution, spp)
            for result, shifts in ((bound, metric.bound), (expected, metric.expected)):
                shift_db = 0.0 if is_empty else shifts[group]
                result[_FIELDS[name]] = min(MAX_DB, center_db + shift_db)
        return PictureErrors(**bound), PictureErrors(**expected)


OUTSIDE = "other samples, widths, filters, layers or versions than measured, or guided paths"
"""Reasons for the bound of noise_floor, for people."""


def promise_sentence(resolution: int) -> str:
    """Return what a stated log error promises at a width, as measured on other scenes; a sentence.

    The width is the next one below that was judged, or the smallest.
    """
    statement = load_statement()
    if statement is None:
        return f"The stated error is a bound ({OUTSIDE})."
    judged = statement.metrics["log"].judged
    widths = sorted(map(int, judged))
    width = max((px for px in widths if px <= resolution), default=widths[0])
    record = judged[str(width)]
    good = min(99, math.floor(100 - 100 * record.over_1))
    return (
        f"Of a hundred pictures of scenes like those that calibrated it, {good} or more are at "
        f"most 1 dB worse, and half are {record.caution_db:.1f} dB better "
        f"({record.pictures} pictures of {record.layouts} layouts at {width} px)."
    )


def terms_of(measures: ErrorMeasures, resolution: int, spp: float) -> dict[str, float]:
    """Return the terms of a statement by the names of their weights.

    Unbiased measures may be below 0 by chance: they are at least a quarter of the agreement.
    """
    least = measures.agreement / 4
    errors = {
        "estimate": max(measures.estimate, least),
        "agreement": measures.agreement,
        "move": measures.move,
        "surprise": measures.surprise,
        "sure": max(measures.sure / measures.block_agreement, least),
    }
    return {
        **{name: -10 * math.log10(max(error, LEAST_ERROR)) for name, error in errors.items()},
        "hits": 10 * math.log10(max(measures.hits, _LEAST_HITS)),
        "samples": math.log2(spp / 64),
        "width": math.log2(resolution / _NARROW_PX),
    }


def group_of(resolution: int) -> str:
    """Return the group of widths whose shifts a picture takes: those below 128, 256, and others."""
    return "narrow" if resolution < _NARROW_PX else "medium" if resolution < _WIDE_PX else "wide"


def statement_for(settings: RenderSettings, samples: DualBuffer) -> CalibratedStatement | None:
    """Return what states the error of a view's samples; None for the bound.

    The bound states pictures that were not calibrated: of lights or layers apart, with another
    denoiser, with guided paths, of more or fewer samples, or of other widths.
    """
    statement = _statement_of(settings)
    if statement is None or samples.is_guided:
        return None
    least, most = statement.spp
    return statement if least <= samples.spp <= most else None


def first_spp(settings: RenderSettings) -> int:
    """Return the samples per pixel of the first measurement, both halves together.

    A bound that takes the place of a calibrated statement is measured after FIRST_SPP or more.
    """
    is_other = settings.stated_error == "calibrated" and _statement_of(settings) is None
    spp = settings.min_spp * max(1, math.ceil(settings.min_spp_px / settings.resolution))
    return min(max(spp, FIRST_SPP) if is_other else spp, settings.max_spp)


def _statement_of(settings: RenderSettings) -> CalibratedStatement | None:
    """Return what states errors of pictures with these settings, within its range of samples."""
    is_plain = not settings.per_light and not settings.part_names and settings.denoiser == "high"
    statement = load_statement() if is_plain and settings.stated_error == "calibrated" else None
    if statement is None:
        return None
    narrowest, widest = statement.widths
    return statement if narrowest <= settings.resolution <= widest else None


def is_far(bound: PictureErrors, settings: RenderSettings, spp: int) -> bool:
    """Return whether halves alone show that sampling goes on, so that no picture is needed.

    Args:
        bound: stated by the halves.
        settings: targets, and how near to them a picture is asked for.
        spp: samples per pixel so far; at the cap there is always a picture.
    """
    within_db = settings.picture_within_db
    if within_db is None or spp >= settings.max_spp:
        return False
    return max(gaps_db(settings.targets_db, by_metric(bound)).values(), default=0.0) > within_db


@functools.cache
def load_statement(path: Path = FILE) -> CalibratedStatement | None:
    """Return the statement of a file; None where its rows are of other versions of pictures.

    Raises:
        TrilightError: the file is damaged.
    """
    statement = read_json(path.read_bytes(), CalibratedStatement, str(path))
    return statement if statement.versions == versions_of_pictures() else None


def versions_of_pictures() -> dict[str, str]:
    """Return what pictures and their measures depend on: the denoiser, and the renderer's revision.

    The revision is a digest of the constants by which samples, corrections and measures are made.
    """
    constants = [_CODE, PASS_SPP, TILE_PX, BLOCK_PX, LEAST_PASSES, STANDARD_ERRORS, STANDS_OUT,
                 DARKER, GLINT, MOST_APART]  # fmt: skip
    return {
        "denoiser": metadata.version("pyoidn"),
        "renderer": sha256_hex(canonical_json(constants))[:12],
    }


def measures_of_totals(
    totals: NDArray[np.float64], surprise: float, count: int, hits: float
) -> ErrorMeasures:
    """Return the measures of one metric from six totals over a picture.

    Args:
        totals: over the pixels of the estimate, the agreement, the move, and a quarter of the
            squared difference of the halves with the picture's slope; over blocks of BLOCK_PX of
            `sure` and of that quarter, from sums over the block.
        surprise: largest one of a pixel.
        count: pixels that count.
        hits: share of the pixels that show geometry.
    """
    count = max(count, 1)
    estimate, agreement, move, slope_agreement = (float(each) / count for each in totals[:4])
    sure, in_blocks = (float(each) / (BLOCK_PX**2 * count) for each in totals[4:])
    return ErrorMeasures(
        estimate=estimate,
        agreement=agreement,
        move=move,
        surprise=surprise / count,
        sure=sure,
        block_agreement=in_blocks / slope_agreement if slope_agreement else 1.0,
        hits=hits,
    )
