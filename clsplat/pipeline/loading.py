"""Load and check pipeline files, and apply overrides and the decisions of `adapt:`."""

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
from clsplat.pipeline.explanation import explain, first_fault, key_path_text
from clsplat.pipeline.file import STAGE_LISTS, PipelineFile
from clsplat.pipeline.files import VARIANT_SUFFIXES, find
from clsplat.pipeline.overrides import CADENCE, NoSuchKey, apply, list_keys, split, suggestion
from clsplat.pipeline.yaml_file import Document, KeyPath, read_yaml, yaml_text
from clsplat.prepare.cache import PlannedStep, plan
from clsplat.scene.quality import Measures
from clsplat.training.stage import Scheduled, Stage, Training, find_output_conflict

LOG = logging.getLogger("clsplat")


@dataclass(frozen=True)
class Pipeline:
    """A pipeline whose settings have been checked."""

    path: Path
    settings: PipelineFile
    reason: str = ""
    """The reason why settings differ from those of the file, in one line."""

    @property
    def names(self) -> list[str]:
        """The names of the preparation steps and stages, in order."""
        return [*(step.stage for step in self.settings.prepare), *(stage.stage for stage in self.stages)]

    @property
    def stages(self) -> list[Stage]:
        return list(self.settings.stages)

    @property
    def decisions(self) -> list[Decision]:
        """The settings that were chosen from the photos."""
        return (self.settings.adapt and self.settings.adapt.decisions) or []

    @property
    def reasons(self) -> list[str]:
        """The reasons for the decisions that change this run."""
        return [decision.reason for decision in self.decisions if decision.matters]

    @property
    def undecided(self) -> list[str]:
        """The keys whose values will be chosen from the photos."""
        if (adapt := self.settings.adapt) is None or adapt.decisions is not None:
            return []
        return [key for key in adapt.keys(self.settings.optimize) if key not in adapt.keep]

    def preparation(self, out: Path) -> list[PlannedStep]:
        """Return the preparation steps for the run folder `out`, each with the reason why it must run, if any.

        Raises DataError or ConfigError.
        """
        settings, folder = self.settings, prepared_folder(out)
        if settings.prepare and settings.scene.masks is not None:
            raise ConfigError(
                "scene.masks: the masks must fit the undistorted photos; run without scene.masks first, "
                f"then use the scene in {folder} as --scene, with masks of its images"
            )
        return plan(settings.prepare, settings.scene.folder, folder) if settings.prepare else []

    def resolved_settings(self) -> dict[str, Any]:
        """Return all settings with their values, as plain data with the structure of a pipeline file."""
        data = self.settings.model_dump(mode="json")
        data |= {key: [_untag_stage(stage) for stage in data[key]] for key in STAGE_LISTS}
        return {key: value for key, value in data.items() if value or key not in ("plugins", "adapt")}

    def text(self) -> str:
        """Return the resolved pipeline as YAML."""
        return yaml_text(self.resolved_settings())


def prepared_folder(out: Path) -> Path:
    """Return the folder for the results of `prepare:`, which is next to `out` and shared by all run folders there."""
    return out.absolute().parent / PREPARED


def load(name: str, overrides: list[str] | None = None) -> Pipeline:
    """Read and check a pipeline, given its path or the name of a shipped pipeline.

    overrides: settings as for `--set`, such as 'optimize.steps=500'.
    Raises ConfigError with the file, line, key, and nearest match.
    """
    path = find(name)
    return check_document(path, read_yaml(path), overrides or [])


def check_document(path: Path, document: Document, overrides: Sequence[str] = ()) -> Pipeline:
    """Return the pipeline in a document with overrides applied.  The document stays unchanged.

    Raises ConfigError like `load`."""
    if not isinstance(document.data, dict):
        raise ConfigError(f"{path}:1: expected keys such as name and stages")
    tagged_data = _tag_file(document, path)
    try:
        data = copy.deepcopy(without_decisions(tagged_data) if any(map(_changes_photos, overrides)) else tagged_data)
        key_paths = [apply(data, override, PipelineFile) for override in overrides]
        return _without_done_steps(Pipeline(path, _keep_overrides(_validate(data, path, document), key_paths)))
    except ConfigError:
        _raise_cause(tagged_data, overrides, path, document)
        raise


def _without_done_steps(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline without `prepare` if the scene already has cameras, and log that."""
    steps, scene = pipeline.settings.prepare, pipeline.settings.scene
    if not steps or scene.path is None or not steps[0].is_done_in(scene.folder):
        return pipeline
    reason = f"{scene.folder} has cameras; skipped: {', '.join(step.stage for step in steps)}"
    LOG.info("%s", reason)
    return replace(pipeline, settings=pipeline.settings.model_copy(update={"prepare": []}), reason=reason)


def _validate(data: dict[str, Any], path: Path, document: Document) -> PipelineFile:
    if isinstance(record := data.get("plugins"), dict):
        plugins.require({str(name): str(digest) for name, digest in record.items()}, str(path))
    try:
        settings = PipelineFile.model_validate(data)
    except ValidationError as error:
        raise ConfigError(explain(error, PipelineFile, path, document)) from error
    _check_order(path, settings)
    try:
        settings.check_conflicts()
    except ConfigError as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error
    nested = [item for _, item in iter_settings(settings)]
    classes = {*map(type, nested), *(class_ for item in nested if isinstance(item, Rule) for class_ in item.columns)}
    return settings.model_copy(update={"plugins": plugins.used_by(classes)})


def _raise_cause(data: dict[str, Any], overrides: Sequence[str], path: Path, document: Document) -> None:
    """Raise the error of the file without overrides, if any, or else the error of the first invalid override."""
    all_paths = [key.key_path for key in list_keys(_validate(data, path, document))]
    conflict: tuple[str, ConfigError] | None = None  # an override and its error; a later override may resolve it
    for override in overrides:
        names, _ = split(override)
        try:
            key_path = apply(data, override, PipelineFile)
        except NoSuchKey as error:
            raise OverrideError(override, error.reason + suggestion(names, all_paths)) from error
        try:
            settings = PipelineFile.model_validate(data)
            _check_order(path, settings)
            settings.check_conflicts()
            conflict = None
        except ValidationError as error:
            fault_path, message = first_fault(error, PipelineFile)
            contains_key = fault_path == key_path[: len(fault_path)]
            raise OverrideError(
                override, message if contains_key else f"{key_path_text(fault_path)}: {message}"
            ) from error
        except ConfigError as error:
            conflict = (conflict[0] if conflict else override), error
    if conflict:
        raise OverrideError(conflict[0], one_line(conflict[1]).removeprefix(f"{path}: ")) from conflict[1]


# Settings that follow from the photos.  They are decided once, as if by `--set`, and again if the photos change.

AUTO = ("chosen", "reason")  # keys that a run writes next to `auto`
LENGTHS = ("near", "unit")  # keys that a run replaces with lengths if they are `auto`


def apply_adaptation(pipeline: Pipeline, measures: Measures) -> Pipeline:
    """Return the pipeline with the decisions of its `adapt`.  Existing decisions are kept.  Raises ConfigError."""
    adapt = pipeline.settings.adapt
    return with_decisions(pipeline, adapt.decide(pipeline.settings.optimize, measures)) if adapt else pipeline


def with_decisions(pipeline: Pipeline, decisions: Iterable[Decision]) -> Pipeline:
    """Return the pipeline with decisions, except for the keys in `adapt.keep`.

    The pipeline is returned unchanged if it already has decisions.  Raises ConfigError.
    """
    if (adapt := pipeline.settings.adapt) is None or adapt.decisions is not None:
        return pipeline
    data = pipeline.settings.model_dump(mode="json")
    new_decisions = [decision for decision in decisions if decision.key not in adapt.keep]
    try:
        for decision in new_decisions:
            apply(data, decision.override, PipelineFile)
        data["adapt"]["decisions"] = [decision.model_dump() for decision in new_decisions]
        return replace(pipeline, settings=_validate(data, pipeline.path, Document(data)))
    except ConfigError as error:
        keys = ", ".join(decision.key for decision in new_decisions)
        raise ConfigError(
            f"adapt: {adapt.type}: {one_line(error)}; override one of its keys with --set: {keys}"
        ) from error


def _keep_overrides(settings: PipelineFile, key_paths: Sequence[KeyPath]) -> PipelineFile:
    """Add the keys set by overrides to `adapt.keep`.  Raises ConfigError if `adapt` decides an unknown key."""
    if (adapt := settings.adapt) is None:
        return settings
    keep, data, keys = adapt.keep, settings.model_dump(mode="json"), adapt.keys(settings.optimize)
    if unknown := [key for key in (*keep, *(decision.key for decision in adapt.decisions or ())) if key not in keys]:
        raise ConfigError(f"adapt: {adapt.type} does not set {quote(unknown[0])}; expected one of {', '.join(keys)}")
    for key in keys:
        try:
            key_path = apply(copy.deepcopy(data), f"{key}=null", PipelineFile)
        except OverrideError as error:
            raise ConfigError(f"adapt: {adapt.type}: {key}: {error.reason}") from error
        if key_path[0] not in ("model", "stages"):
            raise ConfigError(
                f"adapt: {adapt.type}: {key} cannot be adapted, since it is used before the photos are analyzed"
            )
        if key not in keep and any(key_path[: len(path)] == path[: len(key_path)] for path in key_paths):
            keep = [*keep, key]
    decisions = adapt.decisions and [decision for decision in adapt.decisions if decision.key not in keep]
    return settings.model_copy(update={"adapt": adapt.model_copy(update={"keep": keep, "decisions": decisions})})


def without_decisions(data: dict[str, Any]) -> dict[str, Any]:
    """Return a file's data without the decisions of an earlier run, so that a run makes new ones."""
    adapt = data.get("adapt")
    return {**dict(without_auto(data)), "adapt": {**adapt, "decisions": None} if isinstance(adapt, dict) else adapt}


def without_auto(data: Any) -> Any:
    """Return plain data of a resolved pipeline without the values that a run chose for keys that are `auto`."""
    if isinstance(data, list):
        return [without_auto(item) for item in data]
    if not isinstance(data, dict):
        return data
    for key in LENGTHS:
        if (length := data.get(f"{key}_auto")) is not None:
            data = {**data, key: "auto" if data[key] == length else data[key], f"{key}_auto": None}
    is_auto = all(key in data for key in AUTO)
    return {key: without_auto(value) for key, value in data.items() if not (is_auto and key in AUTO)}


def _changes_photos(override: str) -> bool:
    """Return whether an override changes the training photos, which affect the decisions."""
    names, _ = split(override)
    return names[0] == "scene" and names[1:2] != ["validation"]


def _tag_file(document: Document, path: Path) -> dict[str, Any]:
    """Return the file's data with each stage as {stage: name, …}, which selects its model, and without the variants."""
    data = {key: value for key, value in document.data.items() if key not in VARIANT_SUFFIXES}
    for key in STAGE_LISTS:
        if isinstance(data.get(key), list):
            data[key] = [_tag_stage(item, (key, i), document, path) for i, item in enumerate(data[key])]
    return data


def _tag_stage(item: Any, key_path: tuple[str | int, ...], document: Document, path: Path) -> Any:
    if isinstance(item, str):
        return {"stage": item}
    if not (isinstance(item, dict) and len(item) == 1 and isinstance(next(iter(item.values())), dict | None)):
        key = "".join(f"[{p}]" if isinstance(p, int) else str(p) for p in key_path[:2])
        raise ConfigError(f"{path}:{document.line(key_path)}: {key}: expected '- stage' or '- stage: {{key: value}}'")
    name, fields = next(iter(item.items()))
    fields = dict(fields or {})
    if "stage" in fields:
        tag = (*key_path, name, "stage")
        raise ConfigError(f"{path}:{document.line(tag)}: {key_path_text(tag)}: unknown key 'stage'; remove it")
    if isinstance(fields.get("during"), list):
        fields["during"] = [
            _tag_stage(inner, (*key_path, name, "during", i), document, path)
            for i, inner in enumerate(fields["during"])
        ]
    return {"stage": name, **fields}


def _untag_stage(stage: dict[str, Any]) -> dict[str, Any]:
    fields = {key: value for key, value in stage.items() if key != "stage"}
    if fields.get("every") is None:  # only stages inside `during` have a cadence
        fields = {key: value for key, value in fields.items() if key not in CADENCE}
    if "during" in fields:
        fields["during"] = [_untag_stage(inner) for inner in fields["during"]]
    return {stage["stage"]: fields}


def _explain_late_stage(stages: Sequence[Stage], need: str) -> str:
    """Return a text about a stage in `during` that would make `need` only after training ends; "" if there is none."""
    step = 0
    for training in stages:
        if not isinstance(training, Training):
            continue
        for inner in training.during:
            if need in inner.makes and inner.every:
                cadence = f"{inner.stage} makes every {inner.every} steps after step {inner.start}"
                can_run = any(
                    fires_at(inner.every, later_step) for later_step in range(step + 1, step + training.steps)
                )
                remedies = [] if can_run else [f"set {inner.stage}.every below {training.steps}"]
                remedies += (
                    [f"set {inner.stage}.start earlier"] if can_run or inner.start >= step + training.steps else []
                )
                return f"{cadence}, but the training ends earlier; {' and '.join(remedies)}, or use --minutes"
        step += training.steps
    return ""


def _check_order(path: Path, settings: PipelineFile) -> None:
    """Raise ConfigError if a stage needs something, such as a model, that no earlier stage makes."""
    available_items, removed, step = {"scene"}, dict[str, str](), 0
    for i, stage in enumerate(settings.stages):
        for key in CADENCE if isinstance(stage, Scheduled) else ():
            if getattr(stage, key) != type(stage).model_fields[key].default:
                raise ConfigError(f"{path}: stages[{i}] {stage.stage}: '{key}' belongs inside optimize.during")
        for need in sorted(stage.needs - available_items):
            makers = ", ".join(name for name, cls in variants(Stage).items() if need in cls.makes)
            if need in removed:
                reason = f"which {removed[need]} removes; add {makers} in between"
                raise ConfigError(f"{path}: stages[{i}] {stage.stage} needs '{need}', {reason}")
            if reason := _explain_late_stage(settings.stages[:i], need):
                raise ConfigError(f"{path}: stages[{i}] {stage.stage} needs '{need}', which {reason}")
            reason = f"no earlier stage creates; add {makers} before it"
            raise ConfigError(f"{path}: stages[{i}] {stage.stage} needs '{need}', which {reason}")
        removed |= dict.fromkeys(available_items & stage.removes, f"stages[{i}] {stage.stage}")
        available_items = (available_items - stage.removes) | stage.makes
        if isinstance(stage, Training):
            available_items.update(output for inner in stage.active_stages(step) for output in inner.makes)
            step += stage.steps
    if file := find_output_conflict(settings.stages):
        raise ConfigError(f"{path}: two stages write '{file}'; change the file name in one of them")
