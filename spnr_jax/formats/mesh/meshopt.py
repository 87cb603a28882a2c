"""Buffers that meshopt packed (EXT_meshopt_compression, KHR_meshopt_compression), through meshoptimizer, an extra."""

import numpy as np

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.draco import MISSING

STRIDES = {"OCTAHEDRAL": (4, 8), "COLOR": (4, 8), "QUATERNION": (8,), "EXPONENTIAL": range(4, 257, 4)}  # of filters


def unpack(data: memoryview, packed: dict) -> bytes:
    """The bytes of a buffer view, as its extension describes them; RejectedAsset where the data is broken."""
    try:
        import meshoptimizer  # an extra: only here
    except ImportError:
        raise RejectedAsset(MISSING.format(package="meshoptimizer")) from None
    mode, count, stride, kind = packed["mode"], packed["count"], packed["byteStride"], packed.get("filter", "NONE")
    try:
        if mode != "ATTRIBUTES":
            decode = {"TRIANGLES": meshoptimizer.decode_index_buffer, "INDICES": meshoptimizer.decode_index_sequence}
            return decode[mode](count, 4, data).astype({2: "<u2", 4: "<u4"}[stride]).tobytes()
        elements = meshoptimizer.decode_vertex_buffer(count, stride, data, np.dtype((np.void, stride)))
    except (RuntimeError, ValueError) as error:
        raise RejectedAsset(f"holds meshopt data that is broken or cut off ({error})") from None
    if kind == "NONE":
        return elements.tobytes()
    if stride not in STRIDES.get(kind, ()):
        raise RejectedAsset(f"holds meshopt vertices of {stride} bytes with the filter {kind!r:.40}: broken file")
    if kind == "COLOR":
        return _colors(elements.view("<i1" if stride == 4 else "<i2").reshape(-1, 4)).tobytes()
    decode = {"OCTAHEDRAL": "decode_filter_oct", "QUATERNION": "decode_filter_quat", "EXPONENTIAL": "decode_filter_exp"}
    return getattr(meshoptimizer, decode[kind])(elements, count, stride).tobytes()


def _colors(values: np.ndarray) -> np.ndarray:
    """RGB and alpha, unsigned, of luma, two differences of colour, and alpha with a bit that gives the scale."""
    whole = 2 * np.iinfo(values.dtype).max + 1
    luma, alpha = (values[:, i].astype(np.int64) & whole for i in (0, 3))
    orange, green = values[:, 1].astype(np.int64), values[:, 2].astype(np.int64)
    scale = 2 ** np.frexp(np.maximum(alpha, 1))[1].astype(np.int64) - 1
    alpha = alpha & (scale >> 1)
    parts = [luma + orange - green, luma + green, luma - orange - green, alpha << 1 | alpha & 1]
    return np.rint(np.stack(parts, axis=-1) * (whole / scale)[:, None]).astype(np.int64).astype(values.dtype)
