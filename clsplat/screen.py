"""What the terminal shows: a live line of progress, or plain lines where there is no terminal."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn

from clsplat.training import run as training

LOG = logging.getLogger("clsplat")
CONSOLE = Console(highlight=False, soft_wrap=True)
ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)


class _ScreenHandler(logging.Handler):
    """Log lines above the progress bar: remarks to stdout, warnings to stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        console = ERRORS if record.levelno >= logging.WARNING else CONSOLE
        prefix = "warning: " if record.levelno >= logging.WARNING else ""
        console.print(prefix + record.getMessage(), markup=False)


def start_logging(debug: bool) -> None:
    """Send the log to the screen."""
    LOG.setLevel(logging.DEBUG)
    LOG.handlers.clear()
    handler = _ScreenHandler()
    handler.setLevel(logging.DEBUG if debug else logging.INFO)
    LOG.addHandler(handler)


def log_to_file(path: Path) -> None:
    """Append the log to a file, with the time of every line."""
    handler = logging.FileHandler(path)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    LOG.addHandler(handler)


def line(progress: training.Progress) -> str:
    """One step as text."""
    p = progress
    return (
        f"step {p.step}/{p.steps}  loss {p.loss:.4f}  psnr {p.psnr:.1f}  gaussians {p.gaussians:,}  "
        f"{p.milliseconds:.1f} ms/step  {_clock(p.seconds_left)} left"
    )


@contextmanager
def progress_bar() -> Iterator[Callable[[training.Progress], None]]:
    """Yield a function that shows progress."""
    if not CONSOLE.is_terminal:
        yield lambda progress: LOG.info(line(progress))
        return
    bar = Progress(BarColumn(bar_width=24), TextColumn("{task.description}"), console=CONSOLE)
    task = bar.add_task("", total=None)
    with Live(bar, console=CONSOLE, refresh_per_second=8, transient=True):

        def show(progress: training.Progress) -> None:
            bar.update(task, total=progress.steps, completed=progress.step, description=line(progress))
            LOG.debug(line(progress))

        yield show


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
