"""Spoils good examples: bits, lengths, numbers, nesting, pieces of other examples. Fast, and the same for a seed."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np

LARGEST = 64 * 1024  # [bytes] what is grown grows to this
NUMBERS = [
    b"0", b"-0", b"1", b"-1", b"1e308", b"-1e308", b"1e400", b"1e-320", b"9" * 25, b"-" + b"9" * 25, b"9" * 5000,
    b"NaN", b"nan", b"Infinity", b"-Infinity", b"inf", b"-inf", b"9007199254740993", b"18446744073709551615",
    b"-9223372036854775808", b"4294967296", b"2147483648", b"65536", b"0x7fffffff", b"1_000", b"1.5", b"00",
    b"1979-05-27",
]  # fmt: skip
TOKENS = [
    *NUMBERS, b"null", b"true", b"false", b'""', b"[]", b"{}", b"[[]]", b'{"":1}', b"[{}]", b'"\\ud800"', b'"\\u0000"',
    b"\xff\xfe", b"\xed\xa0\x80", b"\xc0\x80", b"\xf0\x9f\xa4\x96", b"\0", b"\n", b"\r\n", b",", b":", b"=",
    b"*", b"**",
    b"$*", b"/", b"//", b"@", b"#", b"?", b"..", b"'", b'"', b"\\", b"{", b"}", b"[", b"]", b"(", b")", b"%",
    b"-", b" ",
    b"\t", b"\x1b[2J", b"\xe2\x80\xa8", b"\xef\xbb\xbf", b"<<", b"&a", b"*a", b"!!python/object", b"kind",
    b"%s%n", b">",
]  # fmt: skip
LONG = [b"[", b"{", b'{"a":', b"(", b"\x91", b"\xdd\xff\xff\xff\xff", b"a.", b"A", b"9", b"- ", b"  ", b"\0",
    b"\xff", b"\xc3\xa9", b"/", b"a,"]  # fmt: skip
VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 2**31, 2**53, 2**53 + 1, 2**63 - 1, -(2**63), 2**64 - 1, 0.0, -0.0, 0.5, 1e-320, 1e6,
    1e16, 1e300, -1e300, float("nan"), float("inf"), float("-inf"), "", "x", "\0", "KH01", "KH02", "/", "*",
    "é", "a" * 300,
    "\x1b[31m", [], [[]], {}, {"": None}, [0.0, 0.0], [0.0, 0.0, 0.0], [1e300] * 3, [float("nan")] * 3,
    [0] * 4, [[0, 0]] * 3,
]  # fmt: skip
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z0-9_]*")
_PACKINGS = [struct.Struct(code) for code in ("<H", "<I", "<Q", ">H", ">I", ">Q", "<d", "<f", ">d")]
_WHOLE = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**53, 2**63, 2**64 - 1]
_FRACTIONS = [0.0, -0.0, 1e-320, 1e30, -1e30, float("nan"), float("inf"), float("-inf")]


class Dice:
    """Random whole numbers, drawn by the thousand: a numpy call for each would be most of the work."""

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator = generator
        self._drawn: list[int] = []

    def below(self, limit: int) -> int:
        """From 0 to `limit` - 1, nearly uniform."""
        if not self._drawn:
            self._drawn = self._generator.integers(0, 1 << 62, 4096).tolist()
        return self._drawn.pop() % limit

    def one(self, among: Sequence[Any]) -> Any:
        """One of them."""
        return among[self.below(len(among))]


class Mutator:
    """Makes spoilt inputs from good ones."""

    def __init__(self, examples: Sequence[bytes], generator: np.random.Generator) -> None:
        """`examples` are what the place is meant to read."""
        self.dice = Dice(generator)
        self._examples = list(examples)
        self._trees = [tree for example in examples if (tree := _tree(example)) is not None]
        text = sum(_printable(example) for example in examples) * 2 > len(examples)
        both: list[_Step] = [_flip, _set, _cut, _drop, _repeat, _token, _long, _number, self._splice]
        self._steps: list[_Step] = [*both, *([_word, _line, _number, _token] if text else [_packed, _packed, _noise])]

    def spoilt(self) -> bytes:
        """The next input: now and then a good example as it is."""
        dice = self.dice
        roll = dice.below(64)
        if roll == 0:
            return bytes(dice.one(self._examples))
        if roll == 1:
            return dice._generator.bytes(dice.below(64))
        if self._trees and roll < 32:
            made = self._regrown()
            if roll < 26:
                return made
        else:
            made = dice.one(self._examples)
        for _ in range(1 + dice.below(4)):
            made = dice.one(self._steps)(made, dice)
        if dice.below(512) == 0 and made:
            made = made * (LARGEST // len(made) + 1)
        return made[:LARGEST]

    def _splice(self, data: bytes, dice: Dice) -> bytes:
        other = dice.one(self._examples)
        begin = dice.below(len(other) + 1)
        at = dice.below(len(data) + 1)
        return data[:at] + other[begin : begin + 1 + dice.below(len(other) + 1)] + data[at + dice.below(4) :]

    def _regrown(self) -> bytes:
        """A well-formed message in which some values are other ones, or belong elsewhere."""
        dice = self.dice
        head, packed, tree = dice.one(self._trees)
        for _ in range(1 + dice.below(3)):
            tree = _changed(tree, dice)
        try:
            return head + (msgspec.msgpack.encode(tree) if packed else _json(tree))
        except (OverflowError, msgspec.MsgspecError, ValueError):
            return head + b"{}"


_Step = Callable[[bytes, Dice], bytes]


def _printable(example: bytes) -> bool:
    sample = example[:400]
    return sum(32 <= byte < 127 or byte in b"\n\r\t" for byte in sample) >= 0.9 * len(sample)


def _tree(example: bytes) -> tuple[bytes, bool, Any] | None:
    """What an example holds behind its address (up to the last zero byte), if it is JSON or MessagePack."""
    head, _, body = example.rpartition(b"\0") if example[:1] not in (b"{", b"[") else (b"", b"", example)
    head += b"\0" if len(head) < len(example) - len(body) else b""
    try:
        return head, False, msgspec.json.decode(body)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        pass
    for at in (*(k + 1 for k, byte in enumerate(example[:60]) if byte == 0), 0):
        try:
            tree = msgspec.msgpack.decode(example[at:])
        except (msgspec.MsgspecError, UnicodeDecodeError, ValueError):
            continue
        if isinstance(tree, dict):
            return example[:at], True, tree
    return None


def _json(tree: object) -> bytes:
    import json  # noqa: PLC0415 - the only encoder that writes what is not JSON: NaN, Infinity

    return json.dumps(tree, ensure_ascii=False, default=str).encode("utf-8", "surrogatepass")


def _changed(tree: Any, dice: Dice) -> Any:  # noqa: PLR0911
    """The tree with one value changed, somewhere in it."""
    if isinstance(tree, dict) and tree and dice.below(12):
        keys = list(tree)
        key = dice.one(keys)
        if dice.below(16):
            return {**tree, key: _changed(tree[key], dice)}
        match dice.below(3):
            case 0:
                return {k: value for k, value in tree.items() if k != key}
            case 1:
                return {**tree, str(dice.one(VALUES)): tree[key]}
            case _:
                return {**tree, key: tree[dice.one(keys)]}
    if isinstance(tree, list) and tree and dice.below(8):
        at = dice.below(len(tree))
        match dice.below(8):
            case 0:
                return tree[:at]
            case 1:
                return tree + tree[at:] * (1 + dice.below(3))
            case _:
                return [*tree[:at], _changed(tree[at], dice), *tree[at + 1 :]]
    if isinstance(tree, int | float) and not isinstance(tree, bool) and dice.below(2):
        return dice.one([-tree, tree + 1, tree - 1, tree * 1000, tree / 1000, 0, 1, str(tree), [tree]])
    return dice.one(VALUES)


def _flip(data: bytes, dice: Dice) -> bytes:
    if not data:
        return data
    at = dice.below(len(data))
    return data[:at] + bytes((data[at] ^ (1 << dice.below(8)),)) + data[at + 1 :]


def _set(data: bytes, dice: Dice) -> bytes:
    at = dice.below(len(data) + 1)
    return data[:at] + bytes((dice.below(256),)) + data[at + 1 :]


def _cut(data: bytes, dice: Dice) -> bytes:
    return data[: dice.below(len(data) + 1)]


def _drop(data: bytes, dice: Dice) -> bytes:
    at = dice.below(len(data) + 1)
    return data[:at] + data[at + 1 + dice.below(1 + min(64, len(data))) :]


def _repeat(data: bytes, dice: Dice) -> bytes:
    begin = dice.below(len(data) + 1)
    piece = data[begin : begin + 1 + dice.below(64)]
    at = dice.below(len(data) + 1)
    return data[:at] + piece * (1 + dice.below(4)) + data[at:]


def _token(data: bytes, dice: Dice) -> bytes:
    at = dice.below(len(data) + 1)
    return data[:at] + bytes(dice.one(TOKENS)) + data[at + dice.below(8) :]


def _long(data: bytes, dice: Dice) -> bytes:
    at = dice.below(len(data) + 1)
    return data[:at] + dice.one(LONG) * dice.one([3, 20, 300, 300, 3000, 20000]) + data[at:]


def _number(data: bytes, dice: Dice) -> bytes:
    """Another number where one stands."""
    begin = dice.below(len(data) + 1)
    found = _NUMBER.search(data, begin) or _NUMBER.search(data)
    return data if found is None else data[: found.start()] + bytes(dice.one(NUMBERS)) + data[found.end() :]


def _word(data: bytes, dice: Dice) -> bytes:
    """A word of the text where another stands."""
    found = _WORD.search(data, dice.below(len(data) + 1))
    other = _WORD.search(data, dice.below(len(data) + 1))
    if found is None or other is None:
        return data
    return data[: found.start()] + (other[0] if dice.below(3) else dice.one(TOKENS)) + data[found.end() :]


def _line(data: bytes, dice: Dice) -> bytes:
    """Lines lost, doubled, exchanged or joined."""
    lines = data.split(b"\n")
    at, other = dice.below(len(lines)), dice.below(len(lines))
    match dice.below(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(other, lines[at])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case _:
            lines[at : at + 2] = [b" ".join(lines[at : at + 2])]
    return b"\n".join(lines)


def _packed(data: bytes, dice: Dice) -> bytes:
    """A number as machines write it, where some number may stand."""
    packing = dice.one(_PACKINGS)
    at = dice.below(max(1, len(data) - packing.size + 1))
    if packing.format[-1] in "df":
        value = packing.pack(dice.one(_FRACTIONS))
    else:
        value = packing.pack(dice.one(_WHOLE) & ((1 << (8 * packing.size)) - 1))
    return data[:at] + value + data[at + packing.size :]


def _noise(data: bytes, dice: Dice) -> bytes:
    at = dice.below(len(data) + 1)
    return data[:at] + dice._generator.bytes(1 + dice.below(16)) + data[at + dice.below(16) :]
