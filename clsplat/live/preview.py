"""Pictures of the model in training, with memory of their own: the run's state is read and never changed."""

import logging
import time
from dataclasses import replace

import cv2
import numpy as np

from clsplat.errors import MemoryLimitError
from clsplat.live.orders import Order, Pace, Picture
from clsplat.metrics.views import render_view
from clsplat.render.camera import upload_camera
from clsplat.render.rasterizer import Budget as Limits
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.view import View
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
SIDES = (400, 280, 200, 140)  # px, the longer side
AIMS: dict[Pace, float] = {"moving": 0.04, "still": 0.4, "again": 0.4}  # s for a picture, that choose its side
GUESS = 0.03  # s, before anything was measured
QUALITY = 85  # of JPEG
MAX_PAIRS = 1 << 23  # in memory at a time: 100 MB or so; frames with more are drawn in bands
ROOM = 0.95  # of the device's memory that may be in use


class Preview:
    """Draws the model of a run between its steps."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._rasterizer: Rasterizer | None = None
        self._costs: dict[int, float] = {}  # s, of the last picture of each side

    def cost(self, pace: Pace) -> float:
        """Return the estimated time of the next picture, s."""
        return self._estimate(self._side(pace))

    def draw(self, order: Order) -> Picture:
        """Draw what an order asks for.  Raises MemoryLimitError where the device has no room beside the training."""
        side, rasterizer = self._side(order.pace), self._opened()
        started = time.perf_counter()
        view = fitted(order.view, side)
        camera = upload_camera(self.run.device, view)
        image = render_view(self.run.painter(rasterizer), camera)
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        self._costs[side] = time.perf_counter() - started
        return Picture(data.tobytes(), self.run.step)

    def release(self) -> None:
        """Give the memory back."""
        self._rasterizer = None

    def _opened(self) -> Rasterizer:
        device, training = self.run.device, self.run.rasterizer
        if device.allocated + training.workspace.nbytes > ROOM * device.info.memory:
            self.release()
            raise MemoryLimitError("the device has no memory for pictures beside the training")
        if self._rasterizer is None:
            limits = Limits(min(MAX_PAIRS, training.budget.pairs), training.budget.tiles)
            sort = training.tiler.sort
            self._rasterizer = Rasterizer(device, "radix" if sort == "auto" else sort, limits)
            self._costs.clear()
        return self._rasterizer

    def _side(self, pace: Pace) -> int:
        """The largest side whose picture is cheap enough."""
        return next((side for side in SIDES if self._estimate(side) <= AIMS[pace]), SIDES[-1])

    def _estimate(self, side: int) -> float:
        """As long as the last one of that side, else by the area of those that are known."""
        if side in self._costs:
            return self._costs[side]
        return max((cost * min(1.0, (side / known) ** 2) for known, cost in self._costs.items()), default=GUESS)


def fitted(view: View, side: int) -> View:
    """Return a view whose picture has `side` px at most."""
    camera = view.camera
    factor = max(camera.width, camera.height) / side
    return view if factor <= 1 else replace(view, camera=camera.downscaled(factor))
