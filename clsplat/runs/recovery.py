"""What a run that goes on makes again of files that were lost, and what is beyond repair."""

import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Protocol

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.files import CHECKPOINTS, CHECKSUMS, INPUTS, METRICS, NOTE, PIPELINE, RECORDS, STATUS
from clsplat.pipeline.loading import Pipeline, load
from clsplat.runs.state import changed, has_ended, restart
from clsplat.training import checkpoint
from clsplat.training.stage import Stage, Training
from clsplat.training.status import read_status

LOG = logging.getLogger("clsplat")
OF_EVERY_RUN = frozenset({PIPELINE, STATUS, METRICS, CHECKSUMS, INPUTS, NOTE})  # whatever it goes on from


class RunPosition(Protocol):
    """Where a run stands, or the state in a checkpoint."""

    step: int
    cursor: int
    stage_step: int
    acted: int


@dataclass
class Beginning:
    """The place of a run that has no checkpoint so far."""

    step: int = 0
    cursor: int = 0
    stage_step: int = 0
    acted: int = 0


class Course:
    """What a run that goes on from a place writes in its folder."""

    def __init__(self, pipeline: Pipeline, out: Path, at: RunPosition) -> None:
        begun = at.cursor + (at.stage_step > 0)
        ended, training, coming = (pipeline.stages[i:j] for i, j in ((0, at.cursor), (at.cursor, begun), (begun, None)))
        last = takewhile(lambda stage: not (stage.edits or isinstance(stage, Training)), reversed(ended))
        self.out = out
        self.repeatable: list[Stage] = [] if training else list(last)  # of the model as it is, the latest first
        self._coming = [path for stage in coming for path in stage.outputs(out)]
        self._training = [path for stage in training for path in stage.outputs(out)]
        self._due = [path for stage in training if isinstance(stage, Training) for path in _due(stage, out, at)]
        self._from_beginning = begun == 0

    def writes(self, file: Path) -> bool:
        """Whether it writes a file, be that whole or lost."""
        if file.parent == self.out and file.name in OF_EVERY_RUN:
            return True
        if file == self.out / RECORDS:
            return self._from_beginning
        return is_below(file, self._coming) or file in self._due

    def may_write(self, file: Path) -> bool:
        """Whether it goes on with a file, or the training that has begun may write it anew."""
        return file == self.out / RECORDS or is_below(file, self._training)

    def mends(self, file: Path) -> bool:
        """Whether a file that is lost is there again at its end."""
        return self.writes(file) or any(is_below(file, stage.outputs(self.out)) for stage in self.repeatable)


def is_below(file: Path, places: Iterable[Path]) -> bool:
    """Whether a file is one of some files, or lies in one of some folders."""
    return any(file.is_relative_to(place) for place in places)


def _due(stage: Training, out: Path, at: RunPosition) -> list[Path]:
    """The files, not folders, that a training which has begun writes anew: each time its stage is due."""
    last = at.step - at.stage_step + stage.steps
    return [
        path
        for number, inner in enumerate(stage.during)
        if any(inner.due(step, step == last) for step in range(at.step + (number < at.acted), last + 1))
        for path in inner.outputs(out)
    ]


def beyond_repair(out: Path, lost: Sequence[Path]) -> list[Path]:
    """Those of the lost files of a run that `resume` does not make again: all where it has nothing to go on from."""
    status = read_status(out)
    if "cells" in status or not lost:  # the cells of a matrix are looked at one by one
        return []
    files = checkpoint.saved(out)
    taken, at = _newest_whole(files)
    is_unknown = not status and (out / INPUTS).exists()
    if not taken and (files or is_unknown or status.get("checkpoint") or status.get("state") == "done"):
        return list(lost)
    try:
        course = Course(load(str(out / PIPELINE)), out, at)
    except ConfigError:  # which is lost itself, and written again with the settings of the checkpoint
        return []
    later = [*files[files.index(taken) + 1 :], out / CHECKPOINTS / str(status.get("checkpoint"))] if taken else []
    return [file for file in lost if not (course.mends(file) or file in later)]


def _newest_whole(files: Sequence[Path]) -> tuple[Path | None, RunPosition]:
    """The newest checkpoint that is whole, and where it lets a run go on; without one that is its beginning."""
    for file in reversed(files):
        with suppress(ConfigError, DataError):
            return file, checkpoint.load(file)[0]
    return None, Beginning()


def is_complete(out: Path) -> bool:
    """Whether a run that is done has its files, or as many as can be had without training again.

    What a checkpoint can bring back is not there yet; what none can is named in a warning.  Raises DataError where that
    is metrics.json, without which there is no result.
    """
    lost = changed(out)
    left = beyond_repair(out, lost)
    if out / METRICS in left:
        raise DataError(f"{out / METRICS}: is missing or was changed; {restart(out)} trains the run again")
    if left:
        without = "" if checkpoint.saved(out) else "without a checkpoint "
        LOG.warning("%s: is missing or was changed; %sonly --restart makes it again", left[0], without)
    return len(left) == len(lost)


def is_finished(pipeline: Pipeline, out: Path) -> bool:
    """Whether a run of this pipeline has come to its end, and has its files, as `is_complete` tells.

    Raises ConfigError when that was with other settings.
    """
    return has_ended(pipeline, out) and is_complete(out)
