"""Mutations of valid files that know the files' structure: the same generator makes the same damage.

Files are a dict from names to bytes.  A container is opened, one of its parts is damaged, and it is closed again with
right lengths and checksums, so that the damage reaches what reads the part; now and then the whole is damaged instead.
    bytes   bits flipped, pieces cut, doubled, moved, inserted; 1 to 8 bytes replaced by extreme numbers
    text    numbers and words replaced, lines doubled and dropped
    JSON    any value replaced by another type, an extreme, a path, a deep nest; keys renamed, dropped, entries doubled
"""

import copy
import io
import json
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

Files = dict[str, bytes]
Parts = dict[str, bytes]
Random = np.random.Generator

DECOY = "secret.bin"  # lies beside the folder of an input; no reader may open it
PATHS: tuple[str, ...]
PATHS = (f"../{DECOY}", f"..\\{DECOY}", f"a/../../{DECOY}", f"%2e%2e/{DECOY}", "/etc/passwd", "file:///etc/passwd")
PATHS += (
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
)
NUMBERS: tuple[str, ...]
NUMBERS = ("0", "-1", "1", "255", "256", "65536", "2147483647", "-2147483648", "4294967295", "9223372036854775807")
NUMBERS += (
    "1e308",
    "-1e308",
    "1e-320",
    "1e39",
    "nan",
    "inf",
    "-inf",
    "1e999",
    "9" * 400,
    "9" * 5000,
    "0x10",
    "1_0",
    "٣",
    "1.5",
)
VALUES: tuple[Any, ...] = (None, True, False, 0, -1, 1, 2, 3, 7, 2**31, 2**32 - 1, 2**63, 10**30, 10**400, 0.5, -0.0)
VALUES += (1e308, float("nan"), float("inf"), -float("inf"), [], {}, [[]], [None], "", "a", [0] * 1000, {"": 0}, *PATHS)
FORMATS = ("<B", "<H", "<I", "<Q", "<i", "<f", "<d", ">I", ">f")
EXTREMES = (
    0,
    1,
    -1,
    127,
    255,
    32767,
    65535,
    2**31 - 1,
    2**32 - 1,
    2**63 - 1,
    -(2**31),
    float("nan"),
    float("inf"),
    1e38,
)
DEEP = 100_000
HEADER = 400  # bytes in which half of the damage is done: that is where the counts are
MOST_OPERATIONS = 4


def mutated(files: Files, rng: Random) -> Files:
    """The files with 1 to 4 pieces of damage, mostly one and in the first file."""
    damaged = dict(files)
    names = list(files)
    for _ in range(min(rng.geometric(0.6), MOST_OPERATIONS)):
        name = names[0] if rng.random() < 0.6 else names[rng.integers(len(names))]
        if rng.random() < 0.03:
            damaged.pop(name, None)
        elif name in damaged:
            damaged[name] = damage(damaged[name], rng)
    return damaged


def damage(data: bytes, rng: Random) -> bytes:
    """The bytes damaged once, in the deepest structure that is known, or as they are."""
    if rng.random() < 0.8:
        for opened in (open_glb, open_zip, open_png, open_npy, open_map):
            found = opened(data)
            if found is not None:
                parts, close = found
                name = list(parts)[rng.integers(len(parts))]
                return close(parts | {name: damage(parts[name], rng)})
        if data[:1] in (b"{", b"[") and rng.random() < 0.9:
            return damage_json(data, rng)
    text = data[:HEADER].isascii() and rng.random() < 0.7
    operations = TEXT_OPERATIONS if text else BYTE_OPERATIONS
    return operations[rng.integers(len(operations))](data, rng)


# Bytes


def _place(data: bytes, rng: Random) -> int:
    end = min(len(data), HEADER) if rng.random() < 0.5 else len(data)
    return int(rng.integers(max(1, end)))


def _piece(data: bytes, rng: Random) -> tuple[int, int]:
    start = _place(data, rng)
    return start, start + int(2 ** rng.uniform(0, 9))


def flip(data: bytes, rng: Random) -> bytes:
    """Some bits turned over."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 9) if data else 0):
        changed[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def cut_end(data: bytes, rng: Random) -> bytes:
    """The beginning alone."""
    return data[: _place(data, rng)]


def drop(data: bytes, rng: Random) -> bytes:
    """A piece left out."""
    start, end = _piece(data, rng)
    return data[:start] + data[end:]


def insert(data: bytes, rng: Random) -> bytes:
    """Random bytes, or the same byte many times, put in."""
    start, end = _piece(data, rng)
    new = rng.bytes(end - start) if rng.random() < 0.5 else bytes([int(rng.integers(256))]) * (end - start)
    return data[:start] + new + data[start:]


def double(data: bytes, rng: Random) -> bytes:
    """A piece once more, there or elsewhere."""
    start, end = _piece(data, rng)
    place = end if rng.random() < 0.5 else _place(data, rng)
    return data[:place] + data[start:end] + data[place:]


def overwrite(data: bytes, rng: Random) -> bytes:
    """A number of 1 to 8 bytes replaced by an extreme one."""
    form, value = FORMATS[rng.integers(len(FORMATS))], EXTREMES[rng.integers(len(EXTREMES))]
    if form[1] in "fd":
        with np.errstate(all="ignore"):
            new = np.array(value, form[0] + {"f": "f4", "d": "f8"}[form[1]]).tobytes()
    else:
        size = struct.calcsize(form)
        whole = int(value) if np.isfinite(value) else 2**53
        new = (whole % 2 ** (8 * size)).to_bytes(size, "little" if form[0] == "<" else "big")
    start = _place(data, rng)
    return data[:start] + new + data[start + len(new) :]


# Text


def _tokens(data: bytes, rng: Random, kind: Callable[[bytes], bool]) -> tuple[bytes, bytes, bytes] | None:
    """(before, token, behind) of one token of a kind, None where there is none nearby."""
    start = _place(data, rng)
    words = data[start : start + 2000].replace(b"\n", b" ").replace(b",", b" ").split(b" ")
    for word in words:
        if word and kind(word):
            place = data.index(word, start)
            return data[:place], word, data[place + len(word) :]
    return None


def number(data: bytes, rng: Random) -> bytes:
    """A number in the text replaced by an extreme one."""
    found = _tokens(data, rng, lambda word: word.strip(b"+-.e").isdigit() or word.replace(b".", b"", 1).isdigit())
    return found[0] + NUMBERS[rng.integers(len(NUMBERS))].encode() + found[2] if found else flip(data, rng)


def word(data: bytes, rng: Random) -> bytes:
    """A word in the text replaced by a path, a number, or a word from elsewhere."""
    found, other = _tokens(data, rng, bytes.isascii), _tokens(data, rng, bytes.isascii)
    if not found or not other:
        return flip(data, rng)
    choices = (PATHS[rng.integers(len(PATHS))].encode(), NUMBERS[rng.integers(len(NUMBERS))].encode(), other[1])
    return found[0] + choices[rng.integers(3)] + found[2]


def line(data: bytes, rng: Random) -> bytes:
    """A line dropped, doubled, many times doubled, or moved."""
    lines = data.split(b"\n")
    at, to = int(rng.integers(len(lines))), int(rng.integers(len(lines)))
    kept = lines.pop(at)
    copies = (0, 1, 2, 500)[rng.integers(4)]
    return b"\n".join(lines[:to] + [kept] * copies + lines[to:])


BYTE_OPERATIONS = (flip, cut_end, drop, insert, double, overwrite, overwrite, overwrite)
TEXT_OPERATIONS = (number, number, number, word, word, line, line, flip, cut_end, drop, insert)


# JSON


def damage_json(data: bytes, rng: Random) -> bytes:
    """The JSON text with one place of its tree changed; any bytes where it is no JSON."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return flip(data, rng)
    if rng.random() < 0.02:
        opening, closing = (b"[", b"]") if rng.random() < 0.5 else (b'{"a":', b"}")
        return opening * DEEP + b"0" + closing * DEEP
    tree = damage_tree(tree, rng)
    return json.dumps(tree).encode("utf-8", "surrogatepass")


def damage_tree(tree: Any, rng: Random) -> Any:
    """Lists, dicts and plain values with one place changed; the argument stays as it is."""
    root = [copy.deepcopy(tree)]
    places: list[tuple[Any, Any]] = [(root, 0)]
    for holder, key in places:  # grows: every place of the tree
        inner = holder[key]
        if isinstance(inner, dict | list):
            places += [(inner, name) for name in (inner if isinstance(inner, dict) else range(len(inner)))]
    holder, key = places[rng.integers(len(places))]
    change = rng.random()
    if change < 0.12 and holder is not root:
        del holder[key]
    elif change < 0.22 and isinstance(holder, dict):
        holder[("", "a", "x" * 3000, "../a", f"{key} ")[rng.integers(5)]] = holder.pop(key)
    elif change < 0.32 and isinstance(holder, list) and holder is not root:
        holder.extend([holder[key]] * (1, 2, 1000)[rng.integers(3)])
    elif change < 0.45:
        other_holder, other_key = places[rng.integers(len(places))]
        holder[key] = copy.deepcopy(other_holder[other_key])
    else:
        holder[key] = copy.deepcopy(VALUES[rng.integers(len(VALUES))])
    return root[0]


# Containers


def chunks_of(data: bytes, place: int, head: str, behind: int) -> Parts:
    """Chunks from a place on, by number and kind: each has a head of size and kind, and so many bytes behind it."""
    parts: Parts = {}
    while place + struct.calcsize(head) + behind <= len(data):
        size, kind = struct.unpack_from(head, data, place)
        start = place + struct.calcsize(head)
        parts[f"{len(parts)} {kind.hex()}"] = data[start : start + size]
        place = start + size + behind
    return parts


def open_glb(data: bytes) -> tuple[Parts, Callable[[Parts], bytes]] | None:
    """The chunks of a GLB file."""
    if data[:4] != b"glTF":
        return None
    parts = chunks_of(data, 12, "<I4s", behind=0)

    def close(parts: Parts) -> bytes:
        chunks = b"".join(struct.pack("<I4s", len(v), bytes.fromhex(k.split()[1])) + v for k, v in parts.items())
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    return (parts, close) if parts else None


def open_zip(data: bytes) -> tuple[Parts, Callable[[Parts], bytes]] | None:
    """The members of a ZIP archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = {info.filename: archive.read(info) for info in archive.infolist()}
    except Exception:  # noqa: BLE001 - damaged before: any error of zipfile says that there is nothing to open
        return None

    def close(parts: Parts) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for name, content in parts.items():
                archive.writestr(name, content)
        return stream.getvalue()

    return (parts, close) if parts else None


def open_png(data: bytes) -> tuple[Parts, Callable[[Parts], bytes]] | None:
    """The chunks of a PNG image."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return None
    parts = chunks_of(data, 8, ">I4s", behind=4)

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    def close(parts: Parts) -> bytes:
        return data[:8] + b"".join(chunk(bytes.fromhex(k.split()[1]), v) for k, v in parts.items())

    return (parts, close) if parts else None


def open_npy(data: bytes) -> tuple[Parts, Callable[[Parts], bytes]] | None:
    """Header text and numbers of a .npy file."""
    if not data.startswith(b"\x93NUMPY\x01\x00") or len(data) < 10:
        return None
    size = int.from_bytes(data[8:10], "little")

    def close(parts: Parts) -> bytes:
        return data[:8] + (len(parts["header"]) % 65536).to_bytes(2, "little") + parts["header"] + parts["numbers"]

    return {"header": data[10 : 10 + size], "numbers": data[10 + size :]}, close


def open_map(data: bytes) -> tuple[Parts, Callable[[Parts], bytes]] | None:
    """The files in a record of a packed data set."""
    import msgpack

    if not data or not 0x80 <= data[0] <= 0x8F:
        return None
    try:
        parts = msgpack.unpackb(data)
    except Exception:  # noqa: BLE001 - damaged before: any error of msgpack says that there is nothing to open
        return None
    sound = all(isinstance(name, str) and isinstance(content, bytes) for name, content in parts.items())
    return (parts, msgpack.packb) if sound and parts else None
