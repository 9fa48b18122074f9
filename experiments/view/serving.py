"""Server of a page: on loopback alone, behind a gate, without a way to share it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from typing import Any, Final

import viser
from websockets.asyncio import server as websockets

from agents.body.device_address import LOOPBACK
from agents.errors import ExplainedError
from experiments.scene.drawing import light
from experiments.view.gate import Gate
from experiments.view.heartbeat import page_mark

_PATCHING: Final = threading.Lock()


class PageServer(viser.ViserServer):
    """Server of a page that only its address opens."""

    def __init__(self, port: int) -> None:
        self.gate = Gate()
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # refused requests are no news
        with redirect_stdout(StringIO()), _gated(self.gate):  # its own banner
            super().__init__(host=LOOPBACK, port=port, label="zenpark", verbose=False)
        self.on_client_connect(self._open_page)
        self.on_client_disconnect(lambda client: self.gate.close(client.client_id))

    @property
    def address(self) -> str:
        """Address of the page, with its secret."""
        return f"http://{LOOPBACK}:{self.get_port()}/{self.gate.secret}/"

    def address_for_once(self) -> str:
        """Address that leads to the page one time: for the command line of a browser."""
        return f"http://{LOOPBACK}:{self.get_port()}/{self.gate.ticket()}"

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Shares nothing: a message of a page would be enough to send it through a server on the internet."""
        return None

    def _open_page(self, client: viser.ClientHandle) -> None:
        self.gate.open(client.client_id)
        client.gui.add_html(page_mark(client.client_id), order=1000.0)


@contextmanager
def served(port: int, *, dark: bool) -> Iterator[PageServer]:
    """Serve a page to this machine alone, at `port` or the next free one."""
    server = PageServer(port)
    server.gui.configure_theme(
        dark_mode=dark, show_logo=False, show_share_button=False, control_width="large", brand_color=(0, 114, 178)
    )
    server.gui.main_panel.dock_right()
    light(server)
    try:
        yield server
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


@contextmanager
def _gated(gate: Gate) -> Iterator[None]:
    """Block in which a server of the library `websockets` asks the gate; raises ExplainedError if none was started.

    viser has no parameter for it: it calls `websockets.asyncio.server.serve`, which has a public `process_request`.
    """
    serve, gated = websockets.serve, list[str]()

    def serve_behind_gate(*arguments: Any, process_request: Any, **options: Any) -> Any:  # noqa: ANN401 - as there
        gated.append("")
        return serve(*arguments, process_request=partial(gate.answer, process_request), **options)

    with _PATCHING:
        setattr(websockets, "serve", serve_behind_gate)  # noqa: B010 - a class there
        try:
            yield
        finally:
            setattr(websockets, "serve", serve)  # noqa: B010
    if not gated:
        raise ExplainedError("the page would be open to every program: this viser is of another make; ./zenpark view")
