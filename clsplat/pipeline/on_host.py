"""Whether the harmonics of a pipeline may lie on the host, and what does not go together with that."""

from clsplat.errors import ConfigError
from clsplat.pipeline.file import PipelineFile
from clsplat.training.memory import Harmonics


def harmonics_of(settings: PipelineFile) -> Harmonics:
    """Return where harmonics lie: `auto` is the device where a stage needs all of them there, or bands above 0 lack."""
    asked = settings.rasterizer.harmonics
    return "device" if asked == "auto" and (settings.model.sh_degree == 0 or _readers(settings)) else asked


def check_on_host(settings: PipelineFile) -> None:
    """Raise ConfigError where a stage needs all harmonics on the device, and the settings keep them on the host."""
    if settings.rasterizer.harmonics == "host" and (readers := _readers(settings)):
        raise ConfigError(
            f"{readers[0]} changes the harmonics of all Gaussians on the device, and they lie on the host; expected "
            "`rasterizer.harmonics: device`, with fewer Gaussians where it does not hold them, or no such stage"
        )


def _readers(settings: PipelineFile) -> list[str]:
    """The stages that need all harmonics on the device, by their places."""
    stages = [
        (i, outer.stage, inner) for i, outer in enumerate(settings.stages) for inner in getattr(outer, "during", ())
    ]
    return [f"stages[{i}] {name}: {inner.stage}" for i, name, inner in stages if inner.reads_harmonics]
