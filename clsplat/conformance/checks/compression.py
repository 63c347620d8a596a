"""What compression of a model computes on the device: each Gaussian's contribution, and clusters for a palette."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.comparison import GRADIENT, SUM, Figure, by_element, by_norm, equal
from clsplat.conformance.scenes import Case, random_case, safe_case
from clsplat.density.contribution import contributions, sensitivities
from clsplat.density.survey import Look
from clsplat.formats.palette import LEVELS
from clsplat.gaussians import members
from clsplat.gaussians.clusters import DeviceClusters
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from clsplat.views.photographs import Mask, Photograph

CHECKS = Checks()
SIZES = ((1, 16, 16), (17, 33, 15), (30, 40, 30))  # Gaussians, and px: tiles that end at the edge, and beyond it


def photograph_of(device: Device, case: Case, mask: Mask | None = None) -> Photograph:
    """A black photograph at the camera of a scene."""
    camera = case.device_camera(device)
    colours = device.upload(np.zeros((3, camera.height, camera.width), np.uint8))
    return Photograph(camera, colours, None if mask is None else device.upload(mask[None].astype(np.uint8)))


@CHECKS.add("blend_backward")
def contribution(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count, width, height in SIZES:
        case = safe_case(rng, count, width, height, MARGIN)
        masks = (None, rng.random((height, width)) < 0.6)
        photographs = [photograph_of(device, case, mask) for mask in masks]
        expected = sum(ref.contribution(case.project(), width, height, mask) for mask in masks)
        black, background = np.zeros(3, np.float32), rng.random(3).astype(np.float32)
        found, again = (contributions(_looks(device, case, photographs, black), count) for _ in range(2))
        what = f"blend weights of {count} Gaussians"
        yield by_element("blend_backward", what, found, np.asarray(expected), SUM, floor=0.1)
        yield equal("blend_backward", f"{what}, a second time", again, found)
        found = sensitivities(_looks(device, case, photographs, background), count)
        squares = np.sum([_squares(case, background, mask) for mask in masks], axis=0)
        yield by_norm("blend_backward", f"squared changes of the image by {count} Gaussians", found, squares, GRADIENT)


def _looks(device: Device, case: Case, photographs: list[Photograph], background: NDArray[Any]) -> Iterator[Look]:
    """The views of photographs, by a new rasterizer and model."""
    return Look.each(Rasterizer(device, "radix"), case.model(device), photographs, device.upload(background))


def _squares(case: Case, background: NDArray[Any], mask: Mask | None) -> NDArray[Any]:
    """(dI/dG)² summed over the pixels of a mask and the channels, [N]."""
    width, height = case.size
    counted, total = np.ones((height, width)) if mask is None else mask, np.zeros(len(case.project().opacity))
    for channel in range(3):
        gradient = counted * (np.arange(3) == channel)[:, None, None]
        total += ref.falloff_squares(case.project(), width, height, background.astype(np.float64), gradient)
    return total


@CHECKS.add("nearest_vectors", "sum_members")
def clusters(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """Whole numbers: every label, distance and sum is exact."""
    for count, entries, components in ((1, 1, 3), (17, 9, 45), (130, 21, 9)):
        points, vectors = (
            rng.integers(-LEVELS, LEVELS + 1, (rows, components)).astype(np.float32) for rows in (count, entries)
        )
        vectors[-1], points[-1] = vectors[0], vectors[0]  # equally near: the first counts
        held = DeviceClusters(device, points)
        labels, distance = held.nearest(vectors)
        what = f"{count} points and {entries} vectors"
        expected, half = ref.nearest_vectors(points, vectors)
        yield equal("nearest_vectors", f"labels of {what}", labels, expected)
        yield equal("nearest_vectors", f"distances of {what}", distance, half.astype(np.float32))
        sums = held.sums(expected, entries)
        yield equal("sum_members", f"sums of {what}", sums, ref.member_sums(points, expected, entries))


@CHECKS.add("share_mean")
def shared_means(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count, clusters in ((1, 1), (17, 3), (130, 40)):
        gaussians = random_case(rng, count).model(device).gaussians
        values, labels = gaussians.get("sh_rest"), rng.integers(0, clusters, count)
        weights = rng.random(count).astype(np.float32) * (labels != 0)  # of one cluster all are zero
        members.set_clusters(gaussians, labels, weights)
        members.share(gaussians, "sh_rest")
        what, found = f"means of {clusters} clusters of {count} Gaussians", gaussians.get("sh_rest")
        yield by_element("share_mean", what, found, ref.shared_means(values, labels, weights), SUM, floor=0.1)
        members.share(gaussians, "sh_rest")
        yield equal("share_mean", f"{what}, a second time", gaussians.get("sh_rest"), found)
