"""Frames per second of the viewer in headless Chromium with software rendering, and the size of a page.

python benchmarks/viewer.py PAGE.html
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAMES = 20
MEASURE = """([size, lights, glow]) => {
    const canvas = document.getElementById('canvas'), painter = skindb.painter();
    [canvas.width, canvas.height] = size;
    while (skindb.state.lights.length < lights) document.getElementById('more').click();
    skindb.state.glow = glow;
    const pixel = new Uint8Array(4), wait = () => painter.gl.readPixels(0, 0, 1, 1, 6408, 5121, pixel);
    skindb.draw(); wait();
    const start = performance.now();
    for (let i = 0; i < FRAMES; i++) { skindb.state.azimuth += 1; skindb.draw(); wait(); }
    return 1000 * FRAMES / (performance.now() - start);
}""".replace("FRAMES", str(FRAMES))


def main() -> None:
    """Print the frame rate for each number of lights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    page_file = parser.parse_args().page
    print(f"{page_file.stat().st_size / 1e6:.1f} MB")
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1120, "height": 600})
        page.goto(page_file.resolve().as_uri())
        page.evaluate("skindb.ready")
        for lights, glow in ((1, False), (1, True), (2, True), (4, True)):
            rate = page.evaluate(MEASURE, [[800, 600], lights, glow])
            print(f"{lights} lights, subsurface scattering {'on' if glow else 'off'}: {rate:.1f} frames per second")
        browser.close()


if __name__ == "__main__":
    main()
