"""Write to the terminal: a live progress bar, or plain lines when the output is not a terminal."""

import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn

from clsplat.core import signals
from clsplat.core.errors import OutputError
from clsplat.core.files import raising_output_error
from clsplat.core.progress import Progress as TrainingProgress
from clsplat.core.progress import clock_text, listening, logging_counts_as_debug
from clsplat.core.resources import full_version

LOG = logging.getLogger("clsplat")
CONSOLE = Console(file=signals.STDOUT, highlight=False, soft_wrap=True)  # type: ignore[arg-type]
STDERR_CONSOLE = Console(file=signals.STDERR, highlight=False, soft_wrap=True)  # type: ignore[arg-type]
_bars: list[Live] = []  # currently visible


class StatusSource(Protocol):
    """The status of a run: `now` has stage, progress (done, total, unit), step, and steps."""

    @property
    def now(self) -> Any: ...


class _TerminalHandler(logging.Handler):
    """A handler that prints messages to `console` and warnings to stderr, above any visible progress bar."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self.console = console

    def emit(self, record: logging.LogRecord) -> None:
        is_warning = record.levelno >= logging.WARNING
        console = STDERR_CONSOLE if is_warning else self.console
        if _bars and console.is_terminal:  # a line on another console would run into the bar
            console = CONSOLE
        console.print(("warning: " if is_warning else "") + record.getMessage(), markup=False)


def start_logging(debug: bool, console: Console = CONSOLE) -> None:
    """Log to the terminal, with debug lines if `debug` is True."""
    LOG.setLevel(logging.DEBUG)
    LOG.handlers.clear()
    handler = _TerminalHandler(console)
    handler.setLevel(logging.DEBUG if debug else logging.INFO)
    LOG.addHandler(handler)


def keep_stdout_for_json() -> None:
    """Log to stderr from now on, so that stdout contains only JSON."""
    for handler in LOG.handlers:
        if isinstance(handler, _TerminalHandler):
            handler.console = STDERR_CONSOLE


def print_message(text: str) -> None:
    """Print an informational message; failing to write it is not an error."""
    CONSOLE.print(text, markup=False)


def show(text: str) -> None:
    """Print the result of a command.  Raises OutputError if it cannot be written."""
    CONSOLE.print(text, markup=False)
    signals.check_output()


def show_json(data: Any) -> None:
    """Print data as JSON.  Raises the errors of `show`."""
    signals.STDOUT.write(json.dumps(data, indent=1) + "\n")
    signals.check_output()


class _LogFile(logging.FileHandler):
    """A handler that writes a log file.  If a line cannot be written, the handler warns once and continues."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8", errors="backslashreplace")
        self.has_failed = False

    def handleError(self, record: logging.LogRecord) -> None:
        if not self.has_failed:
            self.has_failed = True
            error = sys.exc_info()[1]
            reason = getattr(error, "strerror", None) or error
            LOG.warning("%s: cannot be written (%s); continuing without this log", self.baseFilename, reason)

    def close(self) -> None:
        with suppress(OSError):  # from buffered lines; handleError has already warned
            super().close()


@contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Append the log to a file, with the time of each line and the traceback of an exception in the block.

    The file includes debug lines at any log level.  Raises OutputError if the file cannot be opened; later failures
    only log a warning.
    """
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: cannot be written (not a regular file); remove it, or use another folder")
    formatter = logging.Formatter("%(asctime)s %(levelname)s %(message)s")
    header = logging.LogRecord(LOG.name, logging.DEBUG, __file__, 0, "clsplat %s", (full_version(),), None)
    with raising_output_error(path):
        with path.open("a", encoding="utf-8") as file:
            file.write(formatter.format(header) + "\n")
        handler = _LogFile(path)
    handler.setFormatter(formatter)
    level = LOG.level
    LOG.setLevel(logging.DEBUG)
    LOG.addHandler(handler)
    try:
        yield
    except BaseException as error:
        LOG.debug("stopped by %s", type(error).__name__, exc_info=error)
        raise
    finally:
        for stream in (signals.STDOUT, signals.STDERR):
            if stream.fault is not None:
                LOG.debug("%s could not be written: %s", stream.name, stream.fault)
        LOG.removeHandler(handler)
        LOG.setLevel(level)
        handler.close()


def progress_line(progress: TrainingProgress) -> str:
    """Format the progress at a step as one line."""
    prefix = "" if progress.is_growth_known else "at least "
    count = "" if progress.gaussians is None else f"gaussians {progress.gaussians:,}  "
    return (
        f"step {progress.step}/{progress.steps}  loss {progress.loss:.4f}  psnr {progress.psnr:.1f}  {count}"
        f"{progress.milliseconds:.1f} ms/step  {prefix}{clock_text(progress.seconds_left)} left"
    )


def device_text(device: dict[str, Any]) -> str:
    """Format a device from `clsplat.devices` as lines of text, including whether it works."""
    sizes = f"{device['memory'] / 2**30:.1f} GiB of memory, buffers up to {device['allocation'] / 2**30:.1f} GiB"
    limits = f"groups up to {device['group']}, {device['local_memory'] >> 10} KiB local, {device['float_width']} lanes"
    return (
        f"{device['name']} ({device['kind']}, {device['units']} units)\n"
        f"  runtime   {device['platform']}\n"
        f"  limits    {sizes}, {limits}\n"
        f"  schedule  {device['schedule']}\n"
        f"  state     {'does not work: ' + device['fault'] if device['fault'] else 'works'}"
    )


@contextmanager
def progress_bar(status: StatusSource) -> Iterator[Callable[[TrainingProgress], None]]:
    """Yield a function that shows progress reports.  Between reports, a terminal shows the counts in `status`."""
    if not CONSOLE.is_terminal:
        yield lambda progress: LOG.info(progress_line(progress))
        return
    bar = _RunBar(status)
    with _draw(bar):
        yield bar.report


@contextmanager
def counts_on_terminal() -> Iterator[None]:
    """Show the progress of counted work in the block if the output is a terminal; otherwise, only log it."""
    if not CONSOLE.is_terminal:
        yield
        return
    bar = _create_bar()
    task = bar.add_task("", total=None, visible=False)

    def update(label: str, done: int, total: int, /, *, seconds_left: float | None) -> None:
        suffix = "" if seconds_left is None or done == total else f"  {clock_text(seconds_left)} left"
        bar.update(task, total=total, completed=done, description=f"{label}: {done} of {total}{suffix}", visible=True)

    with _draw(bar), listening(update):
        yield


class _RunBar:
    """The progress bar of a run.  It is computed from the run's status when drawn, so training never waits for it."""

    def __init__(self, status: StatusSource) -> None:
        self.status, self.bar = status, _create_bar()
        self.task = self.bar.add_task("", total=None)
        self.last_report: tuple[float, TrainingProgress] | None = None  # time, progress
        self.first_draw: tuple[float, int, int] | None = None  # time, step, and number of steps

    def report(self, progress: TrainingProgress) -> None:
        self.last_report = time.monotonic(), progress
        LOG.debug(progress_line(progress))

    def __rich__(self) -> Progress:
        now = self.status.now
        stage, progress, done, total = now.stage or "", now.progress, now.step or 0, now.steps
        if progress is None:
            self.bar.update(self.task, total=None, completed=0, description=stage)
        elif progress.unit == "steps" and total:
            self.bar.update(self.task, total=total, completed=done, description=self._training_text(done, total))
        else:
            text = f"{stage}: {progress.done} of {progress.total} {progress.unit}"
            self.bar.update(self.task, total=progress.total, completed=progress.done, description=text)
        return self.bar

    def _training_text(self, step: int, steps: int) -> str:
        now = time.monotonic()
        if self.last_report and self.last_report[1].steps == steps:
            start_time, progress = self.last_report
            seconds_left = max(0.0, progress.seconds_left - (now - start_time))
            return progress_line(replace(progress, step=step, seconds_left=seconds_left))
        if self.first_draw is None or self.first_draw[2] != steps:
            self.first_draw = now, step, steps
        start_time, start_step, _ = self.first_draw
        seconds = (now - start_time) / (step - start_step) * (steps - step) if step > start_step else None
        return f"step {step}/{steps}" + ("" if seconds is None else f"  about {clock_text(seconds)} left")


def _create_bar() -> Progress:
    return Progress(BarColumn(bar_width=24), TextColumn("{task.description}"), console=CONSOLE)


@contextmanager
def _draw(bar: "Progress | _RunBar") -> Iterator[None]:
    """Draw a progress bar several times a second during the block.  Log lines appear above the bar."""
    with Live(bar, console=CONSOLE, refresh_per_second=4, transient=True) as live, logging_counts_as_debug():
        _bars.append(live)
        try:
            yield
        finally:
            _bars.remove(live)
