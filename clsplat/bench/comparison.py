"""An earlier measurement: its file, and what it does not share with one of now."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from clsplat.errors import ConfigError, quoted
from clsplat.pipeline.loading import load
from clsplat.reading import read_json

EXPECTED = "the JSON of an earlier `clsplat bench --json`"
UNITS: dict[str, str] = {"gflops": "GFLOP/s", "gexp": "Gexp/s", "gbytes": "GB/s"}
ALIKE = 1.1  # largest ratio of two peaks of a machine that has as much to give as before


class _Peaks(BaseModel):
    gflops: float
    gexp: float
    gbytes: float


class _Times(BaseModel):
    stages: dict[str, float]
    host: float
    step: float
    densify: float


class _Earlier(BaseModel):
    """What a comparison reads of an earlier measurement."""

    model_config = ConfigDict(extra="ignore")

    device: str
    pipeline: str = "splat"
    peaks: _Peaks
    scenes: dict[str, _Times]


def read_measurement(path: Path, pipeline: str) -> dict[str, Any]:
    """Read the data of an earlier measurement of the same pipeline.  Raises ConfigError."""
    name = load(pipeline).settings.name
    data = read_json(path, EXPECTED, ConfigError)
    try:
        found = _Earlier.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise ConfigError(f"{path}: {place}: {first['msg']}; expected {EXPECTED}: make it again") from error
    if found.pipeline != name:
        raise ConfigError(f"{path}: expected the pipeline '{name}', it has {quoted(found.pipeline)}")
    return {key: value for key, value in data.items() if key != "against"}  # that of one still earlier


def peaks_text(peaks: dict[str, float]) -> str:
    """Return the peaks of a device, as the `data` of a measurement has them, in words."""
    return f"{peaks['gflops']:.0f} GFLOP/s, {peaks['gexp']:.1f} Gexp/s, copy {peaks['gbytes']:.1f} GB/s"


def beside(now: dict[str, Any], earlier: dict[str, Any]) -> list[str]:
    """Return lines about what the `data` of two measurements do not share, for whoever compares their times."""
    lines = [f"earlier: {peaks_text(earlier['peaks'])}"]
    if earlier["device"] != now["device"]:
        lines.append(f"  of another device: {quoted(earlier['device'])}")
    ratios = {unit: now["peaks"][key] / earlier["peaks"][key] for key, unit in UNITS.items() if earlier["peaks"][key]}
    if any(not 1 / ALIKE <= ratio <= ALIKE for ratio in ratios.values()):
        told = ", ".join(f"{ratio:.2f} of its {unit}" for unit, ratio in ratios.items())
        lines.append(f"  the device gives {told}: compare ratios to the floors")
    if missing := [name for name in now["scenes"] if name not in earlier["scenes"]]:
        lines.append(f"  has not measured: {', '.join(missing)}; there are {', '.join(earlier['scenes']) or 'none'}")
    return lines
