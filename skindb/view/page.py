"""Pages for the person at this machine: made from templates, and served from memory in one
session that a token opens.
"""

from __future__ import annotations

import html
import json
import re
import secrets
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from skindb.errors import InputError, input_error, require, system_fault
from skindb.files import private_file

SCRIPTS = (
    "session",
    "page/matrix",
    "page/data",
    "page/shaders",
    "page/gpu",
    "page/visible",
    "page/sky",
    "page/painter",
    "page/photographs",
    "page/main",
)
MAX_PAGE_BYTES = 30_000_000
OVERCAST = "overcast sky"
APPROXIMATIONS = (
    "Shadows come from maps of 1,024 texels with filtered edges. Light under the "
    "skin is the irradiance, blurred in the texture by one Gaussian, which has the mean "
    "square distance of the dipole and the local diffusion length. Diffuse light of the "
    "environment comes from spherical harmonics of the order 3 at each surfel, its "
    "reflection by the surface from 256 distant lights, and from a smooth image while "
    "something moves. Without a graphics card, light is computed at vertices 2.3 mm apart, "
    "with fewer pixels and texels, until the picture rests. Light that is reflected more "
    "than once is not included. skindb render omits it too, but has none of the other "
    "approximations."
)
LOCAL = "127.0.0.1"
# another port is that of a tunnel
HOST = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?")
HTML = "text/html; charset=utf-8"
JSON = "application/json"
MAX_REQUEST_BYTES = 1_000_000  # a hundred landmarks take about 20,000
REQUEST_SECONDS = 60.0  # for which a connection may be silent
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
Action = Callable[[dict[str, Any]], dict[str, Any]]


def page_text(folder: str, scripts: Iterable[str], parts: Mapping[str, str]) -> str:
    """A page of `skindb.view`.

    Parameters
    ----------
    folder
        Folder with page.html and page.css.
    scripts
        Paths of the scripts, in order, from `skindb/view`.
    parts
        Marker in page.html, such as ``title`` for ``$title`` -> HTML, or JSON from `embedded_json`.
    """
    root = resources.files("skindb.view")
    code = "\n".join((root / name).read_text(encoding="utf-8") for name in scripts)
    style = (root / folder / "page.css").read_text(encoding="utf-8")
    template = Template((root / folder / "page.html").read_text(encoding="utf-8"))
    return template.substitute(parts, style=style, script=f"(() => {{\n{code}\n}})();")


def embedded_json(value: Any) -> str:
    """JSON that is safe inside a script element: ASCII without "<", so that no data end
    the element.
    """
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


@dataclass(frozen=True)
class PagedFace:
    """A face of a page: its entry in the list of takes, and its data."""

    take: str
    title: str
    still: str
    data: bytes

    @classmethod
    def of(cls, record: Mapping[str, Any], still: str) -> PagedFace:
        """The face of a record of `face_record`."""
        attributes = record["about"]["attributes"]
        texts = [
            f"{name} {attributes[name]}"
            for name in ("age", "gender", "condition")
            if name in attributes
        ]
        return cls(
            attributes["take"],
            ", ".join([attributes["take"], *texts]),
            still,
            embedded_json(record).encode(),
        )


def index_text(
    faces: Sequence[PagedFace], *, embedded: bool = False, environment: str = OVERCAST
) -> str:
    """The page of faces, which contains their data or requests faces/<take>.json;
    `environment` is the name of the light from all directions.
    """
    takes = [
        {"take": face.take, "title": face.title, "still": face.still} for face in faces
    ]
    scripts = [
        f'<script type="application/json" id="face-{html.escape(face.take)}">'
        f"{face.data.decode()}</script>"
        for face in faces
    ]
    title = f"skindb: {faces[0].take}" if len(faces) == 1 else "skindb viewer"
    parts = {
        "title": html.escape(title),
        "approximations": APPROXIMATIONS,
        "environment": html.escape(environment),
        "takes": embedded_json(takes),
        "faces": "\n".join(scripts) if embedded else "",
    }
    return page_text("page", [f"{name}.js" for name in SCRIPTS], parts)


def write_page(
    out: Path, faces: Iterable[PagedFace], *, environment: str = OVERCAST
) -> int:
    """Write a self-contained page of faces and return its size in bytes.

    Raises
    ------
    InputError
        If the page would be larger than 30 MB.
    """
    content = index_text([*faces], embedded=True, environment=environment).encode()
    require(
        len(content) <= MAX_PAGE_BYTES,
        str(out),
        f"a page must have at most {MAX_PAGE_BYTES // 1_000_000} MB",
        f"{len(content) / 1e6:.0f} MB",
        "name fewer takes, or fit with a larger --spacing",
    )
    private_file(out).write_bytes(content)
    return len(content)


@dataclass(frozen=True)
class Content:
    """What is served under a name: its media type, and a function that returns its bytes."""

    kind: str
    read: Callable[[], bytes]


class PageServer(ThreadingHTTPServer):
    """Server at 127.0.0.1 of one page and what the page requests, which is not yet running.

    The address contains a token that is valid for one request, whose answer sets a
    cookie for all others. The path of the cookie is random, because browsers send
    cookies to every port of a host, also to servers of other users.

    Parameters
    ----------
    contents
        Name -> content; the page has the empty name.
    actions
        Name -> function of a JSON object that the page posts; returns the answer.
    port
        Port; 0 chooses a free one.

    Raises
    ------
    InputError
        If the port is taken.
    """

    daemon_threads = True

    def __init__(
        self,
        contents: Mapping[str, Content],
        actions: Mapping[str, Action],
        *,
        port: int = 0,
    ) -> None:
        self.contents = contents
        self.actions = actions
        self.root = f"/{secrets.token_urlsafe(12)}/"
        self.cookie = f"skindb={secrets.token_urlsafe()}"
        self._token = secrets.token_urlsafe()
        self._unused = threading.Lock()
        try:
            super().__init__((LOCAL, port), _Handler)
        except OSError as error:
            raise input_error(
                f"port {port}",
                "must be free",
                error.strerror or str(error),
                "choose another port, or omit --port",
            ) from None

    @property
    def address(self) -> str:
        """Address that opens the session, in one browser."""
        return f"http://{LOCAL}:{self.server_address[1]}{self.root}?token={self._token}"

    def accepts(self, query: str) -> bool:
        """Whether the query of an address contains the token, which is accepted only
        the first time.
        """
        return _are_equal(query, f"token={self._token}") and self._unused.acquire(
            blocking=False
        )


def _are_equal(secret: str, candidate: str) -> bool:
    """Comparison of secrets, whose time does not depend on them."""
    return secrets.compare_digest(secret.encode(), candidate.encode())


class _Handler(BaseHTTPRequestHandler):
    """Answers requests of its own page; every other request is refused, whatever its method."""

    server: PageServer
    server_version = "skindb"
    sys_version = ""
    timeout = REQUEST_SECONDS
    begins = False  # whether this request opens the session
    name: str | None = None  # of the requested content or action

    def handle_one_request(self) -> None:
        """Answer a request; it is no fault if the page was closed meanwhile."""
        with suppress(ConnectionError):
            super().handle_one_request()

    def parse_request(self) -> bool:
        """Read the head of a request of any method, and whether it is permitted."""
        if not super().parse_request():
            return False
        path, _, query = self.path.partition("?")
        refusal = self._foreign()
        if not refusal and not self._has_cookie():
            self.begins = (
                self.command == "GET"
                and path == self.server.root
                and self.server.accepts(query)
            )
            refusal = (
                ""
                if self.begins
                else "open the address that skindb printed; it can be opened once"
            )
        if refusal:
            self.send_error(HTTPStatus.FORBIDDEN, refusal)
        elif path.startswith(self.server.root):
            self.name = path.removeprefix(self.server.root)
        return not refusal

    def _foreign(self) -> str:
        """Reason why a request is not from the page itself; empty if it is."""
        hosts = self.headers.get_all("Host", [])
        origins = self.headers.get_all("Origin", [])
        if len(hosts) != 1 or not HOST.fullmatch(hosts[0]):
            return "only requests to this machine are allowed"
        if origins not in ([], [f"http://{hosts[0]}"]) or (
            self.command == "POST" and not origins
        ):
            return "only requests of the page itself are allowed"
        return ""

    def _has_cookie(self) -> bool:
        """Whether a cookie is that of the session; those of other servers at this host
        may be malformed.
        """
        cookies = ";".join(self.headers.get_all("Cookie", [])).split(";")
        return any(_are_equal(cookie.strip(), self.server.cookie) for cookie in cookies)

    def do_GET(self) -> None:
        """Answer with a content."""
        content = None if self.name is None else self.server.contents.get(self.name)
        if content is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        try:
            self._answer(HTTPStatus.OK, content.kind, content.read())
        except InputError as error:
            self._answer(
                HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", str(error).encode()
            )
        except OSError as error:
            fault = system_fault(error, "file system")
            self._answer(
                HTTPStatus.INTERNAL_SERVER_ERROR,
                "text/plain; charset=utf-8",
                str(fault).encode(),
            )

    def do_HEAD(self) -> None:
        """Answer as to GET, without the content."""
        self.do_GET()

    def do_POST(self) -> None:
        """Answer with the result of an action."""
        action = None if self.name is None else self.server.actions.get(self.name)
        length = self.headers.get("Content-Length", "")
        if action is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif self.headers.get("Content-Type") != JSON:
            self.send_error(HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
        elif not re.fullmatch("[0-9]{1,9}", length) or int(length) > MAX_REQUEST_BYTES:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        else:
            self._act(action, self.rfile.read(int(length)))

    def _act(self, action: Action, body: bytes) -> None:
        try:
            request = json.loads(body)
            reply = action(request if isinstance(request, dict) else {})
        except InputError as error:
            reply = {"faults": [str(fault) for fault in error.faults]}
        except OSError as error:
            reply = {"faults": [str(system_fault(error, "file system"))]}
        except (ValueError, RecursionError):
            self.send_error(HTTPStatus.BAD_REQUEST, "the request must be JSON")
            return
        self._answer(HTTPStatus.OK, JSON, json.dumps(reply).encode())

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        if self.begins:
            settings = f"Path={self.server.root}; HttpOnly; SameSite=Strict"
            self.send_header("Set-Cookie", f"{self.server.cookie}; {settings}")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def end_headers(self) -> None:
        """Add the headers of every answer."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, *_: Any) -> None:
        """Do not log requests."""
