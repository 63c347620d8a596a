"""What does not go together with harmonics on the host."""

from clsplat.errors import ConfigError
from clsplat.pipeline.file import PipelineFile


def check_on_host(settings: PipelineFile) -> None:
    """Raise ConfigError where a stage needs all harmonics on the device, and they lie on the host."""
    if settings.rasterizer.harmonics.in_use == "device":
        return
    for i, outer in enumerate(settings.stages):
        for stage in getattr(outer, "during", ()):
            if stage.reads_harmonics:
                raise ConfigError(
                    f"stages[{i}] {outer.stage}: {stage.stage} changes the harmonics of all Gaussians on the device, "
                    "and they lie on the host; expected `rasterizer.harmonics: device`, with fewer Gaussians where it "
                    "does not hold them, or no such stage"
                )
