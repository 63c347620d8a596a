"""A benchmark: its cases, the device's peaks, the times, and their tables."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clsplat.bench.cases import Result, run_bench
from clsplat.bench.comparison import beside, peaks_text
from clsplat.bench.packing import Packings, measure_packings, task_of
from clsplat.bench.peaks import Peaks, measure_peaks
from clsplat.bench.scenes import SIZES, case, grown, real_case
from clsplat.bench.table import growth_chart, growth_table, table
from clsplat.errors import ConfigError, quoted
from clsplat.files import write_text
from clsplat.opencl.device import Device, open_device
from clsplat.opencl.discovery import Schedule, choose, resolve_schedule
from clsplat.pipeline.loading import load


@dataclass(frozen=True)
class Measurement:
    """Times of a training step, scene by scene."""

    device: str
    pipeline: str
    peaks: Peaks
    results: dict[str, Result]

    def data(self) -> dict[str, Any]:
        """Return everything as plain data."""
        scenes = {name: asdict(result) for name, result in self.results.items()}
        return {"device": self.device, "pipeline": self.pipeline, "peaks": asdict(self.peaks), "scenes": scenes}

    def text(self, earlier: dict[str, Any]) -> str:
        """Return tables of the times, beside the `data` of an earlier measurement unless that is empty."""
        head = [f"device: {self.device}", f"peaks: {peaks_text(asdict(self.peaks))}"]
        was = earlier.get("scenes", {})
        tables = [table(name, result, was.get(name)) for name, result in self.results.items()]
        return "\n".join([*head, *(beside(self.data(), earlier) if earlier else ()), *tables])


def measure(
    scenes: Sequence[str] = ("A",),
    *,
    model: Path | None = None,
    scene: Path | None = None,
    pipeline: str = "splat",
    repeats: int = 20,
    schedule: Schedule = "auto",
    device: str | Device | None = None,
) -> Measurement:
    """Time a training step on fixed scenes, and of a model at the views of its scene.  Raises ClsplatError."""
    if unknown := [name for name in scenes if name not in SIZES]:
        raise ConfigError(f"--scenes: no scene named '{unknown[0]}'; there are {', '.join(SIZES)}")
    if (model is None) != (scene is None):
        raise ConfigError("bench: --model and --scene go together")
    settings = load(pipeline).settings
    opened = open_device(device, schedule)
    peaks = measure_peaks(opened)
    cases = {name: case(opened, *SIZES[name], settings) for name in scenes}
    if model is not None and scene is not None:
        cases[model.stem] = real_case(opened, model, scene, settings)
    return Measurement(opened.text, settings.name, peaks, run_bench(cases, peaks, repeats))


def measure_packing(
    scenes: Sequence[str], *, pipeline: str, repeats: int, schedule: Schedule, device: str | Device | None
) -> Packings:
    """Time the packings of a CPU with a training step of one fixed scene.  Raises ClsplatError."""
    if len(scenes) != 1 or scenes[0] not in SIZES:
        raise ConfigError(f"--packing: expected one scene, of {', '.join(SIZES)}, got {quoted(','.join(scenes))}")
    load(pipeline)
    info = device.info if isinstance(device, Device) else choose(device)
    resolve_schedule(info, schedule)
    return measure_packings(info, task_of(info, SIZES[scenes[0]], pipeline, repeats, schedule), scenes[0])


def measure_growth(chart: Path, *, pipeline: str, repeats: int, schedule: Schedule, device: str | Device | None) -> str:
    """Time 50 000 to a million Gaussians; write an SVG, return a table.  Raises ClsplatError."""
    settings = load(pipeline).settings
    opened = open_device(device, schedule)
    peaks = measure_peaks(opened)
    sizes = [run_bench({"": one}, peaks, repeats)[""] for one in grown(opened, settings)]
    write_text(chart, growth_chart(sizes))
    return f"device: {opened.text}\n{growth_table(sizes)}"
