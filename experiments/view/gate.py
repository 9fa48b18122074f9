"""Admission to a page: requests by a name of this machine, from the page itself, with the secret of its address."""

from __future__ import annotations

import hmac
import re
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http import HTTPStatus
from math import inf
from typing import Final
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from experiments.view.heartbeat import CLOCK, LAG_S, SCRIPT

# with any port: that of a tunnel is another one. Every other name is of a page that had this machine's address put
# behind the name of its own server.
OWN_HOST: Final = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.ASCII)
TICKETS: Final = "open"  # first part of the path of an address that is good for one use
REFUSED: Final = "zenpark: this address is of no page, or of one that is over; open the one that zenpark printed\n"
GONE_S: Final = 60.0
WEBSOCKET: Final = "websocket"
PRIVATE: Final = {  # headers of every answer: the address goes nowhere, and no other page frames this one
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "frame-ancestors 'none'",
}
Handler = Callable[[ServerConnection, Request], Response | None]


@dataclass(frozen=True)
class Seen:
    """Last report of a page about what it shows."""

    drawn: float = -inf  # [s, UTC] time of the picture; -inf before the first report
    stage: int = -1  # number of the case
    hidden: bool = False  # True behind another page or window, where browsers draw nothing
    opened: float = -inf  # [s, UTC] opening of a page that has reported nothing yet


@dataclass
class Gate:
    """Gate of one server."""

    secret: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)
    seen: dict[int, Seen] = field(default_factory=dict)  # pages that are open, by number
    stops: int = 0  # emergency stops that pages have sent, which a page looks for after its own
    _tickets: set[str] = field(default_factory=set, repr=False)

    def ticket(self) -> str:
        """Path that leads to the page once: a command line, such as a browser's, is no place for the secret."""
        made = secrets.token_urlsafe(24)
        self._tickets.add(made)
        return f"{TICKETS}/{made}"

    def answer(self, inner: Handler, connection: ServerConnection, request: Request) -> Response | None:
        """Answer of a request: a refusal, or what `inner` says of it below the secret; None opens a websocket."""
        target = urlsplit(request.path)
        first, slash, rest = target.path.removeprefix("/").partition("/")
        fits = own(request.headers)
        redeemed = fits and first == TICKETS and rest in self._tickets and not _upgrades(request.headers)
        if not redeemed and not (fits and hmac.compare_digest(first.encode(), self.secret.encode())):
            return _text(HTTPStatus.FORBIDDEN, REFUSED)
        if redeemed:
            self._tickets.discard(rest)
        if _upgrades(request.headers):
            return inner(connection, request)
        if redeemed or not slash:  # names in the page would be beside its folder, not in it
            return _text(HTTPStatus.SEE_OTHER, "", Location=f"/{self.secret}/")
        if rest == CLOCK:
            self._note(target.query)
            return _text(HTTPStatus.OK, f"{time.time():.4f} {self.stops}")
        return _page(inner, connection, request, rest)

    def _note(self, query: str) -> None:
        """Takes in what a page reports with its question; a malformed report counts as none."""
        try:
            given = {key: values[-1] for key, values in parse_qs(query, max_num_fields=8).items()}
            page, drawn, stage = int(given["page"]), float(given["drawn"]), int(given["stage"])
        except (KeyError, ValueError):
            return
        if page in self.seen and drawn <= time.time():
            self.seen[page] = Seen(drawn, stage, hidden=given.get("hidden") == "1")

    def lag(self, utc: float) -> float:
        """Time for which the slowest page that is in sight has had no newer picture, at `utc` [s, UTC].

        A page that reports nothing for `GONE_S` counts no more.
        """
        latest = [max(each.drawn, each.opened) for each in list(self.seen.values()) if not each.hidden]
        return utc - min((at for at in latest if utc - at < GONE_S), default=utc)

    def open(self, page: int) -> None:
        """Expects reports of a page."""
        self.seen[page] = Seen(opened=time.time() - LAG_S)  # few pictures, until it shows how fast it is

    def close(self, page: int) -> None:
        self.seen.pop(page, None)


def own(headers: Headers) -> bool:
    """Whether a request names this machine, and is not from a page of another origin."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or OWN_HOST.fullmatch(hosts[0]) is None:
        return False
    if not origins:  # browsers ask so for a page, but never for a websocket
        return not _upgrades(headers)
    return origins == [f"http://{hosts[0]}"]


def _upgrades(headers: Headers) -> bool:
    return any(WEBSOCKET in value.lower() for value in headers.get_all("Upgrade"))


def _page(inner: Handler, connection: ServerConnection, request: Request, path: str) -> Response | None:
    """A file of the page; its first one with our script in it."""
    if not path:
        request.headers.pop("Accept-Encoding", None)  # asks for plain text
    response = inner(connection, Request(f"/{path}", request.headers))
    if response is not None:
        if not path:
            response.body = bytes(response.body).replace(b"<head>", b"<head>" + SCRIPT, 1)
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        response.headers.update(PRIVATE)
    return response


def _text(status: HTTPStatus, text: str, **more: str) -> Response:
    body = text.encode()
    headers = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), **PRIVATE, **more}
    return Response(status.value, status.phrase, Headers(**headers), body)
