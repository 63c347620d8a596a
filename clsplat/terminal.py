"""What the terminal shows: a live line of progress, or plain lines where there is no terminal."""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn

from clsplat.opencl.device import DeviceInfo, resolve_schedule
from clsplat.training import run as training

LOG = logging.getLogger("clsplat")
CONSOLE = Console(highlight=False, soft_wrap=True)
ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)


class _TerminalHandler(logging.Handler):
    """Log lines above the progress bar: remarks to stdout, warnings to stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        console = ERRORS if record.levelno >= logging.WARNING else CONSOLE
        prefix = "warning: " if record.levelno >= logging.WARNING else ""
        console.print(prefix + record.getMessage(), markup=False)


def start_logging(debug: bool) -> None:
    """Send the log to the screen."""
    LOG.setLevel(logging.DEBUG)
    LOG.handlers.clear()
    handler = _TerminalHandler()
    handler.setLevel(logging.DEBUG if debug else logging.INFO)
    LOG.addHandler(handler)


@contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Append the log to a file, with the time of every line."""
    handler = logging.FileHandler(path)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    LOG.addHandler(handler)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        handler.close()


def line(progress: training.Progress) -> str:
    """One step as text."""
    p = progress
    return (
        f"step {p.step}/{p.steps}  loss {p.loss:.4f}  psnr {p.psnr:.1f}  gaussians {p.gaussians:,}  "
        f"{p.milliseconds:.1f} ms/step  {_clock(p.seconds_left)} left"
    )


def device_text(info: DeviceInfo, fault: str | None) -> str:
    """A device and whether it works, for people."""
    sizes = f"{info.memory / 2**30:.1f} GiB of memory, buffers up to {info.allocation / 2**30:.1f} GiB"
    limits = f"groups up to {info.group}, {info.local_memory >> 10} KiB local, {info.float_width} lanes"
    return (
        f"{info.name} ({info.kind}, {info.units} units)\n"
        f"  runtime   {info.platform}\n"
        f"  limits    {sizes}, {limits}\n"
        f"  schedule  {resolve_schedule(info, 'auto')}\n"
        f"  state     {'does not work: ' + fault if fault else 'works'}"
    )


def summary(folder: Path) -> None:
    """Print what a run achieved, and where it lies."""
    metrics = json.loads((folder / "metrics.json").read_text())
    test = next(iter(metrics["test"].values()), None)
    quality = f"test PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.4f}; " if test else ""
    CONSOLE.print(
        f"{quality}{metrics['gaussians']:,} Gaussians; {metrics['train_seconds']:.0f} s of training", markup=False
    )
    for title, name in (("model", "point_cloud.ply"), ("renders", "renders"), ("report", "report.html")):
        if (folder / name).exists():
            CONSOLE.print(f"  {title:<8} {folder / name}", markup=False)


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
