"""Output to the terminal: a live line of progress, or plain lines when the output is not a terminal."""

import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn

from clsplat.files import unwritable

if TYPE_CHECKING:  # the command line starts without OpenCL
    from clsplat.training import run as training

LOG = logging.getLogger("clsplat")


class _Console(Console):
    """A console that discards its output when the reader closes the pipe; the work continues."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        discard_output()


CONSOLE = _Console(highlight=False, soft_wrap=True)
ERRORS = _Console(stderr=True, highlight=False, soft_wrap=True)


def discard_output() -> None:
    """Discard all further output to stdout, so that a closed pipe causes no error."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


class _TerminalHandler(logging.Handler):
    """A handler that prints log lines above the progress bar: remarks to `remarks`, warnings to stderr."""

    def __init__(self, remarks: Console) -> None:
        super().__init__()
        self.remarks = remarks

    def emit(self, record: logging.LogRecord) -> None:
        warning = record.levelno >= logging.WARNING
        (ERRORS if warning else self.remarks).print(
            ("warning: " if warning else "") + record.getMessage(), markup=False
        )


def start_logging(debug: bool, remarks: Console = CONSOLE) -> None:
    """Send the log to the terminal, with debug lines when `debug` is True."""
    LOG.setLevel(logging.DEBUG)
    LOG.handlers.clear()
    handler = _TerminalHandler(remarks)
    handler.setLevel(logging.DEBUG if debug else logging.INFO)
    LOG.addHandler(handler)


def keep_stdout_for_json() -> None:
    """Send remarks of the log to stderr from here on: stdout holds JSON alone."""
    for handler in LOG.handlers:
        if isinstance(handler, _TerminalHandler):
            handler.remarks = ERRORS


def show(text: str) -> None:
    """Print text as it is."""
    CONSOLE.print(text, markup=False)


def show_json(data: Any) -> None:
    """Print data as JSON."""
    print(json.dumps(data, indent=1), flush=True)


@contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Append the log to a file, with the time of every line, and the traceback of an error that ends the block.

    The file has debug lines, whatever the level of the log was.
    """
    try:
        handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise unwritable(path, error) from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    level = LOG.level
    LOG.setLevel(logging.DEBUG)
    LOG.addHandler(handler)
    try:
        yield
    except BaseException as error:
        LOG.debug("ended by %s", type(error).__name__, exc_info=error)
        raise
    finally:
        LOG.removeHandler(handler)
        LOG.setLevel(level)
        handler.close()


def line(progress: "training.Progress") -> str:
    """Return the progress at a step as text."""
    p = progress
    return (
        f"step {p.step}/{p.steps}  loss {p.loss:.4f}  psnr {p.psnr:.1f}  gaussians {p.gaussians:,}  "
        f"{p.milliseconds:.1f} ms/step  {_clock(p.seconds_left)} left"
    )


def device_text(device: dict[str, Any]) -> str:
    """A device, as `clsplat.devices` lists it, and whether it works, as lines of text."""
    d = device
    sizes = f"{d['memory'] / 2**30:.1f} GiB of memory, buffers up to {d['allocation'] / 2**30:.1f} GiB"
    limits = f"groups up to {d['group']}, {d['local_memory'] >> 10} KiB local, {d['float_width']} lanes"
    return (
        f"{d['name']} ({d['kind']}, {d['units']} units)\n"
        f"  runtime   {d['platform']}\n"
        f"  limits    {sizes}, {limits}\n"
        f"  schedule  {d['schedule']}\n"
        f"  state     {'does not work: ' + d['fault'] if d['fault'] else 'works'}"
    )


def show_summary(folder: Path) -> None:
    """Print the metrics of a run and the paths of its files; nothing for a matrix."""
    if not (folder / "metrics.json").exists():
        return
    metrics = json.loads((folder / "metrics.json").read_text())
    test = next(iter(metrics["test"].values()), None)
    quality = f"test PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.4f}; " if test else ""
    show(f"{quality}{metrics['gaussians']:,} Gaussians; {metrics['train_seconds']:.0f} s of training")
    for title, name in (("model", "point_cloud.ply"), ("renders", "renders"), ("report", "report.html")):
        if (folder / name).exists():
            show(f"  {title:<8} {folder / name}")


@contextmanager
def progress_bar() -> Iterator[Callable[["training.Progress"], None]]:
    """Yield a function that shows progress."""
    if not CONSOLE.is_terminal:
        yield lambda progress: LOG.info(line(progress))
        return
    bar = Progress(BarColumn(bar_width=24), TextColumn("{task.description}"), console=CONSOLE)
    task = bar.add_task("", total=None)
    with Live(bar, console=CONSOLE, refresh_per_second=8, transient=True):

        def update(progress: "training.Progress") -> None:
            bar.update(task, total=progress.steps, completed=progress.step, description=line(progress))
            LOG.debug(line(progress))

        yield update


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
