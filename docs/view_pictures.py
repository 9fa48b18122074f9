"""Makes the pictures of docs/view.md and of the README: a run in the browser, live and replayed; needs chromium.

`.venv/bin/python docs/view_pictures.py [FOLDER [NAME...]]`: all of them into docs/, if nothing is named.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from agents.network.endpoints import free_endpoint
from experiments.file.document import load
from experiments.run import simulate

ROOT = Path(__file__).resolve().parents[1]
FLAGS = ["--no-sandbox", "--disable-quic", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--ignore-gpu-blocklist"]  # fmt: skip
OBSTACLES = ["--set", "arena.obstacles.crate={box=[0.3, 0.2], at=[0.75, 0.1], height=0.3}",
             "--set", "arena.obstacles.post={radius=0.07, at=[-0.85, 0.1], height=0.6}"]  # fmt: skip
REDRAW_S = 6.0  # without a graphics card


@dataclass(frozen=True)
class Picture:
    """Picture of a replay."""

    name: str
    folder: Path
    at_s: float
    size: tuple[int, int] = (1280, 720)
    dark: bool = False


def main() -> None:
    """Makes all pictures."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs"
    wanted = sys.argv[2:]
    with tempfile.TemporaryDirectory() as made, sync_playwright() as driver:
        both, one = Path(made) / "robotic-park", Path(made) / "robotic-park-event"
        for folder, cases in ((both, ()), (one, ("event",))):
            folder.mkdir()
            simulate(load("robotic-park"), cases=cases, folder=folder)
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), headless=True, args=FLAGS)
        for picture in (
            Picture("view", one, 13.5),
            Picture("view-replay", both, 24.0),
            Picture("view-dark", one, 12.0, dark=True),
            Picture("view-phone", one, 30.0, size=(390, 844)),
        ):
            if wanted and picture.name not in wanted:
                continue
            with _viewing(picture.folder.name, *(["--dark"] if picture.dark else []), folder=Path(made)) as address:
                page = _open(browser, address, picture.size)
                if picture.size[0] > 600:
                    box = page.locator("input[type=text]").nth(0)
                    box.fill(str(picture.at_s))
                    box.press("Enter")
                _save(page, target / f"{picture.name}.png")
        if not wanted or "view-live" in wanted:
            _live(browser, target / "view-live.png", Path(made) / "live")
        browser.close()


def _live(browser: object, target: Path, folder: Path) -> None:
    """A picture of a run in real time."""
    command = [sys.executable, "-m", "tools.guard", "run", "robotic-park", "--case", "event", "--no-report",
               "--set", "duration_s=90", *OBSTACLES, "--out", str(folder)]  # fmt: skip
    run = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        while not (folder / "network.txt").exists():
            assert run.poll() is None, "the run ended"
            time.sleep(0.5)
        time.sleep(REDRAW_S)
        with _viewing("--connect", f"@{folder}/network.txt") as address:
            page = _open(browser, address, (1280, 900))
            time.sleep(2.0 * REDRAW_S)
            _save(page, target)
    finally:
        run.terminate()
        run.wait()


class _viewing:  # noqa: N801 - a context
    """`./zenpark view`, at an address."""

    def __init__(self, *arguments: str, folder: Path = ROOT) -> None:
        port = free_endpoint(preferred_port=0).rpartition(":")[2]
        command = [sys.executable, "-m", "tools.guard", "view", *arguments, "--port", port]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self._process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().split()[0]

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait()


def _open(browser: object, address: str, size: Sequence[int]) -> Page:
    page: Page = browser.new_page(viewport={"width": size[0], "height": size[1]})  # type: ignore[attr-defined]
    page.goto(address, wait_until="commit")
    page.wait_for_selector("canvas", timeout=120_000)
    time.sleep(REDRAW_S)
    for close in page.locator(".mantine-Notification-closeButton").all():  # "software rendering", of this machine
        close.click()
    return page


def _save(page: Page, target: Path) -> None:
    time.sleep(REDRAW_S)
    shot = Image.open(BytesIO(page.screenshot(timeout=120_000))).convert("RGB")
    page.close()
    shot.save(target, optimize=True)
    print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
