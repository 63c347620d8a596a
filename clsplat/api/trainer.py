"""Train a pipeline step by step from Python."""

import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from clsplat.api.arguments import PathLike, load_plugins, overrides
from clsplat.api.renderer import open_checked, serialized
from clsplat.core import lock
from clsplat.core.errors import ClsplatError, ConfigError, DataError, Interrupted, OutputError
from clsplat.core.files import CHECKSUMS, END_STATES
from clsplat.core.schedule import Schedule
from clsplat.core.signals import stopping_on_signals
from clsplat.gaussians.model import Model
from clsplat.losses.base import ViewGradients
from clsplat.losses.host import HostFunction, HostLoss
from clsplat.metrics.views import mean, measure
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, load
from clsplat.runs import opening, outputs, run_folder, runner
from clsplat.runs.failures import recording_failures
from clsplat.runs.model_file import path_setting
from clsplat.runs.opening import RunScene, resolve_choices
from clsplat.runs.run_folder import Start
from clsplat.runs.state import RunState
from clsplat.runs.stepwise import is_trained, run_until_training, train
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Scene
from clsplat.stages.optimize import Optimize
from clsplat.training import checkpoint
from clsplat.training.checkpoint import save_on_failure
from clsplat.training.modules.base import learned_scene
from clsplat.training.run import host_model
from clsplat.training.status import StatusFile


@dataclass(frozen=True, eq=False)
class Report:
    """The gradients of a training step, and the number of Gaussians after it."""

    step: int  # global step, from 1
    gaussians: int
    view: ViewGradients  # the gradients of this step, valid until the next step

    @property
    def loss(self) -> float:
        """The sum of the losses; reading it waits for the device."""
        return self.view.loss

    def __repr__(self) -> str:
        return f"Report(step {self.step}, {self.gaussians:,} Gaussians)"


class Trainer:
    """Trains a scene with a pipeline.  The result is bit-identical to that of `clsplat run`.

    The constructor runs the stages before `optimize`.  The last step also runs later stages that edit the model.  Other
    stages, such as `evaluate` and `export`, do not run; use the method `evaluate` and the property `model`.  Ctrl-C
    takes effect after the current step, and training can continue.  Threads may share a trainer; their calls run one
    at a time.
    """

    def __init__(
        self,
        scene: Scene | PathLike,
        pipeline: PathLike = "splat_7k",
        *,
        set: Mapping[str, Any] | None = None,
        device: str | Device | None = None,
        out: PathLike | None = None,
        start: Start = "new",
    ) -> None:
        """Prepare training.

        scene: a dataset folder, or a scene returned by `read_scene`, which keeps its split
        pipeline: a file, or the name of a shipped pipeline
        set: settings by key, such as {"optimize.steps": 3000}
        device: part of the name of a device, or an open device with the schedule that the pipeline sets
        out: the run folder; default: a temporary folder that is deleted with the trainer
        start: as for `clsplat.run`

        A trainer locks its folder until the training ends, `close()` is called, or the trainer is deleted.
        Raises ConfigError, DataError, and DeviceError.
        """
        self._lock = threading.RLock()
        load_plugins()
        folder = scene.path if isinstance(scene, Scene) else Path(scene)
        scene_path = [f"scene.path={path_setting(folder)}"] if folder.is_dir() else []
        self.pipeline = load(str(pipeline), [*scene_path, *overrides(set or {})])
        _check_pipeline(self.pipeline)
        self.scene = scene if isinstance(scene, Scene) else read_scene(folder, self.pipeline.settings.scene.split)
        if names := [view.name for view in self.scene.split("train") if not view.has_photograph]:
            raise DataError(f"{self.scene.path}: the view '{names[0]}' has no image; training needs one per view")
        if start != "new" and out is None:
            raise ConfigError(f"start='{start}': expected a run folder as `out`")
        if out is None:
            out = tempfile.mkdtemp(prefix="clsplat-")
            weakref.finalize(self, shutil.rmtree, out, ignore_errors=True)
        self.out = Path(out)
        state = RunState.read(self.out)
        outputs.check_output_paths(self.pipeline, state)
        rasterizer = self.pipeline.settings.rasterizer
        open_device = open_checked(device, rasterizer.schedule, rasterizer.sort)
        with ExitStack() as stack:
            status = stack.enter_context(run_folder.open_run_folder(state, start, step=0))
            with recording_failures(status, reraise=True):
                run_scene = RunScene.from_scene(self.pipeline.settings.scene, self.scene)
                self._run = opening.make_run(self.pipeline, run_scene, open_device, self.out, status)
                self.pipeline = resolve_choices(self.pipeline, self._run)
                runner.begin(self.pipeline, self._run, start)
                # the checksums include files of stages that a trainer does not run
                (self.out / CHECKSUMS).unlink(missing_ok=True)
                with save_on_failure(self._run):
                    run_until_training(self.pipeline, self._run)
            stack.callback(_record_closed, status)
            self._resources = stack.pop_all()
        weakref.finalize(self, self._resources.close)
        self._steps = train(self.pipeline, self._run)
        self._state: Literal["open", "done", "failed", "closed"] = "open"
        self._record_end()

    @serialized
    def close(self) -> None:
        """End the training and unlock the run folder.  The training can be resumed from `out`.

        Before the last step, the state in status.json becomes "interrupted".  A trainer closes automatically after the
        last step or an error.
        """
        if self._state == "open":
            self._state = "closed"
        self._steps = iter(())
        self._resources.close()

    @serialized
    def step(self) -> Report:
        """Train for one step.  Raises StopIteration when the training is finished.

        After an error in a step, the trainer cannot continue, and the state in status.json becomes "failed".  After the
        last step, the state becomes "done".
        """
        interrupts: list[bool] = []

        def finish_step() -> None:
            if interrupts:
                raise KeyboardInterrupt
            interrupts.append(True)

        if self._state == "done":
            raise StopIteration
        if self._state != "open":
            reason = "ended with an error" if self._state == "failed" else "is closed"
            raise ClsplatError(f"{self!r} {reason}; create a new one, with start='resume' if `out` has a checkpoint")
        try:
            with (
                recording_failures(self._run.status, reraise=True),
                stopping_on_signals(finish_step),
                save_on_failure(self._run),
            ):
                view = next(self._steps, None)
                self._record_end()
        except BaseException:
            self._state = "failed"
            self.close()
            raise
        if view is None:
            raise StopIteration
        if interrupts:
            raise KeyboardInterrupt
        return Report(self._run.step, self._run.model.gaussians.count, view)

    def steps(self, count: int | None = None) -> Iterator[Report]:
        """Train step by step, for `count` steps or to the end of the training, and yield the report of each step."""
        step_count = 0
        while count is None or step_count < count:
            try:
                yield self.step()
            except StopIteration:
                return
            step_count += 1

    def run(self, count: int | None = None) -> Report | None:
        """Train for `count` steps, or to the end of the training; return the last report, or None if no step ran."""
        report = None
        for report in self.steps(count):  # noqa: B007
            pass
        return report

    @property
    @serialized
    def model(self) -> Model:
        """A copy of the current model.  `model.baked()` bakes in the 3D filter, as in the files of a run."""
        return host_model(self._run)

    @serialized
    def add_loss(self, function: HostFunction, weight: Schedule = 1.0) -> None:
        """Add a loss in NumPy: `function(image, photograph) -> (value, gradient with respect to the image)`.

        function: all its arrays are [height, width, 3] float32; the two images have values in [0, 1]
        weight: a number or a schedule

        Each step copies both images to the host and the gradient back; a plug-in with a kernel avoids these copies.
        Raises ConfigError for a negative weight.  A step raises ValueError if the function returns anything else, and
        NumericError for values that are not finite.
        """
        self._run.losses.append(HostLoss(function, weight))

    @serialized
    def evaluate(self, split: str = "test") -> dict[str, Any]:
        """Return the metrics of a split at the image size of the training, with the keys of metrics.json.

        PSNR is in dB.  A split without views has only the key `views`.  Raises ValueError for an unknown split.
        """
        run = self._run
        views = learned_scene(run).downscaled(run.downscale).split(split)
        if not views:
            return {"views": 0}
        return mean(measure(run.painter(), views, run.photographs.empty_copy(), train_views=run.scene.split("train")))

    @serialized
    def checkpoint(self) -> Path:
        """Save a checkpoint and return its file.

        Training that resumes from it is bit-identical to uninterrupted training.  Losses from `add_loss` are not saved.
        The newest two checkpoints are kept in `out`.  Raises OutputError if the file cannot be written.
        """
        with nullcontext() if self._state == "open" else lock.lock_folder(self.out):
            return checkpoint.save(self._run, keep=2)

    def _record_end(self) -> None:
        """Set the state in status.json to "done" if no steps remain."""
        if is_trained(self.pipeline, self._run):
            self._run.status.end("done", exit_code=0)
            self._state = "done"
            self.close()

    def __repr__(self) -> str:
        return f"Trainer({self.pipeline.settings.name} on {self.scene.path.name}, step {self._run.step})"


def _record_closed(status: StatusFile) -> None:
    """Record that a trainer was closed or deleted before its last step, unless its folder was removed."""
    if status.now.state not in END_STATES and status.out.is_dir():
        with suppress(OutputError):
            status.end("interrupted", Interrupted.exit_code, "the trainer was closed before its last step")


def _check_pipeline(pipeline: Pipeline) -> None:
    """Raise ConfigError if a pipeline has no training stage, or if it has `prepare` steps."""
    if pipeline.settings.prepare:
        raise ConfigError(f"{pipeline.path}: has `prepare` steps; use clsplat.run, or train on a prepared scene")
    if not any(isinstance(stage, Optimize) for stage in pipeline.stages):
        raise ConfigError(f"{pipeline.path}: has no 'optimize' stage; add one")
    for stage in pipeline.stages:
        stage.check()
