"""Age of the picture of a live page: how old its data are, when a page showed it, how many pictures a page can take."""

from __future__ import annotations

from html import escape
from math import inf
from pathlib import Path
from typing import Final

CLOCK: Final = "clock"  # path that answers with the time of this machine and the number of emergency stops
SCRIPT: Final = b"<script>%s</script>" % Path(__file__).with_name("heartbeat.js").read_bytes()
STALE_S: Final = 5.0  # a page with an older picture gives no order that sets robots in motion
RECORDED_S: Final = 60.0  # messages that were never younger than this are of a recording that is played
LAG_S: Final = 1.0  # time from a picture to the report of a page that shows it, with nothing in the way
STEEP: Final = 2.0  # [s/s] growth of the time between two pictures with what is above that
SLOWEST_S: Final = 2.0  # longest pause of two pictures


class DataAge:
    """Age of the newest poses that are known."""

    def __init__(self) -> None:
        self._stamp = self._arrived = -inf
        self._least = inf  # [s] time from stamp to arrival

    def add(self, stamp: float, utc: float, now: float) -> None:
        """Poses of `stamp` [s, UTC] arrived at `utc` [s, UTC], which is `now` [s, monotonic]."""
        self._stamp, self._arrived = stamp, now
        self._least = min(self._least, utc - stamp)

    @property
    def recorded(self) -> bool:
        """Whether they are of a recording: no pose arrived in the minute in which it was measured."""
        return RECORDED_S < self._least < inf

    def seconds(self, utc: float, now: float) -> float | None:
        """The age [s] at `utc` [s, UTC], which is `now` [s, monotonic]; None before the first pose."""
        if self._arrived == -inf:
            return None
        delay = utc - self._stamp - (self._least if self.recorded else 0.0)
        return max(now - self._arrived, delay, 0.0)


def mark(stage: int, drawn: float, age: float | None, words: str = "", *, over: bool = False) -> str:
    """Mark of a picture, as HTML, which the script of the page reads and shows with its age.

    Args:
        stage: Number of the case.
        drawn: Time of the picture [s, UTC].
        age: Age of its data then [s]; None: there are none.
        words: Addition for people.
        over: Whether the picture is the last one: its age is no fault.
    """
    picture = "" if age is None else f"{drawn - age:.3f}"
    return (
        "<style>.zenpark-age::before{content:var(--zenpark-age,'the age of the picture is unknown');"
        "color:var(--zenpark-age-colour,rgb(213,50,30));font-weight:var(--zenpark-age-weight,700)}</style>"
        f"<div class='zenpark-age' role='status' data-stage='{stage}' data-drawn='{drawn:.3f}' data-picture='{picture}'"
        f" data-over='{'1' if over else ''}' data-words='{escape(words)}'"
        " style='padding:0.3em 1em;font-size:0.85em'></div>"
    )


def page_mark(page: int) -> str:
    """Mark of a page, as HTML, which identifies its reports."""
    return f"<i data-page='{page}' hidden></i>"


def frame_s(lag: float, usual: float) -> float:
    """Time between two pictures [s], `usual` ones if the slowest page shows each within `LAG_S`.

    A page that is sent more than it can draw would fall behind for ever.
    """
    return min(max(usual, STEEP * (lag - LAG_S)), SLOWEST_S)
