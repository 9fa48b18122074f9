"""What robots say of themselves, heard by whoever watches all of them."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import TypeVar

import zenoh

from agents import session as network
from agents import wire
from agents.keys import Keys

M = TypeVar("M", wire.Status, wire.State, wire.Position, wire.Command)


def by_robots(
    handler: network.Polled[zenoh.Sample], kind: type[M], *, keys: Keys, robots: Container[str]
) -> Iterator[M]:
    """What has come on the keys of some robots; what is malformed, or says another name than its key, is left out."""
    for sample in network.received(handler):
        try:
            message = wire.decode(sample.payload.to_bytes(), str(sample.encoding), kind)
        except wire.Malformed:
            continue
        if message.robot in robots and keys.whose(str(sample.key_expr)) == message.robot:
            yield message
