"""Damage to bytes, where no engine is there that looks at what code was reached: flips, cuts, lies, odd words."""

from __future__ import annotations

import random
import re
import struct

WORDS = [
    *(b"nan", b"NaN", b"inf", b"-Infinity", b"1e308", b"-1e400", b"1e-320", b"-1", b"0", b"-0.0", b"9" * 30, b"1_0"),
    *(b"4294967295", b"18446744073709551616", b"2147483648", b"0x10", b"1.5", b"null", b"true", b"[]", b"{}", b'""'),
    *(b"../../x", b"/x", b"..", b"~", b"%41", b"\0", b"\n", b"\r\n", b"\xff", b"\xef\xbb\xbf", "ä٣²".encode()),
    *(
        b",",
        b";",
        b'"',
        b"'",
        b"#",
        b" ",
        b":",
        b"- ",
        b"&a",
        b"*a",
        b"!!python/name:os.system",
        b"[" * 200,
        b"{a: " * 60,
    ),
    *(struct.pack(layout, value) for layout in ("<i", "<q") for value in (-1, 0, 1, 2**31 - 1, -(2**31), 10**8)),
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e300, -0.0, 5e-324)),
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), 1e38)),
    *(struct.pack("<Q", value) for value in (2**63, 2**64 - 1, 2**32, 2**62)),
]
"""What readers stumble over, as text and as binary numbers."""


def mutated(data: bytes, rng: random.Random) -> bytes:
    """The bytes with one to four changes."""
    for _ in range(1 + int(rng.expovariate(1)) % 4):
        data = rng.choice(_CHANGES)(data or b"\0", rng)
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    bit = rng.randrange(8 * len(data))
    return data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]


def _byte(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data))
    word = rng.choice(WORDS)
    return data[:at] + word + data[at + len(word) :]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(WORDS) + data[at:]


def _number(data: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"[-+.\w]+", data[:4000]))
    if not found:
        return _byte(data, rng)
    word = rng.choice(found)
    return data[: word.start()] + rng.choice(WORDS) + data[word.end() :]


def _cut(data: bytes, rng: random.Random) -> bytes:
    begin, end = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
    return data[:begin] if rng.random() < 0.3 else data[:begin] + data[min(end, begin + 64) :]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    begin = rng.randrange(len(data))
    length = rng.randrange(1, 65)
    to = rng.randrange(len(data) + 1)
    return data[:to] + data[begin : begin + length] * rng.choice((1, 1, 1, 3, 40)) + data[to:]


_CHANGES = (_flip, _flip, _byte, _overwrite, _overwrite, _insert, _number, _number, _cut, _repeat)
