"""From a pipeline file to checked stages, and back to the resolved file that a run folder holds."""

import copy
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clsplat.core.errors import ConfigError, OverrideError, one_line, quote
from clsplat.core.files import PREPARED
from clsplat.core.schedule import fires_at
from clsplat.core.settings import iter_settings, variants
from clsplat.density.edit import Rule
from clsplat.pipeline import plugins
from clsplat.pipeline.adapt import Decision
from clsplat.pipeline.explanation import explain, first_fault, place_text
from clsplat.pipeline.file import STAGE_LISTS, PipelineFile
from clsplat.pipeline.files import find
from clsplat.pipeline.overrides import CADENCE, NoSuchKey, apply, settable, split, suggestion
from clsplat.pipeline.yaml_file import Document, Place, read_yaml, yaml_text
from clsplat.prepare.cache import Planned, plan
from clsplat.scene.quality import Measures
from clsplat.training.stage import Scheduled, Stage, Training, written_twice

LOG = logging.getLogger("clsplat")


@dataclass(frozen=True)
class Pipeline:
    """A checked pipeline."""

    path: Path
    settings: PipelineFile
    reason: str = ""
    """Why settings are others than those of the file, in one line."""

    @property
    def names(self) -> list[str]:
        """The names of its steps and stages, in order."""
        return [*(step.stage for step in self.settings.prepare), *(stage.stage for stage in self.stages)]

    @property
    def stages(self) -> list[Stage]:
        return list(self.settings.stages)

    @property
    def decisions(self) -> list[Decision]:
        """What was decided by the photographs."""
        return (self.settings.adapt and self.settings.adapt.decisions) or []

    @property
    def undecided(self) -> list[str]:
        """The keys that are still to be decided by the photographs."""
        if (adapt := self.settings.adapt) is None or adapt.decisions is not None:
            return []
        return [key for key in adapt.keys(self.settings.optimize) if key not in adapt.keep]

    def preparation(self, out: Path) -> list[Planned]:
        """Return the steps before a run in `out`, with the reasons to run them.  Raises DataError or ConfigError."""
        settings, folder = self.settings, prepared_folder(out)
        if settings.prepare and settings.scene.masks is not None:
            raise ConfigError(
                "scene.masks: prepared photographs have another shape than those of "
                f"{settings.scene.folder}; expected a scene with cameras: run without scene.masks first, then give the "
                f"result in {folder} as --scene, with masks of its images"
            )
        return plan(settings.prepare, settings.scene.folder, folder) if settings.prepare else []

    def resolved(self) -> dict[str, Any]:
        """Return every setting with its value, as plain data in the shape of a file."""
        data = self.settings.model_dump(mode="json")
        data |= {key: [_untagged(stage) for stage in data[key]] for key in STAGE_LISTS}
        return {key: value for key, value in data.items() if value or key not in ("plugins", "adapt")}

    def text(self) -> str:
        """Return the text of the resolved file."""
        return yaml_text(self.resolved())


def prepared_folder(out: Path) -> Path:
    """Return the folder for results of `prepare:`: beside the run folder, for all runs there."""
    return out.absolute().parent / PREPARED


def load(name: str, overrides: list[str] | None = None) -> Pipeline:
    """Read and check a pipeline: a path, or the name of a shipped one; `overrides` are 'stage.key=value'.

    Raises ConfigError naming file, line, place and the nearest match.
    """
    path = find(name)
    return checked(path, read_yaml(path), overrides or [])


def checked(path: Path, document: Document, overrides: Sequence[str] = ()) -> Pipeline:
    """Check a document with overrides; the document stays unchanged.  Raises ConfigError as `load` does."""
    if not isinstance(document.data, dict):
        raise ConfigError(f"{path}:1: expected keys such as name and stages")
    tagged = _tagged_file(document, path)
    try:
        data = copy.deepcopy(forgotten(tagged) if any(map(_is_of_photographs, overrides)) else tagged)
        places = [apply(data, override, PipelineFile) for override in overrides]
        return _as_needed(Pipeline(path, _keeping(_validated(data, path, document), places)))
    except ConfigError:
        _blame(tagged, overrides, path, document)
        raise


def _as_needed(pipeline: Pipeline) -> Pipeline:
    """The pipeline without steps of `prepare` whose work a scene has behind it; say so."""
    steps, scene = pipeline.settings.prepare, pipeline.settings.scene
    if not steps or scene.path is None or not steps[0].is_done_in(scene.folder):
        return pipeline
    reason = f"{scene.folder} holds cameras; left out: {', '.join(step.stage for step in steps)}"
    LOG.info("%s", reason)
    return replace(pipeline, settings=pipeline.settings.model_copy(update={"prepare": []}), reason=reason)


def _validated(data: dict[str, Any], path: Path, document: Document) -> PipelineFile:
    if isinstance(recorded := data.get("plugins"), dict):
        plugins.require({str(name): str(digest) for name, digest in recorded.items()}, str(path))
    try:
        settings = PipelineFile.model_validate(data)
    except ValidationError as error:
        raise ConfigError(explain(error, PipelineFile, path, document)) from error
    _check_order(path, settings)
    try:
        settings.check_together()
    except ConfigError as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error
    found = [one for _, one in iter_settings(settings)]
    kinds = {*map(type, found), *(kind for one in found if isinstance(one, Rule) for kind in one.columns)}
    return settings.model_copy(update={"plugins": plugins.used_by(kinds)})


def _blame(data: dict[str, Any], overrides: Sequence[str], path: Path, document: Document) -> None:
    """Raise the error of the file without overrides, or else that of the first invalid override."""
    known = [key.place for key in settable(_validated(data, path, document))]
    without: tuple[str, ConfigError] | None = None  # what is not there since an override; a later one may make it
    for override in overrides:
        names, _ = split(override)
        try:
            place = apply(data, override, PipelineFile)
        except NoSuchKey as error:
            raise OverrideError(override, error.reason + suggestion(names, known)) from error
        try:
            settings = PipelineFile.model_validate(data)
            _check_order(path, settings)
            settings.check_together()
            without = None
        except ValidationError as error:
            where, complaint = first_fault(error, PipelineFile)
            around = where == place[: len(where)]
            raise OverrideError(override, complaint if around else f"{place_text(where)}: {complaint}") from error
        except ConfigError as error:
            without = (without[0] if without else override), error
    if without:
        raise OverrideError(without[0], one_line(without[1]).removeprefix(f"{path}: ")) from without[1]


# What follows from the photographs: decided once, like `--set`, and forgotten for other photographs.

AUTO = ("chosen", "reason")  # what a run writes next to a key `auto`


def adapted(pipeline: Pipeline, measures: Measures) -> Pipeline:
    """Return the pipeline with what its `adapt` decides; decisions that are made stay.  Raises ConfigError."""
    adapt = pipeline.settings.adapt
    return with_decisions(pipeline, adapt.decide(pipeline.settings.optimize, measures)) if adapt else pipeline


def with_decisions(pipeline: Pipeline, decisions: Iterable[Decision]) -> Pipeline:
    """Return the pipeline with these decisions, but for keys that it keeps; its own stay.  Raises ConfigError."""
    if (adapt := pipeline.settings.adapt) is None or adapt.decisions is not None:
        return pipeline
    data = pipeline.settings.model_dump(mode="json")
    made = [one for one in decisions if one.key not in adapt.keep]
    try:
        for one in made:
            apply(data, one.override, PipelineFile)
        data["adapt"]["decisions"] = [one.model_dump() for one in made]
        return replace(pipeline, settings=_validated(data, pipeline.path, Document(data)))
    except ConfigError as error:
        keys = ", ".join(one.key for one in made)
        raise ConfigError(f"adapt: {adapt.type}: {one_line(error)}; --set of one of its keys wins: {keys}") from error


def _keeping(settings: PipelineFile, places: Sequence[Place]) -> PipelineFile:
    """The settings, whose `adapt` keeps what overrides have set.  Raises ConfigError where its keys have no place."""
    if (adapt := settings.adapt) is None:
        return settings
    keep, data, keys = adapt.keep, settings.model_dump(mode="json"), adapt.keys(settings.optimize)
    if unknown := [key for key in (*keep, *(one.key for one in adapt.decisions or ())) if key not in keys]:
        raise ConfigError(f"adapt: {adapt.type} does not decide {quote(unknown[0])}; there are {', '.join(keys)}")
    for key in keys:
        try:
            own = apply(copy.deepcopy(data), f"{key}=null", PipelineFile)
        except OverrideError as error:
            raise ConfigError(f"adapt: {adapt.type}: {key}: {error.reason}") from error
        if own[0] not in ("model", "stages"):
            raise ConfigError(f"adapt: {adapt.type}: {key} is used before photographs are measured")
        if key not in keep and any(own[: len(place)] == place[: len(own)] for place in places):
            keep = [*keep, key]
    decisions = adapt.decisions and [one for one in adapt.decisions if one.key not in keep]
    return settings.model_copy(update={"adapt": adapt.model_copy(update={"keep": keep, "decisions": decisions})})


def forgotten(data: dict[str, Any]) -> dict[str, Any]:
    """Return a file's data without what a run decided by its photographs: it is decided again."""
    adapt = data.get("adapt")
    return {**dict(without_auto(data)), "adapt": {**adapt, "decisions": None} if isinstance(adapt, dict) else adapt}


def without_auto(data: Any) -> Any:
    """Return plain data of a resolved pipeline without what keys `auto` chose."""
    if isinstance(data, list):
        return [without_auto(item) for item in data]
    if not isinstance(data, dict):
        return data
    chooses = all(key in data for key in AUTO)
    return {key: without_auto(value) for key, value in data.items() if not (chooses and key in AUTO)}


def _is_of_photographs(override: str) -> bool:
    """Whether an override sets which photographs are trained with, by which a run may have decided."""
    names, _ = split(override)
    return names[0] == "scene" and names[1:2] != ["validation"]


def _tagged_file(document: Document, path: Path) -> dict[str, Any]:
    """The file's data with each stage as {stage: name, …}, from which the models are chosen, and without `short`."""
    data = {key: value for key, value in document.data.items() if key != "short"}
    for key in STAGE_LISTS:
        if isinstance(data.get(key), list):
            data[key] = [_tagged(item, (key, i), document, path) for i, item in enumerate(data[key])]
    return data


def _tagged(item: Any, place: tuple[str | int, ...], document: Document, path: Path) -> Any:
    if isinstance(item, str):
        return {"stage": item}
    if not (isinstance(item, dict) and len(item) == 1 and isinstance(next(iter(item.values())), dict | None)):
        where = "".join(f"[{p}]" if isinstance(p, int) else str(p) for p in place[:2])
        raise ConfigError(f"{path}:{document.line(place)}: {where}: expected '- stage' or '- stage: {{key: value}}'")
    name, fields = next(iter(item.items()))
    fields = dict(fields or {})
    if "stage" in fields:
        inner = (*place, name, "stage")
        raise ConfigError(f"{path}:{document.line(inner)}: {place_text(inner)}: unknown key 'stage'; remove it")
    if isinstance(fields.get("during"), list):
        fields["during"] = [
            _tagged(inner, (*place, name, "during", i), document, path) for i, inner in enumerate(fields["during"])
        ]
    return {"stage": name, **fields}


def _untagged(stage: dict[str, Any]) -> dict[str, Any]:
    fields = {key: value for key, value in stage.items() if key != "stage"}
    if fields.get("every") is None:  # a cadence belongs inside `during` only
        fields = {key: value for key, value in fields.items() if key not in CADENCE}
    if "during" in fields:
        fields["during"] = [_untagged(inner) for inner in fields["during"]]
    return {stage["stage"]: fields}


def _late(stages: Sequence[Stage], need: str) -> str:
    """Say of a part what should make it during a training, but does not act; "" where there is none."""
    step = 0
    for training in stages:
        if not isinstance(training, Training):
            continue
        for inner in training.during:
            if need in inner.makes and inner.every:
                cadence = f"{inner.stage} makes at every {inner.every} steps after step {inner.start}"
                acts = any(fires_at(inner.every, one) for one in range(step + 1, step + training.steps))
                remedies = [] if acts else [f"set {inner.stage}.every below {training.steps}"]
                remedies += [f"set {inner.stage}.start earlier"] if acts or inner.start >= step + training.steps else []
                return f"{cadence}; the training ends before: {' and '.join(remedies)}, or use --minutes"
        step += training.steps
    return ""


def _check_order(path: Path, settings: PipelineFile) -> None:
    """Raise ConfigError where a stage needs a part of the run that no earlier stage makes."""
    made, taken, step = {"scene"}, dict[str, str](), 0
    for i, stage in enumerate(settings.stages):
        for key in CADENCE if isinstance(stage, Scheduled) else ():
            if getattr(stage, key) != type(stage).model_fields[key].default:
                raise ConfigError(f"{path}: stages[{i}] {stage.stage}: '{key}' belongs inside optimize.during")
        for need in sorted(stage.needs - made):
            makers = ", ".join(name for name, kind in variants(Stage).items() if need in kind.makes)
            if need in taken:
                gone = f"which {taken[need]} takes away ({makers} makes it again)"
                raise ConfigError(f"{path}: stages[{i}] {stage.stage} needs '{need}', {gone}")
            if late := _late(settings.stages[:i], need):
                raise ConfigError(f"{path}: stages[{i}] {stage.stage} needs '{need}', which {late}")
            raise ConfigError(
                f"{path}: stages[{i}] {stage.stage} needs '{need}', which no earlier stage makes ({makers} makes it)"
            )
        taken |= dict.fromkeys(made & stage.takes, f"stages[{i}] {stage.stage}")
        made = (made - stage.takes) | stage.makes
        if isinstance(stage, Training):
            made.update(part for inner in stage.acting(step) for part in inner.makes)
            step += stage.steps
    if place := written_twice(settings.stages):
        raise ConfigError(f"{path}: two stages write '{place}'; give one of them another name")
