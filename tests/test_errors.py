"""A bug of ours is told apart from a broken file, and --debug is taken from any place of a command line."""

import json

import pytest

from spnr_jax import errors
from spnr_jax.formats.mesh import meshes
from spnr_jax.formats.mesh.assets import RejectedAsset


def raised_in(module, code):
    """The error of a piece of code that stands in a module of this name."""
    with pytest.raises((NameError, AttributeError, ValueError)) as caught:
        exec(compile(code, module, "exec"), {"__name__": module, "json": json})
    return caught.value


@pytest.mark.parametrize(
    ("module", "code", "bug"),
    [
        ("spnr_jax.formats.ply", "absent", True),
        ("data_gen.store.check", "def f():\n    print(x)\n    x = 1\nf()", True),
        ("spnr_jax.formats.ply", "json.absent", True),
        ("spnr_jax.formats.ply", "json.loads('[]').items()", False),  # the file holds a list
        ("spnr_jax.formats.ply", "json.loads('{')", False),
        ("trimesh.exchange.ply", "absent", False),  # a library's way to say that a file is broken
        ("trimesh.exchange.ply", "json.absent", False),
    ],
)
def test_a_name_that_there_is_not_is_a_bug_in_our_code_alone(module, code, bug):
    assert errors.is_bug(raised_in(module, code)) is bug


def test_a_bug_in_a_reader_of_meshes_is_not_called_a_broken_file(tmp_path, monkeypatch):
    (tmp_path / "a.glb").write_bytes(b"glTF")
    with pytest.raises(RejectedAsset):
        meshes.load_mesh(tmp_path / "a.glb")
    space = {"__name__": meshes.__name__}
    exec("def load(path, transparent_parts): return absent", space)
    monkeypatch.setattr(meshes, "load_gltf", space["load"])
    with pytest.raises(NameError, match="absent"):
        meshes.load_mesh(tmp_path / "a.glb")


def test_debug_is_an_option_at_any_place_or_a_variable(monkeypatch):
    monkeypatch.delenv("SPNR_DEBUG", raising=False)
    assert errors.split_debug(["render", "a.ply"]) == (["render", "a.ply"], False)
    assert errors.split_debug(["--debug", "render", "a.ply"]) == (["render", "a.ply"], True)
    for value, shown in (("1", True), ("0", False), ("", False)):
        monkeypatch.setenv("SPNR_DEBUG", value)
        assert errors.split_debug([]) == ([], shown)
