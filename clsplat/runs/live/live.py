"""Run the live preview: the part of it in the training thread."""

import logging
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from clsplat.core.errors import ClsplatError
from clsplat.core.progress import Progress
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.runs.live.preview import RESERVE, Curves, Desk, PageCamera, Pictures, Preview, ShownRun
from clsplat.runs.live.server import LOOPBACK, Answers, Server, scene_data
from clsplat.scene.scene import position_text
from clsplat.scene.viewpoint import Viewpoint
from clsplat.training.run import Run
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")
LOOKING = 5.0  # s after its last request that a page counts as open; then the memory of previews is freed
ABSENT = 120.0  # s without a request that end a pause; background pages ask once a minute
FAREWELL = 1.5  # s that a finished run waits for the page to learn of its end
TOKEN = 16  # bytes


class Live:
    """Serves a page while runs train, one after another.  As a context manager, it stops the server at the end."""

    def __init__(self, port: int = 0) -> None:
        """port: on the loopback address; 0: the default one, or the next free one.  Raises ConfigError."""
        self.desk = Desk()
        self._preview: Preview | None = None
        self._server = Server(port, secrets.token_urlsafe(TOKEN), Answers(self.desk))

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        return f"http://{LOOPBACK}:{self._server.port}/{self._server.token}/"

    @property
    def text(self) -> str:
        """The address of the page, and how to reach it from another machine."""
        port = self._server.port
        return (
            f"live preview: {self.address}\n"
            f"  from another machine: `ssh -L {port}:{LOOPBACK}:{port} HOST`, then that address"
        )

    def close(self) -> None:
        """Stop the server, once an open page knows how the run ended."""
        desk = self.desk
        desk.pause(False)
        desk.ended = True
        try:
            end = time.monotonic() + FAREWELL
            while desk.silent() < LOOKING and not desk.is_end_sent and time.monotonic() < end:
                self._leave()  # a page that waits for a preview makes no other request
                time.sleep(0.05)
        finally:
            self._server.stop()
            self._leave()

    def follow(self, status: StatusFile) -> None:
        """Show the state of a run that starts."""
        self.desk.status = status

    @contextmanager
    def showing(self, run: Run) -> Iterator[None]:
        """Show the model and the reports of a run during the block."""
        self._enter(run)
        try:
            yield
        finally:
            run.on_step = lambda: None
            self._leave()

    def reporting(self, show: Callable[[Progress], None]) -> Callable[[Progress], None]:
        """Return a function that shows a report as `show` does, and on the page."""

        def both(progress: Progress) -> None:
            show(progress)
            if shown := self.desk.shown:
                shown.curves.add(progress)

        return both

    def _enter(self, run: Run) -> None:
        desk, scene = self.desk, run.scene.downscaled(run.downscale)
        number = desk.shown.number + 1 if desk.shown else 1
        title, test = f"{run.name} · {run.scene_name}", scene.split("test")
        if scene.origin.any():
            title += f" · origin {position_text(scene.origin)}"
        points = run.original.points.positions if run.original.points else np.zeros((0, 3), np.float32)
        stand = Viewpoint.from_points(points, scene.views, (test or scene.views)[0])
        data = scene_data(number, title, scene.views, {view.name for view in test}, stand)
        photographs = run.photographs
        background = BACKGROUNDS[photographs.background_name]
        pictures = Pictures(scene.views, background, photographs.undistorted, desk.budget)
        desk.step, desk.fault = 0, ""
        desk.shown = ShownRun(number, title, scene.views, data, pictures, Curves([]))
        self._preview = Preview(run)
        run.on_step = lambda: self._on_step(run)
        desk.budget.skip()

    def _leave(self) -> None:
        """Release the run, as its model may be large."""
        self.desk.step, self._preview = 0, None
        while order := self.desk.orders.first():
            self.desk.orders.deliver(order, None)

    def _on_step(self, run: Run) -> None:
        """Render requested previews, if there is time; wait while the page pauses the training."""
        desk, preview = self.desk, self._preview
        if preview is None or not (run.has_model and run.is_consistent):
            return
        desk.step = max(run.step, 1)
        if desk.orders:
            self._draw(run, preview)
        elif desk.silent() > LOOKING:
            preview.release()
        if desk.paused and not run.interrupted:
            self._pause(run, preview)

    def _draw(self, run: Run, preview: Preview, free: bool = False) -> None:
        """Render the first request, if there is time for it.  free: the training is paused anyway."""
        order = self.desk.orders.first()
        if order is None:
            return
        kept = RESERVE if order.pace == "again" else 0.0
        if not free and self.desk.budget.credit < preview.cost(order.pace) + kept:
            return
        started = time.perf_counter()
        run.device.finish()
        if (
            run.device.info.kind == "CPU"
        ):  # on a CPU only the time of rendering is lost; on a GPU also the queue of the host
            started = time.perf_counter()
        self._deliver(order, preview)
        if not free:
            self.desk.budget.spend(time.perf_counter() - started)

    def _deliver(self, order: PageCamera, preview: Preview) -> None:
        """Render a request; failures are shown on the page, and the training continues."""
        try:
            self.desk.orders.deliver(order, preview.draw(order))
            self.desk.fault = ""
        except ClsplatError as error:
            self.desk.orders.deliver(order, None)
            self.desk.fault = str(error)

    def _pause(self, run: Run, preview: Preview) -> None:
        """Wait until the page resumes the training, nobody looks for a while, or the run should stop."""
        desk = self.desk
        LOG.info("paused at step %d from the live page", run.step)
        with run.status.stage("paused"):
            while desk.paused and not run.interrupted:
                if desk.silent() > ABSENT:
                    LOG.info("no live page for %.0f s", ABSENT)
                    desk.pause(False)
                elif desk.orders:
                    self._draw(run, preview, free=True)
                else:
                    desk.orders.wait(0.2)
        desk.budget.skip()
        LOG.info("resumed" if not run.interrupted else "stopping")
