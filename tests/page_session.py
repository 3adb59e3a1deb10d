"""A client of the servers of pages, without a browser."""

from __future__ import annotations

import http.client
import io
import json
import socket
import threading
from contextlib import contextmanager
from urllib.parse import urlsplit


@contextmanager
def running(server):
    """The server, which answers until the end of the context."""
    with server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()


class _Received(io.BytesIO):
    """What was received, as the socket that `http.client` reads."""

    def makefile(self, *_):
        return self


class Session:
    """A session with a server; `cookie` is sent with every request, unless a header replaces it."""

    def __init__(self, address, *, cookie=None):
        self.address = urlsplit(address)
        self.host = self.address.netloc
        self.cookie = cookie

    @classmethod
    def opened(cls, address):
        """A session that the address of a server has opened."""
        session = cls(address)
        session.page = session.request("GET", f"?{session.address.query}")
        session.cookie = session.page.headers["Set-Cookie"].partition(";")[0]
        return session

    def request(self, method, path, body=None, **headers):
        """Answer with status and headers, and everything after them as body.

        `path` is absolute, or a name below the root of the server.
        """
        path = path if path.startswith("/") else self.address.path + path
        sent = {"Host": self.host} | ({"Cookie": self.cookie} if self.cookie else {})
        sent |= (
            {"Origin": f"http://{self.host}", "Content-Type": "application/json"}
            if method == "POST"
            else {}
        )
        sent |= {name.replace("_", "-"): value for name, value in headers.items()}
        sent |= (
            {}
            if body is None
            else {"Content-Length": sent.get("Content-Length", str(len(body)))}
        )
        lines = [f"{method} {path} HTTP/1.0"]
        for name, value in sent.items():
            lines += [
                f"{name}: {one}"
                for one in (value if isinstance(value, list) else [value])
                if one is not None
            ]
        with socket.create_connection(
            (self.address.hostname, self.address.port), timeout=30
        ) as connection:
            connection.sendall(
                "\r\n".join([*lines, "", ""]).encode("latin-1") + (body or b"")
            )
            with connection.makefile("rb") as stream:
                # all of it, so that nothing is hidden behind the first answer
                received = stream.read()
        answer = http.client.HTTPResponse(_Received(received), method="GET")
        answer.begin()
        answer.body = received.partition(b"\r\n\r\n")[2]
        return answer

    def status(self, method, path, body=None, **headers):
        """Status of the answer."""
        return self.request(method, path, body, **headers).status

    def post(self, name, value, **headers):
        """The JSON of the answer to a JSON object."""
        return json.loads(
            self.request("POST", name, json.dumps(value).encode(), **headers).body
        )
