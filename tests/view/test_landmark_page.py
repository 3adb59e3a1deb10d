"""The page that sets landmarks, in headless Chromium, and its server."""

from __future__ import annotations

import json
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import trimesh
from browser_page import inaccessible, opened
from page_session import Session, running
from waiting import wait_until

from skindb.format.folder import read_capture
from skindb.geometry.scan import Crop
from skindb.view.landmarks import landmark_server, landmark_task
from skindb.virtual.face import FaceShape
from skindb.virtual.head import parametric_head

MAX_CLICK_ERROR_MM = 0.5  # about a pixel; measured: median 0.02 mm


@pytest.fixture(scope="module")
def head():
    return parametric_head(FaceShape(nose_length=3.0, jaw_width=56.0), spacing_mm=2.0)


@pytest.fixture
def server(head, tmp_path):
    """Server of the page of a head that has no landmarks yet; the ball behind it must
    not be clicked.
    """
    ball = trimesh.creation.icosphere(2, radius=70.0)
    vertices = np.concatenate([head.vertices, ball.vertices - [0, 0, 100]])
    faces = np.concatenate([head.faces, ball.faces[:, ::-1] + len(head.vertices)])
    colours = np.full((len(vertices), 4), [200, 60, 60, 255], np.uint8)
    trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False).export(
        tmp_path / "scan.ply"
    )
    with served(tmp_path) as found:
        yield found


@pytest.fixture
def address(server):
    return server.address


def served(folder):
    return running(
        landmark_server(landmark_task(folder / "scan.ply", folder / "landmarks.json"))
    )


def on_canvas(page, place):
    x, y = page.evaluate("(p) => skindb.project(p)", [float(c) for c in place])
    box = page.locator("#canvas").bounding_box()
    return box["x"] + x, box["y"] + y


def point(page, name):
    return page.evaluate("(name) => skindb.state.points[name]", name)


def status(page, text):
    page.wait_for_function(
        "(text) => document.getElementById('status').textContent.includes(text)",
        arg=text,
    )


@pytest.mark.slow
def test_page__a_click_sets_the_next_point_where_it_is(browser, address, head):
    page = opened(browser, address, width=860, height=500)
    names = page.evaluate("Object.keys(skindb.state.names)")
    assert {*names} == {*head.landmarks}
    for name in names:
        assert page.evaluate("skindb.state.selected") == name
        azimuth = {"jaw_right": -75, "jaw_left": 75}.get(name, 0)
        page.evaluate("(a) => { skindb.view.azimuth = a; skindb.draw(); }", azimuth)
        page.mouse.click(*on_canvas(page, head.landmarks[name]))
    found = np.array([point(page, name) for name in names])
    truth = np.array([head.landmarks[name] for name in names])
    # triangles of 2 mm cut the true surface, so that the nearest point of the mesh
    # counts; where the surface is seen at a grazing angle (wings of the nose, jaw), the
    # ray to the true point meets it up to 0.4 mm away
    on_mesh = trimesh.proximity.closest_point_naive(
        trimesh.Trimesh(head.vertices, head.faces, process=False), truth
    )[0]
    error = np.linalg.norm(found - on_mesh, axis=1)
    assert error.max() < MAX_CLICK_ERROR_MM, dict(zip(names, error, strict=True))
    # single precision, and clicks at fractions of a pixel
    assert np.median(error) < 0.05
    assert page.evaluate("skindb.state.selected") is None
    assert page.locator("#count").inner_text() == "20 of 20 points are set."
    assert not page.problems
    page.close()


def write_capture(folder):
    """The capture.json of a folder with a scan and landmarks, and nothing else."""
    consent = {"scope": ["fit"], "reference": "test"}
    record = {
        "format": "skindb-capture",
        "version": 2,
        "subject": "S1",
        "session": "2026-01-01T10:00:00Z",
    }
    record |= {"consent": consent, "mesh": "scan.ply", "landmarks": "landmarks.json"}
    (folder / "capture.json").write_text(json.dumps(record))


@pytest.mark.slow
def test_page__saves_what_ingest_reads(browser, address, head, tmp_path):
    out = tmp_path / "landmarks.json"
    page = opened(browser, address, width=860, height=500)
    page.mouse.click(*on_canvas(page, head.landmarks["forehead_centre"]))
    page.get_by_role("button", name="Save", exact=True).click()
    status(page, "Nothing is saved yet")
    assert "19 of the 20 points are missing" in page.locator("#questions").inner_text()
    page.get_by_role("button", name="Cancel").click()
    assert not out.exists()
    page.wait_for_function("Object.keys(skindb.state.suggestions).length === 19")
    page.get_by_role("button", name="Accept all suggestions").click()
    page.get_by_label("y from").fill("-100")
    page.get_by_role("button", name="Save", exact=True).click()
    status(page, "20 points were saved")
    assert "landmarks.crop.json" in page.locator("#status").inner_text()
    box = json.loads((tmp_path / "landmarks.crop.json").read_text())
    assert box["low"][1] == -100
    write_capture(tmp_path)
    capture = read_capture(tmp_path)  # crops by the saved box
    assert capture.crop == Crop(tuple(box["low"]), tuple(box["high"]))
    assert {*capture.landmarks} == {*head.landmarks}
    for name, place in capture.landmarks.items():
        # three decimals of a mm
        np.testing.assert_allclose(place, point(page, name), atol=0.5e-3)
    assert capture.surface.vertices[:, 1].min() >= -100
    page.get_by_label("y from").fill("-105")
    # its own file is replaced without a question
    page.get_by_role("button", name="Save", exact=True).click()
    crop_file = tmp_path / "landmarks.crop.json"
    wait_until(lambda: json.loads(crop_file.read_text())["low"][1] == -105)
    status(page, "20 points were saved")
    page.get_by_role("button", name="Remove chin").click()
    status(page, "The changes since the last save are not saved yet.")
    # Chromium asks, because there are changes
    page.on("dialog", lambda dialog: dialog.accept())
    page.reload()
    page.evaluate("skindb.ready")
    # as in the file
    assert page.locator("#count").inner_text() == "20 of 20 points are set."
    assert page.get_by_label("y from").input_value() == "-105"
    assert not page.problems
    page.close()


@pytest.mark.slow
def test_page__reads_an_existing_file_and_asks_before_it_is_replaced(
    browser, address, head, tmp_path
):
    out = tmp_path / "landmarks.json"
    out.write_text(json.dumps({name: p.tolist() for name, p in head.landmarks.items()}))
    with served(tmp_path) as again:
        page = opened(browser, again.address, width=860, height=500)
        assert page.locator("#count").inner_text() == "20 of 20 points are set."
        before = out.read_bytes()
        page.get_by_role("button", name="Remove chin").click()
        page.get_by_role("button", name="Undo").click()
        page.get_by_role("button", name="Save", exact=True).click()
        status(page, "Nothing is saved yet")
        assert out.read_bytes() == before
        page.get_by_role("button", name="Save anyway").click()
        status(page, "20 points were saved")
        assert out.read_bytes() != before
        page.close()


@pytest.mark.slow
def test_page__points_are_moved_removed_undone_and_accepted(browser, address, head):
    page = opened(browser, address, width=860, height=500)
    start = on_canvas(page, head.landmarks["nasion"])
    page.get_by_role("button", name="nasion", exact=True).click()
    page.mouse.click(*start)
    first = point(page, "nasion")
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0], start[1] - 10)
    page.mouse.move(start[0], start[1] - 20)
    page.mouse.up()
    up = point(page, "nasion")
    # px, single precision
    np.testing.assert_allclose(on_canvas(page, up), (start[0], start[1] - 20), atol=0.1)
    page.keyboard.press("Control+z")
    assert point(page, "nasion") == first
    page.get_by_role("button", name="Remove nasion").click()
    assert point(page, "nasion") is None
    page.get_by_role("button", name="Undo").click()
    assert point(page, "nasion") == first
    page.wait_for_function("'chin' in skindb.state.suggestions")
    # in one step: the next suggestions may be on their way
    accept = page.get_by_role("button", name="Accept chin")
    chin = accept.evaluate(
        "(one) => { const p = skindb.state.suggestions.chin; one.click(); return p; }"
    )
    assert point(page, "chin") == chin
    turned = page.evaluate("skindb.view.azimuth")
    page.mouse.move(60, 60)
    page.mouse.down()
    page.mouse.move(160, 60)
    page.mouse.up()
    assert page.evaluate("skindb.view.azimuth") != turned
    assert page.evaluate("Object.keys(skindb.state.points).length") == 2
    assert not page.problems
    page.close()


def test_page__works_with_keys_and_shows_the_scans_colours(browser, address):
    page = opened(browser, address, width=860, height=500)
    canvas = page.locator("#canvas")
    redness = """() => {
        skindb.draw();
        const gl = document.getElementById('canvas').getContext('webgl2');
        const pixel = new Uint8Array(4);
        const [x, y] = [gl.drawingBufferWidth / 2, gl.drawingBufferHeight * 0.35];
        gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
        return pixel[0] / pixel[1];
    }"""
    # one may lie where the pixel is read
    page.get_by_label("show suggestions").uncheck()
    assert page.evaluate(redness) == pytest.approx(200 / 60, rel=0.05)  # of eight bits
    page.get_by_label("show the colours").uncheck()
    assert page.evaluate(redness) < 1.3
    canvas.focus()
    canvas.press("ArrowLeft")
    assert page.evaluate("skindb.view.azimuth") == 5
    canvas.press("0")
    assert page.evaluate("skindb.view.azimuth") == 0
    canvas.press("Enter")
    assert page.evaluate("Object.keys(skindb.state.points)") == ["forehead_centre"]
    for control in page.locator("input, button, canvas").all():
        assert control.evaluate(
            "(one) => one.ariaLabel || one.labels?.[0]?.textContent || one.textContent"
        ).strip()
    assert not page.problems
    page.close()


@pytest.mark.slow
def test_page__fits_a_width_of_400_px(browser, address):
    page = opened(browser, address, width=400, height=800)
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    page.close()


@pytest.mark.slow
def test_landmark_server__saves_nothing_for_others(server, tmp_path):
    """A page that knows the address, but not the token, can neither read the scan nor
    write landmarks.
    """
    body = json.dumps({"points": {"chin": [0, 0, 0]}}).encode()
    stranger = Session(server.address)
    session = Session.opened(server.address)
    for name in ("save", "suggest"):
        assert stranger.status("POST", name, body) == 403
        assert session.status("POST", name, body, Origin="http://example.org") == 403
        assert session.status("POST", name, body, Host="example.org") == 403
    assert stranger.status("GET", "mesh") == 403
    assert session.status("GET", "../scan.ply") == 404
    assert session.status("GET", "mesh") == 200
    assert "faults" in session.post("save", {})
    assert [*tmp_path.glob("*landmarks*")] == []


def test_landmark_server__says_what_is_wrong_with_what_it_gets(server, head):
    session = Session.opened(server.address)

    def faults(points, **more):
        return " ".join(session.post("save", {"points": points, **more})["faults"])

    assert "three" in faults({"chin": "x"}) or "[x, y, z]" in faults({"chin": "x"})
    assert "within 1 mm of the scan" in faults({"chin": [0, 0, 500]})
    chin = head.landmarks["chin"].tolist()
    assert "lower corner must lie below" in faults(
        {"chin": chin}, crop={"low": [1, 1, 1], "high": [0, 0, 0]}
    )


class _Foreign(BaseHTTPRequestHandler):
    """A page of another user's server on this machine, which is of the same site to a browser."""

    def do_GET(self):
        self.server.cookies.append(self.headers.get("Cookie", ""))
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<p>foreign</p>")

    def log_message(self, *_):
        pass


FOREIGN_REQUEST = """async ([address, options]) => {
    try { const answer = await fetch(address, options); return `${answer.type} ${answer.status}`; }
    catch (error) { return error.name; }
}"""


@pytest.mark.slow
def test_landmark_server__a_page_of_another_server_in_the_same_browser_gets_nothing(
    server, browser, tmp_path
):
    own = opened(browser, server.address, width=860, height=500)
    cookies = own.context.cookies(
        f"http://127.0.0.1:{server.server_address[1]}{server.root}"
    )
    assert [(cookie["httpOnly"], cookie["sameSite"]) for cookie in cookies] == [
        (True, "Strict")
    ]
    foreign_server = ThreadingHTTPServer(("127.0.0.1", 0), _Foreign)
    foreign_server.cookies = []
    with running(foreign_server):
        own.goto(f"http://127.0.0.1:{foreign_server.server_address[1]}/")
        save = {
            "method": "POST",
            "credentials": "include",
            "body": json.dumps({"points": {"chin": [0, 0, 0]}}),
        }
        # as if it were known
        address = f"http://127.0.0.1:{server.server_address[1]}{server.root}"
        assert own.evaluate(FOREIGN_REQUEST, [f"{address}save", save]) == "TypeError"
        assert (
            own.evaluate(
                FOREIGN_REQUEST, [f"{address}save", save | {"mode": "no-cors"}]
            )
            == "TypeError"
        )
        assert (
            own.evaluate(
                FOREIGN_REQUEST, [f"{address}mesh", {"credentials": "include"}]
            )
            == "TypeError"
        )
    # ports share cookies, but not their paths
    assert foreign_server.cookies == [""] * len(foreign_server.cookies)
    assert len(foreign_server.cookies) > 0
    assert [*tmp_path.glob("*landmarks*")] == []
    own.close()


@pytest.mark.slow
def test_landmark_page__names_are_data(server, browser, tmp_path):
    """Names of landmarks and files are neither markers of the template nor the end of a script."""
    name = (
        "$script </script><script>document.title = 'x'</script> \u2028 ${out} {about}"
    )
    (tmp_path / "landmarks.json").write_text(json.dumps({name: [0, 0, 60]}))
    page = opened(browser, server.address, width=860, height=500)
    assert page.title() == "Landmarks of scan.ply"
    assert page.evaluate("Object.keys(skindb.state.points)") == [name]
    assert not page.problems
    page.close()


def test_page__is_accessible(browser, address):
    page = opened(browser, address, width=860, height=500)
    assert inaccessible(page) == []
    page.close()
