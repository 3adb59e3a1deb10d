"""Time of the gestures of the viewer in headless Chromium with software rendering, and the
size of a page.

python -m benchmarks viewer PAGE.html
"""

from __future__ import annotations

import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
ROUNDS = 15
SECONDS = 4  # of each gesture, after as many in which the page chooses how many pixels it draws
# gestures of a user, one at each frame that the browser shows, until the time is over
GESTURES = """async () => {
    const {canvas} = skindb.painter(), found = {};
    const key = (shiftKey) => (i) => canvas.dispatchEvent(
        new KeyboardEvent("keydown", {key: i % 2 ? "ArrowLeft" : "ArrowRight", shiftKey}));
    const slide = (input) => (i) => {
        input.value = Number(input.min) + (0.5 + 0.01 * (i % 9)) * (input.max - input.min);
        input.dispatchEvent(new Event("input"));
    };
    const zoom = (i) => canvas.dispatchEvent(new WheelEvent("wheel", {deltaY: i % 2 ? 50 : -50}));
    const gestures = {turn: key(false), light: key(true), zoom};
    const sliders = "#lights :first-child [type=range], #environment [type=range], "
        + "#camera [type=range], #traits [type=range]";
    for (const input of document.querySelectorAll(sliders))
        gestures[`slider of ${input.ariaLabel}`] = slide(input);
    for (const [name, act] of Object.entries(gestures)) {
        let shown = 0, i = 0, start = performance.now();
        const end = start + 2000 * SECONDS, half = start + 1000 * SECONDS;
        for (let now = start; now < end; now = await new Promise(requestAnimationFrame)) {
            act(i++);
            if (now > half) shown++;
        }
        found[name] = [shown / SECONDS, canvas.width, canvas.height];
    }
    return [found, canvas.clientWidth, canvas.clientHeight];
}""".replace("SECONDS", str(SECONDS))
# the gestures take turns, so that other load slows all of them down alike; mean of two frames,
# because light under the skin follows at every other one
MEASURE = """async () => {
    const {state, painter} = skindb, {gl, canvas, face} = painter();
    const pixel = new Uint8Array(4), times = {};
    const gestures = {
        turn: (i) => { state.azimuth = i % 2 ? 5 : 0; },
        light: (i) => { state.lights[0].azimuth = i % 2 ? -20 : -15; },
        environment: (i) => { state.around.turn = i % 2 ? 5 : 0; },
    };
    face.traits.forEach((trait, k) => {
        gestures[`slider of ${trait.name}`] = (i) => {
            skindb.amounts(face.traits.map((_, j) => (j === k ? 0.5 + i / 100 : 0)));
        };
    });
    skindb.stop();
    const drawn = (change, coarse) => {
        const start = performance.now();
        for (const i of [0, 1]) {
            change(i);
            painter().draw(state, coarse);
            gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);  // waits for the frame
        }
        return (performance.now() - start) / 2;
    };
    for (const fraction of [0.5, 1]) {
        canvas.width = 800 * fraction;
        canvas.height = 600 * fraction;
        for (let i = 0; i <= ROUNDS; i++)
            for (const [name, change] of Object.entries(gestures)) {
                skindb.amounts(face.traits.map(() => 0));
                drawn(change, fraction < 1);  // begins the gesture
                const took = drawn(change, fraction < 1);
                if (i) (times[`${name} ${fraction}`] ||= []).push(took);
            }
    }
    return times;
}""".replace("ROUNDS", str(ROUNDS))


def main(page: Path) -> None:
    """Print what a user sees of each gesture, then the median time of a frame at two sizes,
    and its ratio to that of a turn.
    """
    print(f"{page.stat().st_size / 1e6:.1f} MB")
    with sync_playwright() as running:
        browser = running.chromium.launch(
            executable_path=shutil.which("chromium"), args=FLAGS
        )
        tab = browser.new_page(
            viewport={"width": 1120, "height": 600}, reduced_motion="reduce"
        )
        tab.set_default_timeout(0)
        tab.goto(page.resolve().as_uri())
        tab.evaluate("skindb.ready")
        shown, *size = tab.evaluate(GESTURES)
        times = tab.evaluate(MEASURE)
        browser.close()
    for name, (rate, *pixels) in shown.items():
        print(
            f"{size[0]} x {size[1]}, {name}: {rate:.1f} frames per second, drawn with "
            f"{pixels[0]} x {pixels[1]} pixels"
        )
    for name, samples in times.items():
        gesture, _, fraction = name.rpartition(" ")
        size = (
            "800 x 600"
            if fraction == "1"
            else "400 x 300 (while moving, shown at 800 x 600)"
        )
        median = sorted(samples)[ROUNDS // 2]
        turn = sorted(times[f"turn {fraction}"])[ROUNDS // 2]
        print(
            f"{size}, {gesture}: {median:.0f} ms, {1000 / median:.1f} frames per second, "
            f"{median / turn:.1f} turns"
        )
