"""What a killed process left in the cache of compiled programs is made anew, once and without a warning."""

import os
import subprocess
import sys

PROGRAM = """
import os, pathlib, sys
from spnr_jax.devices import runtime
os.environ["JAX_COMPILATION_CACHE_DIR"] = sys.argv[1]
seen = []
for cut in (True, False, False):
    runtime.keep_programs()
    import jax
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.clear_caches()
    assert jax.jit(lambda x: 2 * x)(1.0) == 2
    seen.append({entry.name: entry.read_bytes() for entry in pathlib.Path(sys.argv[1]).glob("*-cache")})
    for name, content in seen[-1].items() if cut else ():
        pathlib.Path(sys.argv[1], name).write_bytes(content[: len(content) // 2])
whole, mended, kept = seen
assert whole and whole.keys() == mended.keys() and mended == kept
assert all(len(mended[name]) > 0.9 * len(whole[name]) for name in whole)
"""


def test_a_cut_off_entry_is_made_anew_once_and_without_a_word(tmp_path):
    command = [sys.executable, "-W", "error", "-c", PROGRAM, tmp_path]
    alone = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}  # JAX set it here
    done = subprocess.run(command, env=alone, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
