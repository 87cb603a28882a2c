"""What is cut out of files: options, their order, the file's own frame, and what is said where nothing is left."""

import numpy as np
import pytest

from spnr_jax.formats import clouds
from spnr_jax.formats.clouds import place_cloud, read_cloud
from spnr_jax.formats.cut import Cut
from spnr_jax.surfels.sides import spiral

FAR = np.array([5e6, 2e6, 0.0])  # where float32 knows half metres at best


def scene(folder, origin=(0.0, 0.0, 0.0)):
    """A file of a large and a small ball, and one point far from both."""
    points = [spiral(3000), 0.3 * spiral(1500) + [2, 0, 0], [[0, 4, 0]]]
    np.save(folder / "a.npy", np.concatenate(points) + origin)
    return folder / "a.npy"


def read(path, **options):
    """The cloud and the lines that it reported of what was done."""
    lines: list[str] = []
    return read_cloud(path, report=lines.append, **options), [line for line in lines if not line.startswith("no ")]


def test_a_box_is_in_the_units_and_axes_of_the_file_however_far_it_lies(tmp_path):
    box = tuple(map(float, (*(FAR + [1.001, -1, -1]), *(FAR + [3, 1, 1]))))
    lines: list[str] = []
    placed = place_cloud(scene(tmp_path, FAR), up="z", cut=Cut(crop=box), report=lines.append)
    assert "--crop: 1,500 of 4,501 points lie inside" in lines
    back = placed.cloud.positions[0] @ placed.rotation + placed.origin
    assert np.all((back > box[:3]) & (back < box[3:]))


def test_the_box_is_cut_before_a_file_is_thinned_while_reading(tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "CAPACITY", 1600)
    cloud, lines = read(scene(tmp_path), cut=Cut(crop=(1.5, -1.0, -1.0, 3.0, 1.0, 1.0)))
    assert len(cloud.positions) == 1500
    assert not any("while reading" in line for line in lines)


def test_objects_are_cut_out_before_they_are_cleaned_and_thinned(tmp_path):
    cloud, lines = read(scene(tmp_path), cut=Cut(object="2"), clean="auto", num_points=200)
    assert np.linalg.norm(cloud.positions - [2, 0, 0], axis=1).max() < 0.31
    assert [line.split()[0] for line in lines] == ["--object:", "200"]
    largest, _ = read(scene(tmp_path), cut=Cut(object="largest"))
    assert len(largest.positions) == 3000


def test_a_box_and_an_object_are_cut_out_of_a_mesh(tmp_path):
    triangle = "v {0} 0 0\nv {1} 0 0\nv {0} 1 0\n"
    (tmp_path / "a.obj").write_text(triangle.format(0, 1) + triangle.format(5, 7) + "f 1 2 3\nf 4 5 6\n")
    for cut in (Cut(crop=(-1.0, -1.0, -1.0, 2.0, 2.0, 2.0)), Cut(object="2")):
        cloud, _ = read(tmp_path / "a.obj", cut=cut, num_points=300)
        assert len(cloud.positions) == 300
        assert cloud.positions[:, 0].max() <= 1
    with pytest.raises(ValueError, match=r"a\.obj: --crop 8 8 8 9 9 9: none of the"):
        read(tmp_path / "a.obj", cut=Cut(crop=(8.0, 8.0, 8.0, 9.0, 9.0, 9.0)))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"object": "smallest"}, "--object must be largest or a number from 1, got 'smallest'"),
        ({"object": "0"}, "--object must be largest or a number from 1, got '0'"),
        (
            {"crop": (1.0, 0.0, 0.0, 0.0, 1.0, 1.0)},
            "--crop takes xmin ymin zmin xmax ymax zmax, each min up to its max",
        ),
        ({"crop": (np.nan, 0.0, 0.0, 1.0, 1.0, 1.0)}, "--crop takes xmin ymin zmin xmax ymax zmax"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, expected):
    with pytest.raises(ValueError, match=expected):
        Cut(**options)
