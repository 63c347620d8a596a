"""Run a benchmark, and compare its times with the device's peak throughput and an earlier measurement."""

import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from clsplat.conformance.bench.cases import SIZES, BenchResult, Peaks, load_case, make_case, measure_peaks, run_bench
from clsplat.core.errors import ConfigError, quote
from clsplat.core.reading import read_json
from clsplat.core.text_table import text_table
from clsplat.opencl.device import Device, open_device
from clsplat.opencl.discovery import Schedule
from clsplat.pipeline.loading import load

EXPECTED_FILE = "the JSON of an earlier `clsplat bench --json`"
UNITS: dict[str, str] = {"gflops": "GFLOP/s", "gexp": "Gexp/s", "gbytes": "GB/s"}
TOTALS = {"host": "host", "step": "step", "steps without waits": "steps", "densify": "densify"}  # row labels and keys
MAX_PEAK_RATIO = 1.1  # times are comparable only if the ratio of the peaks is at most this


class _Peaks(BaseModel):
    gflops: float
    gexp: float
    gbytes: float


class _Times(BaseModel):
    stages: dict[str, float]
    host: float
    step: float
    steps: float = 0.0  # missing in old files
    densify: float


class _EarlierMeasurement(BaseModel):
    """The part of an earlier measurement that a comparison reads."""

    model_config = ConfigDict(extra="ignore")

    device: str
    pipeline: str = "splat"
    peaks: _Peaks
    scenes: dict[str, _Times]


def read_measurement(path: Path, pipeline: str) -> dict[str, Any]:
    """Read the data of an earlier measurement of the same pipeline.  Raises ConfigError."""
    name = load(pipeline).settings.name
    data = read_json(path, EXPECTED_FILE, ConfigError)
    try:
        actual = _EarlierMeasurement.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key_path = ".".join(map(str, first["loc"])) or "the file"
        raise ConfigError(f"{path}: {key_path}: {first['msg']}; expected {EXPECTED_FILE}; create it again") from error
    if actual.pipeline != name:
        raise ConfigError(f"{path}: expected the pipeline '{name}', got {quote(actual.pipeline)}; measure again")
    return {key: value for key, value in data.items() if key != "against"}  # the baseline of that measurement


def peaks_text(peaks: dict[str, float]) -> str:
    """Return the peaks of a device as text.  peaks: the key `peaks` in the `data` of a measurement."""
    return f"{peaks['gflops']:.0f} GFLOP/s, {peaks['gexp']:.1f} Gexp/s, copy {peaks['gbytes']:.1f} GB/s"


def compare_conditions(new: dict[str, Any], earlier: dict[str, Any]) -> list[str]:
    """Return lines of text about differences between the `data` of two measurements, other than times."""
    lines = [f"earlier: {peaks_text(earlier['peaks'])}"]
    if earlier["device"] != new["device"]:
        lines.append(f"  measured on another device: {quote(earlier['device'])}")
    ratios = {unit: new["peaks"][key] / earlier["peaks"][key] for key, unit in UNITS.items() if earlier["peaks"][key]}
    if any(not 1 / MAX_PEAK_RATIO <= ratio <= MAX_PEAK_RATIO for ratio in ratios.values()):
        changes = ", ".join(f"{ratio:.2f} of its {unit}" for unit, ratio in ratios.items())
        lines.append(f"  the device now reaches {changes}; compare the ratios to the floors instead of times")
    if missing_names := [name for name in new["scenes"] if name not in earlier["scenes"]]:
        lines.append(f"  scenes: {', '.join(earlier['scenes']) or 'none'}; missing: {', '.join(missing_names)}")
    return lines


def table(name: str, result: BenchResult, earlier: dict[str, Any] | None) -> str:
    """Return a table of the times of one scene.  earlier: data of the same scene in an earlier measurement, or None."""
    work, mib = result.work, 2**20
    counts = f"{work.gaussians:,} Gaussians, {work.pairs:,} pairs, {work.rows:,} rows, {work.pixels:,} pixels"
    rows = [(stage, ms, result.floors.get(stage)) for stage, ms in result.stages.items()]
    total = sum(result.floors.values())
    rows += [(row, getattr(result, key), total if "step" in row else None) for row, key in TOTALS.items()]
    old_times = {**earlier["stages"], **{row: earlier.get(key, 0.0) for row, key in TOTALS.items()}} if earlier else {}
    cells = [["stage", "ms", "floor", "ratio", *(("earlier", "now/earlier") if earlier else ())]]
    for stage, ms, floor in rows:
        ratio = (f"{floor:.2f}", f"{ms / floor:.2f}") if floor else ("", "")
        old_ms = old_times.get(stage, 0)
        comparison = (f"{old_ms:.2f}", f"{ms / old_ms:.2f}") if old_ms > 0 else ()
        cells.append([stage, f"{ms:.2f}", *ratio, *comparison])
    memory = f"memory {result.memory / mib:,.0f} MiB at peak; training plans {result.planned / mib:,.0f} MiB"
    rest = f"{memory}; {result.launches} kernel launches and {result.bytes / mib:,.0f} MiB of traffic per step"
    return f"scene {name}: {counts}\n" + textwrap.indent(f"{text_table(cells, left_columns=1)}\n{rest}", "  ")


@dataclass(frozen=True)
class Measurement:
    """The times of a training step for each scene."""

    device: str
    pipeline: str
    peaks: Peaks
    results: dict[str, BenchResult]

    def data(self) -> dict[str, Any]:
        """Return the measurement as plain data."""
        scenes = {name: asdict(result) for name, result in self.results.items()}
        return {"device": self.device, "pipeline": self.pipeline, "peaks": asdict(self.peaks), "scenes": scenes}

    def text(self, earlier: dict[str, Any]) -> str:
        """Return tables of the times.  earlier: `data` of an earlier measurement to compare with, or an empty dict."""
        header = [f"device: {self.device}", f"peaks: {peaks_text(asdict(self.peaks))}"]
        earlier_scenes = earlier.get("scenes", {})
        tables = [table(name, result, earlier_scenes.get(name)) for name, result in self.results.items()]
        return "\n".join([*header, *(compare_conditions(self.data(), earlier) if earlier else ()), *tables])


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
    """Time training steps on synthetic scenes, and on a model with a view of its scene.  Raises ClsplatError."""
    if unknown_names := [name for name in scenes if name not in SIZES]:
        raise ConfigError(f"--scenes: expected names from {', '.join(SIZES)}, got '{unknown_names[0]}'")
    if (model is None) != (scene is None):
        raise ConfigError("bench needs --model and --scene together; add the missing one")
    settings = load(pipeline).settings
    bench_device = open_device(device, schedule)
    peaks = measure_peaks(bench_device)
    cases = {name: make_case(bench_device, *SIZES[name], settings) for name in scenes}
    if model is not None and scene is not None:
        cases[model.stem] = load_case(bench_device, model, scene, settings)
    return Measurement(bench_device.label, settings.name, peaks, run_bench(cases, peaks, repeats))
