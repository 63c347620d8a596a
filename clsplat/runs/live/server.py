"""Serve requests on the loopback address, in threads."""

import hmac
import json
import logging
import math
import os
import socketserver
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from time import sleep
from typing import Any, cast, get_args
from urllib.parse import parse_qsl, unquote, urlsplit

import numpy as np

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.page import inline, render
from clsplat.core.quaternions import rotation_matrix
from clsplat.formats.splats import EXPECTED_TIME, is_timestamp
from clsplat.runs.live.preview import Credit, Desk, Kind, Pace, PageCamera, ShownRun
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.page import camera_data, joined, style, viewpoint_data

# What a browser asks, and who may ask: GET alone, by a name of this machine, below a secret path.

FIELDS = 8  # of a query
NAMES = frozenset(
    {"127.0.0.1", "localhost", "[::1]"}
)  # other hosts are foreign pages whose name resolves to this machine
HEADERS = {  # of all answers without others
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the address contains the secret
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


@dataclass(frozen=True)
class Answer:
    """A response: status, body and content type."""

    status: int
    body: bytes = b""
    kind: str = "text/plain; charset=utf-8"
    headers: dict[str, str] = field(default_factory=dict)

    @classmethod
    def json(cls, value: Any) -> "Answer":
        return cls(200, json.dumps(value, separators=(",", ":")).encode(), "application/json")


class Refused(Exception):
    """A request is refused; carries the response."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.answer = Answer(status, f"{why}\n".encode())


@dataclass(frozen=True)
class Request:
    """A request: the path after the secret, and the fields of the query."""

    path: str
    query: dict[str, str]

    def number(self, name: str, least: int, most: int) -> int:
        """Return a field as a whole number.  Raises Refused."""
        text = self.query.get(name, "")
        if not (text.isascii() and text.isdecimal() and len(text) <= 12 and least <= int(text) <= most):
            raise Refused(400, f"{name}: expected a whole number from {least} to {most}")
        return int(text)


def read(target: str, host: str, token: str) -> Request:
    """Parse a request.  Raises Refused: 400, 403, 404."""
    if host_name(host.strip().lower()) not in NAMES:
        raise Refused(403, "this page only answers requests to 127.0.0.1 and localhost")
    try:
        parts = urlsplit(target)
        query = parse_qsl(parts.query, keep_blank_values=True, max_num_fields=FIELDS)
    except ValueError:
        raise Refused(400, "expected the address of this page") from None
    secret, _, path = unquote(parts.path)[1:].partition("/")
    if not hmac.compare_digest(secret.encode("utf-8", "replace"), token.encode()):
        raise Refused(404, "not found")
    return Request(path, dict(query))


def host_name(host: str) -> str:
    """Return a Host without its port, as a tunnel may use another one."""
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdecimal() else host


LOG = logging.getLogger("clsplat")
LOOPBACK = "127.0.0.1"
PORT, PORTS = 8710, 20  # the first default port, and how many are tried
IDLE = 15.0  # s until an idle connection is closed
RATE, BURST = 30.0, 120.0  # responses per second, and at once after a rest, as a page starts with many small images
POLL = 0.1  # s between checks whether the server should stop


class Server(socketserver.ThreadingTCPServer):
    """Answers requests under /TOKEN/ on the loopback address, in daemon threads."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 32
    allow_reuse_address = os.name == "posix"  # on Windows it would let two programs share a port

    def __init__(self, port: int, token: str, answer: Callable[[Request], Answer]) -> None:
        """port: 0 uses the first free one from PORT on.  Raises ConfigError if it is in use."""
        self.token, self.answer, self.ended, self._rate = token, answer, False, Credit(RATE, BURST)
        self._rate.spend(-BURST)
        for self.port in [port] if port else range(PORT, PORT + PORTS):
            try:
                super().__init__((LOOPBACK, self.port), _Connection)
                break
            except OSError as error:
                reason = error.strerror
        else:
            which = f"port {port}" if port else f"ports {PORT} to {PORT + PORTS - 1}"
            raise ConfigError(
                f"--live: {which} of {LOOPBACK} cannot be used ({reason}); give another one"
                + ("" if not port else ", or none: the next that is free is taken")
            )
        threading.Thread(target=self.serve_forever, args=(POLL,), name="live", daemon=True).start()

    def stop(self) -> None:
        """Stop answering; open connections end after their current response."""
        self.ended = True
        self.shutdown()
        self.server_close()

    def pace(self) -> None:
        """Wait until the next response is allowed."""
        while self._rate.credit < 1:
            sleep(1 / RATE)
        self._rate.spend(1)

    def handle_error(self, request: Any, client_address: Any) -> None:
        LOG.debug("live: a request failed", exc_info=True)


class _Connection(BaseHTTPRequestHandler):
    """One connection, with requests one after another."""

    server: Server
    protocol_version = "HTTP/1.1"
    timeout = IDLE
    wbufsize = -1  # send a response as one packet
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        if not self.server.ended:
            self.server.pace()
            try:
                answer = self.server.answer(read(self.path, self.headers.get("Host", ""), self.server.token))
            except Refused as refused:
                answer = refused.answer
            self._send(answer)
        self.close_connection |= self.server.ended

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        self.close_connection = True  # the rest may be a body
        self._send(Answer(code, f"{message}\n".encode()))

    def _send(self, answer: Answer) -> None:
        self.send_response_only(answer.status)
        headers = {"Content-Type": answer.kind, "Content-Length": len(answer.body), **HEADERS, **answer.headers}
        for name, value in headers.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(answer.body)

    def log_message(self, format: str, *values: Any) -> None:
        LOG.debug("live: " + format, *values)


# The page of a live preview, with the style and the controls of the viewer.

FOLDER = Path(__file__).parent
SHARED = ("camera", "motion", "controls", "photographs", "frustums", "panel")  # of the viewer
OWN = ("curves", "link", "live")


def page() -> bytes:
    """Return the page, which requests everything else."""
    own = [(FOLDER / f"{name}.js").read_text("utf-8") for name in OWN]
    text = render(
        "live.html.j2",
        style=inline(style() + (FOLDER / "live.css").read_text("utf-8")),
        script=inline(joined(SHARED, own)),
    )
    return text.encode()


def scene_data(number: int, title: str, views: Sequence[View], test: set[str], stand: Viewpoint) -> dict[str, Any]:
    """Return the data of a run for live.js: its views and its viewpoint."""

    def described(index: int, view: View) -> dict[str, Any]:
        of = f"view={index}&scene={number}"
        pictures = {kind: f"{kind}.jpg?{of}" for kind in ("thumbnail", "photograph")}
        split = "test" if view.name in test else "train"
        return {"name": view.name, "split": split, **pictures, **camera_data(view)}

    first = next((i for i, view in enumerate(views) if view is stand.start), -1)
    described_views = [described(i, view) for i, view in enumerate(views)]
    return {"number": number, "title": title, **viewpoint_data(stand), "views": described_views, "first": first}


# The answers of the server: the page, the scene, the state, pictures, and the two buttons.

WAIT = 4.0  # s until a page that waits for a preview asks again
MAX_NUMBER = 1e9  # of a camera
MAX_SIDE, MAX_ASPECT = 16384, 8.0  # of a requested preview
STATUS_KEYS = {"state", "stage", "progress", "step", "steps", "gaussians", "seconds_left", "message", "device", "host"}


class Answers:
    """Answers requests from any thread."""

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
        """Return the response.  Raises Refused."""
        if (route := self._routes.get(request.path)) is None:
            raise Refused(404, "not found")
        self.desk.hear()
        return route(request)

    def _state(self, request: Request) -> Answer:
        desk, shown = self.desk, self.desk.shown
        ended = desk.ended  # read first, so that a page that learns of the end gets the final state
        status = desk.status.now.model_dump(include=STATUS_KEYS, exclude_none=True) if desk.status else {}
        state: dict[str, Any] = {**status, "scene": shown.number if shown else 0, "drawn": desk.step}
        state |= {"paused": desk.paused, "ended": ended, "fault": desk.fault}
        if shown:
            state["points"] = shown.curves.after(request.number("after", 0, 1 << 40))
        desk.is_end_sent = desk.is_end_sent or ended
        return Answer.json(state)

    def _scene(self, request: Request) -> Answer:
        return Answer.json(self._shown().scene)

    def _frame(self, request: Request) -> Answer:
        """Return a preview of a `view`, or of a `camera` as camera.js writes it, at a `time` if given.

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
        order = PageCamera(request.number("page", 0, 1 << 40), view, cast(Pace, pace))
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

    def _shown(self) -> ShownRun:
        if self.desk.shown is None:
            raise Refused(503, "no scene yet")
        return self.desk.shown


def moment(text: str) -> float:
    """Return a time of the scene.  Raises Refused."""
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not is_timestamp(found):
        raise Refused(400, f"time: {EXPECTED_TIME}")
    return found


def camera(text: str) -> View:
    """Parse a view as camera.js writes it: eye; quaternion x, y, z, w; fx, fy, cx, cy, width, height.

    Raises Refused.
    """
    try:
        eye, turn, lens = ([float(value) for value in part.split(",")] for part in text.split(";"))
    except ValueError:
        raise Refused(400, "camera: expected eye;quaternion;lens") from None
    if (len(eye), len(turn), len(lens)) != (3, 4, 6) or not all(abs(v) <= MAX_NUMBER for v in [*eye, *turn, *lens]):
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
