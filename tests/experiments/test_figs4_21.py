"""The contact sheets show every object of every method in one layout, and are made once."""

import dataclasses

import numpy as np
import pytest
from PIL import Image
from support import stand_ins, tiny_dataset
from support.tiny_runs import forbidden

from data_gen.store import layout
from experiments.comparison import figures, trained_networks
from experiments.comparison.trained_networks import Sources
from experiments.paper import figs4_21
from experiments.paper.figs4_21 import Gallery, main
from spnr_jax import cli
from spnr_jax.formats import data_sets

SIZE, GAP = tiny_dataset.SIZE, figures.GAP
NAMES = tiny_dataset.SPLITS["test"]


@pytest.fixture(autouse=True)
def _stand_ins(monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    monkeypatch.setattr(trained_networks, "networks", lambda *_: stand_ins.stand_ins("Ours", "Ours (a/run)"))


def asked(out, **options):
    return Gallery(data=tiny_dataset.dataset().folder, out=out, **({"rows": 1, "columns": 2} | options))


def reference(name, view=0):
    return np.round(255 * data_sets.on_white(data_sets.read_object(tiny_dataset.dataset(), name).images[view]))


def place(sheet, column, row=0):
    start = column * (SIZE + GAP), row * (SIZE + GAP)
    return np.asarray(Image.open(sheet))[start[1] : start[1] + SIZE, start[0] : start[0] + SIZE]


def test_every_sheet_has_the_objects_in_the_same_place_page_after_page(tmp_path, monkeypatch):
    read = data_sets.read_object

    def with_a_darker_view(*arguments):
        item = read(*arguments)
        images = item.images.copy()
        images[1, ..., :3] //= 2
        return dataclasses.replace(item, images=images)

    monkeypatch.setattr(data_sets, "read_object", with_a_darker_view)
    main(asked(tmp_path, view=1))
    sheets_of = {path.name for path in tmp_path.glob("*_[12].png")}
    assert sheets_of == {f"{stem}_{page}.png" for stem in ("reference", "ours", "ours-a-run") for page in (1, 2)}
    for i, name in enumerate(NAMES):
        page, column = divmod(i, 2)
        np.testing.assert_array_equal(place(tmp_path / f"reference_{page + 1}.png", column), reference(name, 1))
        drawn = np.asarray(Image.open(tmp_path / "pictures" / "Ours" / f"{name}.png"))
        np.testing.assert_array_equal(place(tmp_path / f"ours_{page + 1}.png", column), drawn)
    assert (place(tmp_path / "ours_2.png", 1) == 255).all()


def test_side_by_side_are_the_first_and_the_last_object_and_some_between_a_row_for_each_method():
    pictures = [np.full((64, 64, 3), i, np.uint8) for i in range(9)]
    shown = {"Reference": pictures, "Ours": [200 - x for x in pictures]}
    sheet = figs4_21.side_by_side(shown, 3)
    left = sheet.shape[1] - 3 * (64 + GAP)
    cells = [sheet[row * (64 + GAP) + 9, left + column * (64 + GAP) + 9, 0] for row in (0, 1) for column in (0, 1, 2)]
    assert cells == [0, 4, 8, 200, 196, 192]
    assert figs4_21.side_by_side(shown, 99).shape[1] == left + 9 * (64 + GAP)


def test_pictures_are_made_once_and_of_one_view_and_network(tmp_path, monkeypatch):
    main(asked(tmp_path))

    monkeypatch.setattr(stand_ins.StandIn, "show", forbidden)
    before = (tmp_path / "ours_1.png").read_bytes()
    main(asked(tmp_path))
    assert (tmp_path / "ours_1.png").read_bytes() == before
    with pytest.raises(ValueError, match="holds a gallery with another view; choose another --out"):
        main(asked(tmp_path, view=1))
    monkeypatch.setattr(trained_networks, "networks", lambda *_: stand_ins.stand_ins("Ours", checksum="1"))
    with pytest.raises(ValueError, match="holds pictures of Ours with another config"):
        main(asked(tmp_path))


def test_poisson_pictures_of_a_table_are_shown_where_there_is_one_of_every_object(tmp_path, capsys):
    table, points = tmp_path / "table", tiny_dataset.CONFIG.test_points
    grey = np.full((SIZE, SIZE, 4), 99, np.uint8)
    grey[..., 3] = 255
    for name in NAMES:
        folder = table / f"poisson_{points}" / name
        folder.mkdir(parents=True)
        (folder / "000.png").write_bytes(layout.encode_image(grey))
        (folder / "made.json").write_text("{}")
    main(asked(tmp_path / "out", sources=Sources(table1=table)))
    assert (place(tmp_path / "out" / "poisson_1.png", 0) == 99).all()
    assert "Poisson, trimmed 0.3 left out" in capsys.readouterr().out


def test_a_view_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match="--view 3: object ball_000004 has views 0 to 2"):
        main(asked(tmp_path, view=3))


class TestGrid:
    red, blue = (np.tile(np.uint8(color), (4, 4, 1)) for color in ((200, 0, 0), (0, 0, 200)))

    def test_cells_stand_in_rows_and_a_missing_one_is_white(self):
        found = figures.grid([[self.red, self.blue], [self.blue]], size=8)
        assert found.shape == (2 * (8 + GAP), 2 * (8 + GAP), 3)
        np.testing.assert_array_equal(found[0, 0], self.red[0, 0])
        np.testing.assert_array_equal(found[7, 8 + GAP], self.blue[0, 0])
        np.testing.assert_array_equal(found[8 + GAP, 0], self.blue[0, 0])
        assert (found[8 + GAP :, 8 + GAP :] == 255).all()
