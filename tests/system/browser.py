"""Chromium as a test drives it: a page of the view, the requests that it makes, and the scene that arrives in it."""

import shutil
from contextlib import contextmanager

import msgspec
import numpy as np
import pytest
import zstandard

from tests.waiting import PATIENCE_S

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)  # fmt: skip

FRAMES = 4
# A page without pixels, ten times a second: without a graphics card they would take all processors from the robots.
BLIND = """
window.requestAnimationFrame = draw => setTimeout(() => draw(performance.now()), 100);
const constants = WebGL2RenderingContext, original = HTMLCanvasElement.prototype.getContext;
const answers = {
    getExtension: () => null, getSupportedExtensions: () => [], isContextLost: () => false, getError: () => 0,
    getContextAttributes: () => ({ alpha: true, antialias: false, depth: true, stencil: false }),
    getShaderPrecisionFormat: () => ({ precision: 23, rangeMin: 127, rangeMax: 127 }),
    getParameter: what =>
        [constants.VERSION, constants.SHADING_LANGUAGE_VERSION].includes(what) ? "WebGL 2.0"
        : [constants.VIEWPORT, constants.SCISSOR_BOX].includes(what) ? new Int32Array([0, 0, 300, 150]) : 4096,
    getShaderParameter: () => true, getShaderInfoLog: () => "", getProgramInfoLog: () => "",
    getProgramParameter: (_, what) => what === constants.LINK_STATUS,
    checkFramebufferStatus: () => constants.FRAMEBUFFER_COMPLETE,
};
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
    if (!kind.startsWith("webgl")) return original.call(this, kind, ...rest);
    const known = { canvas: this, drawingBufferWidth: this.width, drawingBufferHeight: this.height, ...answers };
    return new Proxy(known, { get: (it, name) => it[name] ?? constants[name] ?? (() => ({})) });
};
"""

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium")


class Page:
    """A page that is open."""

    def __init__(self, page):
        self.page = page
        self.hosts = set()  # of all its requests, `host:port`
        self.nodes = {}  # properties of the scene's nodes, as they arrived last
        self.camera = {}  # of the page, as it said last
        page.on("request", lambda request: self.hosts.add(request.url.split("/")[2] if "//" in request.url else ""))
        page.on("websocket", self._listen)

    def _listen(self, socket):
        self.hosts.add(socket.url.split("/")[2])
        socket.on("framereceived", lambda data: self._receive(data) if isinstance(data, bytes) else None)
        socket.on("framesent", lambda data: self._answer(data) if isinstance(data, bytes) else None)

    def _answer(self, data):
        message = msgspec.msgpack.decode(data)
        if message["type"] == "ViewerCameraMessage":
            self.camera = message

    def _receive(self, data):
        """Messages as viser packs them: sizes, compressed msgpack, then the arrays, each aligned to eight bytes."""
        size, packed = (int.from_bytes(data[k : k + 8], "little") for k in (0, 8))
        plain = zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], max_output_size=size)
        inner = msgspec.msgpack.decode(plain)
        at, arrays = -(-(16 + packed) // 8) * 8, []
        for length in inner["binaryBufferLengths"]:
            arrays.append(data[at : at + length])
            at += -(-length // 8) * 8
        for message in inner["messages"]:
            self._take(message, arrays)

    def _take(self, message, arrays):
        if name := message.get("name"):
            given = message.get("updates") or message.get("props") or {}
            if message.get("type") == "SetPositionMessage":
                given = {"position": message["position"]}
            self.nodes.setdefault(name, {}).update({key: _array(value, arrays) for key, value in given.items()})

    def positions(self, name):
        """Positions (N, 3) of the copies of a batched mesh [m]."""
        return np.frombuffer(self.nodes[name]["batched_positions"], dtype="<f4").reshape(-1, 3)

    def pixel(self, point):
        """Where the page draws a point of the scene [m]."""
        wide, tall = self.camera["image_width"], self.camera["image_height"]
        w, x, y, z = self.camera["wxyz"]
        turned = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        right, down, ahead = turned.T @ (np.array(point) - self.camera["position"])
        scale = 0.5 * tall / np.tan(0.5 * self.camera["fov"]) / ahead
        return 0.5 * wide + scale * right, 0.5 * tall + scale * down

    def drag(self, begin, end):
        """Drags what is drawn at one point of the scene to another [m], with the mouse."""
        mouse = self.page.mouse
        self.page.evaluate(  # what has arrived is drawn some frames later
            """left => new Promise(done => {
                const next = () => (left-- ? requestAnimationFrame(next) : done());
                next();
            })""",
            FRAMES,
        )
        mouse.move(*self.pixel(begin))
        mouse.down()
        mouse.move(*self.pixel(end), steps=5)
        mouse.up()

    def until(self, true, what, limit_s=PATIENCE_S):
        """Waits, and lets the page's messages in meanwhile."""
        left = limit_s
        while not true():
            assert left > 0.0, f"not in {limit_s:g} s: {what}"
            self.page.wait_for_timeout(50)
            left -= 0.05

    def button(self, text):
        return self.page.get_by_role("button", name=text)


def _array(value, arrays):
    """A property, an array as its bytes."""
    if isinstance(value, dict) and any("inary" in key for key in value):
        (index,) = (each for key, each in value.items() if isinstance(each, int))
        return arrays[index]
    return value


@contextmanager
def opened(address, width=900, height=600):
    """A page in a browser of its own, whose scene has no pixels; an address may be waited for while it starts."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, headless=True, args=list(FLAGS))
        try:
            page = Page(browser.new_page(viewport={"width": width, "height": height}))
            page.page.add_init_script(BLIND)
            page.page.goto(address if isinstance(address, str) else address(), wait_until="commit")
            yield page
        finally:
            browser.close()
