"""What a browser sends: its files, and numbers that nobody meant to be sent."""

import re

import pytest
from support.tiny_viewer import model, scene, state

from spnr_jax.viewer import scene as scenes
from spnr_jax.viewer import session, uploads


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("chair.ply", "chair.ply"), ("../../etc/passwd", "passwd"), ("C:\\x\\..\\a b.xyz", "a b.xyz"), ("", "file"),
        ("..", ".."), ("a\x00[b](http://c).ply", "c_.ply"), ("x" * 500 + ".ply", "x" * 56 + ".ply"),
    ],
)  # fmt: skip
def test_of_a_browsers_file_name_only_its_last_part_is_shown(name, shown):
    assert uploads.display_name(name) == shown


def test_an_uploaded_cloud_is_read_in_a_temporary_folder_that_is_gone_afterwards(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    content = "\n".join(f"{x} {x * x} 0" for x in range(30)).encode()
    lines = []
    cloud = uploads.read_upload("../../up.xyz", content, num_points=10, up="y", report=lines.append)
    assert len(cloud.positions) == 10
    assert lines
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.ply", b"", "a.ply: the file is empty"),
        ("a.exe", b"MZ", "a.exe: unknown kind"), ("ply", b"", "ply: unknown"),
        ("../evil/.ply", b"x", "unknown kind"), ("n.xyz", b"0 0 nan\n", "n.xyz"), ("p.npz", b"\x80\x04N.", "p.npz"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_read_is_refused_under_the_browsers_name(name, content, words, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ValueError, match=re.escape(words)) as refused:
        uploads.read_upload(name, content, num_points=10, up="y")
    assert str(tmp_path) not in str(refused.value)
    assert "\n" not in str(refused.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["x/../../../evil.gif", "exe", None, 3])
def test_a_film_of_a_kind_that_is_not_offered_writes_nothing(kind, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ValueError, match="a film is one of mp4, gif"):
        session.film(model(), state(), 1.0, kind, "points")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("sent", [(("points",), "best", "1000000"), (("secret",), "best", "24"), ((), "x", "a")])
def test_controls_that_say_what_they_do_not_offer_are_refused(sent):
    with pytest.raises(ValueError, match="one of"):
        session.chosen(model(), *sent)


@pytest.mark.parametrize("value", [float("nan"), "a", [1, 2], None, 10**400, {}])
def test_an_edit_with_no_number_is_refused_and_one_outside_is_clipped(value):
    with pytest.raises(ValueError, match="roughness has to be a number"):
        scenes.edited(scene(), "roughness", value)
    assert (scenes.edited(scene(), "roughness", 7).cloud.roughness == 1).all()


@pytest.mark.parametrize("corner", [[float("nan"), 0], "ab", None, [0], [[0, 1], 2]])
def test_a_selection_or_target_that_is_no_point_changes_nothing(corner):
    before = state()
    assert session.select(before, corner, [1, 1], add=False) is before
    assert session.record(corner)(before) is before


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), 0.0, -1.0, 1e9])
def test_a_path_of_no_or_endless_time_is_refused(seconds):
    with pytest.raises(ValueError, match="between keyframes"):
        session.path_poses(state(), seconds)
