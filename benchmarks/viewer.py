"""Frames per second of the viewer in headless Chromium with software rendering, and the
size of a page.

python -m benchmarks viewer PAGE.html
"""

from __future__ import annotations

import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAMES = 20
MEASURE = """async ([lights, glow, amount, still]) => {
    const canvas = document.getElementById('canvas'), gl = skindb.painter().gl;
    const pixel = new Uint8Array(4);
    while (skindb.state.lights.length < lights) document.getElementById('more').click();
    skindb.state.glow = glow;
    skindb.amounts(skindb.amounts().map(() => amount));
    skindb.state.azimuth = 0;
    // the face turns to and fro, so that all cases show it from the front
    const frame = async (i) => {
        if (still) { skindb.state.azimuth = i % 2 ? 5 : 0; skindb.stop(); skindb.draw(); }
        else {
            const key = i % 2 ? 'ArrowRight' : 'ArrowLeft';
            canvas.dispatchEvent(new KeyboardEvent('keydown', {key}));
            await new Promise(requestAnimationFrame);
        }
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);  // waits for the frame
    };
    await frame(0);
    const start = performance.now();
    for (let i = 0; i < FRAMES; i++) await frame(i);
    return 1000 * FRAMES / (performance.now() - start);
}""".replace("FRAMES", str(FRAMES))
CASES = (  # lights, subsurface scattering, amount of the traits, whether at rest
    (1, False, 0, True),
    (1, False, 0, False),
    (1, True, 0, False),
    (1, True, 1, True),
    (1, True, 1, False),
    (2, True, 1, False),
    (4, True, 1, False),
)


def main(page: Path) -> None:
    """Print the frame rate for each number of lights."""
    page_file = page
    print(f"{page_file.stat().st_size / 1e6:.1f} MB")
    with sync_playwright() as running:
        browser = running.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS
        )
        page = browser.new_page(viewport={"width": 1120, "height": 600})
        page.goto(page_file.resolve().as_uri())
        page.evaluate("skindb.ready")
        size = page.evaluate(
            "[skindb.painter().canvas.clientWidth, skindb.painter().canvas.clientHeight]"
        )
        print(f"canvas of {size[0]} x {size[1]} pixels")
        for lights, glow, amount, still in CASES:
            rate = page.evaluate(MEASURE, [lights, glow, amount, still])
            parts = [
                f"lights: {lights}",
                f"subsurface scattering {'on' if glow else 'off'}",
                f"traits at {amount}",
            ]
            parts.append("full resolution" if still else "while the view turns")
            print(f"{', '.join(parts)}: {rate:.1f} frames per second")
        browser.close()
