"""Render previews of the model in training, in separate memory; the run's state is only read."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import MemoryLimitError
from clsplat.core.page import shrink
from clsplat.core.progress import Progress
from clsplat.metrics.views import render_view
from clsplat.render.camera import upload_camera
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.rasterizer import RenderLimits as Limits
from clsplat.scene.photographs import load_photograph
from clsplat.scene.view import View
from clsplat.training.run import Run
from clsplat.training.status import StatusFile
from clsplat.viewer.page import LARGEST, THUMBNAIL

# Pictures that pages wait for, from a few at a time.

MAX_WAITING = 4  # requests
Pace = Literal["moving", "still", "again"]  # the camera moves; it just stopped; it stands still


@dataclass(frozen=True)
class EncodedPicture:
    """An encoded image, and the step that it shows."""

    jpeg: bytes
    step: int


@dataclass(eq=False)
class PageCamera:
    """The camera of a page."""

    page: int  # identifies the page
    view: View
    pace: Pace
    done: threading.Event = field(default_factory=threading.Event)
    picture: EncodedPicture | None = None


class Orders:
    """A short queue between the threads of the server and the training thread."""

    def __init__(self) -> None:
        self._waiting: deque[PageCamera] = deque()
        self._changed = threading.Condition()

    def ask(self, order: PageCamera, seconds: float) -> bool:
        """Wait for the preview of an order, which replaces one that its page still waits for.

        Returns False where too many wait; the order has no picture when the time was too short.
        """
        with self._changed:
            before = next((other for other in self._waiting if other.page == order.page), None)
            if before is None and len(self._waiting) >= MAX_WAITING:
                return False
            if before is not None:
                self._waiting.remove(before)
                before.done.set()
            self._waiting.append(order)
            self._changed.notify_all()
        order.done.wait(seconds)
        self._drop(order)
        return True

    def _drop(self, order: PageCamera) -> None:
        with self._changed:
            if order in self._waiting:
                self._waiting.remove(order)

    def first(self) -> PageCamera | None:
        """Return the order that has waited longest, those of moving cameras first."""
        with self._changed:
            return min(self._waiting, key=lambda order: order.pace == "again", default=None)

    def deliver(self, order: PageCamera, picture: EncodedPicture | None) -> None:
        """End the wait."""
        self._drop(order)
        order.picture = picture
        order.done.set()

    def wait(self, seconds: float) -> None:
        """Wait until there is a request, or the pause ends."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(seconds)

    def wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def __bool__(self) -> bool:
        return bool(self._waiting)


LOG = logging.getLogger("clsplat")
SIDES = (400, 280, 200, 140)  # px, the longer side
AIMS: dict[Pace, float] = {"moving": 0.04, "still": 0.4, "again": 0.4}  # s per preview, which determine its size
GUESS = 0.03  # s, before the first measurement
QUALITY = 85  # of JPEG
MAX_PAIRS = 1 << 23  # in memory at a time, about 100 MB; frames with more are rendered in bands
ROOM = 0.95  # fraction of the device's memory that may be used


class Preview:
    """Renders the model of a run between its steps."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._rasterizer: Rasterizer | None = None
        self._costs: dict[int, float] = {}  # s, of the last preview of each size

    def cost(self, pace: Pace) -> float:
        """Return the estimated time of the next preview, s."""
        return self._estimate(self._side(pace))

    def draw(self, order: PageCamera) -> EncodedPicture:
        """Render an order.  Raises MemoryLimitError if the device has no memory left next to the training."""
        side, rasterizer = self._side(order.pace), self._opened()
        started = time.perf_counter()
        view = fitted(order.view, side)
        camera = upload_camera(self.run.device, view)
        image = render_view(self.run.painter(rasterizer), camera)
        jpeg = encoded(image, QUALITY)
        self._costs[side] = time.perf_counter() - started
        return EncodedPicture(jpeg, self.run.step)

    def release(self) -> None:
        """Free the memory."""
        self._rasterizer = None

    def _opened(self) -> Rasterizer:
        device, training = self.run.device, self.run.rasterizer
        if device.allocated + training.workspace.nbytes > ROOM * device.info.memory:
            self.release()
            raise MemoryLimitError("the training leaves no device memory for previews")
        if self._rasterizer is None:
            limits = Limits(min(MAX_PAIRS, training.budget.pairs), training.budget.tiles)
            sort = training.tiler.sort
            self._rasterizer = Rasterizer(device, "radix" if sort == "auto" else sort, limits)
            self._costs.clear()
        return self._rasterizer

    def _side(self, pace: Pace) -> int:
        """Return the largest size whose preview is fast enough."""
        return next((side for side in SIDES if self._estimate(side) <= AIMS[pace]), SIDES[-1])

    def _estimate(self, side: int) -> float:
        """Return the time of the last preview of a size, or an estimate from others by area."""
        if side in self._costs:
            return self._costs[side]
        return max((cost * min(1.0, (side / known) ** 2) for known, cost in self._costs.items()), default=GUESS)


def fitted(view: View, side: int) -> View:
    """Return a view of at most `side` px."""
    camera = view.camera
    factor = max(camera.width, camera.height) / side
    return view if factor <= 1 else replace(view, camera=camera.downscaled(factor))


# A share of the time, saved up to a limit.


class Credit:
    """A budget that grows with time, for callers that may use a fraction `share` of the time."""

    def __init__(self, share: float, most: float, clock: Callable[[], float] = time.monotonic) -> None:
        """share: credit per second; most: largest credit, which limits bursts after a rest."""
        self.share, self.most, self.spent = share, most, 0.0
        self._clock, self._credit, self._at = clock, 0.0, clock()
        self._lock = threading.Lock()

    @property
    def credit(self) -> float:
        """The time that may be spent now; negative after an expense larger than its estimate."""
        with self._lock:
            return self._grown()

    def spend(self, amount: float) -> None:
        """Subtract an expense from the credit."""
        with self._lock:
            self._credit = self._grown() - amount
            self.spent += amount

    def skip(self) -> None:
        """Give no credit for the time since the last call."""
        with self._lock:
            self._at = self._clock()

    def _grown(self) -> float:
        now = self._clock()
        self._credit = min(self.most, self._credit + self.share * (now - self._at))
        self._at = now
        return self._credit


# The photographs of a run as small files, read when a page asks for them; its browser keeps them.

Kind = Literal["thumbnail", "photograph"]
JPEG_SIDES: dict[Kind, int] = {"thumbnail": THUMBNAIL, "photograph": LARGEST}
JPEG_QUALITY = 88
PATIENCE = 20.0  # s that a page waits for its turn


class Pictures:
    """Reads one photo at a time.  Its CPU time counts as rendering time."""

    def __init__(
        self, views: Sequence[View], background: tuple[float, float, float], undistorted: Path | None, budget: Credit
    ) -> None:
        self.views, self._background, self._undistorted, self._budget = views, background, undistorted, budget
        self._lock = threading.Lock()

    def get(self, kind: Kind, index: int) -> bytes | None:
        """Return a JPEG; None if there is no time for it now.  Raises DataError if the photo cannot be read."""
        if not self._lock.acquire(timeout=PATIENCE):
            return None
        try:
            return self._read(kind, index) if self._in_time() else None
        finally:
            self._lock.release()

    def _in_time(self) -> bool:
        end = time.monotonic() + PATIENCE
        while self._budget.credit <= 0:
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

    def _read(self, kind: Kind, index: int) -> bytes:
        started = time.thread_time()
        pixels = load_photograph(self.views[index], self._background, self._undistorted)[:, :, :3]
        data = encoded(shrink(pixels, JPEG_SIDES[kind]), JPEG_QUALITY)
        self._budget.spend((time.thread_time() - started) / (os.cpu_count() or 1))
        return data


def encoded(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return an RGB image, [height, width, 3], as a JPEG."""
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


# What the reports of a run say, as points of curves.

MAX_POINTS = 600  # of more, every second point is dropped
Point = tuple[int, float, float, int | None]  # step, loss, PSNR in dB, Gaussians


class Curves:
    """The points of one run, in order of steps."""

    def __init__(self, points: list[Point]) -> None:
        self._points = points
        self._thin()

    def add(self, progress: Progress) -> None:
        self._points.append((progress.step, round(progress.loss, 6), round(progress.psnr, 3), progress.gaussians))
        self._thin()

    def after(self, step: int) -> list[Point]:
        """Return the points after a step."""
        return [point for point in list(self._points) if point[0] > step]

    def _thin(self) -> None:
        while len(self._points) > MAX_POINTS:
            self._points = [*self._points[:-1:2], self._points[-1]]


# What the thread that trains and the threads that answer share.

SHARE = 0.025  # of the time, for previews; waiting for the device and answering cost about as much again
SAVED = 1.0  # s of it that are saved for moving cameras
RESERVE = 0.3  # s of those that previews of still cameras do not use


@dataclass(frozen=True)
class ShownRun:
    """What a page shows of one run; each run of a matrix has another number."""

    number: int
    title: str
    views: tuple[View, ...]
    scene: dict[str, Any]  # what live.js reads
    pictures: Pictures
    curves: Curves


@dataclass
class Desk:
    """The state of a live preview; each field has one writer, which replaces it as a whole."""

    orders: Orders = field(default_factory=Orders)
    budget: Credit = field(default_factory=lambda: Credit(SHARE, SAVED))
    status: StatusFile | None = None
    shown: ShownRun | None = None
    step: int = 0  # of the model that can be rendered; 0: there is none
    paused: bool = False
    ended: bool = False
    is_end_sent: bool = False  # whether a page knows that it ended
    fault: str = ""  # why there are no previews
    heard: float = float("-inf")  # time of the last request of a page

    def hear(self) -> None:
        """Record a request of a page."""
        self.heard = time.monotonic()

    def silent(self) -> float:
        """Return the time since the last request of a page, s."""
        return time.monotonic() - self.heard

    def pause(self, paused: bool) -> None:
        """Pause or resume the training."""
        self.paused = paused
        self.orders.wake()
