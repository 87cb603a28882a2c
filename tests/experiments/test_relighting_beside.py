"""Relighting beside Mitsuba and under turned lights: both studies on one object, their scores of known pictures."""

import importlib.util
import json

import numpy as np
import pytest
from support import tiny_surfels
from support.tiny_runs import goes_on

from data_gen.make import objects
from data_gen.plan.tasks import Task
from data_gen.render import light, views
from data_gen.render.variant import LLVM, SCALAR, choose_variant, mitsuba_module
from data_gen.store import layout
from experiments.comparison import relit
from experiments.studies import relighting_beside, relighting_turns
from spnr_jax.formats import data_sets

NAME, SIZE = "frame_000000", tiny_surfels.SIZE
needs_solver = pytest.mark.skipif(importlib.util.find_spec("pymeshlab") is None, reason="pymeshlab is not installed")


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    """A data set of one object whose views have the room's light, turned, as `spnr-data generate` writes it."""
    folder = tmp_path_factory.mktemp("lit") / "set"
    view = views.ViewConfig(resolution=SIZE, views=2, spp=8, visibility_grid=1)
    lights = light.Lights(kinds=light.read_kinds(("room",)))
    settings = {"num_points": 64, "seed": 0, "variant": SCALAR, "spread": "even"}
    bench = objects.Workbench(out=str(folder), lights=lights, view=view, **settings)
    mitsuba_module(SCALAR)
    layout.write_object(folder, NAME, objects.make_record(bench, Task(category="frame", object_id=NAME)))
    for split in ("train", "val", "test"):
        layout.write_text(folder / "splits" / f"{split}.txt", f"{NAME}\n" if split == "test" else "")
    described = {"settings": vars(view) | settings, "environment_map": {"kinds": [{"name": "room"}]}}
    layout.write_text(folder / "dataset.json", layout.json_text({"schema_version": layout.SCHEMA_VERSION} | described))
    return folder


@pytest.fixture
def compiled():
    """Mitsuba's compiled code, for one test."""
    if choose_variant()[0] != LLVM:
        pytest.skip("no usable LLVM library")
    yield
    mitsuba_module(SCALAR)


def test_the_maps_that_lit_a_data_set_are_drawn_again_and_others_refused(lit, tmp_path):
    dataset = data_sets.open_dataset(lit)
    item = data_sets.read_object(dataset, NAME)
    maps = relit.maps_of(dataset, item, tmp_path)
    assert len(maps) == 2
    assert np.abs(maps[0] - maps[1]).mean() > 0.05, "each view has its own turn"
    described = json.loads((lit / "dataset.json").read_text())
    described["environment_map"]["kinds"] = [{"name": "maps", "sha256": {"sky.hdr": "0"}}]
    dataset.settings.update(described)
    with pytest.raises(ValueError, match=r"holds no sky\.hdr"):
        relit.maps_of(dataset, item, tmp_path)


def test_a_map_turns_as_a_light_does():
    rng = np.random.default_rng(0)
    envmap = rng.random((32, 64, 3)).astype(np.float32)
    light_of = relighting_turns.light_of
    found, expected = light_of(relit.turned(envmap, 90)), light_of(envmap).turned(90)
    np.testing.assert_allclose(found.tables, expected.tables, rtol=1e-3, atol=1e-4)


@pytest.mark.ci
@needs_solver
def test_the_study_beside_scores_every_row_and_goes_on_where_it_stopped(lit, compiled, tmp_path):
    options = relighting_beside.BesideStudy(
        data=(lit,),
        maps=tmp_path,
        out=tmp_path / "out",
        run=str(tiny_surfels.run()),
        counts=(32,),
        sizes=(SIZE // 2, SIZE),
        objects=1,
        spp=4,
    )
    relighting_beside.main(options)
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    (found,) = results["objects"]["room"]
    assert len(found) == 3 + 1 + 2  # ours, Poisson, oracles
    assert np.isfinite([found[row][str(size)] for row in found for size in options.sizes]).all()
    assert found[relighting_beside.NO_SHADOWS][str(SIZE)][4] == 0
    assert found[relighting_beside.OCCLUSION][str(SIZE)][1] > 20, "the true mesh under the very map"
    assert (tmp_path / "out" / f"{NAME}.png").is_file()
    goes_on(relighting_beside.main, options)


@pytest.mark.ci
@needs_solver
def test_the_study_of_turned_lights_ends_with_a_table_a_gallery_and_a_film(lit, tmp_path):
    options = relighting_turns.TurnsStudy(
        data=lit,
        out=tmp_path / "out",
        lights=("night", "room"),
        turning=1,
        run=str(tiny_surfels.run()),
        count=32,
        objects=1,
        steps=2,
        resolution=SIZE,
        size=SIZE,
        frames=2,
        spp=2,
    )
    relighting_turns.main(options)
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["objects"]
    assert list(rows) == [f"night, {method}" for method in relighting_turns.METHODS]
    assert np.isfinite(list(rows.values())).all()
    for name in ("gallery.png", "film.gif"):
        assert (tmp_path / "out" / name).is_file()
    mitsuba_module(SCALAR)


def test_shadows_are_told_by_the_reference_and_not_by_a_picture_without_them():
    rng = np.random.default_rng(1)
    bare = np.ones((16, 16, 4), np.float32)
    bare[..., :3] = rng.uniform(0.4, 0.9, (16, 16, 1))
    reference = bare.copy()
    reference[4:12, 4:12, :3] *= 0.5
    assert relighting_beside.shadow_score(reference[..., :3], reference, bare) == pytest.approx(1, abs=1e-5)
    assert relighting_beside.shadow_score(bare[..., :3], reference, bare) == 0
    inverse = bare[..., :3] * np.where(reference[..., :3] < bare[..., :3], 1, 0.5)
    assert relighting_beside.shadow_score(inverse, reference, bare) < -0.9


def test_a_picture_that_follows_the_light_tells_its_change_and_a_still_one_does_not():
    references = [np.ones((8, 8, 4), np.float32) * [0.3 + 0.2 * i, 0.4, 0.5, 1] for i in range(3)]
    assert relighting_turns.change_score([x[..., :3] for x in references], references) == pytest.approx(1, abs=1e-5)
    assert relighting_turns.change_score([references[0][..., :3]] * 3, references) == 0
