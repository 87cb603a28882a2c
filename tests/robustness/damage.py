"""Damage to the bytes of valid files, drawn from a `random.Random`: Hypothesis hands in one whose draws it can shrink.

Files are a dict from names to bytes.  A ZIP archive is opened, one of its members damaged, and closed again with right
checksums, so that the damage reaches what reads the member.
"""

import contextlib
import io
import re
import struct
import zipfile
from random import Random

Files = dict[str, bytes]

DECOY = "secret.bin"  # lies beside the folder of an input; no reader may open it
WORDS = [
    *(f"../{DECOY}", f"a/../../{DECOY}", f"%2e%2e/{DECOY}", "/etc/passwd", "file:///etc/passwd", "http://localhost/a"),
    *("C:\\a", "\0", "..", "", "x" * 5000, "\U0001f600", "data:;base64,%%", "[" * 100_000, "null", "{}", "[]", '"a"'),
    *("0", "-1", "1", "255", "256", "65536", "2147483647", "-2147483648", "4294967295", "9223372036854775807", "1e308"),
    *("-1e308", "1e-320", "1e39", "nan", "inf", "-inf", "9" * 400, "9" * 5000, "0x10", "1_0", "1.5", "true"),
]
EXTREMES = [0, 1, -1, 127, 255, 32767, 65535, 2**31 - 1, 2**32 - 1, 2**63 - 1, -(2**31)]
FLOATS = [float("nan"), float("inf"), 1e38, -1.0]
HEADER = 400  # bytes in which half of the damage is done: that is where the counts are
TOKEN = re.compile(rb"[\w.+-]+")


def mutated(files: Files, rng: Random) -> Files:
    """The files with 1 to 4 pieces of damage, mostly in the first file; now and then one is missing."""
    damaged, names = dict(files), list(files)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        name = names[0] if rng.randrange(5) < 3 else rng.choice(names)
        if rng.randrange(32) == 13:
            damaged.pop(name, None)
        elif name in damaged:
            damaged[name] = damage(damaged[name], rng)
    return damaged


def damage(data: bytes, rng: Random) -> bytes:
    """The bytes damaged once: in a member of an archive, in a number or word of a text, or anywhere."""
    if data[:2] == b"PK" and rng.randrange(5) < 4:
        with contextlib.suppress(Exception):  # damaged before: there is nothing to open
            return _in_archive(data, rng)
    text = data[:HEADER].isascii() and rng.randrange(10) < 7
    place = rng.randrange(max(1, min(len(data), HEADER) if rng.randrange(2) else len(data)))
    if text and (token := TOKEN.search(data, place)):
        return data[: token.start()] + rng.choice(WORDS).encode() + data[token.end() :]
    size, kind = 2 ** rng.randrange(10), rng.randrange(6)
    if kind == 0:
        return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)] if data else []) + data[place + 1 :]
    if kind == 1:
        return data[:place] + (b"" if rng.randrange(2) else data[place + size :])
    if kind == 2:  # a piece from elsewhere, or one byte, many times
        start = rng.randrange(max(1, len(data)))
        piece = data[start : start + size] if rng.randrange(2) else bytes([rng.randrange(256)])
        return data[:place] + piece * rng.choice((1, 2, 500)) + data[place:]
    order = rng.choice("<>")
    if kind == 3:
        new = struct.pack(order + rng.choice("fd"), rng.choice(FLOATS))
    else:
        code = rng.choice("BHIQ")
        new = struct.pack(order + code, rng.choice(EXTREMES) % 256 ** struct.calcsize(code))
    return data[:place] + new + data[place + len(new) :]


def _in_archive(data: bytes, rng: Random) -> bytes:
    """A ZIP archive with one member damaged."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name, stream = rng.choice(list(members)), io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, damage(content, rng) if member == name else content)
    return stream.getvalue()
