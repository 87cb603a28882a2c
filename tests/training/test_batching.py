"""Batches are a function of (seed, step), and agree with the files."""

import dataclasses
import threading
import time
from contextlib import closing

import jax
import numpy as np
import pytest
from PIL import Image
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_dataset import CONFIG, NAMES, one_object

from spnr_jax.formats import data_sets
from spnr_jax.training import batching


def test_batches_are_the_same_from_any_first_step():
    whole = list(batching.batches(tiny_dataset.dataset(), CONFIG, 0))
    assert len(whole) == CONFIG.num_steps
    for first in (0, 2, 5):
        rest = list(batching.batches(tiny_dataset.dataset(), CONFIG, first))
        assert len(rest) == CONFIG.num_steps - first
        for a, b in zip(rest, whole[first:], strict=True):
            same_bits(a, b)


def test_steps_and_seeds_give_different_points_and_views():
    objects = [one_object()]
    batch = batching.make_batch(objects, CONFIG, 0)
    for other in (
        batching.make_batch(objects, CONFIG, 1),
        batching.make_batch(objects, dataclasses.replace(CONFIG, seed=1), 0),
    ):
        assert not np.array_equal(batch.cloud.positions, other.cloud.positions)
    two = batching.make_batch([one_object(), one_object()], CONFIG, 0)
    assert not np.array_equal(*two.cloud.positions), "places in a batch draw independently"


@pytest.mark.parametrize("batch_objects", [1, 2, 3, 7])
def test_every_object_appears_once_per_epoch(batch_objects):
    config = dataclasses.replace(CONFIG, batch_objects=batch_objects)
    steps = 4 * len(NAMES)
    order = [name for step in range(steps) for name in batching.object_names(NAMES, config, step)]
    epochs = [tuple(order[i : i + len(NAMES)]) for i in range(0, len(order), len(NAMES))]
    assert all(sorted(epoch) == sorted(NAMES) for epoch in epochs)
    assert len(set(epochs)) > 1, "the order is a new one in each epoch"


def test_points_are_a_subset_without_repetition_and_padding_is_masked():
    cloud = one_object().cloud
    rows = {tuple(row) for row in cloud.positions}
    chosen = batching.choose_points(cloud, 9, 16, np.random.default_rng(0))
    assert chosen.mask.tolist() == [True] * 9 + [False] * 7
    found = {tuple(row) for row in chosen.positions[:9]}
    assert len(found) == 9
    assert found <= rows
    assert not any(np.any(column[9:]) for column in jax.tree.leaves(chosen))


def test_normals_and_materials_stay_with_their_points_and_a_cloud_may_lack_normals():
    item = one_object()
    roughness = {tuple(p): r for p, r in zip(item.cloud.positions, item.cloud.roughness, strict=True)}
    np.testing.assert_allclose(item.cloud.normals, item.cloud.positions / tiny_dataset.RADIUS, atol=1e-6)
    chosen = batching.choose_points(item.cloud, 9, 16, np.random.default_rng(1))
    np.testing.assert_allclose(chosen.normals, chosen.positions / tiny_dataset.RADIUS, atol=1e-6)
    assert [roughness[tuple(p)] for p in chosen.positions[:9]] == chosen.roughness[:9].tolist()
    np.testing.assert_array_equal(data_sets.first_points(item, 5).normals, item.cloud.normals[:5])
    without = dataclasses.replace(item, cloud=item.cloud.replace(normals=None))
    assert batching.choose_points(without.cloud, 9, 16, np.random.default_rng(1)).normals is None
    assert data_sets.first_points(without, 5).normals is None
    assert item.num_bytes - without.num_bytes == item.cloud.normals.nbytes


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_that_share_of_the_clouds_are_the_first_points(share):
    cloud = one_object().cloud
    chosen = [batching.choose_points(cloud, 9, 16, np.random.default_rng(seed), share) for seed in range(60)]
    first = np.mean([np.array_equal(c.positions[:9], cloud.positions[:9]) for c in chosen])
    assert first == pytest.approx(share, abs=0.2)
    assert share == 0.5 or first == share


def test_first_points_of_a_data_set_of_random_ones_are_refused_as_even():
    dataset = tiny_dataset.dataset()
    config = dataclasses.replace(CONFIG, even_share=0.5)
    with pytest.raises(ValueError, match=f"{dataset.folder}: its points are drawn at random.*--spread even"):
        next(batching.batches(dataset, config, 0))
    even = dataclasses.replace(dataset, settings={"settings": {"spread": "even"}})
    assert (dataset.spread, even.spread) == ("random", "even")
    with closing(batching.batches(even, config, 0)) as batches:
        next(batches)


def test_a_cloud_with_fewer_points_than_asked_is_taken_whole():
    cloud = one_object().cloud
    chosen = batching.choose_points(cloud, 1000, 64, np.random.default_rng(0))
    assert chosen.mask.sum() == tiny_dataset.POINTS
    assert {tuple(p) for p in chosen.positions[chosen.mask]} == {tuple(p) for p in cloud.positions}


def test_the_number_of_points_stays_within_the_config_and_varies():
    item = one_object()
    counts = {int(batching.make_batch([item], CONFIG, step).cloud.mask.sum()) for step in range(40)}
    assert CONFIG.min_points <= min(counts) < max(counts) <= CONFIG.max_points
    assert len(counts) > 5


def test_pictures_conditions_and_cameras_of_a_batch_are_those_of_the_files():
    item = one_object()
    batch = batching.make_batch([item], CONFIG, 4)
    poses = list(map(bytes, item.camera.cam_to_world))
    views = [poses.index(bytes(pose)) for pose in batch.camera.cam_to_world[0]]
    assert len(set(views)) == CONFIG.views_per_object
    folder = tiny_dataset.dataset().folder / "objects" / NAMES[0]
    for i, view in enumerate(views):
        picture, condition = (
            np.asarray(Image.open(folder / kind / f"{view:03d}.png"), np.float64) / 255
            for kind in ("images", "conditions")
        )
        seen = condition[..., 3] == 1
        assert 0 < seen.sum() < seen.size
        np.testing.assert_array_equal(batch.condition_mask[0, i], seen)
        np.testing.assert_allclose(batch.condition[0, i][seen], condition[..., :3][seen], atol=1e-6)
        assert not batch.condition[0, i][~seen].any()
        over_white = picture[..., :3] * picture[..., 3:] + (1 - picture[..., 3:])
        np.testing.assert_allclose(batch.image[0, i], over_white, atol=1e-6)


def test_the_reader_stops_when_its_consumer_stops_and_reads_only_a_little_ahead(monkeypatch):
    asked, before = [], threading.active_count()
    object_names = batching.object_names
    monkeypatch.setattr(batching, "object_names", lambda *a: asked.append(a[-1]) or object_names(*a))
    line = batching.batches(tiny_dataset.dataset(), dataclasses.replace(CONFIG, num_steps=1000), 0)
    next(line)
    line.close()
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before
    assert max(asked) <= batching.READ_AHEAD


def test_the_order_of_a_million_objects_costs_nothing_per_step():
    names = tuple(map(str, range(10**6)))
    start = time.monotonic()
    for step in range(100):
        batching.object_names(names, CONFIG, step)
    assert time.monotonic() - start < 5, "one permutation for all these steps takes 0.1 s, one each takes a minute"


def test_the_cache_holds_as_many_objects_as_fit():
    read = batching.cached_reader(tiny_dataset.dataset(), CONFIG, int(2.5 * one_object().num_bytes))
    first = [read(name) for name in NAMES]
    assert [read(name) is kept for name, kept in zip(NAMES, first, strict=True)] == [True, True, False, False, False]


def test_objects_beyond_the_memory_of_the_cache_are_read_again_to_the_same_batches():
    expected = list(batching.batches(tiny_dataset.dataset(), CONFIG, 0))
    for a, b in zip(batching.batches(tiny_dataset.dataset(), CONFIG, 0, cache_bytes=0), expected, strict=True):
        same_bits(a, b)
