"""Buffers and images that other people's encoders packed: meshoptimizer 1.3 (npm) and Basis Universal 2.10.

MESHOPT    name -> packed, mode, count, byteStride, filter as in the glTF extension; `plain` is what meshoptimizer's own
           decoder makes of it, `meant` the floats that went into a filter
UASTC, ETC1S_ALPHA    KTX2 images of 8 x 8 texels in four quarters: red, green, blue, light grey; transparent grey
"""

import base64
import json
from pathlib import Path

MESHOPT = {
    name: case | {key: base64.b64decode(case[key]) for key in ("packed", "plain", "meant") if key in case}
    for name, case in json.loads(Path(__file__).with_name("meshopt_packed.json").read_text()).items()
}
UASTC = base64.b64decode(
    "q0tUWCAyMLsNChoKAAAAAAEAAAAIAAAACAAAAAAAAAAAAAAAAQAAAAEAAAAAAAAAaAAAACwAAACUAAAALAAAAAAAAAAAAAAAAAAAAAAAAADAAAAAAAAA"
    "AEAAAAAAAAAAQAAAAAAAAAAsAAAAAAAAAAIAKACmAQIAAwMAABAAAAAAAAAAAAB/AAAAAAAAAAAA/////x8AAABLVFh3cml0ZXIAQmFzaXMgVW5pdmVy"
    "c2FsIDIuMTAAAAQAAAB/fwAA9x8A4B96AAAAAAAAAAAAABfgH+AfAg8AAAAAAAAAAAAXAOD/HwLgAQAAAAAAAAAAFxkZ+d9cawEAAAAAAAAAAA=="
)
ETC1S_ALPHA = base64.b64decode(
    "q0tUWCAyMLsNChoKAAAAAAEAAAAIAAAACAAAAAAAAAAAAAAAAQAAAAEAAAABAAAAaAAAADwAAACkAAAAJAAAAMgAAAAAAAAAlAAAAAAAAABcAQAAAAAA"
    "AAQAAAAAAAAAAAAAAAAAAAA8AAAAAAAAAAIAOACjAQIAAwMAAAgIAAAAAAAAAAA/AAAAAAAAAAAA/////0AAPw8AAAAAAAAAAP////8fAAAAS1RYd3Jp"
    "dGVyAEJhc2lzIFVuaXZlcnNhbCAyLjEwAAAGAAMALwAAAA0AAAAwAAAAAAAAAAAAAAAAAAAAAgAAAAIAAAACAAAAIMBEAAAAAAAA4kQEMBEAAAAAAIAs"
    "0ADiBAwAAABA5qKCAGACAAAAAAAAAdyvJAJUVVVVBQAAAKiqqqoCAMFEAAAAAAAA8t8niAEwBUAAAAAAgGQgAiIECAAAAIIopzjFAGACAAAAAAAAAQQA"
    "Pw3kAA=="
)
