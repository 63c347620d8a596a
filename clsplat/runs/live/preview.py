"""Render previews of the model during training, in separate device memory, without changing the run."""

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
from clsplat.core.page import downscale
from clsplat.core.progress import Progress
from clsplat.metrics.views import render_view
from clsplat.render.camera import upload_camera
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.rasterizer import RenderLimits as Limits
from clsplat.scene.photographs import load_photograph
from clsplat.scene.view import View
from clsplat.training.run import Run
from clsplat.training.status import StatusFile
from clsplat.viewer.page import PHOTO_SIDE, THUMBNAIL_SIDE

# The queue of preview requests.

MAX_WAITING = 4  # requests
Pace = Literal["moving", "still", "again"]  # the camera moves, has just stopped, or has stopped some time ago


@dataclass(frozen=True)
class EncodedImage:
    """An encoded image, and the training step that it shows."""

    jpeg: bytes
    step: int


@dataclass(eq=False)
class PreviewRequest:
    """A request by a page for a preview from its camera."""

    page: int  # ID of the page
    view: View
    pace: Pace
    done: threading.Event = field(default_factory=threading.Event)
    image: EncodedImage | None = None


class RequestQueue:
    """A short queue of requests from the threads of the server to the training thread."""

    def __init__(self) -> None:
        self._requests: deque[PreviewRequest] = deque()
        self._changed = threading.Condition()

    def wait_for(self, request: PreviewRequest, seconds: float) -> bool:
        """Add a request, which replaces an earlier request of the same page, and wait for its preview.

        Returns False if the queue is full.  After a timeout, `request.image` is None.
        """
        with self._changed:
            earlier = next((other for other in self._requests if other.page == request.page), None)
            if earlier is None and len(self._requests) >= MAX_WAITING:
                return False
            if earlier is not None:
                self._requests.remove(earlier)
                earlier.done.set()
            self._requests.append(request)
            self._changed.notify_all()
        request.done.wait(seconds)
        self._drop(request)
        return True

    def _drop(self, request: PreviewRequest) -> None:
        with self._changed:
            if request in self._requests:
                self._requests.remove(request)

    def first(self) -> PreviewRequest | None:
        """Return the oldest request, or None if there is none.  Repeated requests for the same camera come last."""
        with self._changed:
            return min(self._requests, key=lambda request: request.pace == "again", default=None)

    def deliver(self, request: PreviewRequest, image: EncodedImage | None) -> None:
        """Remove a request from the queue, and pass the image to the thread that waits for it; None: not rendered."""
        self._drop(request)
        request.image = image
        request.done.set()

    def wait(self, seconds: float) -> None:
        """Wait until there is a request or `wake` is called, but at most for a number of seconds."""
        with self._changed:
            if not self._requests:
                self._changed.wait(seconds)

    def wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def __bool__(self) -> bool:
        return bool(self._requests)


LOG = logging.getLogger("clsplat")
SIDES = (400, 280, 200, 140)  # px, the longer side
TARGET_TIMES: dict[Pace, float] = {"moving": 0.04, "still": 0.4, "again": 0.4}  # s per preview; determines its size
INITIAL_COST = 0.03  # s per preview, before the first measurement
QUALITY = 85  # of the JPEG
MAX_PAIRS = 1 << 23  # pairs in memory at a time, about 100 MB; frames with more pairs are rendered in bands
MAX_MEMORY = 0.95  # fraction of the device's memory that may be used


class Preview:
    """Renders the model of a run between its steps."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._rasterizer: Rasterizer | None = None
        self._costs: dict[int, float] = {}  # time of the last preview, s, by image side

    def cost(self, pace: Pace) -> float:
        """Return the estimated time of the next preview, s."""
        return self._estimate(self._side(pace))

    def draw(self, request: PreviewRequest) -> EncodedImage:
        """Render a preview.  Raises MemoryLimitError if the training leaves no device memory."""
        side, rasterizer = self._side(request.pace), self._open_rasterizer()
        start_time = time.perf_counter()
        view = downscaled_view(request.view, side)
        camera = upload_camera(self.run.device, view)
        image = render_view(self.run.painter(rasterizer), camera)
        jpeg = encode_jpeg(image, QUALITY)
        self._costs[side] = time.perf_counter() - start_time
        return EncodedImage(jpeg, self.run.step)

    def release(self) -> None:
        """Free the device memory of previews."""
        self._rasterizer = None

    def _open_rasterizer(self) -> Rasterizer:
        device, training = self.run.device, self.run.rasterizer
        if device.allocated + training.workspace.nbytes > MAX_MEMORY * device.info.memory:
            self.release()
            raise MemoryLimitError("training leaves no device memory for previews")
        if self._rasterizer is None:
            limits = Limits(min(MAX_PAIRS, training.budget.pairs), training.budget.tiles)
            self._rasterizer = Rasterizer(device, training.tiler.sort, limits)
            self._costs.clear()
        return self._rasterizer

    def _side(self, pace: Pace) -> int:
        """Return the largest image side, px, for which previews are fast enough; the smallest side if there is none."""
        return next((side for side in SIDES if self._estimate(side) <= TARGET_TIMES[pace]), SIDES[-1])

    def _estimate(self, side: int) -> float:
        """Return the time in seconds of the last preview with this image side.

        If there was none, estimate the time from previews of other sizes, in proportion to their area.
        """
        if side in self._costs:
            return self._costs[side]
        return max((cost * min(1.0, (side / size) ** 2) for size, cost in self._costs.items()), default=INITIAL_COST)


def downscaled_view(view: View, side: int) -> View:
    """Return the view, downscaled so that its longer side has at most `side` px."""
    camera = view.camera
    factor = max(camera.width, camera.height) / side
    return view if factor <= 1 else replace(view, camera=camera.downscaled(factor))


# The time budget of previews.


class Credit:
    """A time budget that grows by a fraction of the elapsed time, up to a limit."""

    def __init__(self, rate: float, limit: float, clock: Callable[[], float] = time.monotonic) -> None:
        """rate: credit per second.  limit: maximum credit, which bounds the time used at once after a pause."""
        self.rate, self.limit, self.spent = rate, limit, 0.0
        self._clock, self._credit, self._updated = clock, 0.0, clock()
        self._lock = threading.Lock()

    @property
    def credit(self) -> float:
        """The time in seconds that previews may use now; negative after an overrun."""
        with self._lock:
            return self._update()

    def spend(self, amount: float) -> None:
        """Subtract a time in seconds from the credit."""
        with self._lock:
            self._credit = self._update() - amount
            self.spent += amount

    def skip(self) -> None:
        """Restart the clock of the credit, so that the time since the last update is not added."""
        with self._lock:
            self._updated = self._clock()

    def _update(self) -> float:
        now = self._clock()
        self._credit = min(self.limit, self._credit + self.rate * (now - self._updated))
        self._updated = now
        return self._credit


# The photos of a run as JPEG.  They are read when a page requests them, and the browser caches them.

Kind = Literal["thumbnail", "photograph"]
JPEG_SIDES: dict[Kind, int] = {"thumbnail": THUMBNAIL_SIDE, "photograph": PHOTO_SIDE}
JPEG_QUALITY = 88
PHOTO_TIMEOUT = 20.0  # s that a request for a photo waits


class EncodedPhotos:
    """Encodes photos as JPEG, one at a time.  The CPU time is subtracted from the budget of the previews."""

    def __init__(
        self, views: Sequence[View], background: tuple[float, float, float], undistorted: Path | None, budget: Credit
    ) -> None:
        self.views, self._background, self._undistorted, self._budget = views, background, undistorted, budget
        self._lock = threading.Lock()

    def get(self, kind: Kind, index: int) -> bytes | None:
        """Return a photo as JPEG, or None if the budget does not allow it within PHOTO_TIMEOUT.  Raises DataError."""
        if not self._lock.acquire(timeout=PHOTO_TIMEOUT):
            return None
        try:
            return self._read(kind, index) if self._wait_for_credit() else None
        finally:
            self._lock.release()

    def _wait_for_credit(self) -> bool:
        deadline = time.monotonic() + PHOTO_TIMEOUT
        while self._budget.credit <= 0:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.05)
        return True

    def _read(self, kind: Kind, index: int) -> bytes:
        start_time = time.thread_time()
        pixels = load_photograph(self.views[index], self._background, self._undistorted)[:, :, :3]
        data = encode_jpeg(downscale(pixels, JPEG_SIDES[kind]), JPEG_QUALITY)
        self._budget.spend((time.thread_time() - start_time) / (os.cpu_count() or 1))
        return data


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode an RGB image, (height, width, 3), as JPEG.  quality: from 0 to 100."""
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


# The progress reports of a run, as points of curves.

MAX_POINTS = 600  # beyond this, every second point is dropped
Point = tuple[int, float, float, int | None]  # step, loss, PSNR in dB, Gaussians


class Curves:
    """Curves of the loss, PSNR, and number of Gaussians of a run over its steps."""

    def __init__(self, points: list[Point]) -> None:
        self._points = points
        self._thin_history()

    def add(self, progress: Progress) -> None:
        self._points.append((progress.step, round(progress.loss, 6), round(progress.psnr, 3), progress.gaussians))
        self._thin_history()

    def after(self, step: int) -> list[Point]:
        """Return the points at steps greater than `step`."""
        return [point for point in list(self._points) if point[0] > step]

    def _thin_history(self) -> None:
        while len(self._points) > MAX_POINTS:
            self._points = [*self._points[:-1:2], self._points[-1]]


# The state shared by the training thread and the threads of the server.

RATE = 0.025  # fraction of the time for previews; waiting for the device and sending responses double the cost
MAX_CREDIT = 1.0  # s, saved for moving cameras
RESERVE = 0.3  # s of credit that repeated previews of still cameras must leave


@dataclass(frozen=True)
class LiveRun:
    """The run that the pages show.  The runs of a matrix have consecutive numbers."""

    number: int
    title: str
    views: tuple[View, ...]
    scene: dict[str, Any]  # data for live.js
    photos: EncodedPhotos
    curves: Curves


@dataclass
class LiveState:
    """The shared state of a live preview; each field is written by a single thread, which replaces it atomically."""

    requests: RequestQueue = field(default_factory=RequestQueue)
    budget: Credit = field(default_factory=lambda: Credit(RATE, MAX_CREDIT))
    status: StatusFile | None = None
    run: LiveRun | None = None
    step: int = 0  # training step of the model that can be rendered; 0 if there is none
    is_paused: bool = False
    has_ended: bool = False
    is_end_sent: bool = False  # whether a page has received the end of the run
    error: str = ""  # reason why there are no previews
    last_request: float = float("-inf")  # s, monotonic clock

    def note_request(self) -> None:
        """Record the time of a page's request."""
        self.last_request = time.monotonic()

    def idle_seconds(self) -> float:
        """Return the time since the last request of a page, s."""
        return time.monotonic() - self.last_request

    def set_paused(self, is_paused: bool) -> None:
        """Pause or resume the training."""
        self.is_paused = is_paused
        self.requests.wake()
