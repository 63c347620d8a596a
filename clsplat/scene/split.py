"""Which views of a scene are for training, for validation and for testing, and which are left out."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from clsplat.errors import DataError, amount
from clsplat.scene.choice import NONE, Choice, Taken, TakenBy, choose
from clsplat.scene.images import Missing
from clsplat.scene.scene import HOLDOUT, Scene, every_nth, make_scene

LOG = logging.getLogger("clsplat")
FOLD, FOLD_OFFSET = 8, 4  # of the training views, in order of name: not the first, the end of many a path
LEAST = 4  # training views that can be divided


@dataclass(frozen=True)
class Split:
    """What of a dataset a run trains on, chooses by and is tested on; fields as in the table `scene` of a pipeline."""

    holdout: int | Choice = HOLDOUT
    train: Choice | None = None
    validation: int | Choice | Literal["auto"] = 0
    missing: Missing = "refuse"
    folder: Path | None = None  # where lists of names are that the dataset's own folder does not have

    @property
    def of_reader(self) -> int:
        """The holdout that a reader is asked for, where the dataset has no split."""
        return self.holdout if isinstance(self.holdout, int) else 0

    def applied(self, scene: Scene) -> Scene:
        """Return the scene, read with `of_reader`, with this split.

        Raises DataError where names are wrong, or a split takes every view.
        """
        folders = [scene.path, *([self.folder] if self.folder else [])]
        if isinstance(self.holdout, Choice) and not (self.holdout.every and scene.test):  # the dataset says which
            names = [view.name for view in scene.views]
            test = _chosen(scene, "holdout", self.holdout, names, folders, {"missing": scene.skipped})
            if len(test) == len(names):
                raise DataError(
                    f"{scene.path}: scene.holdout takes all {len(names)} photographs for testing; expected some to "
                    "train with: name fewer of them, or raise `every`"
                )
            if not test:
                remedy = "lower its offset" if self.holdout.every else "name others, whose photographs are there"
                raise DataError(
                    f"{scene.path}: scene.holdout takes 0 of {len(names)} photographs for testing; expected some: "
                    f"{remedy}, or set scene.holdout to 0 for none"
                )
            scene = _with_test(scene, test)
        left_out: list[str] = []
        if self.train is not None:
            kept = _of(scene, "train", self.train, folders) | set(scene.test)
            if kept == set(scene.test):
                raise DataError(f"{scene.path}: scene.train leaves no photograph to train with; expected some of them")
            LOG.info("scene.train leaves out %s", amount(len(scene.views) - len(kept), "photograph"))
            views = [view for i, view in enumerate(scene.views) if i in kept]
            left_out = [view.name for i, view in enumerate(scene.views) if i not in kept]
            tested = {scene.views[i].name for i in scene.test}
            smaller = replace(scene, views=tuple(views))
            scene = _with_test(smaller, {i for i, view in enumerate(views) if view.name in tested})
        return self.with_validation(scene, left_out)

    def check(self, folder: Path, names: Sequence[str]) -> None:
        """Raise DataError for lists with names of none of the photographs in a folder, however many are placed, or with
        one photograph for testing and not, or for validation and not for training."""
        others: dict[TakenBy, list[str]] = {}
        for key, choice in (("holdout", self.holdout), ("train", self.train), ("validation", self.validation)):
            if isinstance(choice, Choice):
                try:
                    listed = {*choice.check(names, [folder], others)}
                except DataError as error:
                    raise DataError(f"{folder}: scene.{key}: {error}") from error
                if listed and key == "holdout":
                    others["holdout"] = [*listed]
                if listed and key == "train":
                    free = listed | self._counted_out(names)
                    others["train"] = [name for name in names if name not in free]

    def _counted_out(self, names: Sequence[str]) -> set[str]:
        """Names that a number holds out for testing, where all are placed."""
        every, offset = self.of_reader, 0
        if isinstance(self.holdout, Choice):
            every, offset = self.holdout.every or 0, self.holdout.offset
        return {sorted(names)[i] for i in every_nth(sorted(names), every, offset)}

    def with_validation(self, scene: Scene, left_out: Sequence[str] = ()) -> Scene:
        """Return a scene that has all training views, some of them for validation.

        left_out: names of views that were left out of it.  Raises DataError as `applied`.
        """
        folders = [scene.path, *([self.folder] if self.folder else [])]
        if self.validation == 0:
            return scene
        chosen = self.validation
        fold = _auto(scene) if chosen == "auto" else _of(scene, "validation", chosen, folders, left_out)
        train = tuple(i for i in scene.train if i not in fold)
        if not fold or not train:
            raise DataError(
                f"{scene.path}: scene.validation takes {len(fold)} of {len(scene.train)} training photographs; "
                "expected some of them, not all"
            )
        return replace(scene, train=train, validation=tuple(sorted(fold)))


def _with_test(scene: Scene, test: set[int]) -> Scene:
    """The views of a scene, with its extent, where these are for testing."""
    made = make_scene(scene.path, list(scene.views), test, scene.points, scene.background)
    return replace(scene, train=made.train, test=made.test, extent=made.extent)


def _of(
    scene: Scene, key: str, choice: int | Choice, folders: Sequence[Path], left_out: Sequence[str] = ()
) -> set[int]:
    """The indices of the chosen ones of the training views; key: the setting that chooses."""
    names = [scene.views[i].name for i in scene.train]
    tested = [scene.views[i].name for i in scene.test]
    others: Taken = {"holdout": tested, "train": left_out, "missing": scene.skipped}
    return {scene.train[i] for i in _chosen(scene, key, choice, names, folders, others)}


def _chosen(
    scene: Scene,
    key: str,
    choice: int | Choice,
    names: Sequence[str],
    folders: Sequence[Path],
    others: Taken = NONE,
) -> set[int]:
    """The indices of the chosen names.  Raises DataError, with the place of the choice."""
    try:
        return choose(choice, names, folders, others)
    except DataError as error:
        raise type(error)(f"{scene.path}: scene.{key}: {error}") from error


def _auto(scene: Scene) -> set[int]:
    """Every 8th of the training views, and at least two of them."""
    count = len(scene.train)
    if count < LEAST:
        raise DataError(
            f"{scene.path}: has {amount(count, 'training photograph')}; expected {LEAST} or more to keep some for "
            "validation: take more, or set scene.validation to 0"
        )
    order = sorted(scene.train, key=lambda i: scene.views[i].name)
    fold = order[FOLD_OFFSET::FOLD]
    return set(fold if len(fold) > 1 else [order[count // 4], order[3 * count // 4]])
