"""Select the views of a scene by name (every n-th, a list, or the lines of a file), and split the scene."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from clsplat.core.errors import DataError, pluralize, quote
from clsplat.core.reading import read_text
from clsplat.core.settings import InputPath, Settings, in_one_sentence
from clsplat.scene.images import is_image
from clsplat.scene.lookup import Missing
from clsplat.scene.scene import HOLDOUT, Scene, camera_extent, every_nth, remaining_views
from clsplat.scene.view import photograph_name

LOG = logging.getLogger("clsplat")
MAX_BYTES = 1 << 24  # largest file with a list of names
ExcludedBy = Literal["holdout", "train", "missing"]
ExcludedNames = Mapping[ExcludedBy, Sequence[str]]  # names to exclude, by reason: a setting, or missing files
NO_NAMES: ExcludedNames = {}
NOTATIONS = "expected a number, {every, offset}, {names: […]} or {file: …}"


def _require_text(value: Any) -> Any:
    if not isinstance(value, str):
        raise ValueError("expected names of photos as strings: put numbers in quotes, as in '0042'")
    if not value.strip():
        raise ValueError("expected names of photos, got an empty name")
    return value


class MissingViewError(DataError):
    """A selection does not match the photographs of the dataset.  It may match the output of `prepare`."""


class ViewSelection(Settings):
    """Views by name: every n-th, those of a list, or those of a file with one name per line.

    A listed name may be the end of a view's name: `0042`, `0042.jpg` and `images/0042.jpg` name the same photograph,
    even if `prepare` wrote it as `0042.png`.
    """

    every: Annotated[int, Field(gt=0)] | None = None
    """Every n-th view, in order of name."""
    offset: Annotated[int, Field(ge=0)] = 0
    """Index of the first view, counted from 0."""
    names: Annotated[list[Annotated[str, BeforeValidator(_require_text)]], Field(min_length=1)] | None = None
    """Names of the views."""
    file: InputPath | None = None
    """Text file with one name per line; a relative path is relative to the folder of the dataset."""

    @model_validator(mode="before")
    @classmethod
    def _check_notation(cls, value: Any) -> Any:
        """Return the value unchanged.  Raises ValueError with an explanation for common mistakes of notation."""
        if not isinstance(value, dict):
            return value
        if any(isinstance(key, str) and ":" in key and content is None for key, content in value.items()):
            raise ValueError(f"{NOTATIONS} (YAML needs a space after each colon)")
        offset = value.get("offset")
        if isinstance(offset, int) and offset < 0:
            raise ValueError(f"expected an offset of 0 or more, got {quote(offset)}")
        if "offset" in value and len(value) == 1:
            raise ValueError("'offset' needs 'every', as in {every: 8, offset: 4}")
        return value

    @model_validator(mode="after")
    def _check_selectors(self) -> "ViewSelection":
        selectors = [self.every, self.names, self.file]
        if sum(value is not None for value in selectors) != 1 or (self.offset and self.every is None):
            raise ValueError(NOTATIONS)
        if self.every is not None and self.offset >= self.every:
            raise ValueError(f"'offset' must be less than 'every', {self.every}")
        return self

    def input_path(self, key: str, scene: str | None) -> Path | None:
        path = super().input_path(key, scene)
        return path and Path(scene or "") / path

    def select(self, names: Sequence[str], folders: Sequence[Path], excluded: ExcludedNames = NO_NAMES) -> set[int]:
        """Return the indices of the selected `names`.

        folders: the folders in which a relative `file` is looked up, in order.  excluded: names that must not be
        selected.  Listed names of missing photographs are skipped.  Raises DataError for a listed name that is
        excluded, matches no view, or matches several.
        """
        if self.every is not None:
            return every_nth(names, self.every, self.offset)
        source, lines = self._read_names(folders)
        index, excluded_indexes = _NameIndex(names), {key: _NameIndex(group) for key, group in excluded.items()}
        matches_by_name = {name: index.find_indices(name) for name in lines}
        for name in [name for name, matches in matches_by_name.items() if not matches]:
            for key in (key for key, group in excluded_indexes.items() if group.find_indices(name)):
                if key != "missing":
                    raise _excluded_error(source, name, key)
                del matches_by_name[name]
        if count := len({*lines}) - len(matches_by_name):
            LOG.info("%s: skipped %s whose photo is missing", source, pluralize(count, "name"))
        return {i for name, rows in matches_by_name.items() for i in _require_one_match(name, rows, names, source)}

    def check(self, names: Sequence[str], folders: Sequence[Path], excluded: ExcludedNames = NO_NAMES) -> list[str]:
        """Return the names that the list matches; empty for a selection of every n-th view.

        excluded: names that must not be selected.  Raises DataError for a listed name that matches only excluded names
        or no name.
        """
        if self.every is not None:
            return []
        source, lines = self._read_names(folders)
        index, groups = _NameIndex(names), {key: {*group} for key, group in excluded.items()}
        matches = {name: index.find_indices(name) for name in lines}
        for name, indices in matches.items():
            if not indices:
                raise _unknown_name_error(name, names, source)
            for key in (key for key, group in groups.items() if {names[i] for i in indices} <= group):
                raise _excluded_error(source, name, key)
        return [names[i] for indices in matches.values() for i in indices]

    def _read_names(self, folders: Sequence[Path]) -> tuple[str, list[str]]:
        """Return the source of the list, for messages, and its names.  Raises DataError for a bad or empty file."""
        if self.file is None:
            return "the list of names", self.names or []
        files = [folder / self.file for folder in folders]
        path = next((file for file in files if file.is_file()), files[-1])
        lines = (line.strip() for line in read_text(path, limit=MAX_BYTES).splitlines())
        if names := [line for line in lines if line and not line.startswith("#")]:
            return str(path), names
        raise DataError(f"{path}: the file is empty; write one photo name per line")


Number = Annotated[int, Field(ge=0)]
Selection = Annotated[Number | ViewSelection, in_one_sentence(NOTATIONS)]
SelectionOrAuto = Annotated[Number | ViewSelection | Literal["auto"], in_one_sentence(f"{NOTATIONS}, or auto")]


def _excluded_error(source: str, name: str, key: ExcludedBy) -> DataError:
    """Return the error for a listed name that another setting of the scene excludes."""
    reason, remedy = {
        "holdout": ("is a test view", "from scene.holdout"),
        "train": ("is left out by scene.train", "add it to scene.train"),
    }[key]
    message = f"{quote(name)} {reason}; expected training photos: remove it from this list, or {remedy}"
    return MissingViewError(f"{source}: {message}")


class _NameIndex:
    """Find views by the end of the name of their photograph: `a/b.png`, `b.png` and `b` match the same view."""

    def __init__(self, names: Sequence[str]):
        self._views: dict[str, list[int]] = {}
        for i, name in enumerate(names):
            self._views.setdefault(photograph_name(name), []).append(i)
        names = self._names = list(self._views)
        paths = [PurePosixPath(name) for name in names]
        stems = [path.with_suffix("") for path in paths]
        self._indices = {name: i for i, name in reversed([*enumerate(names)])}
        self._endings, self._stems = _group(_path_suffixes(paths)), _group(_path_suffixes(stems))
        self._full_stems = _group((stem.parts, i) for i, stem in enumerate(stems))

    def find_indices(self, name: str) -> list[int]:
        """Return the indices of the views whose names end with a listed name, with or without its suffix.

        If no view matches, names with another suffix match too, since prepared images are PNG files.
        """
        return [i for match in self._find_matches(name) for i in self._views[self._names[match]]]

    def _find_matches(self, name: str) -> list[int]:
        if name in self._indices:
            return [self._indices[name]]
        parts = PurePosixPath(name.replace("\\", "/"))
        stem = (parts.with_suffix("") if is_image(parts) else parts).parts
        return self._endings.get(parts.parts) or self._full_stems.get(stem) or self._stems.get(stem, [])


def _path_suffixes(paths: Sequence[PurePosixPath]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Yield every suffix of each path as a tuple of parts, with the index of the path."""
    return ((path.parts[first:], i) for i, path in enumerate(paths) for first in range(len(path.parts)))


def _group(pairs: Iterable[tuple[tuple[str, ...], int]]) -> dict[tuple[str, ...], list[int]]:
    """Return a dict from each path suffix to the indices of the paths that end with it."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for parts, i in pairs:
        groups.setdefault(parts, []).append(i)
    return groups


def _require_one_match(name: str, matches: Sequence[int], names: Sequence[str], source: str) -> Sequence[int]:
    """Return `matches` if they are views of one photograph.  Raises DataError for zero or several photographs."""
    if len({photograph_name(names[i]) for i in matches}) == 1:
        return matches
    if matches:
        candidates = " and ".join(quote(names[i]) for i in matches[:2])
        raise MissingViewError(f"{source}: {quote(name)} matches {candidates}; use a longer part of the path")
    raise _unknown_name_error(name, names, source)


def _unknown_name_error(name: str, names: Sequence[str], source: str) -> DataError:
    similar = get_close_matches(name, [*names, *(PurePosixPath(name).name for name in names)], 1)
    hint = f"the first is {quote(names[0])}: correct or remove the name"
    hint = f"did you mean {quote(similar[0])}?" if similar else hint
    return MissingViewError(f"{source}: no photo is named {quote(name)}; {hint}")


# Split a scene into training, validation and test views.

FOLD, FOLD_OFFSET = 8, 4  # every 8th training view by name from the 5th on: a camera path often starts at the first
MIN_TRAIN = 4  # smallest number of training views from which some can be held out for validation


@dataclass(frozen=True)
class Split:
    """The choice of training, validation and test views of a run; the fields are settings of `scene` in a pipeline."""

    holdout: int | ViewSelection = HOLDOUT
    train: ViewSelection | None = None
    validation: int | ViewSelection | Literal["auto"] = 0
    missing: Missing = "refuse"
    folder: Path | None = None  # searched for lists of names that are not in the folder of the dataset

    @property
    def reader_holdout(self) -> int:
        """The `holdout` for a reader, which uses it only if the dataset has no split."""
        return self.holdout if isinstance(self.holdout, int) else 0

    def apply(self, scene: Scene) -> Scene:
        """Return `scene`, which was read with `reader_holdout`, with this split.

        Raises DataError for unknown names, or when one of the splits contains all views.
        """
        folders = [scene.path, *([self.folder] if self.folder else [])]
        holdout = self.holdout
        if isinstance(holdout, ViewSelection) and not (holdout.every and scene.test):  # the split of the dataset wins
            names = [view.name for view in scene.views]
            test = _select(scene, "holdout", holdout, names, folders, {"missing": scene.skipped})
            if len(test) == len(names):
                raise DataError(
                    f"{scene.path}: scene.holdout selects all {len(names)} photos for testing; name fewer photos, "
                    "or raise `every`, to leave some for training"
                )
            if not test:
                remedy = "lower its offset" if holdout.every else "name photos of the dataset"
                raise DataError(
                    f"{scene.path}: scene.holdout selects 0 of {len(names)} photos for testing; "
                    f"{remedy}, or set scene.holdout to 0 for none"
                )
            scene = _with_test(scene, test)
        left_out_names: list[str] = []
        if self.train is not None:
            remaining = _select_training(scene, "train", self.train, folders) | set(scene.test)
            if remaining == set(scene.test):
                raise DataError(
                    f"{scene.path}: scene.train leaves no photo to train on; "
                    "select at least one that is not a test photo"
                )
            LOG.info("scene.train leaves out %s", pluralize(len(scene.views) - len(remaining), "photo"))
            views = [view for i, view in enumerate(scene.views) if i in remaining]
            left_out_names = [view.name for i, view in enumerate(scene.views) if i not in remaining]
            test_names = {scene.views[i].name for i in scene.test}
            subset = replace(scene, views=tuple(views))
            scene = _with_test(subset, {i for i, view in enumerate(views) if view.name in test_names})
        return self.with_validation(scene, left_out_names)

    def check(self, folder: Path, names: Sequence[str]) -> None:
        """Raise DataError if a list has an unknown name, or if a photograph is in two lists.

        names: the photographs in `folder`, which need not have poses yet.
        """
        excluded: dict[ExcludedBy, list[str]] = {}
        for key, choice in (("holdout", self.holdout), ("train", self.train), ("validation", self.validation)):
            if isinstance(choice, ViewSelection):
                try:
                    lines = {*choice.check(names, [folder], excluded)}
                except DataError as error:
                    raise DataError(f"{folder}: scene.{key}: {error}") from error
                if lines and key == "holdout":
                    excluded["holdout"] = [*lines]
                if lines and key == "train":
                    valid_names = lines | self._held_out_names(names)
                    excluded["train"] = [name for name in names if name not in valid_names]

    def _held_out_names(self, names: Sequence[str]) -> set[str]:
        """Return the names that `holdout` would select for testing if all photographs got poses."""
        every, offset = self.reader_holdout, 0
        if isinstance(self.holdout, ViewSelection):
            every, offset = self.holdout.every or 0, self.holdout.offset
        return {sorted(names)[i] for i in every_nth(sorted(names), every, offset)}

    def with_validation(self, scene: Scene, omitted_names: Sequence[str] = ()) -> Scene:
        """Return the scene with some of its training views moved to the validation views.

        omitted_names: names of views that are not in the scene because of `train`.  Raises DataError like `apply`.
        """
        folders = [scene.path, *([self.folder] if self.folder else [])]
        if self.validation == 0:
            return scene
        if self.validation == "auto":
            fold = _validation_fold(scene)
        else:
            fold = _select_training(scene, "validation", self.validation, folders, omitted_names)
        train = tuple(i for i in scene.train if i not in fold)
        if not fold or not train:
            raise DataError(
                f"{scene.path}: scene.validation selects {len(fold)} of {len(scene.train)} training photos; "
                "expected some of them, not all"
            )
        return replace(scene, train=train, validation=tuple(sorted(fold)))


def _with_test(scene: Scene, test: set[int]) -> Scene:
    """Return the scene with the views at the indices `test` as test views.  The extent is that of the other views."""
    train = remaining_views(scene.path, len(scene.views), test)
    points = None if scene.points is None else scene.points.positions
    extent = camera_extent([scene.views[i] for i in train], points)
    return replace(scene, train=train, test=tuple(sorted(test)), extent=extent)


def _select_training(
    scene: Scene, key: str, choice: int | ViewSelection, folders: Sequence[Path], omitted_names: Sequence[str] = ()
) -> set[int]:
    """Return the indices of the selected training views.  key: the name of the setting, for messages."""
    names = [scene.views[i].name for i in scene.train]
    test_names = [scene.views[i].name for i in scene.test]
    excluded: ExcludedNames = {"holdout": test_names, "train": omitted_names, "missing": scene.skipped}
    return {scene.train[i] for i in _select(scene, key, choice, names, folders, excluded)}


def _select(
    scene: Scene,
    key: str,
    choice: int | ViewSelection,
    names: Sequence[str],
    folders: Sequence[Path],
    excluded: ExcludedNames = NO_NAMES,
) -> set[int]:
    """Return the indices of the selected names.

    A number n selects every n-th name in sorted order, starting with the first; 0 selects none.

    key: the name of the setting, for messages.
    """
    try:
        if isinstance(choice, ViewSelection):
            return choice.select(names, folders, excluded)
        return every_nth(names, choice)
    except DataError as error:
        raise type(error)(f"{scene.path}: scene.{key}: {error}") from error


def _validation_fold(scene: Scene) -> set[int]:
    """Return the view indices of every 8th training photograph, sorted by name.  At least two are held out."""
    names = [photograph_name(scene.views[i].name) for i in scene.train]
    order = sorted(set(names))
    count = len(order)
    if count < MIN_TRAIN:
        raise DataError(
            f"{scene.path}: has {pluralize(count, 'training photo')}; expected at least {MIN_TRAIN} to hold "
            "some out for validation: add photos, or set scene.validation to 0"
        )
    fold = order[FOLD_OFFSET::FOLD]
    fold = fold if len(fold) > 1 else [order[count // 4], order[3 * count // 4]]
    return {i for i, name in zip(scene.train, names, strict=True) if name in fold}
