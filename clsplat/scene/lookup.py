"""Find the files of a dataset, even if their names, suffixes or folders have changed."""

import difflib
import logging
import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import takewhile
from pathlib import Path, PurePath, PureWindowsPath
from typing import Literal
from urllib.parse import unquote

from clsplat.core.errors import DataError, first_few, pluralize, quote, shorten
from clsplat.core.files import STATUS
from clsplat.core.reading import open_regular
from clsplat.scene.images import is_image

Missing = Literal["refuse", "skip"]  # what to do about missing photographs
PathParts = tuple[str, ...]  # the parts of a path
MAX_DEPTH = 6  # levels of folders to search below the folder of the scene
MAX_COMPARED = 5000  # file names to search for the most similar one
RESULTS = {STATUS, "record.json", "cfg_args"}  # files that mark folders of runs (ours and 3DGS's) and of `prepare`
CONVERTED = re.compile(r"\.(heic|heif|avif|jxl|jp2|dng|cr2|cr3|nef|arw|raf|orf|rw2|exr|gif|pgm|ppm)")
OTHER_CONTENT = re.compile(  # folders whose images are photographs only if the dataset names them
    r"(?<![a-z])(mask|alpha|depth|normal|segmentation|semantic|label|render|output|thumb|thumbnail|preview)s?(?![a-z])"
)
SPLITS = {"train", "test", "val", "validation", "eval"}  # folder names; a photograph in one matches no name in another
REDUCED = re.compile(r"(?:images?|input|rgb|photos?|frames)_(\d{1,2})")  # a folder of photographs at 1/N of the size
OTHER_PROGRAMS = {  # unsupported programs, and a pattern near the start of their camera files
    "Polycam": rb'"t_00"',
    "Record3D": rb'"initPose"|"poses": *\[\[',
    "Metashape": rb"<document[^>]*>\s*<chunk",
    "RealityScan": rb"^#name,x,y",
}
ELSEWHERE = "…"  # replaces the folders outside of the scene in the paths of missing files
logger = logging.getLogger("clsplat")


def safe_join(folder: Path, name: str, source: str) -> Path:
    """Return `folder / name`.  Raises DataError, prefixed with `source`, when the path is outside of the folder."""
    if not _is_safe(name):
        raise DataError(f"{source}: the file name {quote(name)} is not a path below {folder}; rename it")
    return folder / name


def _is_safe(name: str) -> bool:
    path = PureWindowsPath(name)  # splits at both kinds of slash and at drives
    return bool(path.parts) and not path.anchor and ".." not in path.parts and min(name) >= " "


def require_files(path: Path, files: Iterable[Path]) -> None:
    """Raise DataError when some `files` of the dataset at `path` do not exist; the error names the first three."""
    paths = list(files)
    if missing_files := [str(file) for file in paths if not os.path.exists(file)]:  # unlike Path.exists, never raises
        raise DataError(f"{path}: {_describe_missing(missing_files, len(paths))}; restore them")


def _describe_missing(files: Sequence[str], total: int) -> str:
    names = ", ".join(map(shorten, files[:3])) + (", ..." if len(files) > 3 else "")
    return f"{len(files)} of {total} image files are missing: {names}"


def walk_folders(path: Path, depth: int) -> Iterator[tuple[Path, list[str]]]:
    """Yield `path` and the folders up to `depth` levels below it, with the names of their files, both sorted.

    Hidden folders, symbolic links, and folders of results are skipped.
    """
    for base, folders, files in os.walk(path):
        folder = Path(base)
        if folder != path and RESULTS & set(files):
            folders.clear()
            continue
        is_at_max_depth = len(folder.parts) - len(path.parts) >= depth
        folders[:] = [] if is_at_max_depth else sorted(name for name in folders if name[0] != ".")
        yield folder, sorted(files)


def describe_unsupported_cameras(path: Path) -> str:
    """Return a sentence about an unsupported camera file of another program at or below `path`; "" if there is none."""
    folders = [(path.parent, [path.name])] if path.is_file() else walk_folders(path, 2)
    for folder, names in folders:
        for file in [folder / name for name in names if name.endswith((".json", ".xml", ".csv"))][:8]:
            with suppress(OSError), open_regular(file) as stream:
                start = stream.read(4096)
                for program, pattern in OTHER_PROGRAMS.items():
                    if re.search(pattern, start):
                        return (
                            f"the cameras of {program} in {file} are not supported; export them in COLMAP's format, or "
                            "convert them with nerfstudio's `ns-process-data`"
                        )
    return ""


class FileLookup:
    """The image files of a dataset that another machine or program may have written.

    The file `folder / name` is used if it exists.  Otherwise, a name and a file below `root` match if each is the only
    best match of the other.  Paths match better if more of their last components are equal.  Case, the kind of slash,
    Unicode normalization, URL escapes, and the image suffix do not matter.  Symbolic links that point out of `root`
    are skipped.

    spellings: returns the file names to try first for a name, by default the name itself.  strict: require that
    the entire relative path of the file or of the name matches, as for masks and depth maps.  excluded: files that must
    not match.
    """

    def __init__(
        self,
        root: Path,
        folder: Path,
        names: Sequence[str],
        spellings: Callable[[str], Sequence[str]] = lambda name: (name,),
        strict: bool = False,
        excluded: Iterable[Path] = (),
    ) -> None:
        self.root, self.folder, self.strict = root, folder, strict
        self.raw_names, self.names = list(names), list(names)  # names in the dataset, and names of the views
        self.paths = [folder / ELSEWHERE / re.sub("[\0-\x1f]", "?", PureWindowsPath(name).name) for name in names]
        self.matches: dict[int, int] = {}  # by index, for inexact matches: number of equal components at the end
        self.downscaled_files: set[Path] = set()  # photographs from a folder such as images_4
        self.candidates: dict[int, list[Path]] = {}  # files that match a name equally well, by the index of the name
        unmatched = [i for i in range(len(names)) if not self._use_exact_match(i, spellings)]
        self._match(unmatched, {*excluded} | {*self.paths} - {self.paths[i] for i in unmatched})
        self.skipped = tuple(self.names[i] for i in unmatched if i not in self.matches)
        if self.matches:
            logger.info("%s: %s", root, self.note)

    def _use_exact_match(self, i: int, spellings: Callable[[str], Sequence[str]]) -> bool:
        """Use the file that exactly matches the i-th name; return whether it exists."""
        for name in filter(_is_safe, dict.fromkeys((self.raw_names[i], PureWindowsPath(self.raw_names[i]).as_posix()))):
            for path in (self.folder / spelling for spelling in spellings(name)):
                self.paths[i] = path
                if os.path.exists(path):
                    self.names[i] = name
                    if name != self.raw_names[i]:
                        self.matches[i] = name.count("/") + 1
                    return True
        return False

    def _normalized_parts(self, name: str) -> PathParts:
        """Return the normalized parts of a name's path, relative to `root` if possible, or () for an invalid name."""
        path = PureWindowsPath(name)
        parts = path.parts[1:] if path.anchor else path.parts
        if not parts or parts[-1] == ".." or min(name) < " ":
            return ()
        if ".." in parts:
            parts = parts[len(parts) - parts[::-1].index("..") :]
        elif not path.anchor and self.folder.is_relative_to(self.root):
            parts = self.folder.relative_to(self.root).parts + parts
        return tuple(map(_normalize, parts))

    @cached_property
    def _files(self) -> dict[str, list[tuple[PathParts, Path]]]:
        """The image files below `root` with the normalized parts of their paths, by normalized stem."""
        files, real_root = defaultdict[str, list[tuple[PathParts, Path]]](list), os.path.realpath(self.root)
        for folder, names in walk_folders(self.root, MAX_DEPTH):
            parts = tuple(map(_normalize, folder.relative_to(self.root).parts))
            for path in (folder / name for name in names if name[0] != "." and is_image(PurePath(name))):
                if os.path.isfile(path) and Path(os.path.realpath(path)).is_relative_to(real_root):
                    files[_stem(path.name)].append(((*parts, _normalize(path.name)), path))
        return files

    def _match(self, unmatched: Sequence[int], excluded: set[Path]) -> None:
        targets = list(map(self._normalized_parts, self.raw_names)) if unmatched else []
        targets_by_key = defaultdict[str, set[PathParts]](set)
        for target in targets:
            for key in _keys(target):
                targets_by_key[key].add(target)
        for i in unmatched:
            candidates_by_rank = defaultdict[tuple[int, ...], list[tuple[PathParts, Path]]](list)
            files = [file for key in _keys(targets[i]) for file in self._files.get(key, ()) if file[1] not in excluded]
            siblings = [file for file in files if file[0][-2:-1] == targets[i][-2:-1]]  # better matches, faster to rank
            for parts, path in siblings or files:
                if rank := self._rank(self.raw_names[i], targets[i], parts, path):
                    candidates_by_rank[rank].append((parts, path))
            best = candidates_by_rank[max(candidates_by_rank)] if candidates_by_rank else []
            if len(best) > 1:
                self.candidates[i] = [path for _, path in best]
            for parts, path in best if len(best) == 1 else ():
                length = _common_suffix(targets[i], parts)
                other_targets = targets_by_key[_stem(path.name)] - {targets[i]}
                if all(_common_suffix(other_target, parts) < length for other_target in other_targets):
                    base = self.folder if path.is_relative_to(self.folder) else self.root
                    self.names[i], self.paths[i], self.matches[i] = path.relative_to(base).as_posix(), path, length
                    self.downscaled_files |= {path} if _divisor(parts[:-length]) > 1 else set()

    def _rank(self, dataset_name: str, target: PathParts, parts: PathParts, path: Path) -> tuple[int, ...] | None:
        """Return the rank of a file as a match of a name (larger is better), or None if it does not match."""
        length, name = _common_suffix(target, parts), PureWindowsPath(dataset_name)
        parents = {*parts[:-length]}
        is_unrelated = any(map(OTHER_CONTENT.search, parents)) or (SPLITS & parents and SPLITS.intersection(target))
        if length < min(len(parts), len(target), len(name.parts)) if self.strict else is_unrelated:
            return None
        is_equal = parts[-1] == target[-1], path.name == name.name, path.stem == name.stem
        return length, -_divisor(parts[:-length]), *is_equal

    @property
    def note(self) -> str:
        """One sentence with the number of inexact matches and how they match; "" if all matches are exact."""
        for i, length in self.matches.items():
            count = f"{len(self.matches)} of {pluralize(len(self.raw_names), 'image' if self.strict else 'photo')}"
            criterion = "base name" if length == 1 else "the end of their paths"
            scaling = ", with cameras scaled to these smaller photos" if self.downscaled_files else ""
            file = self.paths[i].relative_to(self.root).as_posix()
            return f"{count} matched by {criterion}, such as {file} for {quote(self.raw_names[i])}{scaling}"
        return ""

    def existing_indices(self, source: Path, missing: Missing) -> list[int]:
        """Return the indices of the files that exist, and log a warning about the others.

        source: the dataset, for messages.  Raises DataError when all files are missing, or when some are and `missing`
        is "refuse".
        """
        indices = [i for i, path in enumerate(self.paths) if os.path.exists(path)]
        if missing_indices := sorted({*range(len(self.paths))}.difference(indices), key=self.names.__getitem__):
            fault = f"{source}: {_describe_missing([str(self.paths[i]) for i in missing_indices], len(self.paths))}"
            for name in [self.raw_names[i] for i in missing_indices if not _is_safe(self.raw_names[i])][:1]:
                fault += f"; {quote(name)} is not a path below {self.folder}"
            if missing == "refuse" or not indices:
                advice = ", or --set scene.missing=skip to train without them" if indices and not self.strict else ""
                raise DataError(f"{fault}{self.hint}; restore them{advice}")
            logger.warning("%s%s; the scene is read without them", fault, self.hint)
        return indices

    @cached_property
    def hint(self) -> str:
        """A remark in parentheses that names similar files or the searched folders; "" if no file is missing."""
        if not self.skipped:
            return ""
        relative = {path: path.relative_to(self.root) for files in self._files.values() for _, path in files}
        for i, paths in self.candidates.items():
            matching_files = [relative[path].as_posix() for path in paths]
            return f" ({first_few(matching_files)} match {quote(self.raw_names[i])} equally well)"
        if not relative:
            return f" ({self.root} contains no images)"
        used_paths = {*self.paths}
        unused_names = {_stem(path.name): name for path, name in relative.items() if path not in used_paths}
        similar_stems = difflib.get_close_matches(_stem(self.skipped[0]), [*unused_names][:MAX_COMPARED], 1)
        nearest = f"the nearest file is {unused_names[similar_stems[0]].as_posix()}, " if similar_stems else ""
        folders = Counter(path.parent.as_posix() for path in relative.values())
        return f" ({nearest}searched: {first_few([folder for folder, _ in folders.most_common()])})"


def _normalize(text: str) -> str:
    return unicodedata.normalize("NFC", unquote(text)).strip().casefold()


def _stem(name: str) -> str:
    """Return the normalized name of an image without its suffix."""
    path = PureWindowsPath(_normalize(name))
    return path.stem if is_image(path) or CONVERTED.fullmatch(path.suffix) else path.name


def _keys(parts: PathParts) -> set[str]:
    """Return the keys of a file name for lookups: the name, and the name without one or two suffixes.

    For example, `a.jpg.png` has the keys `a.jpg.png`, `a.jpg`, and `a`.
    """
    return {parts[-1], _stem(parts[-1]), _stem(_stem(parts[-1]))} if parts else set()


def _common_suffix(a: PathParts, b: PathParts) -> int:
    """Return the number of equal parts at the end of two paths whose file names match."""
    return 1 + len([*takewhile(lambda pair: pair[0] == pair[1], zip(a[-2::-1], b[-2::-1], strict=False))])


def _divisor(folders: Sequence[str]) -> int:
    """Return N if one of the folders is named like images_N, otherwise 1."""
    return max([int(match[1]) for folder in folders if (match := REDUCED.fullmatch(folder))], default=1) or 1
