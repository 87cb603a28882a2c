"""Kept traces: the same numbers as `jax.jit`, from the disk in another process, made anew where they are damaged."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from support.laws import close

from spnr_jax.devices import programs
from spnr_jax.kernels.records import TABLES, Camera, Light, Rays, Volume

CALLS = []


def bend(rays, shift, *, times):
    """Counts how often it is traced."""
    CALLS.append(times)
    return dataclasses.replace(rays, origins=times * rays.origins + shift[None])


@pytest.fixture
def folder(tmp_path):
    """An empty cache, and nothing traced yet."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "programs"))
    CALLS.clear()
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


def kept():
    """As a new process has it."""
    return programs.CachedProgram(bend)


RAYS = Rays(np.arange(6, dtype=np.float32).reshape(2, 3), np.ones((2, 3), np.float32))
SHIFT = np.float32([1, 2, 3])
EXPECTED = Rays(3 * RAYS.origins + SHIFT, RAYS.directions)


def test_a_trace_on_the_disk_is_not_traced_again_and_gives_the_same(folder):
    for count in (1, 1):
        close(kept()(RAYS, SHIFT, times=3), EXPECTED)
        assert len(CALLS) == count
    assert len(list(folder.glob("trace-bend-*"))) == 1
    assert not list(folder.glob(".unfinished*"))


def test_other_shapes_types_and_static_arguments_have_traces_of_their_own(folder):
    function = kept()
    function(RAYS, SHIFT, times=3)
    close(function(RAYS, SHIFT, times=2).origins, 2 * RAYS.origins + SHIFT)
    one = jax.tree.map(lambda x: x[:1], RAYS)
    close(function(one, SHIFT, times=3).origins, EXPECTED.origins[:1])
    function(RAYS, np.int32([1, 2, 3]), times=3)
    assert len(CALLS) == len(function.programs) == 4


@pytest.mark.parametrize("damage", [lambda x: x[: len(x) // 2], lambda x: x[:40] + b"?" + x[41:], lambda x: b""])
def test_a_damaged_trace_is_made_anew_once_and_for_all(folder, damage):
    kept()(RAYS, SHIFT, times=3)
    (file,) = folder.glob("trace-bend-*")
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    for count in (2, 2):
        close(kept()(RAYS, SHIFT, times=3), EXPECTED)
        assert len(CALLS) == count
    assert len(file.read_bytes()) == len(whole)


def test_inside_other_transformations_it_is_the_function(folder):
    function = kept()
    mapped = jax.vmap(lambda shift: function(RAYS, shift, times=3).origins)(jnp.stack([SHIFT, 2 * SHIFT]))
    close(mapped, np.stack([EXPECTED.origins, EXPECTED.origins + SHIFT]))
    shutil.rmtree(folder, ignore_errors=True)
    folder.write_text("a file")  # a folder that cannot be written only costs time
    close(function(RAYS, SHIFT, times=3), EXPECTED)
    gradient = jax.grad(lambda shift: jnp.sum(function(RAYS, shift, times=3).origins))(jnp.asarray(SHIFT))
    close(gradient, np.full(3, 2.0))


def test_programs_are_dropped_before_the_memory_maps_of_the_process_run_out(folder, monkeypatch):
    """Three maps of each kernel stay until then; what is dropped computes the same when it is called again."""
    cleared = []
    monkeypatch.setattr(programs.CachedProgram, "instances", [])
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))  # the real one slows every test after this
    first, second = kept(), kept()
    close(first(RAYS, SHIFT, times=3), EXPECTED)
    assert (len(first.programs), cleared) == (1, []), "a process with few maps has dropped a program"
    monkeypatch.setattr(programs, "FULL", 0.0)
    close(second(RAYS, SHIFT, times=3), EXPECTED)
    assert (first.programs, len(second.programs), cleared) == ({}, 1, [True])
    close(first(RAYS, SHIFT, times=3), EXPECTED)
    cleared.clear()
    monkeypatch.setattr(programs, "MAPS", folder / "absent")  # as on other systems
    programs.make_room()
    assert cleared == []


def test_jax_export_writes_and_reads_functions_of_records():
    """Their static fields too, as whole numbers of NumPy."""
    camera = Camera(np.zeros((3, 4), np.float32), np.eye(3, dtype=np.float32), height=np.int64(4), width=6)
    scene = Volume(scene=Light(np.zeros(TABLES, np.float32)), centre=SHIFT, scale=SHIFT[0])
    content = export.export(jax.jit(lambda *of: of))(camera, scene).serialize()
    close(export.deserialize(content).call(camera, scene), (camera, scene))
