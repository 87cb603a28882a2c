"""Damage to valid files that knows their structure, drawn from a `random.Random`.

Hypothesis hands in one whose every draw it can shrink (`st.randoms`).  Files are a dict from names to bytes.  A
container is opened, one of its parts is damaged, and it is closed again with right lengths and checksums, so that the
damage reaches what reads the part; now and then the whole is damaged instead.
"""

import copy
import io
import json
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

Files = dict[str, bytes]
Opened = tuple[Files, Callable[[Files], bytes]]  # parts of a container, and what closes it again

DECOY = "secret.bin"  # lies beside the folder of an input; no reader may open it
PATHS = [
    *(f"../{DECOY}", f"..\\{DECOY}", f"a/../../{DECOY}", f"%2e%2e/{DECOY}", "/etc/passwd", "file:///etc/passwd"),
    *(
        "http://localhost/a.png",
        "C:\\a",
        "\0",
        ".",
        "..",
        "",
        "a\0b",
        "x" * 5000,
        "ü\ud7ff\U0001f600",
        "data:;base64,%%",
    ),
]
NUMBERS = [
    *("0", "-1", "1", "255", "256", "65536", "2147483647", "-2147483648", "4294967295", "9223372036854775807", "1e308"),
    *("-1e308", "1e-320", "1e39", "nan", "inf", "-inf", "1e999", "9" * 400, "9" * 5000, "0x10", "1_0", "٣", "1.5"),
]
VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 3, 7, 2**31, 2**32 - 1, 2**63, 10**30, 10**400, 0.5, -0.0, 1e308),
    *(float("nan"), float("inf"), -float("inf"), [], {}, [[]], [None], "", "a", [0] * 1000, {"": 0}, *PATHS),
]
EXTREMES = [0, 1, -1, 127, 255, 32767, 65535, 2**31 - 1, 2**32 - 1, 2**63 - 1, -(2**31)]
FLOATS = [float("nan"), float("inf"), 1e38, -1.0]
DEEP = 100_000
LARGEST = 2**24  # bytes that a doubled line may make: a deep nest is one line, and may be doubled again
HEADER = 400  # bytes in which half of the damage is done: that is where the counts are


def mutated(files: Files, rng: Random) -> Files:
    """The files with 1 to 4 pieces of damage, mostly in the first file."""
    damaged, names = dict(files), list(files)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        name = names[0] if rng.randrange(5) < 3 else rng.choice(names)
        if _seldom(rng):
            damaged.pop(name, None)
        elif name in damaged:
            damaged[name] = damage(damaged[name], rng)
    return damaged


def damage(data: bytes, rng: Random) -> bytes:
    """The bytes damaged once, in the deepest structure that is known, or as they are."""
    if rng.randrange(5) < 4:
        for opened in OPENERS:
            if (found := opened(data)) is not None:
                parts, close = found
                name = rng.choice(list(parts))
                return close(parts | {name: damage(parts[name], rng)})
        if data[:1] in (b"{", b"[") and rng.randrange(10) < 9:
            return damage_json(data, rng)
    text = data[:HEADER].isascii() and rng.randrange(10) < 7
    return rng.choice((number, number, word, line) if text else (flip, cut, splice, overwrite, overwrite))(data, rng)


def _seldom(rng: Random) -> bool:
    """Once in 32 draws; Hypothesis draws the ends of a range more often than its middle."""
    return rng.randrange(32) == 13


def _place(data: bytes, rng: Random) -> int:
    return rng.randrange(max(1, min(len(data), HEADER) if rng.randrange(2) else len(data)))


def flip(data: bytes, rng: Random) -> bytes:
    """Some bits turned over."""
    changed = bytearray(data)
    for _ in range(rng.randrange(1, 5) if data else 0):
        changed[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(data: bytes, rng: Random) -> bytes:
    """The beginning alone, or all but a piece."""
    start = _place(data, rng)
    return data[:start] + (b"" if rng.randrange(2) else data[start + 2 ** rng.randrange(10) :])


def splice(data: bytes, rng: Random) -> bytes:
    """A piece once more, or the same byte many times, put in somewhere."""
    start, size, place = _place(data, rng), 2 ** rng.randrange(10), _place(data, rng)
    piece = data[start : start + size] if rng.randrange(2) else bytes([rng.randrange(256)]) * size
    return data[:place] + piece + data[place:]


def overwrite(data: bytes, rng: Random) -> bytes:
    """A number of 1 to 8 bytes replaced by an extreme one."""
    order = rng.choice(("little", "big"))
    if rng.randrange(10) < 3:
        new = struct.pack(("<" if order == "little" else ">") + rng.choice("fd"), rng.choice(FLOATS))
    else:
        size = rng.choice((1, 2, 4, 8))
        new = (rng.choice(EXTREMES) % 2 ** (8 * size)).to_bytes(size, order)  # type: ignore[arg-type]
    start = _place(data, rng)
    return data[:start] + new + data[start + len(new) :]


def _token(data: bytes, rng: Random, kind: Callable[[bytes], bool]) -> tuple[bytes, bytes, bytes] | None:
    """(before, token, behind) of one token of a kind, None where there is none nearby."""
    start = _place(data, rng)
    for found in data[start : start + 2000].replace(b"\n", b" ").replace(b",", b" ").split(b" "):
        if found and kind(found):
            place = data.index(found, start)
            return data[:place], found, data[place + len(found) :]
    return None


def number(data: bytes, rng: Random) -> bytes:
    """A number in the text replaced by an extreme one."""
    found = _token(data, rng, lambda word: word.strip(b"+-.e").replace(b".", b"", 1).isdigit())
    return found[0] + rng.choice(NUMBERS).encode() + found[2] if found else flip(data, rng)


def word(data: bytes, rng: Random) -> bytes:
    """A word in the text replaced by a path, a number, or a word from elsewhere."""
    found, other = _token(data, rng, bytes.isascii), _token(data, rng, bytes.isascii)
    if not found or not other:
        return flip(data, rng)
    return found[0] + rng.choice((rng.choice(PATHS).encode(), rng.choice(NUMBERS).encode(), other[1])) + found[2]


def line(data: bytes, rng: Random) -> bytes:
    """A line dropped, moved, or many times doubled."""
    lines = data.split(b"\n")
    kept, to = lines.pop(rng.randrange(len(lines))), rng.randrange(len(lines) + 1)
    times = min(rng.choice((0, 1, 2, 500)), LARGEST // (len(kept) + 1))
    return b"\n".join(lines[:to] + [kept] * times + lines[to:])


def damage_json(data: bytes, rng: Random) -> bytes:
    """The JSON text with one place of its tree changed; any bytes where it is no JSON."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return flip(data, rng)
    if _seldom(rng):
        opening, closing = rng.choice(((b"[", b"]"), (b'{"a":', b"}")))
        return opening * DEEP + b"0" + closing * DEEP
    return json.dumps(damage_tree(tree, rng)).encode("utf-8", "surrogatepass")


def damage_tree(tree: Any, rng: Random) -> Any:
    """Lists, dicts and plain values with one place changed."""
    root = [copy.deepcopy(tree)]
    places: list[tuple[Any, Any]] = [(root, 0)]
    for holder, key in places:  # grows: every place of the tree
        inner = holder[key]
        if isinstance(inner, dict | list):
            places += [(inner, name) for name in (inner if isinstance(inner, dict) else range(len(inner)))]
    (holder, key), change = rng.choice(places), rng.randrange(9)
    if change == 0 and holder is not root:
        del holder[key]
    elif change == 1 and isinstance(holder, dict):
        holder[rng.choice(("", "a", "x" * 3000, "../a", f"{key} "))] = holder.pop(key)
    elif change == 2 and isinstance(holder, list) and holder is not root:
        holder.extend([holder[key]] * rng.choice((1, 2, 1000)))
    elif change == 3:
        other, name = rng.choice(places)
        holder[key] = copy.deepcopy(other[name])
    else:
        holder[key] = copy.deepcopy(rng.choice(VALUES))
    return root[0]


def _chunks(data: bytes, place: int, head: str, behind: int) -> Files:
    """Chunks from a place on, by number and kind: each has a head of size and kind, and so many bytes behind it."""
    parts: Files = {}
    while place + struct.calcsize(head) + behind <= len(data):
        size, kind = struct.unpack_from(head, data, place)
        start = place + struct.calcsize(head)
        parts[f"{len(parts)} {kind.hex()}"] = data[start : start + size]
        place = start + size + behind
    return parts


def open_glb(data: bytes) -> Opened | None:
    """The chunks of a GLB file."""
    if data[:4] != b"glTF" or not (parts := _chunks(data, 12, "<I4s", behind=0)):
        return None

    def close(parts: Files) -> bytes:
        chunks = b"".join(struct.pack("<I4s", len(v), bytes.fromhex(k.split()[1])) + v for k, v in parts.items())
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    return parts, close


def open_zip(data: bytes) -> Opened | None:
    """The members of a ZIP archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = {info.filename: archive.read(info) for info in archive.infolist()}
    except Exception:  # noqa: BLE001 - damaged before: any error of zipfile says that there is nothing to open
        return None

    def close(parts: Files) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for name, content in parts.items():
                archive.writestr(name, content)
        return stream.getvalue()

    return (parts, close) if parts else None


def open_png(data: bytes) -> Opened | None:
    """The chunks of a PNG image."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n") or not (parts := _chunks(data, 8, ">I4s", behind=4)):
        return None

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    return parts, lambda parts: data[:8] + b"".join(chunk(bytes.fromhex(k.split()[1]), v) for k, v in parts.items())


def open_npy(data: bytes) -> Opened | None:
    """Header text and numbers of a .npy file."""
    if not data.startswith(b"\x93NUMPY\x01\x00") or len(data) < 10:
        return None
    size = int.from_bytes(data[8:10], "little")

    def close(parts: Files) -> bytes:
        return data[:8] + (len(parts["header"]) % 65536).to_bytes(2, "little") + parts["header"] + parts["numbers"]

    return {"header": data[10 : 10 + size], "numbers": data[10 + size :]}, close


OPENERS: tuple[Callable[[bytes], Opened | None], ...] = (open_glb, open_zip, open_png, open_npy)
