"""What a browser asks, and who may ask: GET alone, by a name of this machine, below a secret path."""

import hmac
import json
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

LONGEST = 8192  # bytes of a request: its line and its headers
FIELDS = 8  # of a query
NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})  # another one is a page elsewhere whose name leads here
PHRASES = {200: "OK", 204: "No Content", 400: "Bad Request", 403: "Forbidden", 404: "Not Found"}
PHRASES |= {405: "Method Not Allowed", 431: "Request Header Fields Too Large", 503: "Service Unavailable"}
HEADERS = {  # where an answer has no others
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the address holds the secret
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


@dataclass(frozen=True)
class Answer:
    """A status, a body and its kind."""

    status: int
    body: bytes = b""
    kind: str = "text/plain; charset=utf-8"
    headers: dict[str, str] = field(default_factory=dict)

    @classmethod
    def json(cls, value: Any) -> "Answer":
        return cls(200, json.dumps(value, separators=(",", ":")).encode(), "application/json")

    @classmethod
    def refusal(cls, status: int, why: str) -> "Answer":
        return cls(status, f"{why}\n".encode())

    def bytes(self) -> bytes:
        """Return the answer as it is sent."""
        headers = {"Content-Type": self.kind, "Content-Length": len(self.body), **HEADERS, **self.headers}
        lines = [f"HTTP/1.1 {self.status} {PHRASES[self.status]}"]
        lines += [f"{name}: {value}" for name, value in headers.items()]
        if self.status in (400, 405, 431):
            lines.append("Connection: close")
        return "\r\n".join([*lines, "", ""]).encode("latin-1") + self.body


class Refused(Exception):
    """A request that is not answered but for the reason; carries the answer."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.answer = Answer.refusal(status, why)


@dataclass(frozen=True)
class Request:
    """What is asked for: the path behind the secret, and the fields of the query."""

    path: str
    query: dict[str, str]

    def number(self, name: str, least: int, most: int) -> int:
        """Return a field as a whole number.  Raises Refused."""
        text = self.query.get(name, "")
        if not (text.isascii() and text.isdecimal() and len(text) <= 12 and least <= int(text) <= most):
            raise Refused(400, f"{name}: expected a whole number from {least} to {most}")
        return int(text)


def read(head: bytes, token: str) -> Request:
    """Return what the lines of a request ask for.  Raises Refused: 400, 403, 404, 405."""
    try:
        first, *rest = head.decode("ascii").split("\r\n")
        method, target, version = first.split(" ")
        named = [line.partition(":") for line in rest if line]
        hosts = [value.strip().lower() for name, _, value in named if name.lower() == "host"]
        parts = urlsplit(target)
        query = parse_qsl(parts.query, keep_blank_values=True, max_num_fields=FIELDS)
    except ValueError:
        raise Refused(400, "expected a request of HTTP/1.1") from None
    if not version.startswith("HTTP/1.") or len(hosts) != 1 or not target.startswith("/"):
        raise Refused(400, "expected a request of HTTP/1.1 with one Host")
    if method != "GET":
        raise Refused(405, "expected GET")
    if host_name(hosts[0]) not in NAMES:
        raise Refused(403, "this page answers to 127.0.0.1 and localhost alone")
    secret, _, path = unquote(parts.path)[1:].partition("/")
    if not hmac.compare_digest(secret.encode("utf-8", "replace"), token.encode()):
        raise Refused(404, "not found")
    return Request(path, dict(query))


def host_name(host: str) -> str:
    """Return a Host without its port: a tunnel may end at another one."""
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdecimal() else host
