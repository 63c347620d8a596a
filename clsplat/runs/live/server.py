"""Serve the page of the live preview and its data on the loopback address, in threads."""

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
from clsplat.runs.live.preview import Credit, Kind, LiveRun, LiveState, Pace, PreviewRequest
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.page import camera_data, join_scripts, read_style, viewpoint_data

# Requests: only GET, with a host name of this machine, and a secret in the path.

MAX_FIELDS = 8  # of a query
# other host names belong to foreign pages that resolve to this machine (DNS rebinding)
NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})
HEADERS = {  # default headers of all responses
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the address contains the secret
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


@dataclass(frozen=True)
class Response:
    """An HTTP response: status, body, content type, and additional headers."""

    status: int
    body: bytes = b""
    media_type: str = "text/plain; charset=utf-8"
    headers: dict[str, str] = field(default_factory=dict)

    @classmethod
    def json(cls, value: Any) -> "Response":
        return cls(200, json.dumps(value, separators=(",", ":")).encode(), "application/json")


class RequestError(Exception):
    """Raised to reject a request; its `response` is sent to the client."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.response = Response(status, f"{reason}\n".encode())


@dataclass(frozen=True)
class Request:
    """A request: its path without the secret, and the fields of its query."""

    path: str
    query: dict[str, str]

    def number(self, name: str, minimum: int, maximum: int) -> int:
        """Parse a field of the query as an integer.  Raises RequestError if it is missing or out of range."""
        text = self.query.get(name, "")
        if not (text.isascii() and text.isdecimal() and len(text) <= 12 and minimum <= int(text) <= maximum):
            raise RequestError(400, f"{name}: expected a whole number from {minimum} to {maximum}")
        return int(text)


def parse_request(target: str, host: str, token: str) -> Request:
    """Parse a request, and check its host and its secret.  Raises RequestError with status 400, 403, or 404."""
    if host_name(host.strip().lower()) not in NAMES:
        raise RequestError(403, "this page accepts only requests to 127.0.0.1 and localhost")
    try:
        parts = urlsplit(target)
        query = parse_qsl(parts.query, keep_blank_values=True, max_num_fields=MAX_FIELDS)
    except ValueError:
        raise RequestError(400, "invalid URL; expected the address of this page") from None
    secret, _, path = unquote(parts.path)[1:].partition("/")
    if not hmac.compare_digest(secret.encode("utf-8", "replace"), token.encode()):
        raise RequestError(404, "not found")
    return Request(path, dict(query))


def host_name(host: str) -> str:
    """Return the name in a Host header without the port, because a tunnel may use another port."""
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdecimal() else host


LOG = logging.getLogger("clsplat")
LOOPBACK = "127.0.0.1"
PORT, PORTS = 8710, 20  # the first default port, and the number of ports to try
IDLE_TIMEOUT = 15.0  # s until an idle connection is closed
RATE, BURST = 30.0, 120.0  # responses per second, and in an initial burst, because a page first loads many small images
POLL_INTERVAL = 0.1  # s between two checks whether the server has to stop


class Server(socketserver.ThreadingTCPServer):
    """Serves requests under /TOKEN/ on the loopback address, in daemon threads."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 32
    allow_reuse_address = os.name == "posix"  # on Windows it would let two programs share a port

    def __init__(self, port: int, token: str, handle: Callable[[Request], Response]) -> None:
        """port: 0 selects the first free port from PORT on.  Raises ConfigError if no port can be used."""
        self.token, self.handle, self.has_ended, self._rate = token, handle, False, Credit(RATE, BURST)
        self._rate.spend(-BURST)
        for self.port in [port] if port else range(PORT, PORT + PORTS):
            try:
                super().__init__((LOOPBACK, self.port), _Connection)
                break
            except OSError as error:
                reason = error.strerror
        else:
            ports = f"port {port}" if port else f"ports {PORT} to {PORT + PORTS - 1}"
            raise ConfigError(
                f"--live: {ports} of {LOOPBACK} cannot be used ({reason}); give another port"
                + ("" if not port else ", or none to use the first free one")
            )
        threading.Thread(target=self.serve_forever, args=(POLL_INTERVAL,), name="live", daemon=True).start()

    def stop(self) -> None:
        """Stop the server; open connections are closed after their current response."""
        self.has_ended = True
        self.shutdown()
        self.server_close()

    def throttle(self) -> None:
        """Wait until the rate limit allows the next response."""
        while self._rate.credit < 1:
            sleep(1 / RATE)
        self._rate.spend(1)

    def handle_error(self, request: Any, client_address: Any) -> None:
        LOG.debug("live: a request failed", exc_info=True)


class _Connection(BaseHTTPRequestHandler):
    """A connection of a client, which sends one request after another."""

    server: Server
    protocol_version = "HTTP/1.1"
    timeout = IDLE_TIMEOUT
    wbufsize = -1  # send a response as one packet
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        if not self.server.has_ended:
            self.server.throttle()
            try:
                response = self.server.handle(parse_request(self.path, self.headers.get("Host", ""), self.server.token))
            except RequestError as error:
                response = error.response
            self._send(response)
        self.close_connection |= self.server.has_ended

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        self.close_connection = True  # the unread data may be a body
        self._send(Response(code, f"{message}\n".encode()))

    def _send(self, response: Response) -> None:
        self.send_response_only(response.status)
        headers = {"Content-Type": response.media_type, "Content-Length": len(response.body)}
        headers |= {**HEADERS, **response.headers}
        for name, value in headers.items():
            self.send_header(name, str(value))
        self.end_headers()
        self.wfile.write(response.body)

    def log_message(self, format: str, *values: Any) -> None:
        LOG.debug("live: " + format, *values)


# The page of a live preview, with the style and the controls of the viewer.

FOLDER = Path(__file__).parent
VIEWER_SCRIPTS = ("camera", "motion", "controls", "photographs", "frustums", "panel")
SCRIPTS = ("curves", "link", "live")


def render_page() -> bytes:
    """Return the HTML of the page, which requests its data from the server."""
    scripts = [(FOLDER / f"{name}.js").read_text("utf-8") for name in SCRIPTS]
    text = render(
        "live.html.j2",
        style=inline(read_style() + (FOLDER / "live.css").read_text("utf-8")),
        script=inline(join_scripts(VIEWER_SCRIPTS, scripts)),
    )
    return text.encode()


def scene_data(number: int, title: str, views: Sequence[View], test: set[str], viewpoint: Viewpoint) -> dict[str, Any]:
    """Return the data of a run for live.js: its views and its initial viewpoint."""

    def view_data(index: int, view: View) -> dict[str, Any]:
        query = f"view={index}&scene={number}"
        photos = {kind: f"{kind}.jpg?{query}" for kind in ("thumbnail", "photograph")}
        split = "test" if view.name in test else "train"
        return {"name": view.name, "split": split, **photos, **camera_data(view)}

    first_index = next((i for i, view in enumerate(views) if view is viewpoint.start), -1)
    entries = [view_data(i, view) for i, view in enumerate(views)]
    return {"number": number, "title": title, **viewpoint_data(viewpoint), "views": entries, "first": first_index}


# The handlers: the page, the scene, the state, images, and the two buttons.

PREVIEW_TIMEOUT = 4.0  # s that a request waits for a preview; then the page repeats the request
MAX_NUMBER = 1e9  # largest absolute value in a camera
MAX_SIDE, MAX_ASPECT = 16384, 8.0  # of a requested preview
STATUS_KEYS = {"state", "stage", "progress", "step", "steps", "gaussians", "seconds_left", "message", "device", "host"}


class Handlers:
    """Handles requests; can be called from any thread."""

    def __init__(self, live: LiveState) -> None:
        self.live = live
        self._page = render_page()
        self._routes: dict[str, Callable[[Request], Response]] = {
            "": lambda request: Response(200, self._page, "text/html; charset=utf-8"),
            "state.json": self._state,
            "scene.json": self._scene,
            "frame.jpg": self._frame,
            "thumbnail.jpg": lambda request: self._photo(request, "thumbnail"),
            "photograph.jpg": lambda request: self._photo(request, "photograph"),
            "pause": lambda request: self._pause(True),
            "resume": lambda request: self._pause(False),
        }

    def __call__(self, request: Request) -> Response:
        """Return the response to a request.  Raises RequestError."""
        if (route := self._routes.get(request.path)) is None:
            raise RequestError(404, "not found")
        self.live.note_request()
        return route(request)

    def _state(self, request: Request) -> Response:
        live, run = self.live, self.live.run
        has_ended = live.has_ended  # read first, so that a page that receives the end also receives the final state
        status = live.status.now.model_dump(include=STATUS_KEYS, exclude_none=True) if live.status else {}
        state: dict[str, Any] = {**status, "scene": run.number if run else 0, "drawn": live.step}
        state |= {"paused": live.is_paused, "ended": has_ended, "fault": live.error}
        if run:
            state["points"] = run.curves.after(request.number("after", 0, 1 << 40))
        live.is_end_sent = live.is_end_sent or has_ended
        return Response.json(state)

    def _scene(self, request: Request) -> Response:
        return Response.json(self._require_scene().scene)

    def _frame(self, request: Request) -> Response:
        """Return a preview of the model from a `view` of the scene, or from a `camera` in the format of camera.js.

        With a `camera`, the query may contain a timestamp, `time`.  The status is 204 if the preview is not ready yet.
        """
        live, run = self.live, self._require_scene()
        pace = request.query.get("pace", "")
        if pace not in get_args(Pace):
            raise RequestError(400, f"pace: expected one of {', '.join(get_args(Pace))}")
        if "view" in request.query:
            view = run.views[request.number("view", 0, len(run.views) - 1)]
        else:
            view = parse_camera(request.query.get("camera", ""))
            if "time" in request.query:
                view = replace(view, time=parse_timestamp(request.query["time"]))
        preview = PreviewRequest(request.number("page", 0, 1 << 40), view, cast(Pace, pace))
        if not live.requests.wait_for(preview, PREVIEW_TIMEOUT):
            raise RequestError(503, "too many preview requests")
        if preview.image is None:
            return Response(204)
        return Response(200, preview.image.jpeg, "image/jpeg", {"X-Step": str(preview.image.step)})

    def _photo(self, request: Request, kind: Kind) -> Response:
        run = self._require_scene()
        index = request.number("view", 0, len(run.views) - 1)
        if request.query.get("scene") != str(run.number):  # from an earlier run of a matrix
            raise RequestError(404, "not found")
        try:
            data = run.photos.get(kind, index)
        except DataError as error:
            raise RequestError(404, str(error)) from None
        if data is None:
            raise RequestError(503, "busy; try again")
        return Response(200, data, "image/jpeg", {"Cache-Control": "private, max-age=3600"})

    def _pause(self, is_paused: bool) -> Response:
        if not self.live.has_ended:
            self.live.set_paused(is_paused)
        return Response.json({"paused": self.live.is_paused})

    def _require_scene(self) -> LiveRun:
        if self.live.run is None:
            raise RequestError(503, "no scene yet")
        return self.live.run


def parse_timestamp(text: str) -> float:
    """Parse a timestamp in [0, 1].  Raises RequestError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not is_timestamp(value):
        raise RequestError(400, f"time: {EXPECTED_TIME}")
    return value


def parse_camera(text: str) -> View:
    """Parse a view in the format of camera.js.  Raises RequestError.

    The format is "eye;quaternion;lens", each with comma-separated numbers: the position x, y, z; the rotation as a
    quaternion x, y, z, w; and fx, fy, cx, cy, width, height in px.
    """
    try:
        eye, rotation, lens = ([float(value) for value in component.split(",")] for component in text.split(";"))
    except ValueError:
        raise RequestError(400, "camera: expected eye;quaternion;lens") from None
    if (len(eye), len(rotation), len(lens)) != (3, 4, 6) or not all(
        abs(v) <= MAX_NUMBER for v in [*eye, *rotation, *lens]
    ):
        raise RequestError(400, "camera: expected eye (3), quaternion (4), and lens (6) of finite numbers")
    fx, fy, cx, cy, width, height = lens
    sides = sorted((width, height))
    if not (math.hypot(*rotation) > 1e-6 and min(fx, fy) > 1e-3 and sides[0] >= 1 and sides[1] <= MAX_SIDE):
        raise RequestError(
            400, f"camera: expected a nonzero quaternion, focal lengths > 0, and sides from 1 to {MAX_SIDE}"
        )
    if sides[1] > MAX_ASPECT * sides[0]:
        raise RequestError(400, f"camera: expected an image with an aspect ratio of at most {MAX_ASPECT:.0f}")
    x, y, z, w = (component / math.hypot(*rotation) for component in rotation)
    matrix = rotation_matrix(w, x, y, z)
    pose = np.column_stack([matrix, -matrix @ np.array(eye)])
    return View("live", Camera(round(width), round(height), fx, fy, cx, cy), pose)
