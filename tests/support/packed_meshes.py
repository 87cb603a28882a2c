"""Buffers that another encoder packed: meshoptimizer 1.3 (npm).

MESHOPT    name -> packed, mode, count, byteStride, filter as in the glTF extension; `plain` is what meshoptimizer's own
           decoder makes of it, `meant` the floats that went into a filter
"""

import base64
import json
from pathlib import Path

MESHOPT = {
    name: case | {key: base64.b64decode(case[key]) for key in ("packed", "plain", "meant") if key in case}
    for name, case in json.loads(Path(__file__).with_name("meshopt_packed.json").read_text()).items()
}
