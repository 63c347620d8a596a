"""The photographs of a run as small files, read when a page asks for them, and kept as long as there is room."""

import os
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from clsplat.live.budget import Budget
from clsplat.pages.page import shrunk
from clsplat.scene.photographs import load_photograph
from clsplat.scene.view import View
from clsplat.viewer.photographs import LARGEST, THUMBNAIL

Kind = Literal["thumbnail", "photograph"]
SIDES: dict[Kind, int] = {"thumbnail": THUMBNAIL, "photograph": LARGEST}
QUALITY = 88  # of JPEG
ROOM = 48 << 20  # bytes that are kept
PATIENCE = 20.0  # s that a page waits for its share of the time


class Pictures:
    """Reads one photograph at a time.  Its time on all processors counts as that of a drawn picture."""

    def __init__(
        self, views: Sequence[View], background: tuple[float, float, float], undistorted: Path | None, budget: Budget
    ) -> None:
        self.views, self._background, self._undistorted, self._budget = views, background, undistorted, budget
        self._kept: OrderedDict[tuple[Kind, int], bytes] = OrderedDict()  # least recently used first
        self._lock = threading.Lock()

    def get(self, kind: Kind, index: int) -> bytes | None:
        """Return a JPEG; None where there is no time for it now.  Raises DataError where it cannot be read."""
        if not self._lock.acquire(timeout=PATIENCE):
            return None
        try:
            if (kind, index) not in self._kept:
                if not self._in_time():
                    return None
                self._read(index)
            self._kept.move_to_end((kind, index))
            return self._kept[kind, index]
        finally:
            self._lock.release()

    def _in_time(self) -> bool:
        end = time.monotonic() + PATIENCE
        while self._budget.credit <= 0:
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

    def _read(self, index: int) -> None:
        """Read a photograph, and keep all of its sizes."""
        started = time.thread_time()
        pixels = load_photograph(self.views[index], self._background, self._undistorted)[:, :, :3]
        for kind, side in SIDES.items():
            bgr = np.ascontiguousarray(shrunk(pixels, side)[..., ::-1])
            _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            self._kept[kind, index] = data.tobytes()
        while len(self._kept) > len(SIDES) and sum(map(len, self._kept.values())) > ROOM:
            self._kept.popitem(last=False)
        self._budget.spend((time.thread_time() - started) / (os.cpu_count() or 1))
