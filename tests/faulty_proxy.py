"""An HTTP proxy on 127.0.0.1 in front of an S3 server, which fails some requests on purpose."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

from waiting import PATIENCE_SECONDS

REFUSED = {"403": b"AccessDenied", "500": b"InternalError", "503": b"SlowDown"}
FAULTS = (
    "500",
    "503",  # answers of an overloaded server; the request is not executed
    "dropped",  # the connection ends before the request reaches the server
    "half a request",  # the connection ends while the server reads the request
    "lost answer",  # the server executes the request, but its answer is lost
    "late answer",  # the same, after the client has waited
    "half an answer",  # the connection ends in the middle of the answer
)


class FaultyProxy(ThreadingHTTPServer):
    """Forwards requests to `target`; a random `fraction` of them fails with one of `faults`.

    Parameters
    ----------
    without
        Headers that are not forwarded.
    delay_s
        Delay of every request.
    """

    daemon_threads = True

    def __init__(
        self,
        target: str,
        *,
        fraction=0.0,
        faults=FAULTS,
        seed=0,
        delay_s=0.0,
        without=(),
    ) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.target = urlsplit(target)
        self.fraction = fraction
        self.faults = faults
        self.without = without
        self.delay_s = delay_s
        self.address = f"http://127.0.0.1:{self.server_port}"
        self.requests: list[tuple[str, str]] = []  # method and path
        self.next: list[str] = []  # faults of the next requests
        self.part = ""  # only requests whose path contains it may fail
        self.headers: dict[str, str] = {}  # headers of the latest request
        self.failed = Counter[str]()
        self._random = random.Random(seed)
        self._lock = threading.Lock()

    def fault(self, method: str, path: str) -> str:
        """Fault of this request; empty if it must not fail."""
        with self._lock:
            self.requests.append((method, path))
            if self.next:
                return self.next.pop(0)
            if self.part not in path or self._random.random() >= self.fraction:
                return ""
            fault = self._random.choice(self.faults)
            self.failed[fault] += 1
            return fault

    def handle_error(self, request, client_address) -> None:
        """Ignore clients that have closed the connection."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: FaultyProxy

    def handle_one_request(self) -> None:
        if not self._read_request():
            return None
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        time.sleep(self.server.delay_s)
        self.server.headers = {
            name.lower(): value for name, value in self.headers.items()
        }
        fault = self.server.fault(self.command, self.path)
        if fault in REFUSED:
            text = b"<Error><Code>%s</Code></Error>" % REFUSED[fault]
            return self._answer(
                int(fault),
                {"Content-Length": str(len(text))},
                b"" if self.command == "HEAD" else text,
            )
        if fault == "dropped":
            return self._end()
        if fault == "half a request":
            self._forward(body, half=True)
            return self._end()
        status, headers, answer = self._forward(body)
        if fault == "late answer":
            self._wait_until_the_client_gives_up()
        if fault in ("lost answer", "late answer"):
            return self._end()
        if fault == "half an answer":
            self._answer(status, headers, answer[: len(answer) // 2])
            return self._end()
        return self._answer(status, headers, answer)

    def _wait_until_the_client_gives_up(self) -> None:
        """The client closes the connection, of which it expects nothing any more."""
        self.connection.settimeout(PATIENCE_SECONDS)
        with suppress(ConnectionError):
            self.connection.recv(1)

    def _read_request(self) -> bool:
        self.raw_requestline = self.rfile.readline(65537)
        if not self.raw_requestline:
            self.close_connection = True
            return False
        return self.parse_request()

    def _forward(self, body: bytes, *, half: bool = False):
        server = HTTPConnection(
            self.server.target.hostname, self.server.target.port, timeout=30
        )
        try:
            server.putrequest(
                self.command, self.path, skip_host=True, skip_accept_encoding=True
            )
            for name, value in self.headers.items():
                if name.lower() not in self.server.without:
                    server.putheader(name, value)
            server.endheaders(body[: len(body) // 2] if half else body)
            if half:
                return None
            answer = server.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        except (OSError, HTTPException):
            return 502, {"Content-Length": "0"}, b""
        finally:
            server.close()

    def _answer(self, status: int, headers, body: bytes) -> None:
        self.send_response_only(status)
        for name, value in headers.items():
            if name.lower() not in ("connection", "transfer-encoding"):
                self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _end(self) -> None:
        self.close_connection = True


@contextmanager
def faulty_proxy(target: str, **options) -> Iterator[FaultyProxy]:
    """Context with a proxy that serves until its end."""
    proxy = FaultyProxy(target, **options)
    thread = threading.Thread(
        target=proxy.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True
    )
    thread.start()
    try:
        yield proxy
    finally:
        proxy.shutdown()
        proxy.server_close()
        thread.join()
