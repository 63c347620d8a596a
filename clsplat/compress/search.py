"""Look for the file that meets a target: a ladder of pruning shares by settings of the harmonics, all measured."""

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from clsplat.compress.page import page
from clsplat.compress.rungs import Ladder, checked_keeps
from clsplat.compress.target import Point, Target
from clsplat.errors import ConfigError, quoted
from clsplat.files import write_text
from clsplat.formats.model_files import bytes_of, located
from clsplat.formats.output import written
from clsplat.formats.splats import Quality, Reading, Writing, require_still, with_degree
from clsplat.formats.table import tell_losses
from clsplat.gaussians.model import load
from clsplat.gaussians.sky import keep_sky, sky_beside
from clsplat.reading import read_file, sha256
from clsplat.runs.model_file import ModelFile
from clsplat.tuning.folder import claimed
from clsplat.tuning.measuring import Measurer
from clsplat.tuning.tuning import Tuning, require_steps

LOG = logging.getLogger("clsplat")
Format = Literal["sog", "spz"]
KEEPS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)  # shares of the Gaussians
SETTINGS: dict[Format, tuple[tuple[int, Quality], ...]] = {  # of the harmonics: degree, quality
    "sog": ((3, "high"), (3, "balanced"), (3, "small")),  # a palette of a lower degree is hardly smaller
    "spz": ((3, "balanced"), (3, "small"), (2, "small"), (1, "small"), (0, "small")),
}
RECORD, PAGE, TRIALS = "compress.json", "compress.html", "trials"


@dataclass
class Search:
    """A search in its folder: what was measured so far."""

    out: Path
    target: Target
    question: dict[str, Any]  # what is compressed, and how
    source: Point  # the model itself
    split: str  # views that are measured
    scene: str  # its name on pages
    points: list[Point] = field(default_factory=list)

    @property
    def chosen(self) -> Point | None:
        return self.target.best(self.points, self.source.psnr)

    def data(self) -> dict[str, Any]:
        """Return all as plain data."""
        chosen = self.chosen
        return {
            **self.question,
            "target": self.target.text,
            "split": self.split,
            "source": asdict(self.source),
            "points": [asdict(point) for point in self.points],
            "chosen": chosen and asdict(chosen),
        }

    def write(self, result: str = "") -> None:
        """Write what was measured, as JSON and as a page, which leads to the file of the result."""
        write_text(self.out / RECORD, json.dumps(self.data(), indent=1) + "\n")
        measured = self.target, self.source, self.points, self.chosen, self.split
        write_text(self.out / PAGE, page(*measured, self.scene, self.question["model"], result))


def compress(
    model: Path,
    scene: Path | None,
    target: str,
    out: Path,
    *,
    form: Format = "sog",
    keeps: Sequence[float] = KEEPS,
    steps: int | None = None,
    device: Any = None,
) -> dict[str, Any]:
    """Look for a file that meets a target; write it, a page and a record; return the record.

    From one share of the Gaussians to the next the model is pruned and trained for some steps.  Each rung is written
    with several settings of its harmonics, and every file is read back and measured.  The search goes down until files
    of fewer Gaussians cannot be better.  A search that was interrupted goes on.
    Raises ConfigError for a target that no file meets, after the page is written; OutputError where another process
    searches in `out`.
    """
    wanted, shares = Target.of(target), checked_keeps(keeps)
    if steps is not None:
        require_steps(steps)
    if form not in get_args(Format):
        raise ConfigError(f"--format {quoted(form)}: expected one of {', '.join(get_args(Format))}")
    opened = ModelFile(model, scene, device)
    source, first, measurer = opened.source, opened.gaussians, Measurer(opened)
    require_still(source.file, first.as_file(), form)
    question: dict[str, Any] = {"model": str(source.file), "sha256": sha256(located(source.file))}
    question |= {"scene": str(source.folder), "photographs": measurer.identity(), "keeps": shares, "steps": steps}
    size = bytes_of(source.file)  # which a damaged model has not: before the folder is made
    with claimed(out, question, RECORD, "a search", "another --out"):
        tell_losses(_result(out, form), first.as_file())
        whole = Point(source.file.name, 1, first.sh_degree, "", len(first), size, *measurer.figures(first))
        search = Search(out, wanted, question, whole, measurer.split, source.scene_name)
        ladder = Ladder(out, Tuning("compress", source, first, steps, opened.device))
        before = 1.0
        for keep in shares:
            rung = _measured(ladder, ladder.rung(keep, before), keep, form, measurer)
            search.points += rung
            search.write()
            before = keep
            if wanted.ends(rung, whole.psnr) and keep < 1:  # after the model itself: a trained rung can be better
                break
        return _finished(search, form)


def _measured(ladder: Ladder, source: Path, keep: float, form: Format, measurer: Measurer) -> list[Point]:
    """Write a rung with each setting of its harmonics, and measure the files as they are read back."""
    points, model = [], load(source)
    for degree, quality in _settings(form, model.sh_degree):
        name = f"keep_{round(100 * keep):02d}_degree_{degree}_{quality}"
        file = ladder.out / TRIALS / f"{name}.{form}"
        if form == "sog":
            _copy(ladder.fitted(source, name, degree, quality), file)
        else:
            lower = replace(model, sh_rest=with_degree(model.tables(), degree)["sh_rest"])
            lower.save(file, Writing(quality=quality, quiet=True))
        size, figures = file.stat().st_size, measurer.figures(load(file, Reading(quiet=True)))
        point = Point(f"{TRIALS}/{file.name}", keep, degree, quality, len(model), size, *figures)
        LOG.info("%s: %.3g MB, %.2f dB", file.name, size / 1e6, point.psnr)
        points.append(point)
    return points


def _settings(form: Format, degree: int) -> Iterable[tuple[int, Quality]]:
    """Those of a model of this degree that differ: without harmonics there is one."""
    lower = ((min(most, degree), quality) for most, quality in SETTINGS[form])
    return dict.fromkeys((most, quality if most else "balanced") for most, quality in lower)


def _finished(search: Search, form: Format) -> dict[str, Any]:
    """Write the chosen file under its own name.  Raises ConfigError where there is none."""
    chosen, psnr = search.chosen, search.source.psnr
    file = _result(search.out, form)
    if chosen is None:
        near = search.target.nearest(search.points)
        raise ConfigError(
            f"--target {search.target.text}: no file meets it; the nearest, {search.out / near.file}, has "
            f"{near.bytes / 1e6:.3g} MB and {near.psnr - psnr:+z.2f} dB; {search.target.remedy}"
            + (f"; {file.name} there is of another target" if file.exists() else "")
        )
    _copy(search.out / chosen.file, file)
    search.write(file.name)
    return {**search.data(), "file": str(file), "page": str(search.out / PAGE)}


def _result(out: Path, form: Format) -> Path:
    return out / f"compressed.{form}"


def _copy(source: Path, file: Path) -> None:
    """Copy a model file, and the sky beside it."""
    with written(file) as output:
        output.write(read_file(source))
    keep_sky(sky_beside(source), file, output.sha256)
