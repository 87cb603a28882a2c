"""Binary glTF: a document and the bytes that its only buffer holds, in one file."""

import json

import numpy as np

JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"


def packed(document: dict, buffer: bytes) -> bytes:
    """The .glb of a glTF document that says nothing of its buffer, whose length is a multiple of 4."""
    text = json.dumps(document | {"buffers": [{"byteLength": len(buffer)}]}).encode()
    text += b" " * (-len(text) % 4)
    body = _chunk(JSON_CHUNK, text) + _chunk(BINARY_CHUNK, buffer)
    return b"glTF" + np.array([2, 12 + len(body)], "<u4").tobytes() + body


def _chunk(kind: bytes, data: bytes) -> bytes:
    return np.array([len(data)], "<u4").tobytes() + kind + data
