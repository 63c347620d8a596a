"""The live server: loopback only, limited requests, ports, and shutdown."""

import socket
import threading
import time
from contextlib import suppress

import pytest

from clsplat.core.errors import ConfigError
from clsplat.runs.live import server as module
from clsplat.runs.live.preview import MAX_WAITING, Credit, EncodedImage, PreviewRequest, RequestQueue
from clsplat.runs.live.server import Response, Server


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr(module._Connection, "timeout", 0.5)
    made = Server(0, "token", lambda request: Response(200, request.path.encode()))
    yield made
    made.stop()


def exchange(server: Server, data: bytes) -> bytes:
    """Send bytes; return the response until the server closes the connection."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        actual = b""
        while more := connection.recv(1 << 16):
            actual += more
        return actual


def test_server_listens_only_on_loopback(server):
    assert server.socket.getsockname()[0] == "127.0.0.1"


def test_requests_of_one_connection_are_answered_in_order(server):
    first = b"GET /token/%s HTTP/1.1\r\nHost: localhost\r\n\r\n"
    answers = exchange(server, first % b"a" + first % b"b")
    assert answers.count(b"HTTP/1.1 200 OK") == 2
    assert answers.index(b"\r\n\r\na") < answers.index(b"\r\n\r\nb")


@pytest.mark.parametrize("method", [b"POST", b"HEAD", b"get", b"\xff"])
def test_other_methods_are_refused_and_close_the_connection(server, method):
    body = b"GET /token/ HTTP/1.1\r\nHost: localhost\r\n\r\n"
    head = method + b" /token/ HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n" % len(body)
    result = exchange(server, head + body)
    assert result.startswith(b"HTTP/1.1 501")
    assert result.count(b"HTTP/1.1") == 1
    assert b"<" not in result


def test_answer_forbids_frames_caches_and_referrers(server):
    lines = exchange(server, b"GET /token/x HTTP/1.1\r\nHost: localhost\r\n\r\n").decode().split("\r\n")
    assert lines[0] == "HTTP/1.1 200 OK"
    assert lines[-1] == "x"
    for line in ("Cache-Control: no-store", "Referrer-Policy: no-referrer", "X-Frame-Options: DENY"):
        assert line in lines
    assert "X-Content-Type-Options: nosniff" in lines
    assert not [line for line in lines if line.startswith("Server")], "which would name the version of Python"


def test_idle_connection_is_closed(server, monkeypatch):
    monkeypatch.setattr(module._Connection, "timeout", 0.1)
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(b"GET /tok")
        assert connection.recv(100) == b""


def test_server_closes_its_connections_at_its_end(server):
    request = b"GET /token/a HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(request)
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 200")
        (thread,) = (item for item in threading.enumerate() if "process_request_thread" in item.name)
        server.stop()
        with suppress(OSError):
            connection.sendall(request)
            assert connection.recv(1 << 16) == b""
        thread.join(10)
        assert not thread.is_alive()


def test_final_answer_is_complete_and_the_last():
    given, going = threading.Event(), threading.Event()

    def answer(request):
        given.set()
        going.wait(10)
        return Response(200, b"farewell")

    server = Server(0, "token", answer)
    request = b"GET /token/a HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(2 * request)
        given.wait(10)
        server.stop()
        going.set()
        actual = b""
        with suppress(ConnectionError):
            while more := connection.recv(1 << 16):
                actual += more
    assert actual.endswith(b"farewell")
    assert actual.count(b"HTTP/1.1 200") == 1


def test_port_in_use_is_refused_or_the_next_one_is_used(server):
    with pytest.raises(ConfigError, match=rf"--live: port {server.port} of 127.0.0.1 cannot be used \(.*\); give ano"):
        Server(server.port, "token", server.handle)
    other = Server(0, "token", server.handle)
    assert server.port < other.port < module.PORT + module.PORTS
    other.stop()


def test_answers_are_paced(server):
    server._rate.spend(module.BURST + 3)
    waited = threading.Event()
    threading.Thread(target=lambda: (server.throttle(), waited.set()), daemon=True).start()
    assert not waited.wait(0.05)
    assert waited.wait(5)


def test_budget_is_capped_and_carries_debt():
    now = [100.0]
    budget = Credit(0.05, 1.0, lambda: now[0])
    assert budget.credit == 0
    now[0] += 10
    assert budget.credit == pytest.approx(0.5)
    budget.spend(0.8)
    assert budget.credit == pytest.approx(-0.3)
    now[0] += 6
    assert budget.credit == pytest.approx(0, abs=1e-9)
    now[0] += 1000
    assert budget.credit == 1
    budget.spend(1)
    now[0] += 1000
    budget.skip()
    assert budget.credit == 0


def asked(queue: RequestQueue, *wanted: PreviewRequest) -> list[threading.Thread]:
    threads = [threading.Thread(target=queue.wait_for, args=(request, 10)) for request in wanted]
    for number, thread in enumerate(threads, 1):
        thread.start()
        while sum(request in queue._requests for request in wanted) < number:
            time.sleep(0.001)
    return threads


def test_moving_requests_take_precedence_and_the_queue_is_short():
    queue, picture = RequestQueue(), EncodedImage(b"", 1)
    wanted = [PreviewRequest(page, None, "again" if page < 2 else "moving") for page in range(MAX_WAITING)]
    threads = asked(queue, *wanted)
    assert not queue.wait_for(PreviewRequest(99, None, "moving"), 0)
    for request in (wanted[2], wanted[3], wanted[0], wanted[1]):
        assert queue.first() is request
        queue.deliver(request, picture)
    for thread in threads:
        thread.join(5)
    assert not queue


def test_new_request_replaces_the_pages_previous_one():
    queue, first, second = RequestQueue(), PreviewRequest(1, None, "moving"), PreviewRequest(1, None, "still")
    (thread,) = asked(queue, first)
    others = asked(queue, second)
    thread.join(5)
    assert first.image is None
    assert queue.first() is second
    queue.deliver(second, EncodedImage(b"x", 2))
    others[0].join(5)


def test_request_times_out():
    queue, request = RequestQueue(), PreviewRequest(1, None, "moving")
    assert queue.wait_for(request, 0)
    assert request.image is None
    assert not queue
