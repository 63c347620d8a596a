"""The records of a run: metrics.jsonl."""

import json
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import RECORDS, TRIAL, append, raising_output_error, write_text
from clsplat.core.reading import read_file
from clsplat.opencl.device import Timings

LOG = logging.getLogger("clsplat")


class Records:
    """Writes a run folder's records; every line of metrics.jsonl has its step.

    Lines wait until what they tell of is done, for a stage that fails is repeated when the run goes on.
    """

    def __init__(self, out: Path, require_held: Callable[[], None] = lambda: None) -> None:
        """`require_held` raises OutputError when the folder is no longer held."""
        self.out = out
        self._require_held = require_held
        self.path, self.trial = out / RECORDS, out / TRIAL
        self.lines = 0  # of metrics.jsonl that belong to the state of the run, with those that wait
        self.settled = 0  # of them, from before the stages that a resumed run has again
        self._waiting: list[str] = []

    def set_aside(self) -> None:
        """Begin anew, for a refit; the lines so far are in trial.jsonl then.  Raises OutputError."""
        self.write()
        self._require_held()
        with raising_output_error(self.trial):
            self.path.replace(self.trial)
        self.lines = 0

    def start(self, is_refit: bool = False) -> None:
        """Drop the lines after those of the state, which a resumed run writes again.

        Where that is before a refit, lines that were set aside for one come back.
        Those of the state that cannot be read are lost, with all behind them, and a warning says so.
        """
        if not is_refit and self.trial.exists():
            with raising_output_error(self.trial):
                self.trial.replace(self.path)
        kept: list[dict[str, Any]] = []
        fault = "it ends before"
        try:
            for line in islice(self._each(self.path), self.lines):
                kept.append(line)
        except DataError as error:
            fault = str(error)
        if len(kept) < self.lines:
            LOG.warning("%s: %d of %d lines can be read; %s; the run goes on", self.path, len(kept), self.lines, fault)
        self.lines = self.settled = len(kept)
        write_text(self.path, "".join(json.dumps(line) + "\n" for line in kept))

    def add(self, step: int, kind: str, **values: Any) -> None:
        """Add one line; `write` writes it, or the end of the stage."""
        self._waiting.append(json.dumps({"step": step, "kind": kind, **values}) + "\n")
        self.lines += 1

    def write(self) -> None:
        """Append the lines that wait, and sync them: a checkpoint counts them.

        Raises OutputError; then they wait on, and the file is as it was.
        """
        if not self._waiting:
            return
        self._require_held()
        append(self.path, "".join(self._waiting).encode())
        self._waiting.clear()

    @contextmanager
    def of_a_stage(self) -> Iterator[None]:
        """Write the lines that the block adds at its end; where it fails they do not count."""
        lines, waiting = self.lines, len(self._waiting)
        try:
            yield
            self.write()
        except BaseException:
            del self._waiting[waiting:]
            self.lines = lines
            raise

    def read(self, kind: str | None = None, trial: bool = False) -> list[dict[str, Any]]:
        """Return the lines, of one kind or all; a line cut short by a crash is left out.

        trial: those before a refit, none where there was none.

        Raises DataError with file and line when the file is damaged in another way.
        """
        lines = self._each(self.trial if trial else self.path)
        return [line for line in lines if kind in (None, line["kind"])]

    def _each(self, path: Path) -> Iterator[dict[str, Any]]:
        if not path.exists():
            return
        texts = read_file(path).decode(errors="replace").split("\n")
        for number, text in enumerate(texts, 1):
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):
                if number == len(texts):  # nothing, or what a crash has left
                    break
                line = None
            if not isinstance(line, dict) or type(line.get("step")) is not int or not isinstance(line.get("kind"), str):
                raise DataError(
                    f"{path}:{number}: damaged; expected keys and values with 'step' and 'kind'; remove this line"
                )
            yield line


# The time of a training step on the device, by stage.

STAGES = {
    "project_forward": "project",
    "count_large": "pairs",
    "permute": "pairs",
    "emit_pairs": "pairs",
    "emit_large": "pairs",
    "find_tile_offsets": "pairs",
    "scan_blocks": "sort",
    "scan_offsets": "sort",
    "radix_count": "sort",
    "radix_scatter": "sort",
    "count_pairs": "sort",
    "fill_tiles": "sort",
    "sort_tiles": "sort",
    "blend_forward": "blend",
    "unpack_pixels": "loss",
    "pixel_loss": "loss",
    "ssim_maps": "loss",
    "ssim_gradient": "loss",
    "weight_entropy": "loss",
    "lay_over": "blend",
    "look_behind": "blend backward",
    "sky_matches": "loss",
    "sky_cover": "loss",
    "sky_forward": "blend",
    "sky_backward": "blend backward",
    "sky_gather": "sum records",
    "sky_update": "update",
    "apply_mask": "loss",
    "change_background": "loss",
    "measure_residuals": "loss",
    "mask_transients": "loss",
    "covariance_trace": "loss",
    "anisotropy": "loss",
    "blend_backward": "blend backward",
    "sum_records": "sum records",
    "project_backward": "update",
    "pose_gradient": "update",
    "adam_step": "update",
    "update_gaussians": "update",
    "replay_updates": "update",
    "note_update": "update",
    "count_seen": "statistics",
    "accumulate_norm": "statistics",
    "accumulate_error": "statistics",
    "accumulate_gain": "statistics",
    "view_error": "statistics",
    "sum_errors": "statistics",
    "accumulate_sum": "statistics",
    "accumulate_pixel_sum": "statistics",
    "accumulate_radius": "statistics",
    "accumulate_splitting": "statistics",
    "sample_magnitude": "statistics",
    "image_gradient": "statistics",
    "hide_masked": "statistics",
    "sampling_interval": "filter",
    "filter_variance": "filter",
    "draw_pixels": "cones",
    "cast_rays": "cones",
    "spread_edges": "cones",
    "resample_edges": "cones",
    "encode_frustums": "encode",
    "encode_directions": "encode",
    "grid_places": "encode",
    "grid_forward": "encode",
    "dense_forward": "network",
    "composite_forward": "colors of rays",
    "composite_backward": "colors of rays, backward",
    "dense_backward": "network backward",
    "dense_weights": "network, weights",
    "dense_biases": "network, weights",
    "dense_sums": "network, weights",
    "grid_backward": "grid backward",
    "dense_update": "update",
}
ORDER = tuple(dict.fromkeys(STAGES.values()))


def stage_milliseconds(timings: Timings, steps: int = 1) -> dict[str, float]:
    """Average milliseconds of each stage over the `steps` sampled since the last call, in the order of a step."""
    totals: dict[str, float] = defaultdict(float)
    for (label, section), seconds in timings.take().items():
        totals[STAGES.get(label.partition(":")[2], section)] += 1e3 * sum(seconds) / steps
    return {name: totals[name] for name in (*ORDER, "other") if name in totals}


def clocks() -> tuple[float, float]:
    """Return the time, and that of all threads of this process, in s."""
    return time.perf_counter(), time.process_time()


# What reports of a training say about its course: PSNR over several views, and the time that is left.

VIEWS = 5  # reports whose PSNR is averaged
LATEST = 3  # reports whose step time is averaged
TREND = 4  # reports that tell how fast the number of Gaussians grows
WIDE = 2.0  # of the number of Gaussians, largest by smallest: from there on the times tell what a Gaussian costs
USUAL = 0.6  # of the mean time by Gaussian is what one more costs, where they do not tell: the rest is per step
LEAST = 0.4  # of it, whatever they tell: on a busy machine they tell little


def over_views(psnrs: Sequence[float]) -> list[float]:
    """Return the mean of each PSNR and those of the reports before it: one is of one view, and views differ by many dB.

    Terminal, live page and reports show it.
    """
    return [fmean(psnrs[max(0, end - VIEWS) : end]) for end in range(1, len(psnrs) + 1)]


class Forecast:
    """The course of one training, up to `last_step`.  Rules that grow the model act until the step `growth_end`."""

    def __init__(self, last_step: int, growth_end: int) -> None:
        self.last_step, self.growth_end = last_step, growth_end
        self._psnrs: list[float] = []  # dB
        self._reports: list[tuple[int, int, float]] = []  # step, Gaussians, s a step

    @classmethod
    def of(cls, step: int, last_step: int, due: Sequence[Callable[[int], bool]]) -> "Forecast":
        """Return the forecast of a training after `step`; due: whether a rule acts at a step, for each of its rules."""
        later = range(last_step - 1, step, -1)  # none follows the last step
        return cls(last_step, next((one for one in later if any(rule(one) for rule in due)), step))

    def add(self, step: int, psnr: float, gaussians: int, seconds: float) -> None:
        """Take a report; seconds: the mean time of a step since the last one."""
        self._psnrs.append(psnr)
        self._reports.append((step, gaussians, seconds))

    @property
    def psnr(self) -> float:
        """dB, the mean over the views of the last reports."""
        return over_views(self._psnrs[-VIEWS:])[-1]

    @property
    def growth_known(self) -> bool:
        """Whether reports have shown how fast rules grow the model, or none will; else the time left is the least."""
        step, count, _ = self._reports[-1]
        return step >= self.growth_end or count > self._reports[0][1]

    @property
    def seconds_left(self) -> float:
        """The time until the last step, s.

        The time of a step is taken as linear in the number of Gaussians, and that number as growing on as it did in the
        last reports until the rules end.
        """
        steps, counts, seconds = (np.array(column, np.float64) for column in zip(*self._reports, strict=True))
        cost, left = self._cost(counts, seconds), self.last_step - steps[-1]
        now = float(seconds[-LATEST:].mean() + cost * (counts[-1] - counts[-LATEST:].mean()))
        growing = min(max(0.0, self.growth_end - steps[-1]), left)
        if growing == 0 or len(steps) < 2:
            return now * float(left)
        growth = (counts[-1] - counts[-TREND:][0]) / (steps[-1] - steps[-TREND:][0])
        later = now + max(0.0, cost * growth * growing)
        return float(growing * (now + later) / 2 + (left - growing) * later)

    @staticmethod
    def _cost(counts: NDArray[np.float64], seconds: NDArray[np.float64]) -> float:
        """The time that a Gaussian adds to a step, s: its share of the whole, or less."""
        most = float(seconds[-LATEST:].mean() / max(1.0, counts[-LATEST:].mean()))
        if counts.max() < WIDE * counts.min():
            return USUAL * most
        spread = counts - counts.mean()
        return min(max(float(spread @ seconds / (spread @ spread)), LEAST * most), most)
