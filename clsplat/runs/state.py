"""Read a run folder once, and determine the phase of the run and the files that are missing or changed."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError, DataError, one_line, shell_quote
from clsplat.core.files import CHECKSUMS, END_STATES, INPUTS, PIPELINE, STATUS, is_inside
from clsplat.core.machine import Owner
from clsplat.core.reading import read_json, sha256
from clsplat.pipeline.loading import Pipeline, load, with_decisions, without_auto
from clsplat.training import checkpoint
from clsplat.training.settings_diff import Difference, first_difference
from clsplat.training.stage import Scheduled
from clsplat.training.status import read_status


class Phase(IntEnum):
    """The phase of the run in a folder."""

    EMPTY = 0
    """The folder has no run."""
    PREPARING = 1
    """The folder has only a status.json, because no stage has started."""
    BEGUN = 2
    """The run has started, and may have stopped before its end."""
    LOST_STATE = 3
    """The run has started, but both its status and its checkpoints are missing."""
    DONE = 4
    """The run has finished; `RunState.bad_files` lists the files that are missing or changed."""


@dataclass(frozen=True)
class RunState:
    """A snapshot of the folder of a run or a matrix."""

    out: Path
    names: frozenset[str]  # names of the files and folders in `out`
    status: Mapping[str, Any]  # content of status.json; empty if missing or damaged
    checkpoints: tuple[Path, ...]  # oldest first
    sums: Mapping[str, str] | None  # SHA-256 by path in the folder; None if checksums.json is missing or damaged

    @classmethod
    def read(cls, out: Path) -> "RunState":
        """Read a folder, which need not exist.  The pipeline and the outputs are read on first use."""
        names = frozenset[str]()
        with suppress(OSError):
            names = frozenset(path.name for path in out.iterdir())
        return cls(out, names, read_status(out), tuple(checkpoint.list_files(out)), read_sums(out))

    @cached_property
    def phase(self) -> Phase:
        """The phase of the run."""
        has_begun = PIPELINE in self.names or self.checkpoints or (self.status and self.sums is not None)
        if self.status.get("state") == "done" and (has_begun or Owner.from_record(self.status)):
            return Phase.DONE
        if not has_begun:
            return Phase.PREPARING if STATUS in self.names else Phase.EMPTY
        is_known = self.status or self.checkpoints or INPUTS not in self.names
        return Phase.BEGUN if is_known else Phase.LOST_STATE

    @property
    def state_name(self) -> str:
        """The state in status.json, or "killed" if the process no longer exists."""
        owner = Owner.from_record(self.status) if self.status.get("state") not in END_STATES else None
        return "killed" if owner and owner.has_ended else str(self.status.get("state", "unknown"))

    @cached_property
    def pipeline(self) -> Pipeline:
        """The resolved pipeline of the run.  Raises ConfigError if pipeline.yaml is missing or damaged."""
        return load(str(self.out / PIPELINE))

    @cached_property
    def bad_files(self) -> list[str]:
        """The files that are missing or changed; of a finished run, also checksums.json if it is missing."""
        if self.sums is None:
            return [CHECKSUMS] if self.phase is Phase.DONE and "cells" not in self.status else []
        return find_damaged_files(self.out, self.sums)

    def difference(self, pipeline: Pipeline) -> str:
        """Return the difference between another pipeline and the run's pipeline as text, or "" if they are the same.

        If the pipeline of the run cannot be read, the result is the reason.
        """
        try:
            return str(_difference(self.pipeline, pipeline) or "")
        except ConfigError as error:
            return one_line(error)

    def require_same(self, pipeline: Pipeline) -> None:
        """Raise ConfigError if the folder has a finished run with other settings."""
        is_known = self.phase is Phase.DONE and PIPELINE in self.names
        if is_known and (difference := self.difference(pipeline)) and PIPELINE not in self.bad_files:
            raise ConfigError(
                f"{self.out}: has a run with other settings: {difference}; use another folder, or the same settings"
            )

    def is_complete(self, pipeline: Pipeline) -> bool:
        """Return whether a run of this pipeline is finished, with all files intact."""
        return self.phase is Phase.DONE and not self.difference(pipeline) and not self.bad_files

    @property
    def steps_key(self) -> str:
        """The settings key of the number of training steps; optimize.steps if the pipeline cannot be read."""
        with suppress(ConfigError):  # which the resumed run raises again
            return f"{self.pipeline.settings.training.stage}.steps"
        return "optimize.steps"

    def describe_longer_training(self) -> str:
        """Describe how a continued training differs from training with all steps from the start; "" if it does not."""
        training = self.pipeline.settings.training
        steps = training.steps
        stages = (s for s in training.during if type(s).frozen_parameters is not Scheduled.frozen_parameters)
        names = [stage.stage for stage in stages if stage.is_due(steps)]
        if not names or self.status.get("step", 0) < steps:
            return ""
        return f"'{names[0]}' was due at step {steps}, the last one, so the result differs from a single longer run"

    @property
    def restart_command(self) -> str:
        """The command that starts the run from the beginning, for messages."""
        pipeline = "…"
        with suppress(ConfigError):  # the pipeline is missing or damaged
            pipeline = shell_quote(self.pipeline.path)
        return f"`clsplat run {pipeline} --out {shell_quote(self.out)} --restart`"


def has_pipeline(folder: Path) -> bool:
    """Return whether a folder has the pipeline of a run or a matrix."""
    return (folder / PIPELINE).is_file()


def _difference(old_pipeline: Pipeline, new_pipeline: Pipeline) -> Difference | None:
    """Return the first setting that differs, ignoring automatic choices of the run.  Raises ConfigError."""
    decided_pipeline = with_decisions(new_pipeline, old_pipeline.decisions)
    old_settings, new_settings = (
        without_auto(pipeline.resolved_settings()) for pipeline in (old_pipeline, decided_pipeline)
    )
    return first_difference({**old_settings, "adapt": None}, {**new_settings, "adapt": None})


def is_below(file: Path, paths: Iterable[Path]) -> bool:
    """Return whether a file is one of the paths or inside one of them."""
    return any(map(file.is_relative_to, paths))


def read_sums(out: Path) -> dict[str, str] | None:
    """Return the SHA-256 of each file in checksums.json, by path; None if the list is missing or damaged."""
    try:
        sums = read_json(out / CHECKSUMS)
    except DataError:
        return None
    return {name: str(value) for name, value in sums.items() if is_inside(name)} if isinstance(sums, dict) else None


def find_damaged_files(out: Path, sums: Mapping[str, str]) -> list[str]:
    """Return the names of the files in a list of checksums that are missing or changed."""
    return [name for name, value in sums.items() if try_sha256(out / name) != value]


def try_sha256(file: Path) -> str | None:
    """Return the SHA-256 of a file; None if it cannot be read."""
    with suppress(DataError):
        return sha256(file)
    return None
