"""The server of a page: who is answered, and with what."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import pytest
from page_session import Session, running

from skindb.errors import Fault, InputError
from skindb.view.page import HTML, JSON, Content, PageServer

METHODS = (
    "GET",
    "HEAD",
    "POST",
    "PUT",
    "DELETE",
    "OPTIONS",
    "PATCH",
    "TRACE",
    "CONNECT",
    "PROPFIND",
    "get",
)


def _refuse():
    raise InputError(
        Fault(
            "S1",
            "its subject must consent to exports",
            "no such consent",
            "show another take",
        )
    )


@pytest.fixture
def server(tmp_path):
    (tmp_path / "faces").mkdir()
    (tmp_path / "faces/S1.json").write_text("on the disk")
    contents = {
        "": Content(HTML, lambda: b"<p>page</p>"),
        "faces/S1.json": Content(JSON, lambda: b'{"face": 1}'),
        "faces/S2.json": Content(JSON, _refuse),
    }
    with running(
        PageServer(contents, {"save": lambda request: {"seen": request}})
    ) as served:
        yield served


@pytest.fixture
def session(server):
    return Session.opened(server.address)


def test_server__the_token_opens_one_session(server):
    first = Session.opened(server.address)
    assert (first.page.status, first.page.body) == (200, b"<p>page</p>")
    name, *settings = first.page.headers["Set-Cookie"].split("; ")
    assert settings == [f"Path={server.root}", "HttpOnly", "SameSite=Strict"]
    assert len(name) > 40
    assert first.request("GET", "").body == b"<p>page</p>"
    assert first.request("GET", "faces/S1.json").body == b'{"face": 1}'
    assert "Set-Cookie" not in first.request("GET", "").headers
    address = urlsplit(server.address)
    again = Session(server.address).request("GET", f"{address.path}?{address.query}")
    assert again.status == 403
    assert b"page</p>" not in again.body
    assert first.status("GET", f"{address.path}?{address.query}") == 200  # a reload


def test_server__a_token_is_accepted_once_by_concurrent_requests(server):
    address = urlsplit(server.address)
    start = threading.Barrier(8)

    def open_page(_):
        start.wait(10)
        return Session(server.address).status("GET", f"{address.path}?{address.query}")

    with ThreadPoolExecutor(8) as pool:
        assert sorted(pool.map(open_page, range(8))) == [200] + [403] * 7


def test_server__only_a_get_of_the_page_uses_the_token(server):
    address = urlsplit(server.address)
    stranger = Session(server.address)
    for method, path in [
        ("HEAD", ""),
        ("POST", ""),
        ("POST", "save"),
        ("GET", "faces/S1.json"),
        ("OPTIONS", ""),
    ]:
        assert stranger.status(method, f"{path}?{address.query}", b"{}") == 403
    assert stranger.status("GET", f"/?{address.query}") == 403
    assert stranger.status("GET", f"{address.path}?{address.query}&x=1") == 403
    assert stranger.status("GET", f"{address.path}?{address.query[:-1]}") == 403
    assert Session.opened(server.address).page.status == 200


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_server__no_method_is_answered_without_the_session(server, session, method):
    for cookie in (
        None,
        "",
        "skindb",
        "skindb=",
        "skindb=x",
        session.cookie[:-1],
        session.cookie + "x",
        "x=y; a=b",
    ):
        for path in ("", "save", "faces/S1.json", "/", "/etc/passwd", "absent"):
            answer = Session(server.address, cookie=cookie).request(method, path, b"{}")
            assert answer.status == 403, (method, cookie, path)
            assert b"HTTP/1" not in answer.body  # a second answer
            assert b"face" not in answer.body.replace(path.encode() or b" ", b"")


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_server__no_method_is_answered_to_other_hosts_and_origins(session, method):
    own = session.host
    hosts = [
        "example.org",
        f"example.org:{own[10:]}",
        f"{own}.example.org",
        "",
        None,
        f"x@{own}",
        [own, own],
        "127.0.0.2",
    ]
    for host in hosts:
        assert session.status(method, "", b"{}", Host=host) == 403, host
    origins = [
        "http://example.org",
        f"https://{own}",
        f"http://{own}0",
        f"http://{own}/",
        "null",
        "",
        "http://127.0.0.1:1",
    ]
    for origin in [*origins, f"http://localhost{own[9:]}", [f"http://{own}"] * 2]:
        assert session.status(method, "", b"{}", Origin=origin) == 403, origin


def test_server__answers_through_a_tunnel_from_another_port(session):
    assert session.status("GET", "", Host="localhost:8000") == 200
    assert (
        session.status(
            "POST", "save", b"{}", Host="localhost:8000", Origin="http://localhost:8000"
        )
        == 200
    )


def test_server__a_post_needs_an_origin_and_json(session):
    assert session.post("save", {"a": 1}) == {"seen": {"a": 1}}
    assert session.status("POST", "save", b"{}", Origin=None) == 403
    assert session.status("POST", "save", b"{}", Content_Type="text/plain") == 415
    assert session.status("POST", "save", b"{") == 400
    assert session.status("POST", "save", b"[" * 100_000) == 400
    assert session.status("POST", "save", b"{}", Content_Length="1000001") == 413
    for length in ("-1", "x", "", None, "1e3", "\u0662".encode().decode("latin-1")):
        assert session.status("POST", "save", None, Content_Length=length) == 413
    assert session.status("POST", "other", b"{}") == 404
    assert session.status("PUT", "save", b"{}") == 501


def test_server__serves_names_and_no_files(session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("/etc")
    absent = [
        "faces",
        "faces/",
        ".",
        "..",
        "../",
        "faces/../faces/S1.json",
        "faces/S3.json",
        "link/passwd",
        "//etc/passwd",
    ]
    absent += [
        "/",
        "/faces/S1.json",
        "faces/S1.json/",
        "%66aces/S1.json",
        "faces%2fS1.json",
        "\\",
        "save",
    ]
    for name in absent:
        assert session.status("GET", name) == 404, name
    head = session.request("HEAD", "faces/S1.json")
    assert (head.status, head.headers["Content-Length"], head.body) == (200, "11", b"")
    assert session.status("GET", "faces/S1.json?x=1") == 200


def test_server__names_a_fault_of_a_content(session):
    refused = session.request("GET", "faces/S2.json")
    assert refused.status == 404
    assert refused.body.startswith(
        b"S1: its subject must consent to exports; found no such consent"
    )


def test_server__every_answer_forbids_caching_framing_and_other_sources(session):
    for answer in (
        session.page,
        session.request("GET", "absent"),
        session.request("GET", "", Host="x.org"),
    ):
        assert answer.headers["Cache-Control"] == "no-store"
        assert answer.headers["Referrer-Policy"] == "no-referrer"
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert "Python" not in answer.headers["Server"]


def test_server__listens_on_this_machine_and_two_servers_have_different_secrets(server):
    assert server.server_address[0] == "127.0.0.1"
    with PageServer({}, {}) as other:
        assert (
            len(
                {
                    server.root,
                    other.root,
                    server.cookie,
                    other.cookie,
                    server.address,
                    other.address,
                }
            )
            == 6
        )
    with pytest.raises(
        InputError,
        match=r"port [0-9]+: must be free; found .*; choose another port, or omit --port",
    ):
        PageServer({}, {}, port=server.server_address[1])
