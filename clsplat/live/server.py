"""The server: threads that read bounded requests on the loopback address, and write answers."""

import logging
import os
import socket
import socketserver
import threading
from collections.abc import Callable
from contextlib import suppress
from time import monotonic, sleep
from typing import Any

from clsplat.errors import ConfigError
from clsplat.live.budget import Budget
from clsplat.live.requests import LONGEST, Answer, Refused, Request, read

LOG = logging.getLogger("clsplat")
LOOPBACK = "127.0.0.1"
PORT, TRIED = 8710, 20  # the first port that is tried where none is given, and how many
CONNECTIONS = 32  # at a time; browsers keep six
IDLE = 15.0  # seconds until a connection that asks for nothing more is closed
HEAD = 2.0  # seconds that the head of a request may take
RATE, BURST = 30.0, 120.0  # answers a second, and at once after a rest: a page opens with many small pictures
POLL = 0.1  # seconds until the server sees that it is to stop


class Server(socketserver.ThreadingTCPServer):
    """Answers requests below /TOKEN/ on the loopback address, in threads that end with the process."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = CONNECTIONS
    allow_reuse_address = os.name == "posix"  # elsewhere it lets two programs share a port

    def __init__(self, port: int, token: str, answer: Callable[[Request], Answer]) -> None:
        """port: 0 takes the first one from PORT on that is free.  Raises ConfigError where it is in use."""
        self.token, self.answer = token, answer
        self._slots, self._rate = threading.Semaphore(CONNECTIONS), Budget(RATE, BURST)
        self._rate.spend(-BURST)
        self.ended, self._open, self._lock = False, set[Any](), threading.Lock()
        super().__init__((LOOPBACK, 0), _Connection, bind_and_activate=False)
        self.port = self._bind(port)
        self._thread = threading.Thread(target=self.serve_forever, args=(POLL,), name="live", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Answer no more; a connection that is open ends after the answer that it is being given."""
        self.ended = True
        self.shutdown()
        self.server_close()
        with self._lock:
            for one in self._open:
                with suppress(OSError):  # the other side has closed it
                    one.shutdown(socket.SHUT_RD)

    def _bind(self, port: int) -> int:
        """Listen; return the port."""
        ports = [port] if port else range(PORT, PORT + TRIED)
        for one in ports:
            try:
                self.server_address = LOOPBACK, one
                self.server_bind()
                self.server_activate()
                return one
            except OSError as error:
                fault: OSError = error
                self.socket.close()
                self.socket = socket.socket(self.address_family, self.socket_type)
        self.socket.close()
        which = f"port {port}" if port else f"ports {PORT} to {PORT + TRIED - 1}"
        raise ConfigError(
            f"--live: {which} of {LOOPBACK} cannot be used ({fault.strerror}); give another one"
            + ("" if not port else ", or none: the next that is free is taken")
        )

    def paced(self) -> None:
        """Wait until another answer may be given."""
        while self._rate.credit < 1:
            sleep(1 / RATE)
        self._rate.spend(1)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._slots.acquire(timeout=POLL):
            with self._lock:
                self._open.add(request)
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._slots.release()

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.discard(request)
            super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        LOG.debug("live: a request failed", exc_info=True)


class _Connection(socketserver.StreamRequestHandler):
    """One connection: requests one after the other."""

    server: Server
    timeout = IDLE
    disable_nagle_algorithm = True

    def handle(self) -> None:
        try:
            while (head := self._head()) is not None and not self.server.ended:
                self.connection.settimeout(IDLE)
                self.server.paced()
                answer = self._answer(head)
                self.wfile.write(answer.bytes())
                if answer.status in (400, 405, 431):  # what follows may be a body
                    return
        except OSError:  # it was closed, or says nothing
            return

    def _answer(self, head: bytes) -> Answer:
        if len(head) > LONGEST:
            return Answer.refusal(431, f"expected at most {LONGEST} bytes")
        try:
            return self.server.answer(read(head, self.server.token))
        except Refused as refused:
            return refused.answer

    def _head(self) -> bytes | None:
        """The lines up to the empty one, or more than LONGEST bytes; None at the end."""
        self.rfile.peek(1)  # type: ignore[attr-defined]
        head, line, end = b"", b"", monotonic() + HEAD
        while len(head + line) <= LONGEST:
            self.connection.settimeout(max(end - monotonic(), 1e-3))  # one end for all: bytes may come one by one
            if not (byte := self.rfile.read1(1)):
                return None
            line += byte
            if line in (b"\r\n", b"\n"):
                return head
            if byte == b"\n":
                head, line = head + line, b""
        return head + line
