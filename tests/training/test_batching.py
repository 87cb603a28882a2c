"""Batches are a function of (seed, step), and agree with the files."""

import threading
import time
from contextlib import closing
from dataclasses import replace

import jax
import numpy as np
import pytest
from PIL import Image
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_dataset import CONFIG, NAMES, one_object

from spnr_jax.training import batching


def test_batches_are_the_same_from_any_first_step_and_with_any_memory_for_the_cache(monkeypatch):
    whole = list(batching.batches(tiny_dataset.dataset(), CONFIG, 0))
    assert len(whole) == CONFIG.num_steps
    for first, cache in ((2, batching.CACHE_BYTES), (5, batching.CACHE_BYTES), (0, 0)):
        monkeypatch.setattr(batching, "CACHE_BYTES", cache)
        rest = list(batching.batches(tiny_dataset.dataset(), CONFIG, first))
        assert len(rest) == CONFIG.num_steps - first
        for a, b in zip(rest, whole[first:], strict=True):
            same_bits(a, b)


def test_steps_seeds_and_places_in_a_batch_give_different_points():
    objects = [one_object(), one_object()]
    batch = batching.make_batch(objects, CONFIG, 0)
    others = batching.make_batch(objects, CONFIG, 1), batching.make_batch(objects, replace(CONFIG, seed=1), 0)
    for other in others:
        assert not np.array_equal(batch.cloud.positions, other.cloud.positions)
    assert not np.array_equal(*batch.cloud.positions)
    counts = {int(batching.make_batch(objects[:1], CONFIG, step).cloud.mask.sum()) for step in range(40)}
    assert CONFIG.min_points <= min(counts) < max(counts) <= CONFIG.max_points
    assert len(counts) > 5


@pytest.mark.parametrize("batch_objects", [1, 2, 3, 7])
def test_every_object_appears_once_per_epoch(batch_objects):
    config = replace(CONFIG, batch_objects=batch_objects)
    steps = 4 * len(NAMES)
    order = [name for step in range(steps) for name in batching.object_names(NAMES, config, step)]
    epochs = [tuple(order[i : i + len(NAMES)]) for i in range(0, len(order), len(NAMES))]
    assert all(sorted(epoch) == sorted(NAMES) for epoch in epochs)
    assert len(set(epochs)) > 1, "the order is a new one in each epoch"


@pytest.mark.parametrize("count", [9, 1000])
def test_points_are_a_subset_without_repetition_that_keeps_its_columns_and_padding_is_masked(count):
    item, size, kept = one_object(), 64, min(count, tiny_dataset.POINTS)
    roughness = {tuple(p): r for p, r in zip(item.cloud.positions, item.cloud.roughness, strict=True)}
    chosen = batching.choose_points(item.cloud, count, size, np.random.default_rng(1))
    assert chosen.mask.tolist() == [True] * kept + [False] * (size - kept)
    places = [tuple(p) for p in chosen.positions[:kept]]
    assert len(set(places)) == kept
    assert [roughness[place] for place in places] == chosen.roughness[:kept].tolist()
    np.testing.assert_allclose(chosen.normals, chosen.positions / tiny_dataset.RADIUS, atol=1e-6)
    assert not any(np.any(column[kept:]) for column in jax.tree.leaves(chosen))
    without = replace(item, cloud=item.cloud.replace(normals=None))
    assert batching.choose_points(without.cloud, count, size, np.random.default_rng(1)).normals is None
    assert item.num_bytes - without.num_bytes == item.cloud.normals.nbytes


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_that_share_of_the_clouds_are_the_first_points(share):
    cloud = one_object().cloud
    chosen = [batching.choose_points(cloud, 9, 16, np.random.default_rng(seed), share) for seed in range(60)]
    first = np.mean([np.array_equal(c.positions[:9], cloud.positions[:9]) for c in chosen])
    assert first == pytest.approx(share, abs=0.2)
    assert share == 0.5 or first == share


def test_first_points_of_a_data_set_of_random_ones_are_refused_as_even(tmp_path):
    dataset = tiny_dataset.dataset()
    config = replace(CONFIG, even_share=0.5)
    with pytest.raises(ValueError, match=f"{dataset.folder}: its points are drawn at random.*--spread even"):
        batching.prepare(config, dataset, tmp_path, light=None)
    even = replace(dataset, settings={"settings": {"spread": "even"}})
    assert (dataset.spread, even.spread) == ("random", "even")
    with closing(batching.batches(even, config, 0)) as batches:
        next(batches)


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
    line = batching.batches(tiny_dataset.dataset(), replace(CONFIG, num_steps=1000), 0)
    next(line)
    line.close()
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before
    assert max(asked) <= batching.READ_AHEAD
