"""Pictures of the model in training, with memory of their own: the run's state is read and never changed."""

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

MOST = 4  # that wait at a time
Pace = Literal["moving", "still", "again"]  # in motion; at rest for the first time; the same once more


@dataclass(frozen=True)
class EncodedPicture:
    """An encoded picture, and the step that it shows."""

    jpeg: bytes
    step: int


@dataclass(eq=False)
class PageCamera:
    """A camera that a page looks through."""

    page: int  # a number that tells pages apart
    view: View
    pace: Pace
    done: threading.Event = field(default_factory=threading.Event)
    picture: EncodedPicture | None = None


class Orders:
    """A short queue between the threads that answer and the one that trains."""

    def __init__(self) -> None:
        self._waiting: deque[PageCamera] = deque()
        self._changed = threading.Condition()

    def ask(self, order: PageCamera, seconds: float) -> bool:
        """Wait for the picture of an order, in the place of one that its page still waits for.

        Returns False where too many wait; the order has no picture when the time was too short.
        """
        with self._changed:
            before = next((other for other in self._waiting if other.page == order.page), None)
            if before is None and len(self._waiting) >= MOST:
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
        """The order that has waited longest for a picture of a camera in motion, else of one at rest."""
        with self._changed:
            return min(self._waiting, key=lambda order: order.pace == "again", default=None)

    def deliver(self, order: PageCamera, picture: EncodedPicture | None) -> None:
        """End the wait."""
        self._drop(order)
        order.picture = picture
        order.done.set()

    def wait(self, seconds: float) -> None:
        """Wait until something is asked for, or the pause ends."""
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

    def draw(self, order: PageCamera) -> EncodedPicture:
        """Draw what an order asks for.  Raises MemoryLimitError where the device has no room beside the training."""
        side, rasterizer = self._side(order.pace), self._opened()
        started = time.perf_counter()
        view = fitted(order.view, side)
        camera = upload_camera(self.run.device, view)
        image = render_view(self.run.painter(rasterizer), camera)
        jpeg = encoded(image, QUALITY)
        self._costs[side] = time.perf_counter() - started
        return EncodedPicture(jpeg, self.run.step)

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


# A share of the time, saved up to a limit.


class Credit:
    """Credit that grows with time: who asks before an expense spends no more than `share` of the time that passed."""

    def __init__(self, share: float, most: float, clock: Callable[[], float] = time.monotonic) -> None:
        """share: credit a second; most: credit that is kept: a rest is followed by a burst and not by a flood."""
        self.share, self.most, self.spent = share, most, 0.0
        self._clock, self._credit, self._at = clock, 0.0, clock()
        self._lock = threading.Lock()

    @property
    def credit(self) -> float:
        """What may be spent now; negative after an expense that was larger than its estimate."""
        with self._lock:
            return self._grown()

    def spend(self, amount: float) -> None:
        """Take an expense off the credit."""
        with self._lock:
            self._credit = self._grown() - amount
            self.spent += amount

    def skip(self) -> None:
        """Let the time since the last question give no credit."""
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
PATIENCE = 20.0  # s that a page waits for its share of the time


class Pictures:
    """Reads one photograph at a time.  Its time on all processors counts as that of a drawn picture."""

    def __init__(
        self, views: Sequence[View], background: tuple[float, float, float], undistorted: Path | None, budget: Credit
    ) -> None:
        self.views, self._background, self._undistorted, self._budget = views, background, undistorted, budget
        self._lock = threading.Lock()

    def get(self, kind: Kind, index: int) -> bytes | None:
        """Return a JPEG; None where there is no time for it now.  Raises DataError where it cannot be read."""
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

MAX_POINTS = 600  # points that are kept: of more, every second one goes
Point = tuple[int, float, float, int | None]  # step, loss, PSNR in dB, Gaussians


class Curves:
    """The points of one run, in the order of their steps."""

    def __init__(self, points: list[Point]) -> None:
        self._points = points
        self._thin()

    def add(self, progress: Progress) -> None:
        self._points.append((progress.step, round(progress.loss, 6), round(progress.psnr, 3), progress.gaussians))
        self._thin()

    def after(self, step: int) -> list[Point]:
        """Return the points behind a step."""
        return [point for point in list(self._points) if point[0] > step]

    def _thin(self) -> None:
        while len(self._points) > MAX_POINTS:
            self._points = [*self._points[:-1:2], self._points[-1]]


# What the thread that trains and the threads that answer share.

SHARE = 0.025  # of the time, for pictures; the lead that the host loses by each, and answers, cost about as much again
SAVED = 1.0  # s of it that are kept for a motion
RESERVE = 0.3  # s of those that pictures of a camera at rest leave alone


@dataclass(frozen=True)
class ShownRun:
    """What a page needs to know of one run; another run of a matrix has another number."""

    number: int
    title: str
    views: tuple[View, ...]
    scene: dict[str, Any]  # what live.js reads
    pictures: Pictures
    curves: Curves


@dataclass
class Desk:
    """The state of a live preview; each field is written by one side and replaced as a whole."""

    orders: Orders = field(default_factory=Orders)
    budget: Credit = field(default_factory=lambda: Credit(SHARE, SAVED))
    status: StatusFile | None = None
    shown: ShownRun | None = None
    step: int = 0  # of the model that can be drawn; 0: none can
    paused: bool = False
    ended: bool = False
    told: bool = False  # that it has ended, to a page
    fault: str = ""  # why there are no pictures
    heard: float = float("-inf")  # when a page last asked

    def hear(self) -> None:
        """Note that somebody looks."""
        self.heard = time.monotonic()

    def silent(self) -> float:
        """Return for how long no page has asked, s."""
        return time.monotonic() - self.heard

    def pause(self, paused: bool) -> None:
        """Let the training wait, or go on."""
        self.paused = paused
        self.orders.wake()
