"""A side of the benchmark that sleeps instead of rendering; the mode "parity" fakes the differences."""

import time

from experiments.speed import worker

MS = {"network": 2.0, "near points": 1.0, "plain": 8.0, "fast": 4.0}


def make(spec):
    print("a library says something on stdout")
    if spec["mode"] == "encode":
        raise RuntimeError("no memory left\nfor encoding")
    kind = spec.get("variant") or spec.get("function")
    differences = {"plain/image": 1e-6, "fast/image": 1e-3 if spec.get("wrong") else 1e-6}
    return lambda: time.sleep(1e-3 * MS.get(kind, 0)), {
        "software": "fake 1",
        "compile_s": 0.5,
        "differences": differences,
    }


if __name__ == "__main__":
    worker.serve(make)
