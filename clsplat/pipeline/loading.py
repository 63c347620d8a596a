"""From a pipeline file to checked stages, and back to the resolved file that a run folder holds."""

import copy
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clsplat.core.errors import ConfigError, OverrideError, one_line
from clsplat.core.files import PREPARED
from clsplat.core.schedule import is_act
from clsplat.core.settings import nested, variants
from clsplat.density.edit import Rule
from clsplat.pipeline import plugins
from clsplat.pipeline.choices import as_asked, check_choices, held, overridden
from clsplat.pipeline.explanation import explain, first_fault, place_text
from clsplat.pipeline.file import STAGE_LISTS, PipelineFile
from clsplat.pipeline.files import find
from clsplat.pipeline.overrides import CADENCE, NoSuchKey, apply, settable, split, suggestion
from clsplat.pipeline.yaml_file import Document, read_yaml, yaml_text
from clsplat.prepare.cache import Planned, plan
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
        return {key: value for key, value in data.items() if value or key not in ("plugins", "choices")}

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
        return _as_needed(Pipeline(path, _validated(overridden(tagged, overrides), path, document)))
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
        as_asked(settings).check_together()
        check_choices(settings)
    except ConfigError as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error
    found = [one for _, one in nested(settings)]
    kinds = {*map(type, found), *(kind for one in found if isinstance(one, Rule) for kind in one.columns)}
    return settings.model_copy(update={"plugins": plugins.used_by(kinds)})


def _blame(data: dict[str, Any], overrides: Sequence[str], path: Path, document: Document) -> None:
    """Raise the error of the file without overrides, or else that of the first invalid override."""
    known = [key.place for key in settable(_validated(data, path, document))]
    without: tuple[str, ConfigError] | None = None  # what is not there since an override; a later one may make it
    for override in overrides:
        names, _ = split(override)
        before = copy.deepcopy(data)
        try:
            place = apply(data, override, PipelineFile)
        except NoSuchKey as error:
            raise OverrideError(override, error.reason + suggestion(names, known)) from error
        if held(data, [place]):  # whose values need not go together with those of the file
            data = before
            continue
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
                acts = any(is_act(inner.every, one) for one in range(step + 1, step + training.steps))
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
