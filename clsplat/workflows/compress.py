"""Compress a model to a target: search over pruning ratios and SH settings, and measure every file."""

import json
import logging
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from clsplat.core.errors import ConfigError, quote
from clsplat.core.files import write_text
from clsplat.core.page import mark_charts_safe, render
from clsplat.core.reading import read_file, sha256
from clsplat.core.text_table import text_table
from clsplat.formats.packing import open_hashed
from clsplat.formats.splats import Quality, ReadOptions, WriteOptions, require_static, with_degree
from clsplat.formats.table import model_bytes, model_file, warn_about_losses
from clsplat.gaussians.model import MODEL, load
from clsplat.gaussians.sky import read_sky_file, write_sky_file
from clsplat.pipeline.loading import Pipeline
from clsplat.runs.model_file import ModelFile
from clsplat.viewer.charts import Line, line_chart
from clsplat.workflows.finetune import Measurer, Tuning, claim_folder, require_steps

# The pruning ladder: a series of models, each pruned and fine-tuned from the previous one.

STAGES = ("init", "prune_least", "optimize")  # of the recipe; each rung writes a PLY
PALETTE = "palette_sh"
# stages that train the SH palette of a SOG, round all tables, and fine-tune the rounded tables
PALETTE_STAGES = ("reduce_sh", PALETTE, "optimize", "share_palette", PALETTE)
SOG_STAGES = ("init", *PALETTE_STAGES, "round_tables", "optimize", "round_tables")
SOG_FOLDER, SOG = "fitted", "model.sog"


@dataclass(frozen=True)
class Ladder:
    """Prunes and fine-tunes a model in steps, called rungs, each in a separate run folder."""

    out: Path
    tuning: Tuning

    def train_rung(self, keep: float, previous: float) -> Path:
        """Prune from the fraction `previous` of the original Gaussians to `keep`, and train; return the model's file.

        Finished work of an earlier call is kept, and interrupted work resumes.
        """
        if keep == 1:
            return self.tuning.source.file
        file = self.tuning.source.file if previous == 1 else self.folder(previous) / MODEL
        return self.tuning.train(self.pipeline(file, keep / previous), self.folder(keep))

    def folder(self, keep: float) -> Path:
        """Return the run folder of a rung."""
        return self.out / f"keep_{round(100 * keep):02d}"

    def train_sog(self, file: Path, name: str, degree: int, quality: str) -> Path:
        """Fine-tune a rung with the SH palette and the rounding of the SOG format; return the SOG file."""
        values = {"init.file": str(file.resolve()), "reduce_sh.degree": degree}
        values |= {f"stages.{i}.quality": quality for i, stage in enumerate(SOG_STAGES) if stage == PALETTE}
        pipeline = self.tuning.pipeline(SOG_STAGES, values, file=SOG, quality=quality)
        return self.tuning.train(pipeline, self.out / SOG_FOLDER / name, SOG)

    def pipeline(self, file: Path, keep: float) -> Pipeline:
        """Return the pipeline that prunes a model file to the fraction `keep` of its Gaussians and trains it."""
        return self.tuning.pipeline(STAGES, {"init.file": str(file.resolve()), "prune_least.keep": keep})


def ordered_keeps(keeps: Sequence[float]) -> list[float]:
    """Return the unique fractions in descending order.  Raises ConfigError if there are none or one is invalid."""
    fractions = sorted(set(keeps), reverse=True)
    if not fractions or not all(0.01 <= keep <= 1 for keep in fractions):
        raise ConfigError("--keep: expected fractions of the Gaussians from 0.01 to 1, such as 1,0.7,0.5")
    if len({round(100 * keep) for keep in fractions}) < len(fractions):
        raise ConfigError("--keep: expected fractions that differ by at least 0.01")
    return fractions


# Targets: a size, or a loss in PSNR.

UNITS = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}
EXPECTED = "expected a size such as 5MB, or a loss such as -0.1dB"


@dataclass(frozen=True)
class Entry:
    """A file that the search wrote, and its measurements."""

    file: str  # in the folder of the search
    keep: float  # fraction of the Gaussians
    degree: int  # of the SH
    quality: str
    gaussians: int
    bytes: int
    psnr: float  # dB, of the file after reading it back
    ssim: float


@dataclass(frozen=True)
class CompressionTarget:
    """A maximum size, or a maximum loss in PSNR."""

    text: str
    max_bytes: int | None = None
    psnr_change: float | None = None  # dB, at most 0

    @classmethod
    def parse(cls, text: str) -> "CompressionTarget":
        """Parse text such as '5MB' (1 MB = 10^6 bytes; 1 MiB = 2^20 bytes) or '-0.1dB'.  Raises ConfigError."""
        match = re.fullmatch(r"\s*([+-]?\d+(?:\.\d*)?|[+-]?\.\d+)\s*([a-z]+)\s*", text, re.IGNORECASE | re.ASCII)
        unit = match[2].lower() if match else ""
        if match is None or unit not in (*UNITS, "db"):
            raise ConfigError(f"--target {quote(text)}: {EXPECTED}")
        value = float(match[1])
        if not math.isfinite(value * UNITS.get(unit, 1)):
            raise ConfigError(f"--target {quote(text)}: {EXPECTED}")
        if unit == "db":
            if value > 0:
                raise ConfigError(f"--target {quote(text)}: a target above 0 dB is a gain; {EXPECTED}")
            return cls(text.strip(), psnr_change=value)
        if value * UNITS[unit] < 1:
            raise ConfigError(f"--target {quote(text)}: {EXPECTED}")
        return cls(text.strip(), max_bytes=int(value * UNITS[unit]))

    def is_met(self, entry: Entry, psnr: float) -> bool:
        """Return whether a file meets the target.  psnr: PSNR of the original model, dB."""
        if self.max_bytes is not None:
            return entry.bytes <= self.max_bytes
        return entry.psnr >= psnr + (self.psnr_change or 0)

    def best(self, entries: Sequence[Entry], psnr: float) -> Entry | None:
        """Return a file that meets the target, or None if there is none.

        The file has the highest PSNR if the target is a size, and the smallest size if the target is a loss.
        """
        candidates = [entry for entry in entries if self.is_met(entry, psnr)]
        if self.max_bytes is not None:
            return max(candidates, key=lambda entry: (entry.psnr, -entry.bytes), default=None)
        return min(candidates, key=lambda entry: (entry.bytes, -entry.psnr), default=None)

    def nearest(self, entries: Sequence[Entry]) -> Entry:
        """Return the file closest to a target that no file meets.

        It is the smallest file if the target is a size, and the one with the highest PSNR if the target is a loss.
        """
        smallest, best = min(entries, key=lambda entry: entry.bytes), max(entries, key=lambda entry: entry.psnr)
        return best if self.max_bytes is None else smallest

    @property
    def remedy(self) -> str:
        """The advice for the user if no file meets the target."""
        if self.max_bytes is not None:
            return "give a larger size, or smaller fractions with --keep"
        return "allow a larger loss, or train longer with --steps"

    def is_decided(self, rung: Sequence[Entry], psnr: float) -> bool:
        """Return whether the search can stop: every file of a rung meets a target size, or none meets a target loss."""
        results = [self.is_met(entry, psnr) for entry in rung]
        return all(results) if self.max_bytes is not None else not any(results)


# The rate–distortion curve and table of a search, as text and as an offline page.

HEADINGS = ("Gaussians", "kept", "SH degree", "quality", "MB", "of the model", "PSNR, dB", "change, dB", "SSIM")


def cells(entry: Entry, source: Entry) -> list[str]:
    """Return the cells of the file's row in the table of results."""
    return [
        f"{entry.gaussians:,}",
        f"{entry.keep:.0%}",
        str(entry.degree),
        entry.quality or "–",
        f"{entry.bytes / 1e6:.3g}",
        f"{entry.bytes / source.bytes:.1%}",
        f"{entry.psnr:.2f}",
        f"{entry.psnr - source.psnr:+z.2f}",
        f"{entry.ssim:.4f}",
    ]


def format_table(result: dict[str, Any]) -> str:
    """Format the record of a search as text; a star marks the best file."""
    source, entries = Entry(**result["source"]), [Entry(**entry) for entry in result["points"]]
    best_entry = result["chosen"] and Entry(**result["chosen"])
    marks = ["", "", *("*" if entry == best_entry else "" for entry in entries)]
    rows = [HEADINGS, *(cells(entry, source) for entry in (source, *entries))]
    return text_table([[mark, *row] for mark, row in zip(marks, rows, strict=True)])


def page(
    target: CompressionTarget,
    source: Entry,
    entries: Sequence[Entry],
    best_entry: Entry | None,
    split: str,
    scene: str,
    model: str,
    result: str = "",
) -> str:
    """Return the HTML page of a search; result: the name of the written model file."""
    return render(
        "compress.html.j2",
        title=f"{scene} · {source.file}, compressed to {target.text}",
        subtitle=f"{model}; PSNR and SSIM of the {split} views, measured on every file after reading it back",
        result=result,
        verdict=_verdict(target, source, best_entry),
        curves=mark_charts_safe([line_chart("PSNR (dB) over file size (MB)", _lines(target, source, entries))]),
        headings=HEADINGS,
        rows=[(entry.file, cells(entry, source), entry == best_entry) for entry in (source, *entries)],
    )


def _verdict(target: CompressionTarget, source: Entry, best_entry: Entry | None) -> str:
    if best_entry is None:
        return f"No file has met the target {target.text} so far."
    return (
        f"{best_entry.file}: {best_entry.bytes / 1e6:.3g} MB, {best_entry.bytes / source.bytes:.1%} of the model, "
        f"{best_entry.psnr:.2f} dB, {best_entry.psnr - source.psnr:+z.2f} dB"
    )


def _lines(target: CompressionTarget, source: Entry, entries: Sequence[Entry]) -> list[Line]:
    """Return a chart line for each fraction of the Gaussians, and a line for the target."""
    keeps = dict.fromkeys(entry.keep for entry in entries)
    lines = [
        Line(sorted((e.bytes / 1e6, e.psnr) for e in entries if e.keep == keep), f"{keep:.0%} of the Gaussians")
        for keep in keeps
    ]
    max_size = max((entry.bytes for entry in entries), default=0) / 1e6
    if target.psnr_change is not None and entries:
        min_psnr = source.psnr + target.psnr_change
        lines.append(Line([(0, min_psnr), (max_size, min_psnr)], f"target {target.text}", "var(--target)", dash=1))
    return lines


LOG = logging.getLogger("clsplat")
Format = Literal["sog", "spz"]
KEEPS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)  # fractions of the Gaussians
SETTINGS: dict[Format, tuple[tuple[int, Quality], ...]] = {  # SH degree and quality
    "sog": ((3, "high"), (3, "balanced"), (3, "small")),  # lower degrees hardly make the palette smaller
    "spz": ((3, "balanced"), (3, "small"), (2, "small"), (1, "small"), (0, "small")),
}
RECORD, PAGE, TRIALS = "compress.json", "compress.html", "trials"


@dataclass
class Search:
    """A search, the folder in which it runs, and all measurements so far."""

    out: Path
    target: CompressionTarget
    identity: dict[str, Any]  # inputs and options that identify the search
    source: Entry  # the original model
    split: str  # name of the measured views
    scene: str  # name on pages
    entries: list[Entry] = field(default_factory=list)

    @property
    def best_entry(self) -> Entry | None:
        return self.target.best(self.entries, self.source.psnr)

    def data(self) -> dict[str, Any]:
        """Return the record of the search as a dictionary for JSON."""
        best_entry = self.best_entry
        return {
            **self.identity,
            "target": self.target.text,
            "split": self.split,
            "source": asdict(self.source),
            "points": [asdict(entry) for entry in self.entries],
            "chosen": best_entry and asdict(best_entry),
        }

    def write(self, result: str = "") -> None:
        """Write the measurements as JSON, and as an HTML page that links to the result."""
        write_text(self.out / RECORD, json.dumps(self.data(), indent=1) + "\n")
        page_arguments = self.target, self.source, self.entries, self.best_entry, self.split
        write_text(self.out / PAGE, page(*page_arguments, self.scene, self.identity["model"], result))


def compress(
    model: Path,
    scene: Path | None,
    target: str,
    out: Path,
    *,
    file_format: Format = "sog",
    keeps: Sequence[float] = KEEPS,
    steps: int | None = None,
    device: Any = None,
) -> dict[str, Any]:
    """Find a file that meets a target; write it, a page, and a record; return the record.

    The model is pruned and fine-tuned from one fraction of the Gaussians to the next.  Each rung is written with
    several SH settings, and every file is read back and measured.  The search stops when further pruning cannot
    improve the result.  An interrupted search resumes.
    Raises ConfigError for a target that no file meets, after writing the page, and OutputError if another process
    searches in `out`.
    """
    goal, fractions = CompressionTarget.parse(target), ordered_keeps(keeps)
    if steps is not None:
        require_steps(steps)
    if file_format not in get_args(Format):
        raise ConfigError(f"--format {quote(file_format)}: expected one of {', '.join(get_args(Format))}")
    input_model = ModelFile(model, scene, device)
    source, gaussians, measurer = input_model.source, input_model.gaussians, Measurer(input_model)
    require_static(source.file, gaussians.to_splat_file(), file_format)
    identity: dict[str, Any] = {"model": str(source.file), "sha256": sha256(model_file(source.file))}
    identity |= {"scene": str(source.folder), "photographs": measurer.identity(), "keeps": fractions, "steps": steps}
    size = model_bytes(source.file)  # fails for a damaged model, before the folder is created
    with claim_folder(out, identity, RECORD, "a search", "another --out"):
        warn_about_losses(_result_path(out, file_format), gaussians.to_splat_file())
        original = Entry(
            source.file.name, 1, gaussians.sh_degree, "", len(gaussians), size, *measurer.mean_metrics(gaussians)
        )
        search = Search(out, goal, identity, original, measurer.split, source.scene_name)
        ladder = Ladder(out, Tuning("compress", source, gaussians, steps, input_model.device))
        previous = 1.0
        for keep in fractions:
            trials = _measure_rung(ladder, ladder.train_rung(keep, previous), keep, file_format, measurer)
            search.entries += trials
            search.write()
            previous = keep
            if keep < 1 and goal.is_decided(trials, original.psnr):  # a fine-tuned rung can be better than the original
                break
        return _write_result(search, file_format)


def _measure_rung(ladder: Ladder, source: Path, keep: float, file_format: Format, measurer: Measurer) -> list[Entry]:
    """Write a rung with each SH setting, read the files back, and measure them."""
    entries, model = [], load(source)
    for degree, quality in _sh_settings(file_format, model.sh_degree):
        name = f"keep_{round(100 * keep):02d}_degree_{degree}_{quality}"
        file = ladder.out / TRIALS / f"{name}.{file_format}"
        if file_format == "sog":
            _copy(ladder.train_sog(source, name, degree, quality), file)
        else:
            reduced_model = replace(model, sh_rest=with_degree(model.tables(), degree)["sh_rest"])
            reduced_model.save(file, WriteOptions(quality=quality, quiet=True))
        size, measurements = file.stat().st_size, measurer.mean_metrics(load(file, ReadOptions(quiet=True)))
        entry = Entry(f"{TRIALS}/{file.name}", keep, degree, quality, len(model), size, *measurements)
        LOG.info("%s: %.3g MB, %.2f dB", file.name, size / 1e6, entry.psnr)
        entries.append(entry)
    return entries


def _sh_settings(file_format: Format, degree: int) -> Iterable[tuple[int, Quality]]:
    """Return the pairs of SH degree and quality to try for a model of this degree; a single pair for degree 0."""
    settings = ((min(limit, degree), quality) for limit, quality in SETTINGS[file_format])
    return dict.fromkeys((limit, quality if limit else "balanced") for limit, quality in settings)


def _write_result(search: Search, file_format: Format) -> dict[str, Any]:
    """Copy the best file to the result path; return the record.  Raises ConfigError if no file meets the target."""
    best_entry, psnr = search.best_entry, search.source.psnr
    file = _result_path(search.out, file_format)
    if best_entry is None:
        nearest_entry = search.target.nearest(search.entries)
        raise ConfigError(
            f"--target {search.target.text}: no file meets it; the closest, {search.out / nearest_entry.file}, has "
            f"{nearest_entry.bytes / 1e6:.3g} MB and {nearest_entry.psnr - psnr:+z.2f} dB; {search.target.remedy}"
            + (f"; the existing {file.name} is for another target" if file.exists() else "")
        )
    _copy(search.out / best_entry.file, file)
    search.write(file.name)
    return {**search.data(), "file": str(file), "page": str(search.out / PAGE)}


def _result_path(out: Path, file_format: Format) -> Path:
    return out / f"compressed.{file_format}"


def _copy(source: Path, file: Path) -> None:
    """Copy a model file and its sky."""
    with open_hashed(file) as output:
        output.write(read_file(source))
    write_sky_file(read_sky_file(source), file, output.sha256)
