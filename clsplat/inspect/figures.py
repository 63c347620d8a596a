"""The facts as short lines of text, for the terminal and the page."""

from statistics import median

from clsplat.errors import amount
from clsplat.inspect.survey import CameraFacts, Facts

MAX_CAMERAS = 4  # cameras, by the number of their views


def figures(facts: Facts) -> dict[str, str]:
    """Return the figures that a dataset has, by name."""
    lines = {"dataset": facts.kind if facts.kind != "none" else "none found", "images": _images(facts)}
    if facts.train is not None:
        lines["views"] = f"{facts.train} for training, {facts.test} for testing"
    if facts.moments:
        lines["times"] = f"{amount(facts.moments, 'moment')}, seen from {amount(facts.stations, 'place')}"
    if len(facts.submodels) > 1:
        lines["models"] = ", ".join(f"{name} ({amount(count, 'image')})" for name, count in facts.submodels.items())
    for i, camera in enumerate(facts.cameras[:MAX_CAMERAS]):
        lines["camera" if len(facts.cameras) == 1 else f"camera {i + 1} of {len(facts.cameras)}"] = camera_line(camera)
    if facts.extent is not None:
        lines["extent"] = f"{facts.extent:.4g} scene units around the cameras"
        if facts.strayed:
            lines["extent"] += f", without {len(facts.strayed)} that are far away from all others"
    if points := facts.points:
        lines["points"] = f"{points.count:,}"
        if points.error_mean is not None:
            lines["reprojection error"] = f"{points.error_mean:.2f} px on average, 90 % below {points.error_90:.2f} px"
        if points.in_two is not None and points.behind is not None:
            lines["coverage"] = f"{100 * points.in_two:.0f} % of the points in two views or more"
            lines["coverage"] += f", {100 * points.behind:.0f} % behind all cameras" if points.behind else ""
    elif facts.registered:
        lines["points"] = "none"
    if counts := list(facts.seen.values()):
        lines["points per view"] = f"{min(counts):,} to {max(counts):,}, median {median(counts):,.0f}"
    return lines


def camera_line(camera: CameraFacts) -> str:
    """Return a camera on one line."""
    fx, fy = camera.focal
    focal = f"{fx:.1f}" if abs(fx - fy) < 0.05 else f"{fx:.1f}, {fy:.1f}"
    bent = "without bounds" if camera.distortion is None else f"up to {camera.distortion:.1f} px"
    lens = f", distortion {bent}, {100 * camera.kept:.0f} % kept" if camera.distortion != 0 else ""
    return (
        f"{camera.model} {camera.width}x{camera.height}, focal length {focal} px{lens}; {amount(camera.views, 'view')}"
    )


def _images(facts: Facts) -> str:
    if not facts.registered:
        return f"{facts.on_disk} on disk"
    parts = [f"{facts.registered} with a pose"]
    parts += [f"{len(facts.missing)} of them missing on disk"] if facts.missing else []
    parts += [f"{len(facts.unregistered)} more on disk without a pose"] if facts.unregistered else []
    parts += [f"in {facts.folders} folders"] if facts.folders > 1 else []
    parts += [f"{facts.photos.masks} with a mask"] if facts.photos.masks else []
    return ", ".join(parts)
