"""A socket without a network."""

from __future__ import annotations

from collections import deque


class Wire:
    """A socket that is fed by hand."""

    def __init__(self) -> None:
        self.waiting: deque[bytes] = deque()

    def recvfrom(self, most: int) -> tuple[bytes, tuple[str, int]]:
        if not self.waiting:
            raise BlockingIOError
        return self.waiting.popleft()[:most], ("127.0.0.1", 9)

    def recv(self, most: int) -> bytes:
        return self.recvfrom(most)[0]

    def sendto(self, packet: bytes, _to: object = None) -> int:
        assert isinstance(packet, bytes | bytearray)
        return len(packet)

    send = sendto

    def close(self) -> None:
        pass

    def setsockopt(self, *_: object) -> None:
        pass

    setblocking = setsockopt

    def getsockname(self) -> tuple[str, int]:
        return "127.0.0.1", 1
