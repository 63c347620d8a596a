"""Run the cells of a matrix through a store, and put their results into the folder of the matrix."""

from pathlib import Path

from clsplat.cluster.batch import Batch
from clsplat.cluster.store import Store
from clsplat.files import write_text
from clsplat.names import PIPELINE
from clsplat.pipeline.execution import Execution
from clsplat.pipeline.matrix import Experiment
from clsplat.runs import folders
from clsplat.runs.experiment import check_matrix_folder, compare
from clsplat.runs.failures import Failures, failures_recorded
from clsplat.runs.folders import Start
from clsplat.training.status import StatusFile


def run_sweep(
    experiment: Experiment,
    out: Path,
    execution: Execution,
    device: str | None,
    start: Start,
) -> None:
    """Run every cell, unless its result is in the store, and write compare.html; `out` is as after a run without store.

    device: the one of the engine inline.  A cell that fails does not stop the others; at the end a ClsplatError is
    raised with the exit code of the first one.  Raises Interrupted, Different.
    """
    check_matrix_folder(out)
    store, cells = Store(execution.keeps or Path()), experiment.cells
    with (
        folders.opened(out, start, cells=len(cells), done=0, failed={}) as status,
        failures_recorded(status),
    ):
        write_text(out / PIPELINE, experiment.text)
        sweep = _Sweep(experiment.name, experiment.text, cells, out, store, Failures("cells"), start == "restart")
        sweep.status = status
        sweep.run(execution, device)
        status.require_held()
        compare(experiment, out, sweep.failures)
        if sweep.failures:
            raise sweep.failures.whole(len(cells))
        status.end("done", exit_code=0)


class _Sweep(Batch):
    """A batch whose folder is that of a matrix, with its status."""

    status: StatusFile

    def ready(self) -> None:
        self.status.enter("running")

    def tell(self, stage: str | None) -> None:
        if stage is not None:
            self.status.note(stage=stage)
            return
        self.status.note(done=len({*self.outcomes, *self.failures}), failed=self.failures.texts())
        self.status.refresh()

    def require_held(self) -> None:
        self.status.require_held()
