"""The training of the densifier: which meshes it sees."""

from experiments.packaged import densifier_training
from spnr_jax.errors import UserError


def test_the_densifier_trains_on_no_mesh_of_the_test_list(tmp_path, monkeypatch):
    names = ("my table.glb", "lamp.glb", "lamp.obj", "sub/vase.glb", "sub/chair.glb")
    for name in names:
        (tmp_path / "meshes" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "meshes" / name).touch()
    loaded = set()

    def load(source, variant, seed):
        loaded.add(source.name)
        raise UserError("is empty")

    monkeypatch.setattr(densifier_training, "load", load)
    left_out = frozenset({"my_table", "lamp.glb", "chair"})
    densifier_training.make_records(
        densifier_training.Options(meshes=tmp_path / "meshes", left_out=left_out, out=tmp_path, objects=0, steps=1)
    )
    assert loaded == {"lamp.obj", "vase.glb"}
