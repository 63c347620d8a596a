"""What settings of a pipeline exclude each other: motion, harmonics on the host, screen filters, a sky."""

from collections.abc import Iterator

from clsplat.core.errors import ConfigError
from clsplat.core.settings import Settings, variants
from clsplat.density.edit import Rule
from clsplat.density.statistics import Statistic
from clsplat.gaussians.gaussians import INTERVAL2
from clsplat.methods.mini_splatting import ReinitFromDepth
from clsplat.pipeline.choices import as_asked
from clsplat.pipeline.file import PipelineFile
from clsplat.render.backdrops import Directions
from clsplat.stages.optimize import Optimize
from clsplat.training.memory import Harmonics


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


# Whether the harmonics of a pipeline may lie on the host, and what does not go together with that.


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


# Which classes of settings a pipeline has.


def kinds_of(value: object) -> set[type]:
    """Return the classes of all settings inside settings, and of the statistics that their rules read."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return {kind for inner in value for kind in kinds_of(inner)}
    if not isinstance(value, Settings):
        return set()
    kinds = {type(value), *kinds_of([getattr(value, name) for name in type(value).model_fields])}
    if isinstance(value, Rule):
        known = variants(Statistic)
        read = {known[name] for name in value.statistics if name in known}
        kinds |= read | {known[kind.divisor] for kind in read if kind.divisor in known}
    return kinds


# What does not go together with a screen filter.


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


# What does not go together with a sky that a pipeline asks for.


def check_sky(settings: PipelineFile) -> None:
    """Raise ConfigError where poses are learned, or backgrounds drawn, beside colours by direction.

    A sky that `auto` may choose is left out there, by the run; what `choices` make of either is looked at then.
    """
    asked = as_asked(settings)
    if isinstance(asked.model.background, Directions):
        for stage in asked.stages:
            if isinstance(stage, Optimize):
                stage.check_beside("sky")
