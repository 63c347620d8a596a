"""The answers of the server: the page, the scene, the state, pictures, and the two buttons."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast, get_args

import numpy as np

from clsplat.errors import DataError
from clsplat.formats.motion import EXPECTED, is_moment
from clsplat.live.desk import Desk, Shown
from clsplat.live.orders import Order, Pace
from clsplat.live.page import page
from clsplat.live.pictures import Kind
from clsplat.live.requests import Answer, Refused, Request
from clsplat.quaternions import rotation_matrix
from clsplat.scene.camera import Camera
from clsplat.scene.view import View

WAIT = 4.0  # s until a page that waits for a picture asks again
LARGEST = 1e9  # of a number of a camera
MAX_SIDE, MAX_ASPECT = 16384, 8.0  # of a picture that is asked for
STATUS_KEYS = {"state", "stage", "progress", "step", "steps", "gaussians", "seconds_left", "message", "device", "host"}


class Answers:
    """Answers requests, in any thread."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self._page = page()
        self._routes: dict[str, Callable[[Request], Answer]] = {
            "": lambda request: Answer(200, self._page, "text/html; charset=utf-8"),
            "state.json": self._state,
            "scene.json": self._scene,
            "frame.jpg": self._frame,
            "thumbnail.jpg": lambda request: self._picture(request, "thumbnail"),
            "photograph.jpg": lambda request: self._picture(request, "photograph"),
            "pause": lambda request: self._pause(True),
            "resume": lambda request: self._pause(False),
        }

    def __call__(self, request: Request) -> Answer:
        """Return the answer.  Raises Refused."""
        if (route := self._routes.get(request.path)) is None:
            raise Refused(404, "not found")
        self.desk.hear()
        return route(request)

    def _state(self, request: Request) -> Answer:
        desk, shown = self.desk, self.desk.shown
        ended = desk.ended  # at one time, before the rest: who hears of the end hears how it was
        status = desk.status.now.model_dump(include=STATUS_KEYS, exclude_none=True) if desk.status else {}
        state: dict[str, Any] = {**status, "scene": shown.number if shown else 0, "drawn": desk.step}
        state |= {"paused": desk.paused, "ended": ended, "fault": desk.fault}
        if shown:
            state["points"] = shown.curves.after(request.number("after", 0, 1 << 40))
        desk.told = desk.told or ended
        return Answer.json(state)

    def _scene(self, request: Request) -> Answer:
        return Answer.json(self._shown().scene)

    def _frame(self, request: Request) -> Answer:
        """A picture through a camera: of `view`, or `camera` as written by camera.js, at a `time` where one is given.

        204 when it is not ready yet.
        """
        desk, shown = self.desk, self._shown()
        pace = request.query.get("pace", "")
        if pace not in get_args(Pace):
            raise Refused(400, f"pace: expected one of {', '.join(get_args(Pace))}")
        if "view" in request.query:
            view = shown.views[request.number("view", 0, len(shown.views) - 1)]
        else:
            view = camera(request.query.get("camera", ""))
            if "time" in request.query:
                view = replace(view, time=moment(request.query["time"]))
        order = Order(request.number("page", 0, 1 << 40), view, cast(Pace, pace))
        if not desk.orders.ask(order, WAIT):
            raise Refused(503, "too many pictures are waited for")
        if order.picture is None:
            return Answer(204)
        return Answer(200, order.picture.jpeg, "image/jpeg", {"X-Step": str(order.picture.step)})

    def _picture(self, request: Request, kind: Kind) -> Answer:
        shown = self._shown()
        index = request.number("view", 0, len(shown.views) - 1)
        if request.query.get("scene") != str(shown.number):  # of an earlier run of a matrix
            raise Refused(404, "not found")
        try:
            data = shown.pictures.get(kind, index)
        except DataError as error:
            raise Refused(404, str(error)) from None
        if data is None:
            raise Refused(503, "no time for it; ask again")
        return Answer(200, data, "image/jpeg", {"Cache-Control": "private, max-age=3600"})

    def _pause(self, paused: bool) -> Answer:
        if not self.desk.ended:
            self.desk.pause(paused)
        return Answer.json({"paused": self.desk.paused})

    def _shown(self) -> Shown:
        if self.desk.shown is None:
            raise Refused(503, "no scene yet")
        return self.desk.shown


def moment(text: str) -> float:
    """Return a moment of the scene.  Raises Refused."""
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not is_moment(found):
        raise Refused(400, f"time: {EXPECTED}")
    return found


def camera(text: str) -> View:
    """Return the view that camera.js has written: eye; quaternion x, y, z, w; fx, fy, cx, cy, width, height.

    Raises Refused.
    """
    try:
        eye, turn, lens = ([float(value) for value in part.split(",")] for part in text.split(";"))
    except ValueError:
        raise Refused(400, "camera: expected eye;quaternion;lens") from None
    if (len(eye), len(turn), len(lens)) != (3, 4, 6) or not all(abs(v) <= LARGEST for v in [*eye, *turn, *lens]):
        raise Refused(400, "camera: expected 3, 4 and 6 finite numbers")
    fx, fy, cx, cy, width, height = lens
    sides = sorted((width, height))
    if not (math.hypot(*turn) > 1e-6 and min(fx, fy) > 1e-3 and sides[0] >= 1 and sides[1] <= MAX_SIDE):
        raise Refused(400, "camera: expected a rotation, focal lengths and a size")
    if sides[1] > MAX_ASPECT * sides[0]:
        raise Refused(400, f"camera: expected a picture at most {MAX_ASPECT:.0f} times as long as wide")
    x, y, z, w = (part / math.hypot(*turn) for part in turn)
    rotation = rotation_matrix(w, x, y, z)
    pose = np.column_stack([rotation, -rotation @ np.array(eye)])
    return View("live", Camera(round(width), round(height), fx, fy, cx, cy), pose)
