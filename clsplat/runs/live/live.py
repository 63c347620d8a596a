"""Run the live preview in the training thread: render requested images between steps, and pause on request."""

import logging
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from clsplat.core.errors import ClsplatError
from clsplat.core.progress import Progress
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.runs.live.preview import RESERVE, Curves, EncodedPhotos, LiveRun, LiveState, Preview, PreviewRequest
from clsplat.runs.live.server import LOOPBACK, Handlers, Server, scene_data
from clsplat.scene.scene import format_position
from clsplat.scene.viewpoint import Viewpoint
from clsplat.training.run import Run
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")
OPEN_TIMEOUT = 5.0  # s without a request until a page counts as closed, and the memory of previews is freed
PAUSE_TIMEOUT = 120.0  # s without a request until a pause ends; background tabs send one request per minute
END_TIMEOUT = 1.5  # s that a finished run waits for the page to receive the end of the run
TOKEN_BYTES = 16  # number of random bytes


class Live:
    """A page that shows runs while they train, one after another; a context manager that stops the server on exit."""

    def __init__(self, port: int = 0) -> None:
        """port: on the loopback address; 0: the first free default port.  Raises ConfigError if the port is in use."""
        self.state = LiveState()
        self._preview: Preview | None = None
        self._server = Server(port, secrets.token_urlsafe(TOKEN_BYTES), Handlers(self.state))

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        return f"http://{LOOPBACK}:{self._server.port}/{self._server.token}/"

    @property
    def message(self) -> str:
        """A message with the address of the page, and the command for access from another machine."""
        port = self._server.port
        return (
            f"live preview: {self.address}\n"
            f"  from another machine: `ssh -L {port}:{LOOPBACK}:{port} HOST`, then open that address"
        )

    def close(self) -> None:
        """Stop the server.  If a page is open, first wait briefly until it has been notified of the end."""
        state = self.state
        state.set_paused(False)
        state.has_ended = True
        try:
            deadline = time.monotonic() + END_TIMEOUT
            while state.idle_seconds() < OPEN_TIMEOUT and not state.is_end_sent and time.monotonic() < deadline:
                self._release()  # a page that waits for a preview makes no other request
                time.sleep(0.05)
        finally:
            self._server.stop()
            self._release()

    def follow(self, status: StatusFile) -> None:
        """Show the status of a run that is starting."""
        self.state.status = status

    @contextmanager
    def showing(self, run: Run) -> Iterator[None]:
        """Show the model and the progress reports of a run during the block."""
        self._attach(run)
        try:
            yield
        finally:
            run.on_step = lambda: None
            self._release()

    def reporting(self, show: Callable[[Progress], None]) -> Callable[[Progress], None]:
        """Return a function that shows each progress report on the page and passes it to `show`."""

        def show_both(progress: Progress) -> None:
            show(progress)
            if run := self.state.run:
                run.curves.add(progress)

        return show_both

    def _attach(self, run: Run) -> None:
        state, scene = self.state, run.scene.downscaled(run.downscale)
        run_number = state.run.number + 1 if state.run else 1
        title, test_views = f"{run.name} · {run.scene_name}", scene.split("test")
        if scene.origin.any():
            title += f" · origin {format_position(scene.origin)}"
        points = run.original.points.positions if run.original.points else np.zeros((0, 3), np.float32)
        viewpoint = Viewpoint.from_points(points, scene.views, (test_views or scene.views)[0])
        page_data = scene_data(run_number, title, scene.views, {view.name for view in test_views}, viewpoint)
        photographs = run.photographs
        background = BACKGROUNDS[photographs.background_name]
        photos = EncodedPhotos(scene.views, background, photographs.undistorted, state.budget)
        state.step, state.error = 0, ""
        state.run = LiveRun(run_number, title, scene.views, page_data, photos, Curves([]))
        self._preview = Preview(run)
        run.on_step = lambda: self._on_step(run)
        state.budget.skip()

    def _release(self) -> None:
        """Drop the reference to the run, whose model may be large, and answer pending requests without an image."""
        self.state.step, self._preview = 0, None
        while request := self.state.requests.first():
            self.state.requests.deliver(request, None)

    def _on_step(self, run: Run) -> None:
        """Render a requested preview if the time budget allows it, and wait while the page pauses the training."""
        state, preview = self.state, self._preview
        if preview is None or not (run.has_model and run.is_consistent):
            return
        state.step = max(run.step, 1)
        if state.requests:
            self._draw(run, preview)
        elif state.idle_seconds() > OPEN_TIMEOUT:
            preview.release()
        if state.is_paused and not run.interrupted:
            self._pause(run, preview)

    def _draw(self, run: Run, preview: Preview, is_paused: bool = False) -> None:
        """Render the first request.  Do nothing if the time budget does not allow it, unless the training is paused."""
        request = self.state.requests.first()
        if request is None:
            return
        reserve = RESERVE if request.pace == "again" else 0.0
        if not is_paused and self.state.budget.credit < preview.cost(request.pace) + reserve:
            return
        start_time = time.perf_counter()
        run.device.finish()
        # on a GPU, the wait for the queue counts too, because the training also waits
        if run.device.info.kind == "CPU":
            start_time = time.perf_counter()
        self._deliver(request, preview)
        if not is_paused:
            self.state.budget.spend(time.perf_counter() - start_time)

    def _deliver(self, request: PreviewRequest, preview: Preview) -> None:
        """Render a request and deliver the image.  A failure is shown on the page, and does not stop the training."""
        try:
            self.state.requests.deliver(request, preview.draw(request))
            self.state.error = ""
        except ClsplatError as error:
            self.state.requests.deliver(request, None)
            self.state.error = str(error)

    def _pause(self, run: Run, preview: Preview) -> None:
        """Wait until the page resumes the training, the last page is closed, or the run is interrupted."""
        state = self.state
        LOG.info("paused at step %d from the live page", run.step)
        with run.status.stage("paused"):
            while state.is_paused and not run.interrupted:
                if state.idle_seconds() > PAUSE_TIMEOUT:
                    LOG.info("no live page connected for %.0f s; resuming training", PAUSE_TIMEOUT)
                    state.set_paused(False)
                elif state.requests:
                    self._draw(run, preview, is_paused=True)
                else:
                    state.requests.wait(0.2)
        state.budget.skip()
        LOG.info("resumed" if not run.interrupted else "stopping")
