"""What a run has come to, in a few lines: its quality, its files, its photographs, its time, and what comes next."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from clsplat.errors import DataError, in_shell
from clsplat.names import METRICS, VIEW_COLOURS, VIEW_POSES
from clsplat.reading import read_json
from clsplat.training.found import photographs_text, size_text

# of what these stages write; others give their own names
TITLES = {"export": "model", "export_field": "field", "render": "renders", "optimize": "pictures"}
OF_FILES = {VIEW_COLOURS: "colours", VIEW_POSES: "poses"}  # whichever stage writes them
BEFORE_FILES = {"export": "point_cloud.ply", "render": "renders", "viewer": "viewer.html", "report": "report.html"}
SHORTEST = 0.5  # seconds of a stage that is told


def summary(folder: Path) -> list[str]:
    """Return the lines; none for a run that is not done, or a matrix.  Raises DataError where a file is damaged."""
    if not (folder / METRICS).exists():
        return []
    metrics = read_json(folder / METRICS)
    try:
        return list(_lines(folder, metrics))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{folder / METRICS}: the file is damaged; run the pipeline again, --restart") from error


def _lines(folder: Path, metrics: dict[str, Any]) -> Iterator[str]:
    test = next(iter(metrics["test"].values()), None)
    quality = f"test PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.4f}; " if test else ""
    size = size_text(metrics["gaussians"], metrics.get("parameters"))
    yield f"{quality}{size}; {metrics['train_seconds']:.0f} s of training"
    placed = photographs_text(metrics.get("preparation", {}))
    if kept := metrics.get("kept"):
        name, what = (
            ("refit", "steps on all of its photographs") if kept["refit"] else ("kept", "steps, the best model")
        )
        yield f"  {name:<8} {kept['step']:,} {what}, by a validation PSNR of {kept['validation']:.2f} dB"
    if scene := metrics.get("scene"):
        yield f"  scene    {scene}" + (f"; {placed}" if placed else "")
    files = {stage: folder / name for stage, name in metrics.get("files", BEFORE_FILES).items()}
    told = {OF_FILES.get(file.name) or TITLES.get(stage, stage): file for stage, file in files.items() if file.exists()}
    for name, file in told.items():
        yield f"  {name:<{max(8, *map(len, told))}} {file}"
    steps = {name: found.get("seconds", 0) for name, found in metrics.get("preparation", {}).items()}
    spent = {**steps, **metrics.get("seconds", {})}
    if long := [f"{name} {seconds:.0f} s" for name, seconds in spent.items() if seconds >= SHORTEST]:
        yield f"  time     {', '.join(long)}"
    page = next((files[stage] for stage in ("report", "viewer") if stage in files and files[stage].exists()), None)
    if page:
        more = f"; `clsplat resume {in_shell(folder)} --steps {2 * metrics['steps']}` trains longer"
        if metrics.get("by_heart"):
            more = "; the photographs are learnt by heart: more of them help most"
        elif kept and (kept["refit"] or kept["step"] < kept["last"]["step"]):  # validation has found where to end
            more = ""
        yield f"next: open {page} in a browser{more}"
