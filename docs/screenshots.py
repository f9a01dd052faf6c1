"""Draw the pictures of the wizard in README and the quick start: an Autopilot run on the simulated
rig.

    python docs/screenshots.py [--all FOLDER]

`--all` also writes pictures of all steps into FOLDER, before, during and after the run, in several
sizes, light and dark: to be looked at after changes of the page.

Needs Chromium and the packages of the extra `test`; it takes some minutes. Writes
`assets/readme/wizard.webp`, which is animated, and `docs/images/wizard_*.png`.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from chromium import launched  # noqa: E402

SIZE = {"width": 1280, "height": 800}
SHOWN_WIDTH = 800
EVERY_S, LONGEST_S = 0.7, 1200.0
FRAME_MS = 900
TITLE = re.compile("[1-9]\\u2002([A-Z][a-z]+)")  # its number, an en space, its name
MOST_A_STEP = 2
"""Frames of each step in the animation: its beginning and its end."""
PICTURES = {
    "Poses": "wizard_poses",
    "Calibrate": "wizard_calibrate",
    "Scan": "wizard_scan",
    "Measure": "wizard_measure",
}
"""Pictures of the quick start: the last of a step."""
SIZES = ((1280, 800), (1440, 900), (1920, 1080))
STEPS = ["Rig", "Target", "Poses", "Calibrate", "Verify", "Scan", "Merge", "Measure", "Export"]


def draw_looks(page: Page, folder: Path, name: str) -> None:
    """Write pictures of the page as it is now, in all sizes, light and dark."""
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            time.sleep(1)
            page.screenshot(path=folder / f"{name}_{width}x{height}_{scheme}.png")
    page.set_viewport_size(SIZE)  # type: ignore[arg-type]
    page.emulate_media(color_scheme="light")


def draw_steps(page: Page, folder: Path, name: str) -> None:
    """Write pictures of all steps."""
    for number, step in enumerate(STEPS, 1):
        page.get_by_role("button", name=f"{number}. {step}").click()
        time.sleep(6)  # the view moves, and a cloud is loaded
        draw_looks(page, folder, f"{number}_{step}_{name}")


def draw_autopilot(
    page: Page, folder: Path, on_step: Callable[[str], None] = lambda _: None
) -> list[tuple[str, Path]]:
    """Run the Autopilot, and return (the step's title, screenshot) at intervals until it has
    ended; `on_step` is called once in each step."""
    page.get_by_role("button", name="Autopilot").click()
    page.get_by_role("button", name="Stop autopilot").wait_for()
    shots: list[tuple[str, Path]] = []
    end = time.monotonic() + LONGEST_S
    while time.monotonic() < end:
        path, step = folder / f"{len(shots):03d}.png", find_step(page)
        page.screenshot(path=path)
        if step == find_step(page):  # else the picture may show either
            if step and step not in [known for known, _ in shots]:
                on_step(step)
            shots.append((step, path))
        if not page.get_by_role("button", name="Stop autopilot").is_visible():
            return shots
        time.sleep(EVERY_S)
    raise SystemExit("the Autopilot did not end")


def find_step(page: Page) -> str:
    """Return the title of the step that is shown, such as "Calibrate"; empty where none is."""
    title = TITLE.search(page.inner_text("body"))
    return title[1] if title else ""


def write_animation(shots: list[Path], path: Path) -> None:
    """Write an animated WebP of screenshots, reduced."""
    frames = []
    for shot in shots:
        frame = Image.open(shot).convert("RGB")
        frame.thumbnail((SHOWN_WIDTH, SHOWN_WIDTH), Image.Resampling.LANCZOS)
        frames.append(frame)
    durations = [FRAME_MS] * (len(frames) - 1) + [4 * FRAME_MS]
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        quality=60,
        method=6,
    )


def main() -> None:
    """Start the wizard on loopback, drive it, and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", type=Path, help="folder for pictures of all steps")
    everything: Path | None = parser.parse_args().all
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        scans = Path(tempfile.gettempdir(), "scans")  # a name that may be shown
        scans.mkdir()
        command = [
            sys.executable,
            "-m",
            "slviewer.cli",
            "wizard",
            f"{scans}/first-session",
            "--port",
            "0",
        ]
        server = subprocess.Popen(
            [*command, "--no-browser"], stdout=subprocess.PIPE, text=True, cwd=folder
        )
        try:
            assert server.stdout is not None
            link = next(line for line in server.stdout if "slviewer is ready" in line).split()[3]
            browser = launched(playwright.chromium)
            page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
            page.goto(link)
            page.get_by_role("button", name="Autopilot").wait_for(timeout=60_000)
            page.get_by_text("frames/s").wait_for(timeout=60_000)
            time.sleep(12)  # until a line about the renderer is gone, and the preparation begins
            page.get_by_text("Preparing,").first.wait_for(state="hidden", timeout=1000 * LONGEST_S)
            page.mouse.move(640, 400)  # no hint is shown
            page.screenshot(path=Path(folder) / "start.png")
            if everything is None:
                shots = draw_autopilot(page, Path(folder))
            else:
                everything.mkdir(parents=True, exist_ok=True)
                draw_steps(page, everything, "before")
                page.get_by_role("button", name="1. Rig").click()
                shots = draw_autopilot(
                    page,
                    Path(folder),
                    lambda step: draw_looks(
                        page, everything, f"{STEPS.index(step) + 1}_{step}_during"
                    ),
                )
                draw_steps(page, everything, "after")
            # the Autopilot leaves the step before its last result is drawn
            page.get_by_role("button", name="8. Measure").click()
            time.sleep(8)
            shots.append(("Measure", Path(folder) / "measured.png"))
            page.screenshot(path=shots[-1][1])
            browser.close()
        finally:
            server.terminate()
            server.wait(30)
            shutil.rmtree(scans)
        by_step: dict[str, list[Path]] = {"start": [Path(folder) / "start.png"]}
        for step, path in shots:
            by_step.setdefault(step, []).append(path)
        animated = [
            path for paths in by_step.values() for path in paths[:1] + paths[1:][-MOST_A_STEP + 1 :]
        ]
        write_animation(animated, ROOT / "assets" / "readme" / "wizard.webp")
        for step, name in PICTURES.items():
            image = (
                Image.open(by_step[step][-1])
                .convert("RGB")
                .resize((960, 600), Image.Resampling.LANCZOS)
            )
            # which keeps the hues of thin lines beside many greys
            image.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
                ROOT / "docs" / "images" / f"{name}.png", optimize=True
            )


if __name__ == "__main__":
    main()
