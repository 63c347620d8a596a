"""Find the files that a dataset names, also where their names, suffixes or folders have changed since."""

import difflib
import logging
import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path, PurePath, PureWindowsPath
from typing import Literal
from urllib.parse import unquote

from clsplat.core.errors import DataError, first_few, pluralize, quote, shorten
from clsplat.core.files import STATUS
from clsplat.scene.images import is_image

Missing = Literal["refuse", "skip"]  # what to do about missing photographs
Parts = tuple[str, ...]  # of a path
MAX_DEPTH = 6  # folders below that of the scene
MAX_FILES = 300_000
MAX_COMPARED = 5000  # file names, to find the nearest one
RESULTS = {STATUS, "record.json"}  # files that mark the folders of runs and of prepared photographs
CONVERTED = re.compile(r"\.(heic|heif|avif|jxl|jp2|dng|cr2|cr3|nef|arw|raf|orf|rw2|exr|gif|pgm|ppm)", re.IGNORECASE)
OTHER_CONTENT = re.compile(  # folders whose images are photographs only where a name contains the folder
    r"mask|depth|normal|segment|semantic|label|render|output|thumb|preview|^(train|test|val|validation|eval)$"
)
REDUCED = re.compile(r"(?:images?|input|rgb|photos?|frames)_(\d{1,2})")  # a folder of photographs at 1/N of the size
NOWHERE, ELSEWHERE = Path(), "…"  # the second stands for folders outside of the scene
logger = logging.getLogger("clsplat")


def safe_join(folder: Path, name: str, where: str) -> Path:
    """Return `folder / name`.  Raises DataError, starting with `where`, when that is outside the folder."""
    if not _is_safe(name):
        raise DataError(f"{where}: the file name {quote(name)} is not a path below {folder}; rename it")
    return folder / name


def _is_safe(name: str) -> bool:
    path = PureWindowsPath(name)  # splits at both kinds of slash and at drives
    return bool(path.parts) and not path.anchor and ".." not in path.parts and _is_printable(name)


def _is_printable(name: str) -> bool:
    return not any(letter < " " for letter in name)


def require_files(path: Path, files: Iterable[Path]) -> None:
    """Raise DataError that names the first few `files` of the dataset at `path` that do not exist, if any."""
    paths = list(files)
    if lost := [str(file) for file in paths if not os.path.exists(file)]:  # unlike Path.exists, never raises
        raise DataError(f"{_missing_text(path, lost, len(paths))}; put them back")


def _missing_text(path: Path, lost: Sequence[str], count: int) -> str:
    names = ", ".join(map(shorten, lost[:3])) + (", ..." if len(lost) > 3 else "")
    return f"{path}: {len(lost)} of {count} image files are missing: {names}"


def walk_folders(path: Path, depth: int) -> Iterator[tuple[Path, list[str]]]:
    """Yield `path` and the folders up to `depth` levels below it, with the names of their files, both sorted.

    Hidden folders, links, and folders of results are skipped.
    """
    for base, folders, files in os.walk(path):
        folder = Path(base)
        if folder != path and RESULTS & set(files):
            folders.clear()
            continue
        is_deep = len(folder.parts) - len(path.parts) >= depth
        folders[:] = [] if is_deep else sorted(name for name in folders if name[0] != ".")
        yield folder, sorted(files)


class FileLookup:
    """The image files that a dataset names, which another machine or program may have written.

    An image `name` below `folder` is taken as it is.  Otherwise a name and a file below `root` belong together if each
    is the only best match of the other: the one with the longest common end of their paths.  Upper and lower case,
    slashes, Unicode forms, URL escapes and the suffix of the image do not matter.  Links out of `root` are ignored.

    spellings: the file names to look for first, instead of the name itself.  strict: for masks and depth maps, whose
    whole path must match, below their folder or below that of the name.  taken: files that are something else.
    """

    def __init__(
        self,
        root: Path,
        folder: Path,
        names: Sequence[str],
        spellings: Callable[[str], Sequence[str]] = lambda name: (name,),
        strict: bool = False,
        taken: Collection[Path] = (),
    ) -> None:
        self.root, self.folder, self.strict = root, folder, strict
        self.given = list(names)
        self.names = list(names)  # those of the views
        self.paths = [NOWHERE] * len(names)  # where a missing file is expected
        self.matched: dict[int, int] = {}  # the length of the common end of each inexact match
        self.reduced: set[Path] = set()  # photographs from a folder such as images_4
        self.choices: dict[int, list[Parts]] = {}  # several files that fit a name equally well
        self._taken = {*taken}
        lost = [i for i in range(len(names)) if not self._take_exact(i, spellings)]
        if any(map(self._target, lost)):
            self._match(lost)
        if self.matched:
            logger.info("%s: %s", root, self.note)

    def _take_exact(self, i: int, spellings: Callable[[str], Sequence[str]]) -> bool:
        """Take the file that a name spells, and return whether it exists."""
        given = self.given[i]
        for name in dict.fromkeys((given, PureWindowsPath(given).as_posix())):
            paths = [self.folder / spelling for spelling in spellings(name)] if _is_safe(name) else []
            if found := next((path for path in paths if os.path.exists(path)), None):
                self.names[i], self.paths[i] = name, found
                if name != given:
                    self.matched[i] = len(PureWindowsPath(name).parts)
                return True
            self.paths[i] = paths[-1] if paths else self.folder / ELSEWHERE / PureWindowsPath(given).name
        return False

    def _target(self, i: int) -> Parts:
        """Return the parts of a name's path, as far as they may be below `root`; none for an impossible name."""
        path = PureWindowsPath(self.given[i])
        parts = path.parts[1:] if path.anchor else path.parts
        if not parts or parts[-1] == ".." or not _is_printable(self.given[i]):
            return ()
        if ".." in parts:
            return parts[len(parts) - parts[::-1].index("..") :]
        inner = self.folder.relative_to(self.root).parts if self.folder.is_relative_to(self.root) else ()
        return parts if path.anchor else inner + parts

    @cached_property
    def _files(self) -> dict[str, list[Parts]]:
        """The image files below `root` by comparable stem, as parts of their relative paths."""
        files, count = defaultdict[str, list[Parts]](list), 0
        real = os.path.realpath(self.root)
        for folder, names in walk_folders(self.root, MAX_DEPTH):
            parts = folder.relative_to(self.root).parts
            for name in filter(lambda name: name[0] != "." and is_image(PurePath(name)), names):
                path = folder / name
                if os.path.isfile(path) and Path(os.path.realpath(path)).is_relative_to(real):
                    files[_stem(name)].append((*parts, name))
            count += len(names)
            if count > MAX_FILES:
                logger.warning("%s: has more than %d files; photographs are looked for in these", self.root, MAX_FILES)
                break
        return files

    def _match(self, lost: Sequence[int]) -> None:
        targets = {i: target for i in range(len(self.given)) if (target := self._target(i))}
        by_key = defaultdict[str, list[Parts]](list)
        for target in dict.fromkeys(targets.values()):
            for key in _keys(target[-1]):
                by_key[key].append(target)
        exact = self._taken.union({*self.paths} - {self.paths[i] for i in lost})  # lost ones do not exist
        for i in lost:
            target = targets.get(i, ())
            ranked = defaultdict[tuple[int, ...], list[Parts]](list)
            for key in _keys(target[-1]) if target else ():
                for parts in self._files.get(key, ()):
                    if self.root.joinpath(*parts) not in exact and (rank := self._rank(i, target, parts)):
                        ranked[rank].append(parts)
            best = ranked[max(ranked)] if ranked else []
            if len(best) > 1:
                self.choices[i] = best
            elif best:
                length, others = _common_end(target, best[0]), by_key[_stem(best[0][-1])]
                if all(_common_end(other, best[0]) < length for other in others if _folded(other) != _folded(target)):
                    self._take(i, best[0], length)

    def _rank(self, i: int, target: Parts, parts: Parts) -> tuple[int, ...] | None:
        """Return how well a file fits a name, or None if it does not."""
        length = _common_end(target, parts)
        above = [part.casefold() for part in parts[:-length]]
        if self.strict:
            given = PureWindowsPath(self.given[i]).parts
            if length < min(len(parts), len(target), len(given)):
                return None
        elif any(map(OTHER_CONTENT.search, above)):
            return None
        same_name = parts[-1] == target[-1], PurePath(parts[-1]).stem == PurePath(target[-1]).stem
        return (length, -_divisor(above), *map(int, same_name))

    def _take(self, i: int, parts: Parts, length: int) -> None:
        path = self.root.joinpath(*parts)
        base = self.folder if path.is_relative_to(self.folder) else self.root
        self.names[i], self.paths[i] = path.relative_to(base).as_posix(), path
        self.matched[i] = length
        if _divisor([part.casefold() for part in parts[:-length]]) > 1:
            self.reduced.add(path)

    @property
    def note(self) -> str:
        """What was matched, and how, in one sentence; "" if all names are exact."""
        if not self.matched:
            return ""
        i, length = next(iter(self.matched.items()))
        how = "base name" if length == 1 else "the end of their paths"
        reduced = ", with cameras scaled to these smaller photographs" if self.reduced else ""
        file = self.paths[i].relative_to(self.root).as_posix()
        kind = "image" if self.strict else "photograph"
        verb = "was" if len(self.matched) == 1 else "were"
        return (
            f"{pluralize(len(self.matched), kind)} of {len(self.given)} {verb} matched by {how}, such as {file} for "
            f"{quote(self.given[i])}{reduced}"
        )

    def existing(self, where: Path, missing: Missing, sources: Sequence[str] = ()) -> list[bool]:
        """Return which of the files exist.

        Raises DataError, naming the first few, when some are missing and `missing` is not skip, or when all are.
        where: the dataset, for messages; sources: the part of it that has each name.
        """
        exists = [os.path.exists(path) for path in self.paths]
        lost = sorted((i for i, is_there in enumerate(exists) if not is_there), key=self.names.__getitem__)
        if not lost:
            return exists
        is_refused = missing == "refuse" or len(lost) == len(exists)
        hint = self.hint
        if is_refused and (outside := next((i for i in lost if not _is_safe(self.given[i])), None)) is not None:
            place = sources[outside] if sources else where
            more = f"; {len(lost)} of {len(exists)} image files are missing" if len(lost) > 1 else ""
            raise DataError(
                f"{place}: the file name {quote(self.given[outside])} is not a path below {self.folder}{hint}{more}; "
                "rename it, or copy the file into that folder"
            )
        fault = f"{_missing_text(where, [str(self.paths[i]) for i in lost], len(exists))}{hint}"
        if is_refused:
            skip = ", or --set scene.missing=skip to train without them" if len(lost) < len(exists) else ""
            raise DataError(f"{fault}; put them back{'' if self.strict else skip}")
        logger.warning("%s; the scene is read without them", fault)
        return exists

    @cached_property
    def hint(self) -> str:
        """What is there instead of the first missing file, in brackets with a space before them; "" if all exist."""
        lost = [i for i, path in enumerate(self.paths) if not os.path.exists(path)]
        if not lost:
            return ""
        if (several := next((i for i in lost if i in self.choices), None)) is not None:
            choices = ["/".join(parts) for parts in self.choices[several]]
            return f" ({first_few(choices)} fit {quote(self.given[several])} equally well)"
        folders = Counter("/".join(parts[:-1]) or "." for files in self._files.values() for parts in files)
        if not folders:
            return " (no images in that folder)"
        used, name = {*self.paths}, PureWindowsPath(self.given[lost[0]]).name
        free = {stem: parts[0] for stem, parts in self._files.items() if self.root.joinpath(*parts[0]) not in used}
        near = difflib.get_close_matches(_stem(name), [*free][:MAX_COMPARED], 1)
        nearest = f"the nearest file is {'/'.join(free[near[0]])}, " if near else ""
        return f" ({nearest}searched: {first_few([folder for folder, _ in folders.most_common()])})"


def _comparable(text: str) -> str:
    return unicodedata.normalize("NFC", unquote(text)).strip().casefold()


def _stem(name: str) -> str:
    """Return the comparable name of an image without its suffix."""
    path = PurePath(name.strip())
    return _comparable(path.stem if is_image(path) or CONVERTED.fullmatch(path.suffix) else name)


def _keys(name: str) -> tuple[str, ...]:
    """Return the stems that files of a name may have: `a` for a.jpg, and `a.jpg` for a.jpg.png."""
    return tuple(dict.fromkeys((_stem(name), _comparable(name))))


def _folded(parts: Parts) -> Parts:
    return tuple(map(_comparable, parts))


def _common_end(target: Parts, parts: Parts) -> int:
    """Return how many parts two paths with matching file names have in common at their ends."""
    length = 1
    for a, b in zip(reversed(_folded(target[:-1])), reversed(_folded(parts[:-1])), strict=False):
        if a != b:
            break
        length += 1
    return length


def _divisor(folders: Sequence[str]) -> int:
    """Return N for a path through a folder such as images_N, otherwise 1."""
    return max([int(match[1]) for folder in folders if (match := REDUCED.fullmatch(folder))], default=1) or 1
