"""Running one pipeline in its folder, with a log and a progress bar."""

import logging
from contextlib import nullcontext
from pathlib import Path

from clsplat import terminal
from clsplat.live.live import Live
from clsplat.names import LOG_FILE
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline
from clsplat.runs import folders, opening, outputs, runner
from clsplat.runs.choices import settle
from clsplat.runs.failures import failures_recorded
from clsplat.runs.folders import Start
from clsplat.runs.minutes import Show, execute_within
from clsplat.runs.summary import summary
from clsplat.signals import stop_at_once, stop_if_signalled, stopping_on_signals
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


def run_pipeline(
    pipeline: Pipeline,
    out: Path,
    device: str | Device | None,
    start: Start,
    live: Live | None = None,
    minutes: float | None = None,
) -> None:
    """Run one pipeline in its folder, with a log and a progress bar.  Raises ClsplatError; status.json tells why.

    minutes: as for `Job.run`.
    """
    outputs.check_places(pipeline, out)
    with (
        folders.opened(out, start, step=0) as status,
        stopping_on_signals(stop_at_once),
        failures_recorded(status),
        terminal.logging_to(out / LOG_FILE),
    ):
        if live:
            live.follow(status)
        with terminal.counted():
            run = opening.open_run(pipeline, out, device, start, status)
            pipeline = settle(pipeline, run)
            stop_if_signalled()

        def execute(pipeline: Pipeline, run: Run, start: Start, show: Show) -> None:
            with live.showing(run) if live else nullcontext():
                runner.execute(pipeline, run, start, live.reporting(show) if live else show)

        with terminal.progress_bar(status) as show:
            if minutes is None:
                execute(pipeline, run, start, show)
            else:
                execute_within(minutes, pipeline, run, start, show, execute)
        for line in summary(out):
            LOG.debug("%s", line)  # who asked for the run shows it
