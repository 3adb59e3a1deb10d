"""Write the pictures of the how-to guides that no other program makes.

    python docs/make_howtos.py [DB]

DB is the database of `make demo`, of which a copy is used. The page of landmarks is
drawn by Chromium. Pictures that `make_atlas.py`, `make_calibration.py`,
`skindb show` and the benchmarks wrote are reduced to 256 colours if they are large.
"""

from __future__ import annotations

import io
import json
import shutil
import sys
import tempfile
import threading
from collections.abc import Sequence
from html import escape
from pathlib import Path

import imagecodecs
import numpy as np
from click.testing import CliRunner
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import sync_playwright

from skindb.cli import cli
from skindb.view.landmarks import landmark_server, landmark_task

HERE = Path(__file__).parent
PICTURES = HERE / "pictures"
MAX_BYTES = 150_000
LINE, CHARACTER = 17, 7.3  # px, of the terminal
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SET = ("nose_tip", "nasion", "chin", "eye_outer_left")  # landmarks
MIN_BRIGHTNESS = 20  # of 255, mean over the lights: the subject
BOX = 'fill="#f3f0ee" stroke="#8a6d5d"'


def main() -> None:
    """Write all pictures."""
    db = Path(sys.argv[1] if sys.argv[1:] else HERE.parent / "demo/db")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(db, folder / "faces")
        terminals(folder / "faces")
        run("simulate", folder / "captures", "--takes=1", "--cameras=2", "--lights=14",
            "--width=240", "--height=300")  # fmt: skip
        photographs(folder / "captures/V001", folder)
        landmarks(folder / "captures/V001/scan.ply")
        targets(folder / "LAB")
    diagrams()
    for path in PICTURES.glob("*.png"):
        if path.stat().st_size > MAX_BYTES:
            reduced(Image.open(path).convert("RGB")).save(path, optimize=True)


def reduced(picture: Image.Image) -> Image.Image:
    """A picture of at most 800 pixels along a side and 256 colours."""
    picture.thumbnail((800, 800))
    return picture.quantize(256, dither=Image.Dither.FLOYDSTEINBERG)


def run(*words: object) -> str:
    """Output of a command; raises what it raises."""
    result = CliRunner().invoke(
        cli, [*map(str, words), "--progress", "none"], catch_exceptions=False
    )
    if result.exit_code:
        raise RuntimeError(result.output)
    return result.output


def terminals(db: Path) -> None:
    """Pictures of commands on the database with what they print."""
    for name, command, lines in (
        ("database", ["info", db], 18),
        ("privacy", ["withdraw", db, "V003", "--dry-run"], 12),
    ):
        shown = " ".join(str(w).replace(str(db), "faces") for w in command)
        text = run(*command).replace(str(db), "faces").splitlines()[:lines]
        terminal(name, [f"$ skindb {shown}", *text])


def terminal(name: str, lines: Sequence[str]) -> None:
    """Draw lines as on a terminal of 100 columns."""
    cut = [line if len(line) <= 100 else f"{line[:99]}…" for line in lines]
    width = 24 + CHARACTER * max(map(len, cut))
    rows = "".join(
        f'<text x="12" y="{26 + LINE * i}" xml:space="preserve">{escape(line)}</text>'
        for i, line in enumerate(cut)
    )
    write(name, width, 20 + LINE * len(cut), '<rect width="100%" height="100%" rx="6" '
          'fill="#22201f"/><g font-family="monospace" font-size="12" fill="#e8e2dd">'
          f"{rows}</g>")  # fmt: skip


def write(name: str, width: float, height: float, body: str) -> None:
    """Write an SVG picture of a guide."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}">'
    (PICTURES / f"howto_{name}.svg").write_text(f"{head}{body}</svg>\n", "utf-8")


def diagrams() -> None:
    """Boxes and arrows: a cluster, a bucket, and states of a backup."""
    chain("cluster", ["skindb fit DB --scheduler", "a task for each take", "workers",
                      "a commit for each take"])  # fmt: skip
    chain("bucket", ["worker", "objects of the version", "record, if there is none",
                     "visible to all"])  # fmt: skip
    chain("backup", ["database, in use", "state 1, state 2, ... share files",
                     "restore, without withdrawn subjects", "new database"])  # fmt: skip


def chain(name: str, labels: Sequence[str]) -> None:
    """Boxes below each other, joined by arrows."""
    width = 7 * max(map(len, labels)) + 24
    middle = width / 2 + 4
    body = ""
    for y, label in zip(range(4, 1000, 62), labels, strict=False):
        if y > 4:
            body += f'<path d="M{middle} {y - 24}v20m-5 -7l5 7l5 -7" fill="none" stroke="#8a6d5d"/>'
        body += (
            f'<rect x="4" y="{y}" width="{width}" height="36" rx="5" {BOX}/>'
            f'<text x="{middle}" y="{y + 23}" text-anchor="middle">{label}</text>'
        )
    style = 'font-family="sans-serif" font-size="13" fill="#333"'
    write(name, width + 8, 62 * len(labels) - 18, f"<g {style}>{body}</g>")


def photographs(capture: Path, folder: Path) -> None:
    """Frames of one camera, and what `quick` makes of them."""
    dome = json.loads((capture / "dome/dome.json").read_text())
    camera = dome["cameras"][0]
    turn = np.array(camera["R"]) * [[1], [-1], [-1]]  # x right, y up, z to the camera
    (folder / "in").mkdir()
    lines, shown = ["picture,x,y,z"], []
    for light in dome["lights"]:
        frame = dome["frames"].format(
            exposure=dome["exposures"][0]["id"], light=light["id"], camera=camera["id"]
        )
        picture = displayed(
            imagecodecs.png_decode((capture / frame).read_bytes()), camera
        )
        Image.fromarray(picture).save(folder / f"in/{light['id']}.png")
        direction = turn @ np.array(light["position"])
        lines.append(f"{light['id']}.png,{','.join(map(str, direction))}")
        shown.append(picture)
    bright = sorted(shown, key=np.mean, reverse=True)
    mask = np.mean(shown, axis=0).mean(axis=-1) > MIN_BRIGHTNESS
    Image.fromarray(np.uint8(255 * mask)).save(folder / "in/mask.png")
    side_by_side("capture", bright[:5])
    (folder / "lights.csv").write_text("\n".join(lines))
    run("quick", folder / "in", folder / "out", "--lights", folder / "lights.csv")
    maps = [folder / f"out/{name}.png" for name in ("normals", "albedo", "gloss")]
    side_by_side(
        "pictures", [bright[0], *(np.array(Image.open(m).convert("RGB")) for m in maps)]
    )


def targets(lab: Path) -> None:
    """One camera's frames of calibration targets, whose few colours are kept."""
    for kind in ("board", "white", "ball", "chart"):
        run("capture", lab, "--calibration", kind, "--virtual")
    camera = json.loads((lab / "dome/dome.json").read_text())["cameras"][1]
    names = ("calibration/board_1_c01", "calibration/board_2_c01", "white/e0/l003_c01",
             "calibration/ball_1_l005_c01", "calibration/chart_c01_f0")  # fmt: skip
    files = [lab / f"dome/{name}.png" for name in names]
    frames = [imagecodecs.png_decode(file.read_bytes()) for file in files]
    joined = Image.fromarray(
        np.concatenate([displayed(frame, camera) for frame in frames], axis=1)
    )
    few = joined.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(PICTURES / "howto_laboratory.png", optimize=True)


def displayed(frame: NDArray[np.uint16], camera: dict[str, float]) -> NDArray[np.uint8]:
    """Values of a linear frame as sRGB of 8 bits."""
    black, white = camera["black_level"], camera["white_level"]
    linear = np.clip((frame.astype(float) - black) / (white - black), 0, 1)
    return np.uint8(255 * np.where(linear < 0.0031308, 12.92 * linear,
                                   1.055 * linear ** (1 / 2.4) - 0.055))  # fmt: skip


def side_by_side(name: str, pictures: Sequence[NDArray[np.uint8]]) -> None:
    """Write pictures of one height beside each other."""
    equal = [
        Image.fromarray(p).resize((round(240 * p.shape[1] / p.shape[0]), 240))
        for p in pictures
    ]
    joined = Image.fromarray(np.concatenate(list(map(np.array, equal)), axis=1))
    joined.save(PICTURES / f"howto_{name}.png", optimize=True)


def landmarks(scan: Path) -> None:
    """The page of landmarks with four points set, and suggestions for the others."""
    points = json.loads(scan.with_name("landmarks.json").read_text())
    some = scan.with_name("some.json")
    some.write_text(json.dumps({name: points[name] for name in SET}))
    server = landmark_server(landmark_task(scan, some))
    with server, sync_playwright() as playwright:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS
        )
        page = browser.new_page(viewport={"width": 900, "height": 560})
        page.goto(server.address)
        page.evaluate("skindb.ready")
        page.wait_for_timeout(2000)
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        browser.close()
        server.shutdown()
    reduced(picture).save(PICTURES / "howto_landmarks.png", optimize=True)


if __name__ == "__main__":
    main()
