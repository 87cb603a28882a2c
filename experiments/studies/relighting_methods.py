"""What shows an object in a light: our network, disc splats under split-sum shading, and Mitsuba, each as one function.

Split-sum shading (Karis 2013): irradiance by normal and the prefiltered map by mirrored direction and roughness.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.comparison.light_scores import OnWhite, on_white
from experiments.comparison.relit import How, Mitsuba, turned
from experiments.studies.sharpness import told, view_of
from spnr_jax.formats import data_sets
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.kernels.records import Camera, Light, Surfels
from spnr_jax.method.model import Model, Quality, Volume
from spnr_jax.surfels.lighting import room_light
from spnr_jax.surfels.visibility import DIRECTIONS

SPLATS = {  # how much of the light arrives at a disc
    "splats": "splats, split-sum",
    "splats_occlusion": "splats, ambient occlusion",
    "splats_directions": "splats, 64 directions",
}
ORACLES: dict[How, str] = {"unshadowed": "true mesh, no shadows", "occlusion": "true mesh, ambient occlusion"}
POISSON = "Poisson, trimmed 0.3"


class Shots(NamedTuple):
    """Cameras of one size, the light of each, and the map of each for Mitsuba (none without it)."""

    cameras: Sequence[Camera]
    lights: Sequence[Light]
    maps: Sequence[np.ndarray]


@dataclass(frozen=True, eq=False)
class LitObject:
    """An object of a data set, read when it is first asked for."""

    dataset: data_sets.Dataset
    name: str
    mitsuba: Mitsuba | None

    @cached_property
    def item(self) -> data_sets.ObjectData:
        """Points, cameras, references."""
        return data_sets.read_object(self.dataset, self.name)

    @cached_property
    def lights(self) -> list[Light]:
        """The light of each view; the room where the data set has one for all."""
        return self.item.own_lights or [room_light()] * len(self.item.images)

    @cached_property
    def maps(self) -> list[np.ndarray]:
        """The same as maps; empty without Mitsuba."""
        return self.mitsuba.maps(self.dataset, self.item) if self.mitsuba else []

    def shots(self, views: Sequence[int], size: int | None) -> Shots:
        """Views of the data set."""
        cameras = [view_of(self.item, view, size)[0] for view in views]
        maps = [self.maps[view] for view in views] if self.maps else []
        return Shots(cameras, [self.lights[view] for view in views], maps)

    def turning(self, count: int, size: int) -> Shots:
        """The first view, its light going around in so many steps."""
        steps = [360 / count * step for step in range(count)]
        (camera,), (light,), maps = self.shots([0], size)
        around = [turned(envmap, step) for envmap in maps for step in steps]
        return Shots([camera] * count, [light.turned(step) for step in steps], around)


@dataclass(frozen=True, kw_only=True)
class Method:
    """How a row of the tables makes its pictures.

    `draw(lit, count, shots, shadows)` shows an object's first points; without shadows as if nothing hid anything.
    """

    label: str
    folder: str
    """Where its results lie: pictures of other weights have another one."""
    draw: Callable[[LitObject, int, Shots, bool], list[OnWhite]]
    of_points: bool = True
    by_mitsuba: bool = False
    has_shadows: bool = True


def ours(model: Model, fixed: Model | None) -> dict[str, Method]:
    """The network, one that keeps its own light (if any), and the discs without a network."""
    encoded = _encoder(model)
    found = {"network": _of_model(model, encoded, "best", "network", f"network_{checksum(model)}")}
    if fixed is not None:
        folder = f"fixed_{checksum(fixed)}"
        made = _of_model(fixed, _encoder(fixed), "best", "network of one light", folder, keeps_light=True)
        found["fixed"] = dataclasses.replace(made, has_shadows=False)
    seen = {"splats": everything_seen, "splats_occlusion": occluded, "splats_directions": None}
    return found | {
        name: _of_model(model, encoded, "draft", SPLATS[name], name, change) for name, change in seen.items()
    }


def by_mitsuba(mitsuba: Mitsuba) -> dict[str, Method]:
    """Poisson surfaces of the points, and the true mesh with less than light transport."""

    def show(lit: LitObject, asset: Asset, shots: Shots, how: How) -> list[OnWhite]:
        poses = [np.asarray(camera.cam_to_world) for camera in shots.cameras]
        size = shots.cameras[0].height
        drawn = mitsuba.draw(asset, poses, shots.maps, lit.dataset.settings, size, how)
        return [on_white(rgba.astype(np.float32) / 255) for rgba in drawn]

    def poisson(lit: LitObject, count: int, shots: Shots, shadows: bool) -> list[OnWhite]:
        return show(lit, mitsuba.surface(lit.item, count), shots, "path" if shadows else "unshadowed")

    def oracle(lit: LitObject, _: int, shots: Shots, shadows: bool, *, how: How) -> list[OnWhite]:
        return show(lit, mitsuba.mesh(lit.dataset, lit.item), shots, how if shadows else "unshadowed")

    of_mesh = {
        name: Method(label=label, folder=name, draw=partial(oracle, how=name), of_points=False, by_mitsuba=True)
        for name, label in ORACLES.items()
    }
    return {"poisson": Method(label=POISSON, folder="poisson", draw=poisson, by_mitsuba=True), **of_mesh}


def references(lit: LitObject, shots: Shots, how: How = "path") -> np.ndarray:
    """References of other lights than those of the data set: straight alpha (shots, size, size, 4) uint8."""
    assert lit.mitsuba is not None
    poses = [np.asarray(camera.cam_to_world) for camera in shots.cameras]
    asset, size = lit.mitsuba.mesh(lit.dataset, lit.item), shots.cameras[0].height
    return np.stack(list(lit.mitsuba.draw(asset, poses, shots.maps, lit.dataset.settings, size, how)))


def everything_seen(volume: Volume) -> Volume:
    """The volume as if every direction saw every point."""
    return _seen(volume, lambda surfels: jnp.ones_like(surfels.visible))


def occluded(volume: Volume) -> Volume:
    """The volume with ambient occlusion for the visibility of every direction: its mean, weighted by the cosine."""

    def mean(surfels: Surfels):
        cosines = jnp.maximum(jnp.asarray(surfels.normal) @ DIRECTIONS.T, 0)
        share = jnp.sum(surfels.visible * cosines, axis=-1) / jnp.maximum(jnp.sum(cosines, axis=-1), 1e-6)
        return jnp.broadcast_to(share[:, None], surfels.visible.shape)

    return _seen(volume, mean)


def checksum(model: Model) -> str:
    """A few digits that tell the weights of a network from others."""
    found = hashlib.sha256()
    for values in jax.tree.leaves(model.variables):
        found.update(np.ascontiguousarray(values).tobytes())
    return found.hexdigest()[:10]


def _seen(volume: Volume, visible: Callable[[Surfels], jax.Array]) -> Volume:
    surfels = volume.scene.surfels
    surfels = dataclasses.replace(surfels, visible=visible(surfels))
    return dataclasses.replace(volume, scene=dataclasses.replace(volume.scene, surfels=surfels))


def _encoder(model: Model) -> Callable[[LitObject, int], Volume]:
    """What encodes an object's first points, without normals; the last few are kept."""

    @lru_cache(maxsize=4)
    def encoded(lit: LitObject, count: int) -> Volume:
        return model.encode(told(jax.tree.map(lambda x: x[:count], lit.item.cloud), normals=False))

    return encoded


def _of_model(
    model: Model,
    encoded: Callable[[LitObject, int], Volume],
    quality: Quality,
    label: str,
    folder: str,
    change: Callable[[Volume], Volume] | None = None,
    keeps_light: bool = False,
) -> Method:
    """A method that draws what is encoded, after a change, with a model."""

    def draw(lit: LitObject, count: int, shots: Shots, shadows: bool) -> list[OnWhite]:
        volume, lights = encoded(lit, count), None if keeps_light else shots.lights
        volume = volume if change is None else change(volume)
        found = model.render_each(volume if shadows else everything_seen(volume), shots.cameras, quality, lights)
        return [OnWhite(np.clip(np.asarray(r.image), 0, 1), np.asarray(r.acc)) for r in found]

    return Method(label=label, folder=folder, draw=draw)
