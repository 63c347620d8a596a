"""What does not go together with Gaussians that move."""

from collections.abc import Iterator

from clsplat.errors import ConfigError
from clsplat.gaussians.tables import INTERVAL2
from clsplat.pipeline.file import PipelineFile
from clsplat.stages.reinit import ReinitFromDepth


def check_moving(settings: PipelineFile) -> None:
    """Raise ConfigError where Gaussians move and a part reads their means as if they stood still."""
    if settings.model.time is None:
        return
    for i, stage in enumerate(settings.stages):
        if isinstance(stage, ReinitFromDepth):
            raise ConfigError(
                f"stages[{i}] {stage.stage}: a depth is of one moment; expected Gaussians that stand still: remove the "
                "stage, or leave model.time out"
            )
    for what, remedy in _of_means(settings):
        raise ConfigError(
            f"{what} reads Gaussians where they are at their own time, not at that of a view; expected none beside "
            f"model.time: {remedy}, or leave model.time out"
        )


def _of_means(settings: PipelineFile) -> Iterator[tuple[str, str]]:
    """The parts that do so, each with what to write instead."""
    world = settings.model.world_filter
    if world.reads_means:
        yield f"model.world_filter.type '{getattr(world, 'type', '')}'", "set `world_filter: {type: none}`"
    for i, stage in enumerate(settings.stages):
        where = f"stages[{i}] {stage.stage}:"
        for one in (stage, *getattr(stage, "during", ())):
            for rule in getattr(one, "rules", ()):
                if rule.reads_means or INTERVAL2 in rule.tables:
                    default = "" if "rules" in one.model_fields_set else ", which it has by default,"
                    yield f"{where} the rule '{rule.type}'{default}", f"give {one.stage}.rules without {rule.type}"
        for loss in getattr(stage, "losses", ()):
            if INTERVAL2 in getattr(loss, "tables", ()):
                yield f"{where} the loss '{loss.type}' with `pixels`", "remove the loss"
