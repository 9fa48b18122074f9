"""Spoils good examples: pieces of their bytes, and values of what they hold. Fast, and the same for a seed."""

import json
import re
import struct
from random import Random

import msgspec

LARGEST = 64 * 1024  # [bytes] what is grown grows to this
NUMBERS = [
    *b"0 -0 1 -1 1e308 -1e308 1e400 1e-320 NaN nan Infinity -Infinity inf -inf 65536 2147483648 4294967296".split(),
    *b"9007199254740993 18446744073709551615 -9223372036854775808 0x7fffffff 1_000 1.5 00 1979-05-27".split(),
    *(b"9" * 25, b"-" + b"9" * 25, b"9" * 5000),
]
TOKENS = [
    *NUMBERS,
    *b'null true false "" [] {} [[]] {"":1} [{}] "\\ud800" "\\u0000" , : = * ** $* / // @ # ? .. %s%n kind'.split(),
    *b"' \" \\ { } [ ] ( ) % - > << &a *a !!python/object \x1b[2J \xff\xfe \xed\xa0\x80 \xc0\x80".split(),
    *(b"\xf0\x9f\xa4\x96", b"\xe2\x80\xa8", b"\xef\xbb\xbf", b"\0", b"\n", b"\r\n", b" "),
]
LONG = [*b'[ { {"a": ( \x91 \xdd\xff\xff\xff\xff a. A 9 \x00 \xff \xc3\xa9 / a,'.split(b" "), b"- ", b"  "]
VALUES = [
    *(None, True, False, 0, 1, -1, 2**31, 2**53, 2**53 + 1, 2**63 - 1, -(2**63), 2**64 - 1, 0.0, -0.0, 0.5, 1e-320),
    *(1e6, 1e16, 1e300, -1e300, float("nan"), float("inf"), float("-inf"), "", "x", "\0", "KH01", "KH02", "/", "*"),
    *("é", "a" * 300, "\x1b[31m", [], [[]], {}, {"": None}, [0.0] * 2, [0.0] * 3, [1e300] * 3, [float("nan")] * 3),
    *([0] * 4, [[0, 0]] * 3),
]
PLACES = [re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"), re.compile(rb"[A-Za-z_]\w*"), re.compile(rb"\n[^\n]*")]
PACKINGS = [struct.Struct(code) for code in ("<d", "<f", ">d", "<H", "<I", "<Q", ">H", ">I", ">Q")]
WHOLE = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**53, 2**63, 2**64 - 1]
FRACTIONS = [0.0, -0.0, 1e-320, 1e30, -1e30, float("nan"), float("inf"), float("-inf")]


class Mutator:
    """Spoilt inputs, made from good ones."""

    def __init__(self, examples, seed):
        self._random = Random(str(seed))
        self._examples = list(examples)
        printed = sum(byte in range(32, 127) or byte in b"\n\r\t" for example in examples for byte in example[:400])
        self._binary = printed < 0.9 * sum(len(example[:400]) for example in examples)
        self._trees = [tree for example in examples if (tree := parsed(example)) is not None]

    def spoilt(self):
        """The next input: now and then a good example as it is."""
        roll = self._random.randrange(64)
        if roll < 2:
            return self._one(self._examples)
        if roll == 2:
            return self._noise(64)
        whole = bool(self._trees) and roll < 32
        made = self._regrown() if whole else self._one(self._examples)
        if not whole or roll > 26:
            for _ in range(self._one([1, 1, 2, 4])):
                made = self._edited(made)
        if made and not self._random.randrange(512):
            made *= LARGEST // len(made) + 1
        return made[:LARGEST]

    def _one(self, among):
        return among[int(self._random.random() * len(among))]

    def _noise(self, most):
        return self._random.randbytes(self._random.randrange(most))

    def _edited(self, data):
        """Another piece where one was; numbers as machines write them are for binary examples above all."""
        begin, end = self._span(data)
        match self._random.choice((*range(10), *[6] * 4 * self._binary)):
            case 0:
                return data[:begin]
            case 1:
                piece = b""
            case 2:
                piece = data[begin:end] * self._random.randint(2, 5)
            case 3:
                piece = self._noise(16)
            case 4:
                piece = self._one(LONG) * self._one([3, 20, 300, 300, 3000, 20000])
            case 5:
                piece = bytes(byte ^ (1 << self._random.randrange(8)) for byte in data[begin : begin + 1])
                end = begin + 1
            case 6:
                packing = self._one(PACKINGS)
                fraction, bits = packing.format[-1] in "df", 8 * packing.size
                piece = packing.pack(self._one(FRACTIONS) if fraction else self._one(WHOLE) % (1 << bits))
                end = begin + packing.size
            case 7 | 8:
                piece = self._one(TOKENS)
            case _:
                other = self._one([data, self._one(self._examples)])
                piece = other[slice(*self._span(other))]
        return data[:begin] + piece + data[end:]

    def _span(self, data):
        """Begin and end of a number, a word, a line, or any few bytes."""
        begin = self._random.randrange(len(data) + 1)
        found = None if self._binary or self._random.randrange(2) else self._one(PLACES).search(data, begin)
        return found.span() if found else (begin, begin + self._random.randrange(self._one([1, 2, 9, 65])))

    def _regrown(self):
        """A well-formed message in which some values are other ones, or belong elsewhere."""
        head, packed, tree = self._one(self._trees)
        for _ in range(self._random.randint(1, 3)):
            tree = self._changed(tree)
        try:
            return head + (msgspec.msgpack.encode(tree) if packed else text(tree))
        except (OverflowError, msgspec.MsgspecError, ValueError):
            return head + b"{}"

    def _changed(self, tree):
        """The tree with one value changed, somewhere in it."""
        if isinstance(tree, dict | list) and tree and self._random.randrange(10):
            items = dict(tree) if isinstance(tree, dict) else dict(enumerate(tree))
            key = self._one(list(items))
            match self._random.randrange(32):
                case 0:
                    del items[key]
                case 1:
                    items[str(self._one(VALUES)) if isinstance(tree, dict) else len(items)] = items[key]
                case 2:
                    items[key] = items[self._one(list(items))]
                case _:
                    items[key] = self._changed(items[key])
            return items if isinstance(tree, dict) else list(items.values())
        if isinstance(tree, int | float) and not isinstance(tree, bool) and self._random.randrange(2):
            return self._one([-tree, tree + 1, tree - 1, tree * 1000, tree / 1000, 0, 1, str(tree), [tree]])
        return self._one(VALUES)


def parsed(example):
    """Head, whether MessagePack, and tree of an example with JSON or MessagePack behind its last, or a, zero byte."""
    heads = [example.rfind(b"\0") + 1, *(k + 1 for k, byte in enumerate(example[:60]) if byte == 0), 0]
    for at, packed in [(heads[0], False), (0, False), *((at, True) for at in heads[1:])]:
        try:
            tree = (msgspec.msgpack if packed else msgspec.json).decode(example[at:])
        except (msgspec.MsgspecError, ValueError):
            continue
        if isinstance(tree, dict) or not packed:
            return example[:at], packed, tree
    return None


def text(tree):
    """JSON, with NaN and Infinity, which msgspec does not write."""
    return json.dumps(tree, ensure_ascii=False, default=str).encode("utf-8", "surrogatepass")
