"""What should not move, measured: PSNR of the static pixels of a scene that moves, and how much its pictures flicker.

flicker   mean over static pixels and channels of the standard deviation over the moments of one camera, 8-bit levels
static    white in the view's `static_path`; without one, pixels whose photographs deviate by at most STILL levels
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.metrics.images import Mask, psnr
from clsplat.metrics.perceptual import Image
from clsplat.scene.times import by_camera, camera_key, moments_of
from clsplat.scene.view import View, load_mask

STILL = 3.0  # levels of standard deviation: the noise of a camera; what moves through a pixel gives more
MOST_CAMERAS = 8  # whose sums are held, 48 bytes a pixel each
LEAST_MOMENTS = 2
FLICKER, OF_PHOTOGRAPHS, STATIC, SHARE = "flicker", "flicker_photographs", "psnr_static", "static_share"


@dataclass
class Spread:
    """Sums over the moments of one camera, exact in whole numbers, in whatever order they come."""

    count: int = 0
    total: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((), np.uint32))  # [H, W, 3]
    squares: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((), np.uint32))

    def add(self, image: Image) -> None:
        """Add an 8-bit image, [H, W, 3]."""
        values = image.astype(np.uint32)
        self.count += 1
        self.total, self.squares = self.total + values, self.squares + values * values

    def deviation(self) -> NDArray[np.float64]:
        """Return the standard deviation over the moments, [H, W, 3], levels."""
        mean = self.total / self.count
        return np.asarray(np.sqrt(np.maximum(self.squares / self.count - mean * mean, 0)))


@dataclass
class Station:
    """One camera: its renders, its photographs, and the pixels that may be static."""

    views: list[str] = field(default_factory=list)
    renders: Spread = field(default_factory=Spread)
    photographs: Spread = field(default_factory=Spread)
    counted: Mask | None = None  # static by the file, and counted by the masks of all moments
    told: bool = False  # whether a file says what is static


class Stillness:
    """Gathers the views of a measurement, camera by camera.

    Of a camera that shows one moment, as of one that moves, nothing is held.
    """

    def __init__(self, views: Sequence[View]) -> None:
        """views: all that are to be added, in any order."""
        cameras = [group for group in by_camera(views) if len(moments_of(group)) >= LEAST_MOMENTS]
        self._stations = {camera_key(group[0]): Station() for group in cameras[:MOST_CAMERAS]}

    @property
    def held(self) -> int:
        """The number of cameras whose sums are held."""
        return len(self._stations)

    def add(self, view: View, rendered: Image, photograph: Image, counted: Mask | None) -> dict[str, float]:
        """Take a view's 8-bit images, [H, W, 3]; return its PSNR of static pixels where a file says which these are."""
        still = static_pixels(view)
        known = still if counted is None else counted if still is None else still & counted
        if view.time is not None:
            self._gather(view, rendered, photograph, known, still is not None)
        if still is None or known is None or not known.any():
            return {}
        return {STATIC: psnr(rendered, photograph, known)}

    def _gather(self, view: View, rendered: Image, photograph: Image, known: Mask | None, told: bool) -> None:
        if (station := self._stations.get(camera_key(view))) is None:
            return
        station.views.append(view.name)
        station.renders.add(rendered)
        station.photographs.add(photograph)
        station.told |= told
        if known is not None:
            station.counted = known if station.counted is None else station.counted & known

    def figures(self) -> dict[str, dict[str, float]]:
        """Return the flicker of each view's camera by the name of the view; none of cameras with one moment."""
        found = dict[str, dict[str, float]]()
        for station in self._stations.values():
            if station.renders.count < LEAST_MOMENTS:
                continue
            shown, taken = station.renders.deviation(), station.photographs.deviation()
            still = np.ones(shown.shape[:2], bool) if station.counted is None else station.counted
            if not station.told:
                still = still & (taken.max(axis=2) <= STILL)
            if still.any():
                one = {FLICKER: float(shown[still].mean()), OF_PHOTOGRAPHS: float(taken[still].mean())}
                found |= {name: {**one, SHARE: float(still.mean())} for name in station.views}
        return found


def static_pixels(view: View) -> Mask | None:
    """Return which pixels of a view show nothing that moves, [H, W]; None where no file says that."""
    if view.static_path is None:
        return None
    return load_mask(replace(view, mask_path=view.static_path, alpha="transparency"))


def means(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each figure over the views that have it, in the order in which the figures came."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}
