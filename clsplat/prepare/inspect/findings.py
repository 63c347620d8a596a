"""Derive findings from the facts about a dataset: faults that affect training, and their remedies."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from clsplat.core.errors import pluralize, shell_quote, shorten
from clsplat.prepare.gather import MIN_PHOTOGRAPHS, remedy_for, warnings_for
from clsplat.prepare.inspect.facts import (
    MAX_DISTANCE,
    MIN_SEEN,
    CameraFacts,
    Facts,
    PointFacts,
    measure_dataset,
    read_parts,
)
from clsplat.scene.reader import Parts
from clsplat.scene.scene import format_position

TAKE_MORE = "take 30 or more, each from a new position and overlapping the one before by two thirds"
Level = Literal["error", "warning", "note"]
LEVELS: tuple[Level, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """A fault of a dataset and its remedy.  Findings with the level `error` prevent training."""

    level: Level
    fault: str
    remedy: str = ""

    @property
    def text(self) -> str:
        """The fault and the remedy in one sentence."""
        return f"{self.fault}: {self.remedy}" if self.remedy else self.fault


def check_photo_folder(facts: Facts) -> Iterator[Finding]:
    """Yield findings about a folder of photographs without cameras, and about files in it that are not used."""
    count, read_errors = facts.on_disk, facts.comparison.unreadable
    if facts.kind != "none" or facts.faults or not (count or facts.left_out):
        return
    contents = f"{pluralize(count, 'photo')} but" if count else "no readable photos and"
    readable_count, warnings = count - len(read_errors), facts.left_out
    if facts.is_unplaced:
        yield from _check_capture(facts, readable_count)
    else:
        remedy = f"only {readable_count} of {count} photos can be read; {remedy_for(read_errors)}"
        if count < MIN_PHOTOGRAPHS:  # the refusal already names the files that are left out
            remedy, warnings = facts.refusal.removeprefix(f"{facts.path}: "), []
        yield Finding("error", f"{facts.path} contains {contents} no camera poses", remedy)
    for warning in warnings + warnings_for({"damaged": read_errors, "photographs": readable_count}):
        yield Finding("warning", warning.removeprefix(f"{facts.path}: "))


def _check_capture(facts: Facts, readable_count: int) -> Iterator[Finding]:
    """Yield findings about photographs without cameras.  readable_count: the number of readable photographs."""
    if readable_count < MIN_VIEWS:
        fault = f"there {_count_with_verb(readable_count, 'photo', 'only ')}, often too few to find the cameras"
        yield Finding("warning", fault, TAKE_MORE)
    if blank := facts.comparison.blank:
        is_all_blank = len(blank) == readable_count
        blank_text = f"{_count_with_verb(len(blank), 'photo')} black or a single color"
        fault = "all photos are blank" if is_all_blank else blank_text
        remedy = "export them again, or retake them"
        yield Finding("error" if is_all_blank else "warning", f"{fault} ({_join(blank)})", remedy)


MAX_NAMES = 4  # names in a finding
MIN_VIEWS = 10  # training views
MIN_POINTS = 100
MAX_LEFT_OUT = 0.1  # fraction of the photographs that may lack a pose without a warning
MAX_ERROR = 2.0  # px of mean reprojection error; COLMAP drops observations above 4
POSES_ERROR = 1.0  # px, from which pipelines/photos.yaml optimizes poses
POSES = "optimize.modules.camera_optimizer={start: 500}"
MAX_BEHIND, MIN_IN_TWO = 0.1, 0.5  # fractions of the points
MIN_KEPT = 0.6  # fraction of a photograph
FOCAL_RANGE = (0.2, 20.0)  # focal length / image width, 136 to 3 degrees


def derive_findings(facts: Facts) -> list[Finding]:
    """Return the findings about a dataset, errors first, then warnings and notes."""
    checks = (
        check_photo_folder,
        _check_unreadable,
        _check_photographs,
        _check_comparison,
        _check_cameras,
        _check_poses,
        _check_points,
    )
    results = [finding for check in checks for finding in check(facts)]
    if facts.refusal and not facts.is_unplaced and not any(finding.level == "error" for finding in results):
        results.append(Finding("error", facts.refusal))
    return sorted(results, key=lambda finding: LEVELS.index(finding.level))


def check_view_count(train: int) -> Iterator[Finding]:
    """Yield a warning if a scene has few training views.  train: the number of training views."""
    if train < MIN_VIEWS:
        fault = f"there {_count_with_verb(train, 'training view', 'only ')}"
        yield Finding("warning", fault, "expect floaters and blur far from the photos; take 30 or more")


def _check_unreadable(facts: Facts) -> Iterator[Finding]:
    yield from (Finding("error", fault) for fault in facts.faults[:MAX_NAMES])
    if len(facts.faults) > MAX_NAMES:
        more = f"{pluralize(len(facts.faults) - MAX_NAMES, 'more part')} of the dataset cannot be read"
        yield Finding("error", more, "fix the first ones and inspect again")


def _check_photographs(facts: Facts) -> Iterator[Finding]:
    photographs, colmap = facts.photos, facts.kind == "COLMAP"
    if facts.missing:
        fault = f"{len(facts.missing)} of {facts.registered} registered images are missing on disk"
        hint = ", or skip them with --set scene.missing=skip" if len(facts.missing) < facts.registered else ""
        yield Finding("error", f"{fault} ({_join(facts.missing)}){facts.hint}", f"restore the files{hint}")
    if photographs.unreadable:
        unreadable = _join(list(photographs.unreadable))
        reason = next(iter(photographs.unreadable.values())).partition(";")[0]
        fault = f"{pluralize(len(photographs.unreadable), 'image file')} cannot be decoded ({unreadable})"
        yield Finding("error", fault, f"{reason}; {remedy_for({unreadable: reason})}")
    if photographs.unusable_reason:
        fault, _, remedy = photographs.unusable_reason.removeprefix(f"{facts.path}: ").rpartition("; ")
        yield Finding("error", fault, remedy)
    if photographs.blank:
        fault = f"{_count_with_verb(len(photographs.blank), 'photo')} black, a single color, or transparent"
        yield Finding("warning", f"{fault} ({_join(photographs.blank)})", "export them again, or remove them")
    if photographs.cut:
        fault = f"the end is missing from {pluralize(len(photographs.cut), 'image file')} ({_join(photographs.cut)})"
        yield Finding("error", fault, "copy them again")
    if photographs.misfits:
        sizes = [f"{name} is {size}" for name, size in photographs.misfits.items()]
        fault = f"{_count_with_verb(len(sizes), 'image file')} not the size of the camera ({_join(sizes, 2)})"
        remedy = "use the images that the cameras were calibrated on"
        if len(photographs.on_side) == len(sizes):
            remedy = "width and height are swapped: " + remedy
        yield Finding("error", fault, remedy)
    if facts.unregistered:
        fraction = len(facts.unregistered) / facts.on_disk
        fault = (
            f"{len(facts.unregistered)} of {facts.on_disk} images on disk have no pose ({_join(facts.unregistered)})"
        )
        is_serious = colmap and facts.registered and fraction > MAX_LEFT_OUT
        remedy = "they are not used for training" + (
            "; more overlapping photos or colmap exhaustive_matcher may register them" if colmap else ""
        )
        if facts.registered:
            yield Finding("warning" if is_serious else "note", fault, remedy)
    if photographs.exif_turned:
        fault = f"{_count_with_verb(len(photographs.exif_turned), 'photo')} rotated by EXIF"
        yield Finding(
            "note", fault, "clsplat reads the pixels as stored, as COLMAP does, so renders may be rotated too"
        )
    for note in facts.notes:
        yield Finding("note", note)
    for names in facts.same_but_case[:MAX_NAMES]:
        fault = f"{' and '.join(map(shorten, names))} differ only in upper and lower case"
        yield Finding("warning", fault, "they overwrite each other on Windows and macOS; rename one")


def _check_comparison(facts: Facts) -> Iterator[Finding]:
    blurred, jumps = facts.comparison.blurred, facts.comparison.jumps
    if blurred:
        fault = f"{_count_with_verb(len(blurred), 'photo')} blurred ({_join(blurred)})"
        yield Finding("warning", fault, "remove or retake them: the model learns the blur")
    for names in facts.comparison.same[:MAX_NAMES]:
        yield Finding("note", f"{_join(names)} look the same", "one of them is enough")
    if jumps:
        examples = _join([f"{a} to {b}: {stops:.1f}" for a, b, stops in jumps])
        fault = f"the exposure jumps by more than a stop {pluralize(len(jumps), 'time')} ({examples})"
        yield Finding("note", fault, "--set optimize.modules.exposure={} gives each photo its own exposure")
    if steps := facts.comparison.steps:
        examples = _join([f"{a} to {b}: {ratio:.2g} times" for a, b, ratio in steps])
        fault = (
            f"{_count_with_verb(len(steps), 'photo')} more than twice or less than half as bright as the one before "
            f"({examples})"
        )
        remedy = "without exposures in EXIF, --set optimize.modules.exposure={} fits the exposure of each photo"
        yield Finding("note", fault, remedy)


def _check_cameras(facts: Facts) -> Iterator[Finding]:
    sizes = {(camera.width, camera.height) for camera in facts.cameras}
    if len(sizes) > 1:
        remedy = "this is allowed; steps on larger views take longer"
        yield Finding("note", f"the photos have {len(sizes)} sizes", remedy)
    for camera in facts.cameras:
        name = f"the {camera.model} camera {camera.width}x{camera.height} of {pluralize(camera.views, 'view')}"
        if not camera.faces and not FOCAL_RANGE[0] < camera.focal[0] / camera.width < FOCAL_RANGE[1]:
            fault = f"{name} has a focal length of {camera.focal[0]:.4g} px, which is not plausible"
            yield Finding("warning", fault, "calibrate it again, or compute the poses with the correct focal length")
        if not camera.centered:
            yield Finding("warning", f"{name} has its principal point outside the image", "calibrate it again")
        if camera.kept < MIN_KEPT:
            fault = f"undistorting {name} keeps only {100 * camera.kept:.0f} % of each photo"
            yield Finding(
                "warning", fault, "use a lens with less distortion, or crop and undistort the images yourself"
            )


def _check_poses(facts: Facts) -> Iterator[Finding]:
    main, *unused = facts.submodels or {"": 0}
    if unused:
        parts = ", ".join(f"{name} with {facts.submodels[name]} images" for name in unused)
        is_large = any(facts.submodels[name] > MAX_LEFT_OUT * facts.submodels[main] for name in unused)
        fault = f"COLMAP made {len(facts.submodels)} models and only {main} ({facts.submodels[main]} images) is used"
        remedy = f"not used: {parts}; colmap model_merger may merge models that share images"
        yield Finding("warning" if is_large else "note", fault, remedy)
    if facts.train is not None:
        yield from check_view_count(facts.train)
    if facts.test == 0:
        yield Finding("note", "there are no test views", "quality is measured on training views only")
    if facts.same_center:
        fault = "all cameras are at the same position"
        yield Finding("warning", fault, "depth cannot be estimated; take photos from different positions")
    if facts.outlier_cameras:
        count = _count_with_verb(len(facts.outlier_cameras), "camera")
        fault = f"{count} far away from all others ({_join(facts.outlier_cameras)})"
        yield Finding(
            "warning", fault, "the pose is probably wrong; remove the image from the dataset or register it again"
        )
    for names in facts.same_pose[:MAX_NAMES] if not facts.same_center else ():
        fault = f"{_join(names)} have exactly the same pose"
        yield Finding("note", fault, "if they are copies of one photo, training counts it twice; keep one of them")
    if facts.few_points:
        counts = [f"{name}: {facts.points_per_view[name]}" for name in facts.few_points]
        verb = "shows" if len(counts) == 1 else "show"
        fault = f"{pluralize(len(counts), 'view')} {verb} fewer than {MIN_SEEN} points ({_join(counts)})"
        yield Finding("warning", fault, "the poses are unreliable; check the renders, or remove these images")


def _check_points(facts: Facts) -> Iterator[Finding]:
    points = facts.points
    if points is None or points.count == 0:
        if facts.registered and not any("points3d" in fault.lower() for fault in facts.faults):
            remedy = "training starts from a plane sweep, or from random points if the photos are transparent"
            yield Finding("note", "there are no points", remedy)
        return
    if points.count < MIN_POINTS:
        fault = f"there {_count_with_verb(points.count, 'point', 'only ')}"
        yield Finding("warning", fault, "compare with a run that has --set init.source=random")
    if points.not_finite:
        fault = f"{_count_with_verb(points.not_finite, 'point')} not finite"
        yield Finding("warning", fault, "they are ignored; the file may be damaged: export it again")
    if points.distant:
        fault = f"{_count_with_verb(points.distant, 'point')} more than {MAX_DISTANCE:g} times the cameras' extent away"
        yield Finding("note", fault, "they are usually sky or wrong matches, and become very large Gaussians")
    if not facts.refusal:
        yield from _check_coverage(points)
    if points.error_mean is not None and points.error_mean >= POSES_ERROR:
        fault = f"the mean reprojection error of the points is {points.error_mean:.2f} px at the full size"
        remedy = (
            "renders will be blurry; run bundle adjustment (colmap bundle_adjuster), or optimize the cameras too with "
            f'--set "{POSES}"; `photos` does this at {POSES_ERROR:g} px or more at the training size'
        )
        yield Finding("warning" if points.error_mean > MAX_ERROR else "note", fault, remedy)


def _check_coverage(points: PointFacts) -> Iterator[Finding]:
    axes = "the poses do not match the points, or have flipped axes; export poses and points together"
    if points.behind is not None and points.behind > MAX_BEHIND:
        yield Finding("warning", f"{100 * points.behind:.0f} % of the points are behind all cameras", axes)
    elif points.in_two is not None and points.in_two < MIN_IN_TWO:
        yield Finding("warning", f"only {100 * points.in_two:.0f} % of the points project into two or more views", axes)


def _count_with_verb(count: int, word: str, prefix: str = "") -> str:
    """Return a count with a noun and a verb, such as `3 views are`, or `are only 3 views` with a prefix."""
    verb = "is" if count == 1 else "are"
    return f"{verb} {prefix}{pluralize(count, word)}" if prefix else f"{pluralize(count, word)} {verb}"


def _join(names: Sequence[str], limit: int = MAX_NAMES) -> str:
    return ", ".join(map(shorten, names[:limit])) + (", …" if len(names) > limit else "")


@dataclass(frozen=True)
class Inspection:
    """The parts of a dataset, the facts about it, and the findings."""

    parts: Parts
    facts: Facts
    findings: list[Finding]

    @classmethod
    def from_folder(cls, path: Path) -> "Inspection":
        """Inspect the dataset in a folder.  Raises DataError only if the folder does not exist."""
        parts = read_parts(path)
        facts = measure_dataset(parts)
        return cls(parts, facts, derive_findings(facts))

    @property
    def is_trainable(self) -> bool:
        """Whether training can use the dataset unchanged, which is not the case for photographs without cameras."""
        return self.next_step is None and all(finding.level != "error" for finding in self.findings)

    @property
    def next_step(self) -> str | None:
        """Advice on finding the cameras of photographs.  None if the dataset has cameras or unusable photographs."""
        facts = self.facts
        if not facts.is_unplaced or any(finding.level == "error" for finding in self.findings):
            return None
        camera_folder = facts.refusal.partition("photos without cameras; the cameras are ")[2]
        command = f"`clsplat run photos --scene {shell_quote(facts.path)}`"
        return f"use the cameras {camera_folder}" if camera_folder else command

    @property
    def verdict(self) -> str:
        """The findings in one sentence: the first error or warning, and the number of others."""
        errors, warnings = ([f.fault for f in self.findings if f.level == level] for level in ("error", "warning"))
        findings, start, noun = (errors, "cannot train: ", "error") if errors else (warnings, "trains, but ", "warning")
        more = f" (and {pluralize(len(findings) - 1, f'more {noun}')})" if len(findings) > 1 else ""
        if self.next_step:
            problem = f", and {findings[0]}{more}" if findings else ""
            return f"cameras are not known yet{problem}; next: {self.next_step}"
        return f"{start}{findings[0]}{more}" if findings else "ready to train"

    def data(self) -> dict[str, Any]:
        """Return the verdict, findings and facts as plain data for JSON."""
        return {
            "verdict": self.verdict,
            "trainable": self.is_trainable,
            "findings": [{"level": finding.level, "text": finding.text} for finding in self.findings],
            "facts": asdict(self.facts),
        }


# Format the facts as short lines, for the terminal and the page.

MAX_CAMERAS = 4  # number of cameras to list


def summarize(facts: Facts) -> dict[str, str]:
    """Return the main facts as a dict from labels to lines of text."""
    fallback = "photos without cameras" if facts.is_unplaced else "none found"
    lines = {"dataset": facts.kind if facts.kind != "none" else fallback, "images": _format_image_counts(facts)}
    if capture := facts.capture:
        lines["sizes"] = _format_counts(capture.sizes)
        lines["cameras by EXIF"] = _format_counts(capture.cameras)
        lines["GPS positions"] = f"{capture.located}" if capture.located else "none"
        comparison = facts.comparison
        lines["comparison"] = f"{len(comparison.blurred)} blurred, {len(comparison.same)} duplicates"
        lines["comparison"] += f", {len(comparison.jumps)} exposure jumps"
    if facts.train is not None:
        lines["views"] = f"{facts.train} for training, {facts.test} for testing"
    if facts.timestamps:
        cameras = pluralize(facts.moving_cameras, "camera")
        lines["times"] = f"{pluralize(facts.timestamps, 'timestamp')} from {cameras}"
    if len(facts.submodels) > 1:
        lines["models"] = ", ".join(f"{name} ({pluralize(count, 'image')})" for name, count in facts.submodels.items())
    for i, camera in enumerate(facts.cameras[:MAX_CAMERAS]):
        lines["camera" if len(facts.cameras) == 1 else f"camera {i + 1} of {len(facts.cameras)}"] = describe_camera(
            camera
        )
    if facts.extent is not None:
        lines["extent"] = f"{facts.extent:.4g} scene units, the radius of the cameras"
        if facts.outlier_cameras:
            lines["extent"] += f", without {len(facts.outlier_cameras)} far away from all others"
    if any(facts.origin):
        lines["origin"] = f"{format_position(np.array(facts.origin))}, which is subtracted from all coordinates"
    if points := facts.points:
        lines["points"] = f"{points.count:,}"
        if points.error_mean is not None:
            lines["reprojection error"] = f"{points.error_mean:.2f} px on average, 90 % below {points.error_90:.2f} px"
        if points.in_two is not None and points.behind is not None:
            lines["coverage"] = f"{100 * points.in_two:.0f} % of the points in two views or more"
            lines["coverage"] += f", {100 * points.behind:.0f} % behind all cameras" if points.behind else ""
    elif facts.registered:
        lines["points"] = "none"
    if counts := list(facts.points_per_view.values()):
        lines["points per view"] = f"{min(counts):,} to {max(counts):,}, median {median(counts):,.0f}"
    return lines


def _format_counts(counts: Mapping[str, int]) -> str:
    """Format the keys as a list, each followed by its count if there are several keys."""
    return _join([f"{name} ({count})" if len(counts) > 1 else name for name, count in counts.items()])


def describe_camera(camera: CameraFacts) -> str:
    """Describe a camera in a line of text: model, size, focal length, distortion, and number of views."""
    fx, fy = camera.focal
    focal = f"{fx:.1f}" if abs(fx - fy) < 0.05 else f"{fx:.1f}, {fy:.1f}"
    distortion = "unbounded" if camera.distortion is None else f"up to {camera.distortion:.1f} px"
    lens = f", distortion {distortion}, {100 * camera.kept:.0f} % kept" if camera.distortion != 0 else ""
    lens += f", split into {pluralize(camera.faces, 'cube face')}" if camera.faces else ""
    size = f"{camera.width}x{camera.height}"
    return f"{camera.model} {size}, focal length {focal} px{lens}; {pluralize(camera.views, 'view')}"


def _format_image_counts(facts: Facts) -> str:
    if not facts.registered:
        return f"{facts.on_disk} on disk"
    parts = [f"{facts.registered} with a pose"]
    parts += [f"{len(facts.missing)} of them missing from disk"] if facts.missing else []
    parts += [f"{len(facts.unregistered)} more on disk without a pose"] if facts.unregistered else []
    parts += [f"in {facts.folders} folders"] if facts.folders > 1 else []
    parts += [f"{facts.photos.mask_count} with a mask"] if facts.photos.mask_count else []
    return ", ".join(parts)


STYLES = {"error": "bold red", "warning": "yellow", "note": "cyan"}


def show(inspection: Inspection, console: Console) -> None:
    """Print the facts, the findings and the verdict."""
    table = Table.grid(padding=(0, 2))
    for name, value in summarize(inspection.facts).items():
        table.add_row(Text(name, "bold"), Text(value))
    for finding in inspection.findings:
        table.add_row(Text(finding.level, STYLES[finding.level]), Text(finding.text))
    console.print(table, soft_wrap=not console.is_terminal)
    if inspection.is_trainable or inspection.next_step:
        is_ready = inspection.verdict.startswith("ready")
        console.print(Text(inspection.verdict, "bold green" if is_ready else "bold yellow"))
