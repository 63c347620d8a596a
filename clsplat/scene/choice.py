"""A choice of a scene's views by their names: every n-th, a list, or the lines of a file."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from clsplat.errors import DataError, amount, quoted
from clsplat.reading import read_text
from clsplat.scene.images import is_image
from clsplat.scene.scene import every_nth
from clsplat.settings import ReadPath, Settings, in_one_sentence

LOG = logging.getLogger("clsplat")
LARGEST = 1 << 24  # bytes of a list of names
TakenBy = Literal["holdout", "train", "missing"]
Taken = Mapping[TakenBy, Sequence[str]]  # names that are no training views, by the key that says so, or their files
NONE: Taken = {}
NOTATIONS = "expected a number, {every, offset}, {names: […]} or {file: …}"


def _text(value: Any) -> Any:
    if not isinstance(value, str):
        raise ValueError("expected names of photographs as text: put numbers in quotes, as in '0042'")
    if not value.strip():
        raise ValueError("expected names of photographs that are not empty")
    return value


class OfPlaced(DataError):
    """A fault of a choice that follows from which photographs are there: fewer of them may not have it."""


class Choice(Settings):
    """Views by name: every n-th from one on, or those of a list, or of a file with a name a line.

    A listed name is that of the view, or its end: `0042`, `0042.jpg` and `images/0042.jpg` name the same photograph.
    It has this name, too, where it was prepared as `0042.png`.
    """

    every: Annotated[int, Field(gt=0)] | None = None
    """Every n-th view, in order of name."""
    offset: Annotated[int, Field(ge=0)] = 0
    """Place of the first of them, counted from 0."""
    names: Annotated[list[Annotated[str, BeforeValidator(_text)]], Field(min_length=1)] | None = None
    """Names of the views."""
    file: ReadPath | None = None
    """Text file with a name a line; a relative path is one in the folder of the dataset."""

    @model_validator(mode="before")
    @classmethod
    def _as_meant(cls, value: Any) -> Any:
        """Say what is wrong with tables that are nearly right."""
        if not isinstance(value, dict):
            return value
        if any(isinstance(key, str) and ":" in key and given is None for key, given in value.items()):
            raise ValueError(f"{NOTATIONS} (YAML needs a blank after each colon)")
        offset = value.get("offset")
        if isinstance(offset, int) and offset < 0:
            raise ValueError(f"expected an offset of 0 or more, not {quoted(offset)}")
        if "offset" in value and len(value) == 1:
            raise ValueError("expected every beside offset, as in {every: 8, offset: 4}")
        return value

    @model_validator(mode="after")
    def _of_one_kind(self) -> "Choice":
        given = [self.every, self.names, self.file]
        if sum(value is not None for value in given) != 1 or (self.offset and self.every is None):
            raise ValueError(NOTATIONS)
        if self.every is not None and self.offset >= self.every:
            raise ValueError(f"expected an offset below every, {self.every}")
        return self

    def place_of(self, key: str, scene: str | None) -> Path | None:
        place = super().place_of(key, scene)
        return place and Path(scene or "") / place

    def of(self, names: Sequence[str], folders: Sequence[Path], others: Taken = NONE) -> set[int]:
        """Return the indices of the chosen ones of `names`.

        folders: where a relative file is looked for, in order; others: names that may not be chosen, and those whose
        photographs are missing, which are skipped.  Raises DataError for a name that no view has, or several have.
        """
        if self.every is not None:
            return every_nth(names, self.every, self.offset)
        place, listed = self._listed(folders)
        own, of_others = _Ends(names), {key: _Ends(taken) for key, taken in others.items()}
        found_at = {name: own.indices_of(name) for name in listed}
        for name in [name for name, found in found_at.items() if not found]:
            for key in (key for key, taken in of_others.items() if taken.indices_of(name)):
                if key != "missing":
                    raise _taken(place, name, key)
                del found_at[name]
        if lost := len({*listed}) - len(found_at):
            LOG.info("%s: skipped %s whose photograph is missing", place, amount(lost, "name"))
        chosen = {name: _only(name, found, names, place) for name, found in found_at.items()}
        for name, i in chosen.items():
            _tell_of_another(name, names[i], place)
        return set(chosen.values())

    def check(self, names: Sequence[str], folders: Sequence[Path], others: Taken = NONE) -> list[str]:
        """Return those of `names` that are listed, some of which may be left out later; none of every n-th.

        others: names that may not be chosen.  Raises DataError for a name that means none, or only such.
        """
        if self.every is not None:
            return []
        place, listed = self._listed(folders)
        own, of_others = _Ends(names), {key: {*taken} for key, taken in others.items()}
        found = {name: own.indices_of(name) for name in listed}
        for name, indices in found.items():
            if not indices:
                raise _unknown(name, names, place)
            for key in (key for key, taken in of_others.items() if {names[i] for i in indices} <= taken):
                raise _taken(place, name, key)
        return [names[i] for indices in found.values() for i in indices]

    def _listed(self, folders: Sequence[Path]) -> tuple[str, list[str]]:
        """Where the names are listed, and these.  Raises DataError where the file cannot be read, or has none."""
        if self.file is None:
            return "the list of names", self.names or []
        files = [folder / self.file for folder in folders]
        found = next((file for file in files if file.is_file()), files[-1])
        lines = (line.strip() for line in read_text(found, limit=LARGEST).splitlines())
        if listed := [line for line in lines if line and not line.startswith("#")]:
            return str(found), listed
        raise DataError(f"{found}: is empty; expected the name of a photograph in each line")


Number = Annotated[int, Field(ge=0)]
Chosen = Annotated[Number | Choice, in_one_sentence(NOTATIONS)]
ChosenOrAuto = Annotated[Number | Choice | Literal["auto"], in_one_sentence(f"{NOTATIONS}, or auto")]


def _taken(place: str, name: str, key: TakenBy) -> DataError:
    """The error of a name that cannot be chosen, since a key of the scene's settings leaves it to another use."""
    why, remedy = {
        "holdout": ("is held out for testing", "out of scene.holdout"),
        "train": ("is left out by scene.train", "put it into scene.train"),
    }[key]
    told = f"{quoted(name)} {why}; expected training photographs: take it out of this list, or {remedy}"
    return OfPlaced(f"{place}: {told}")


def choose(choice: int | Choice, names: Sequence[str], folders: Sequence[Path], others: Taken = NONE) -> set[int]:
    """Return the indices of the chosen names; a number chooses every n-th from the first on, 0 none.

    Raises DataError as Choice.of does.
    """
    return choice.of(names, folders, others) if isinstance(choice, Choice) else every_nth(names, choice)


class _Ends:
    """Names of views by their ends: `a/b.png`, `b.png` and `b` mean the same one."""

    def __init__(self, names: Sequence[str]):
        paths = [PurePosixPath(name) for name in names]
        stems = [path.with_suffix("") for path in paths]
        self._at = {name: i for i, name in reversed([*enumerate(names)])}
        self._ends, self._stems = _grouped(_ends_of(paths)), _grouped(_ends_of(stems))
        self._whole = _grouped((stem.parts, i) for i, stem in enumerate(stems))

    def indices_of(self, listed: str) -> list[int]:
        """Return the indices of names that a listed one means, whole or as an end, with or without its suffix.

        Where that means none, the suffix of an image may be another: what is prepared is PNG.
        """
        if listed in self._at:
            return [self._at[listed]]
        wanted = PurePosixPath(listed.replace("\\", "/"))
        stem = (wanted.with_suffix("") if is_image(wanted) else wanted).parts
        return self._ends.get(wanted.parts) or self._whole.get(stem) or self._stems.get(stem, [])


def _ends_of(paths: Sequence[PurePosixPath]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Each end of each path, the whole one too, with its index."""
    return ((path.parts[first:], i) for i, path in enumerate(paths) for first in range(len(path.parts)))


def _grouped(indexed: Iterable[tuple[tuple[str, ...], int]]) -> dict[tuple[str, ...], list[int]]:
    """The indices of each of these."""
    found: dict[tuple[str, ...], list[int]] = {}
    for parts, i in indexed:
        found.setdefault(parts, []).append(i)
    return found


def _tell_of_another(listed: str, found: str, place: str) -> None:
    """Log that a name in another folder, of another kind of image, is meant."""
    wanted, path = PurePosixPath(listed), PurePosixPath(found)
    if is_image(wanted) and wanted.suffix != path.suffix and wanted.with_suffix("") != path.with_suffix(""):
        LOG.info("%s: %s means %s", place, quoted(listed), quoted(found))


def _only(listed: str, found: Sequence[int], names: Sequence[str], place: str) -> int:
    """The index that was found.  Raises DataError for none, and for several."""
    if len(found) == 1:
        return found[0]
    if found:
        both = " and ".join(quoted(names[i]) for i in found[:2])
        raise OfPlaced(f"{place}: {quoted(listed)} means {both}; give more of the path")
    raise _unknown(listed, names, place)


def _unknown(listed: str, names: Sequence[str], place: str) -> DataError:
    near = get_close_matches(listed, [*names, *(PurePosixPath(name).name for name in names)], 1)
    more = (
        f"did you mean {quoted(near[0])}?" if near else f"the first is {quoted(names[0])}: correct or remove the name"
    )
    return OfPlaced(f"{place}: no photograph is called {quoted(listed)}; {more}")
