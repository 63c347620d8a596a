"""Write and read metrics.jsonl, the records of a run, and estimate the remaining training time."""

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
_METRIC_FIELDS: dict[str, type | tuple[type, ...]] = {"split": str, "downscale": (int, float), "psnr": (int, float)}
FIELDS: dict[str, dict[str, type | tuple[type, ...]]] = {  # fields that pages and `clsplat status` read, by kind
    "train": {"loss": (int, float), "psnr": (int, float)},
    "evaluate": _METRIC_FIELDS,
    "view": {"view": str, **_METRIC_FIELDS},
    "densify": {"causes": dict},
    "distribution": {"size": list, "anisotropy": list, "opacity": list},
    "snapshot": {"file": str},
}


class Records:
    """The records of a run: lines of metrics.jsonl, each with a step and a kind.

    Lines are buffered until their stage is done, because a failed stage is repeated on resume.
    """

    def __init__(self, out: Path, require_lock: Callable[[], None] = lambda: None) -> None:
        """require_lock: function that raises OutputError if the run no longer holds the folder's lock."""
        self.out = out
        self._require_lock = require_lock
        self.path, self.trial = out / RECORDS, out / TRIAL
        self.line_count = 0  # number of lines in the state of the run, including buffered ones
        self.line_count_at_stage = 0  # number of lines at the start of the stage, which a resumed run repeats
        self._pending: list[str] = []

    def move_to_trial(self) -> None:
        """Move all lines to trial.jsonl before a refit.  Raises OutputError if the file cannot be moved."""
        self.write()
        self._require_lock()
        with raising_output_error(self.trial):
            self.path.replace(self.trial)
        self.line_count = 0

    def start(self, is_refit: bool = False) -> None:
        """Drop the lines that were written after the restored state; the resumed run writes them again.

        If the state is from before a refit, the lines of trial.jsonl are moved back.  A line that cannot be read is
        dropped with all lines after it, and a warning is logged.
        """
        if not is_refit and self.trial.exists():
            with raising_output_error(self.trial):
                self.trial.replace(self.path)
        lines: list[dict[str, Any]] = []
        fault = "the file is too short"
        try:
            for line in islice(self._parse(self.path), self.line_count):
                lines.append(line)
        except DataError as error:
            fault = str(error)
        if len(lines) < self.line_count:
            LOG.warning("%s: only %d of %d lines can be read (%s)", self.path, len(lines), self.line_count, fault)
        self.line_count = self.line_count_at_stage = len(lines)
        write_text(self.path, "".join(json.dumps(line) + "\n" for line in lines))

    def add(self, step: int, kind: str, **values: Any) -> None:
        """Add a line; `write` or the end of the stage appends it to the file."""
        self._pending.append(json.dumps({"step": step, "kind": kind, **values}) + "\n")
        self.line_count += 1

    def write(self) -> None:
        """Append the buffered lines, and sync the file, because a checkpoint contains the number of lines.

        If this raises OutputError, the lines stay buffered, and the file is unchanged.
        """
        if not self._pending:
            return
        self._require_lock()
        append(self.path, "".join(self._pending).encode())
        self._pending.clear()

    @contextmanager
    def stage(self) -> Iterator[None]:
        """When the block ends, write the lines that it added; if it fails, drop them."""
        old_line_count, old_pending_count = self.line_count, len(self._pending)
        try:
            yield
            self.write()
        except BaseException:
            del self._pending[old_pending_count:]
            self.line_count = old_line_count
            raise

    def read(self, kind: str | None = None, trial: bool = False) -> list[dict[str, Any]]:
        """Return the lines of one kind, or all lines.  An incomplete last line, left by a crash, is ignored.

        Lines that lack a field that FIELDS lists for their kind are skipped, since a plug-in wrote them.  trial: return
        the lines from before a refit.  Raises DataError, with file and line, for any other damage.
        """
        fields = FIELDS.get(kind or "", {})
        return [
            line
            for line in self._parse(self.trial if trial else self.path)
            if kind in (None, line["kind"]) and all(isinstance(line.get(key), types) for key, types in fields.items())
        ]

    def _parse(self, path: Path) -> Iterator[dict[str, Any]]:
        if not path.exists():
            return
        json_lines = read_file(path).decode(errors="replace").split("\n")
        for number, text in enumerate(json_lines, 1):
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):
                if number == len(json_lines):  # empty, or incomplete after a crash
                    break
                line = None
            if not isinstance(line, dict) or type(line.get("step")) is not int or not isinstance(line.get("kind"), str):
                raise DataError(
                    f"{path}:{number}: damaged; expected an object with 'step' and 'kind'; remove this line"
                )
            yield line


# The device time of a training step, by stage of the step.

KERNELS = {
    "project": "project_forward",
    "pairs": "count_large emit_pairs emit_large find_tile_offsets",
    "sort": "scan_blocks scan_offsets radix_count radix_scatter fill_tiles sort_tiles merge_runs",
    "blend": "blend_forward lay_over sky_forward",
    "loss": (
        "unpack_pixels pixel_loss ssim_maps ssim_gradient sky_matches sky_cover apply_mask "
        "change_background measure_residuals mask_transients covariance_trace anisotropy"
    ),
    "blend backward": "look_behind sky_backward blend_backward",
    "sum records": "sky_gather sum_records",
    "update": (
        "sky_update project_backward pose_gradient adam_step update_gaussians replay_updates note_update dense_update"
    ),
    "statistics": (
        "count_seen accumulate_norm accumulate_error accumulate_gain view_error sum_errors accumulate_sum "
        "accumulate_pixel_sum accumulate_radius accumulate_splitting sample_magnitude image_gradient hide_masked"
    ),
    "filter": "sampling_interval filter_variance",
    "cones": "draw_pixels cast_rays spread_edges resample_edges",
    "encode": "encode_frustums encode_directions grid_places grid_forward",
    "network": "dense_forward",
    "colors of rays": "composite_forward",
    "colors of rays, backward": "composite_backward",
    "network backward": "dense_backward",
    "network, weights": "dense_weights dense_biases dense_sums",
    "grid backward": "grid_backward",
}  # names of the kernels of each stage, in the order of a step
STAGES = {kernel: stage for stage, kernels in KERNELS.items() for kernel in kernels.split()}


def stage_milliseconds(timings: Timings, steps: int = 1) -> dict[str, float]:
    """Return the mean time of each stage of a step, ms.  steps: number of steps sampled since the last call."""
    totals: dict[str, float] = defaultdict(float)
    for (label, section), seconds in timings.take().items():
        totals[STAGES.get(label.partition(":")[2], section)] += 1e3 * sum(seconds) / steps
    return {name: totals[name] for name in (*KERNELS, "other") if name in totals}


def read_clocks() -> tuple[float, float]:
    """Return the wall-clock time and the CPU time of all threads, s."""
    return time.perf_counter(), time.process_time()


# The progress of training: PSNR averaged over reports, and the remaining time.

PSNR_REPORTS = 5  # reports over which PSNR is averaged
TIME_REPORTS = 3  # reports over which step time is averaged
GROWTH_REPORTS = 4  # latest reports from which growth is extrapolated
MIN_RATIO = 2.0  # smallest ratio of two Gaussian counts from which the cost of a Gaussian can be fitted
DEFAULT_COST = 0.6  # time of an additional Gaussian, relative to the mean, if it cannot be fitted
MIN_COST = 0.4  # lower bound of the fitted cost, relative to the mean; fits are unreliable on a busy machine


def moving_average(psnrs: Sequence[float]) -> list[float]:
    """Return the moving average of PSNRs over PSNR_REPORTS views, since single views differ a lot."""
    return [fmean(psnrs[max(0, end - PSNR_REPORTS) : end]) for end in range(1, len(psnrs) + 1)]


class Forecast:
    """An estimate of the remaining training time.  Training ends at step `last_step`; growth ends at `growth_end`."""

    def __init__(self, last_step: int, growth_end: int) -> None:
        self.last_step, self.growth_end = last_step, growth_end
        self._psnrs: list[float] = []  # dB
        self._reports: list[tuple[int, int, float]] = []  # step, Gaussians, s per step

    @classmethod
    def from_rules(cls, step: int, last_step: int, due: Sequence[Callable[[int], bool]]) -> "Forecast":
        """Create a forecast for training after `step`.  due: for each density rule, whether it acts at a given step."""
        later = range(last_step - 1, step, -1)  # no rule acts after the last step
        return cls(last_step, next((later_step for later_step in later if any(rule(later_step) for rule in due)), step))

    def add(self, step: int, psnr: float, gaussians: int, seconds: float) -> None:
        """Add a report.  psnr: dB; seconds: mean time of a step since the last report."""
        self._psnrs.append(psnr)
        self._reports.append((step, gaussians, seconds))

    @property
    def psnr(self) -> float:
        """The mean PSNR of the last reports, dB."""
        return moving_average(self._psnrs[-PSNR_REPORTS:])[-1]

    @property
    def is_growth_known(self) -> bool:
        """Whether the growth rate is known.  If not, the remaining time is a lower bound."""
        step, count, _ = self._reports[-1]
        return step >= self.growth_end or count > self._reports[0][1]

    @property
    def seconds_left(self) -> float:
        """The estimated time until the last step, s.

        The estimate assumes that the time of a step is linear in the number of Gaussians, and that growth continues at
        the rate of the last reports until `growth_end`.
        """
        steps, counts, seconds = (np.array(column, np.float64) for column in zip(*self._reports, strict=True))
        cost, steps_left = self._cost(counts, seconds), self.last_step - steps[-1]
        current_seconds = float(seconds[-TIME_REPORTS:].mean() + cost * (counts[-1] - counts[-TIME_REPORTS:].mean()))
        growth_steps = min(max(0.0, self.growth_end - steps[-1]), steps_left)
        if growth_steps == 0 or len(steps) < 2:
            return current_seconds * float(steps_left)
        growth = (counts[-1] - counts[-GROWTH_REPORTS:][0]) / (steps[-1] - steps[-GROWTH_REPORTS:][0])
        final_seconds = current_seconds + max(0.0, cost * growth * growth_steps)
        return float(growth_steps * (current_seconds + final_seconds) / 2 + (steps_left - growth_steps) * final_seconds)

    @staticmethod
    def _cost(counts: NDArray[np.float64], seconds: NDArray[np.float64]) -> float:
        """Return the time that one more Gaussian adds to a step, s."""
        mean_time = float(seconds[-TIME_REPORTS:].mean() / max(1.0, counts[-TIME_REPORTS:].mean()))
        if counts.max() < MIN_RATIO * counts.min():
            return DEFAULT_COST * mean_time
        deviation = counts - counts.mean()
        return min(max(float(deviation @ seconds / (deviation @ deviation)), MIN_COST * mean_time), mean_time)
