"""A client of the servers of pages, without a browser."""

from __future__ import annotations

import http.client
import json
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


class Session:
    """A session with a server; `cookie` is sent with every request, unless a header replaces it."""

    def __init__(self, server, *, cookie=None):
        self.server = server
        self.host = "{}:{}".format(*server.server_address)
        self.cookie = cookie

    @classmethod
    def opened(cls, server):
        """A session that the address of the server has opened."""
        session = cls(server)
        session.page = session.request("GET", urlsplit(server.address).path + "?" + urlsplit(server.address).query)
        session.cookie = session.page.headers["Set-Cookie"].partition(";")[0]
        return session

    def request(self, method, path, body=None, **headers):
        """Answer with status, headers and body; `path` is absolute, or a name below the root of the server."""
        path = path if path.startswith("/") else self.server.root + path
        sent = {"Host": self.host} | ({"Cookie": self.cookie} if self.cookie else {})
        sent |= {"Origin": f"http://{self.host}", "Content-Type": "application/json"} if method == "POST" else {}
        sent |= {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection(*self.server.server_address, timeout=30)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            if body is not None:
                sent.setdefault("Content-Length", str(len(body)))
            for name, value in sent.items():
                for one in value if isinstance(value, list) else [value]:
                    if one is not None:
                        connection.putheader(name, one)
            connection.endheaders(body)
            answer = connection.getresponse()
            answer.body = answer.read()
            return answer
        finally:
            connection.close()

    def status(self, method, path, body=None, **headers):
        """Status of the answer."""
        return self.request(method, path, body, **headers).status

    def post(self, name, value, **headers):
        """The JSON of the answer to a JSON object."""
        return json.loads(self.request("POST", name, json.dumps(value).encode(), **headers).body)
