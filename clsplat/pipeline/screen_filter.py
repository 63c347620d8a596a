"""What does not go together with a screen filter."""

from clsplat.density.statistics import Statistic
from clsplat.errors import ConfigError
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.kinds import kinds_of


def check_screen_filter(settings: PipelineFile) -> None:
    """Raise ConfigError where a rule reads what the screen filter does not compute."""
    if not settings.model.screen_filter.pixel_box:
        return
    for i, stage in enumerate(settings.stages):
        for rule in [rule for inner in getattr(stage, "during", ()) for rule in getattr(inner, "rules", ())]:
            for kind in kinds_of(rule):
                if issubclass(kind, Statistic) and kind.reads_conics:
                    raise ConfigError(
                        f"stages[{i}] {stage.stage}: the rule '{rule.type}' reads the inverse covariance of "
                        "splats, which model.screen_filter.type 'box' does not have; expected another screen filter "
                        "(mip is the nearest), or another rule"
                    )
