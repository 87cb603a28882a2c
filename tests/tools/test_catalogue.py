"""A folder of clouds is drawn whole, file by file as each alone; what stands is kept, what cannot be drawn is named."""

import dataclasses
import json
import os
import re
from html import unescape
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
import pytest
from support import tiny_untrained

from spnr_jax.tools import catalogue, pictures
from spnr_jax.tools.commands import Render, is_catalogue

OPTIONS = {"views": 1, "resolution": 24, "num_points": 30, "up": "y", "turntable": "none", "outputs": ("image",)}
NAMES = ("a/x.xyz", "b/x.npy", "b/x.xyz", "c d#.xyz")


def write_cloud(path, seed):
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(seed).uniform(-1, 1, (40, 3))
    np.save(path, points) if path.suffix == ".npy" else np.savetxt(path, points)


def command(cloud, out, **options):
    return Render(cloud=cloud, out=out, **{"run": tiny_untrained.run()} | OPTIONS | options)


def render(cloud, out, **options):
    return list(catalogue.render_catalogue(command(cloud, out, **options)))


@pytest.fixture
def clouds(tmp_path):
    for seed, name in enumerate(NAMES):
        write_cloud(tmp_path / "in" / name, seed)
    (tmp_path / "in" / "notes.md").write_text("no cloud")
    (tmp_path / "in" / ".hidden.xyz").write_text("0 0 0\n")
    return tmp_path / "in"


def stills(out):
    """Times of the pictures, by their paths."""
    return {path.relative_to(out).as_posix(): path.stat().st_mtime_ns for path in out.rglob("*.png")}


def all_of(names):
    return {f"{name}/{name.split('/')[-1].rpartition('.')[0]}_000.png" for name in names}


def headings(out):
    return [unescape(text) for text in re.findall(r"<h2>(.*?)</h2>", (out / "index.html").read_text())]


def test_every_file_is_drawn_as_alone_and_the_page_shows_them_in_their_order(clouds, tmp_path):
    lines = render(clouds, tmp_path / "out")
    assert set(stills(tmp_path / "out")) == all_of(NAMES)
    assert lines[0].startswith("drew 4 of 4 files")
    assert headings(tmp_path / "out") == sorted(NAMES)
    shown = re.findall(r'src="(.*?)"', (tmp_path / "out" / "index.html").read_text())
    assert {unquote(place) for place in shown} == all_of(NAMES)
    list(pictures.render_file(command(clouds / "b" / "x.npy", tmp_path / "alone"), lambda line: None))
    whole, alone = tmp_path / "out" / "b" / "x.npy" / "x_000.png", tmp_path / "alone" / "x_000.png"
    assert whole.read_bytes() == alone.read_bytes()
    assert whole.read_bytes() != (tmp_path / "out" / "b" / "x.xyz" / "x_000.png").read_bytes()


def test_what_stands_is_not_drawn_again_and_what_changed_or_is_gone_is(clouds, tmp_path):
    out = tmp_path / "out"
    render(clouds, out)
    first = stills(out)
    assert render(clouds, out)[0].startswith("drew 0 of 4 files")
    assert stills(out) == first
    write_cloud(clouds / "a" / "x.xyz", 9)
    os.utime(clouds / "a" / "x.xyz", ns=(1, 1))
    (out / "b" / "x.npy" / "x_000.png").unlink()
    write_cloud(clouds / "new.xyz", 10)
    assert render(clouds, out)[0].startswith("drew 3 of 5 files")
    again = stills(out)
    kept = all_of(("b/x.xyz", "c d#.xyz"))
    assert {name: again[name] for name in kept} == {name: first[name] for name in kept}
    assert again["a/x.xyz/x_000.png"] != first["a/x.xyz/x_000.png"]


def test_other_options_draw_anew_and_leave_no_picture_of_the_ones_before(clouds, tmp_path):
    out = tmp_path / "out"
    render(clouds / "b", out, views=2)
    render(clouds / "b", out, elevation=40.0)
    assert set(stills(out)) == all_of(("x.npy", "x.xyz"))
    assert len({record["options"] for record in records(out)}) == 1


def records(out):
    return [json.loads(path.read_text()) for path in out.rglob("drawn.json")]


def test_pictures_of_a_run_that_was_cut_while_it_drew_anew_are_not_those_of_before(clouds, tmp_path, monkeypatch):
    out, write = tmp_path / "out", catalogue.write_whole
    render(clouds / "a", out, elevation=20.0)
    with monkeypatch.context() as patch:  # as if killed just before the record is written
        patch.setattr(catalogue, "write_whole", lambda path, x: None if path.name == "drawn.json" else write(path, x))
        render(clouds / "a", out, elevation=40.0)
    assert render(clouds / "a", out, elevation=20.0)[0].startswith("drew 1 of 1 files")


def test_a_bad_file_is_listed_with_its_reason_and_the_others_are_drawn(clouds, tmp_path, capsys):
    (clouds / "b" / "a_bad.ply").write_bytes(b"no ply & <b>")
    (clouds / "empty.npz").write_bytes(b"")
    lines = render(clouds, tmp_path / "out")
    assert set(stills(tmp_path / "out")) == all_of(NAMES)
    assert "2 left out" in lines[0]
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("left out")]
    assert ["a_bad.ply" in said[0], "the file is empty" in said[1]] == [True, True]
    page = (tmp_path / "out" / "index.html").read_text()
    assert "the file is empty" in page
    assert len(headings(tmp_path / "out")) == 6
    assert "<b>" not in page


def test_a_folder_of_which_nothing_can_be_drawn_is_refused_and_so_is_one_without_clouds(tmp_path):
    (tmp_path / "in").mkdir()
    with pytest.raises(ValueError, match=r"in: there is no file of one of \.ply"):
        render(tmp_path / "in", tmp_path / "out")
    (tmp_path / "in" / "x.xyz").write_text("")
    with pytest.raises(ValueError, match="none of the 1 files can be drawn"):
        render(tmp_path / "in", tmp_path / "out")
    assert "the file is empty" in (tmp_path / "out" / "index.html").read_text()


def test_a_stop_leaves_whole_pictures_and_a_page_and_the_same_command_goes_on(clouds, tmp_path, monkeypatch):
    out, begun = tmp_path / "out", []

    def stop_at_the_third(ready, options, name):
        begun.append(name)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return pictures.draw_all(ready, options, name)

    with monkeypatch.context() as patch:
        patch.setattr(catalogue, "draw_all", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt, match="the same command goes on"):
            render(clouds, out)
    first = stills(out)
    assert 1 <= len(records(out)) <= 2
    assert not list(out.rglob(".unfinished*"))
    assert "not drawn yet" in (out / "index.html").read_text()
    standing = {f"{path.parent.relative_to(out).as_posix()}" for path in out.rglob("drawn.json")}
    render(clouds, out)
    again = stills(out)
    assert set(again) == all_of(NAMES)
    assert {name: again[name] for name in all_of(standing)} == {name: first[name] for name in all_of(standing)}


def test_a_pattern_chooses_files_and_what_was_written_below_it_is_no_cloud(clouds, tmp_path):
    write_cloud(clouds / "out" / "drawn_before.npy", 0)
    render(clouds / "**" / "*.npy", clouds / "out")
    assert headings(clouds / "out") == ["b/x.npy"]
    with pytest.raises(ValueError, match=r"\.\. behind a wildcard"):
        render(clouds / "*" / ".." / "*.npy", tmp_path / "out")
    odd = tmp_path / "chair[1].xyz"
    assert is_catalogue(odd)
    odd.write_text("0 0 0\n")
    assert not is_catalogue(odd), "a file is no pattern, whatever its name"


def test_a_name_that_is_no_text_is_drawn_and_shown(tmp_path):
    folder = tmp_path / "in"
    write_cloud(folder / os.fsdecode(b"caf\xe9.xyz"), 0)
    assert render(folder, tmp_path / "out")[0].startswith("drew 1 of 1 files")
    (shown,) = re.findall(rb'src="(.*?)"', (tmp_path / "out" / "index.html").read_bytes())
    assert os.path.isfile(os.path.join(os.fsencode(tmp_path / "out"), unquote_to_bytes(shown)))


@pytest.mark.ci  # each process imports JAX
def test_workers_draw_the_same_and_list_the_same(clouds, tmp_path):
    (clouds / "b" / "bad.ply").write_bytes(b"no ply")
    options = {"here": {}, "there": {"workers": 2}}
    lines = [render(clouds, tmp_path / name, **chosen)[0] for name, chosen in options.items()]
    assert ["drew 4 of 5" in line and "1 left out" in line for line in lines] == [True, True]
    for name in all_of(NAMES):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()
    pages = [(tmp_path / name / "index.html").read_text() for name in options]
    assert pages[0] == pages[1]


def test_the_digest_follows_options_and_networks_and_not_where_they_work(tmp_path):
    network = tmp_path / "network.npz"
    network.write_bytes(b"one")
    options = command(tmp_path, tmp_path / "out", run=network)
    first = catalogue.digest(options)
    assert catalogue.digest(dataclasses.replace(options, workers=3, out=tmp_path)) == first
    assert catalogue.digest(dataclasses.replace(options, views=3)) != first
    network.write_bytes(b"two")
    assert catalogue.digest(options) != first
