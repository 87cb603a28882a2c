"""Poisson reconstruction beside the references: a surface from each object's points, rendered as they were.

    points -> outward normals -> pymeshlab's screened Poisson solver (Kazhdan 2013) -> mesh with the nearest's materials

Light, cameras, samples per pixel and integrator are those that dataset.json names.  An object whose points span no
surface is an empty picture.  The solver closes what is open, bridges what is near, and extrapolates; `trim` removes its
least supported vertices.  It runs in one thread: equal points, equal surface.
"""

import dataclasses
import hashlib
import importlib
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from data_gen.render import light, views
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments.comparison.contenders import Method, of_rgba
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.assets import Asset, Material, Part
from spnr_jax.formats.images import read_envmap
from spnr_jax.kernels.records import PointCloud
from spnr_jax.kernels.triangles import vertex_normals
from spnr_jax.surfels.normals import outward_normals
from spnr_jax.surfels.skies import indoor_envmap

RENDERING = ("resolution", "fov", "spp", "max_depth")  # settings that decide a picture, given the pose of its camera
STRAIGHT = 1e-5  # points spread less than this share of their extent beside a line have no surface


@dataclass(frozen=True, kw_only=True)
class Surface:
    """How a surface is made of points."""

    depth: int = 12
    """Depth of the solver's octree: the finest cell is the extent / 2^depth; 12 is the paper's."""
    trim: float = 0.0
    """Share of the vertices, those with the fewest points around them, that is cut off; 0 keeps all."""


SURFACES = {"poisson": Surface(), "poisson_trimmed": Surface(trim=0.3)}


# --- the surface of points --------------------------------------------------------------------------------------------


def reconstruct(cloud: PointCloud, surface: Surface) -> Asset | None:
    """The surface of one cloud (points, ...), smooth; None of points on one line, or if the solver finds none."""
    present = np.asarray(cloud.mask)
    positions = np.asarray(cloud.positions, np.float64)[present]
    base_color, roughness, metallic = (
        np.asarray(channel, np.float32)[present] for channel in (cloud.base_color, cloud.roughness, cloud.metallic)
    )
    if len(positions) < 3:
        return None
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if not spread[1] > STRAIGHT * spread[0]:
        return None
    normals = outward_normals(positions, base_color, np.arange(len(positions)))
    vertices, faces = trim(*screened_poisson(positions, normals, surface.depth), surface.trim)
    if not len(faces):
        return None
    nearest = cKDTree(positions).query(vertices)[1]
    part = Part(
        positions=vertices,
        faces=faces,
        material=Material(base_color=np.ones(3, np.float32), roughness=roughness[nearest], metallic=metallic[nearest]),
        normals=vertex_normals(vertices, faces),
        colors=base_color[nearest],
    )
    return Asset(parts=(part,))


def screened_poisson(
    positions: np.ndarray, normals: np.ndarray, depth: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), faces (f, 3) and the density of points around each vertex (v,)."""
    solver = pymeshlab().MeshSet()
    solver.add_mesh(pymeshlab().Mesh(vertex_matrix=positions, v_normals_matrix=normals.astype(np.float64)))
    solver.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
    mesh = solver.current_mesh()
    if not mesh.face_number():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0)
    return mesh.vertex_matrix(), mesh.face_matrix().astype(np.int64), mesh.vertex_scalar_array()


def trim(vertices: np.ndarray, faces: np.ndarray, density: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces without the share of the vertices that has the lowest density, and their faces."""
    if not share or not len(faces):
        return vertices, faces
    kept = density >= np.quantile(density, share)
    number = np.cumsum(kept) - 1
    return vertices[kept], number[faces[kept[faces].all(axis=1)]]


def pymeshlab():
    """The solver's module; ValueError, with what to install, if it is absent."""
    try:
        return importlib.import_module("pymeshlab")
    except ImportError as error:
        needed = "Poisson reconstruction needs pymeshlab: pip install 'spnr-jax[baselines]'"
        raise UserError(f"{needed} ({error})") from None


# --- its pictures -----------------------------------------------------------------------------------------------------


class Renderer:
    """The references' light, cameras and integrator, on surfaces that are made of points."""

    def __init__(self, settings: dict, envmap: Path | None = None, variant: str = "auto", seed: int = 0) -> None:
        """Takes the settings of a data set (`Dataset.settings`); the envmap where that is a file."""
        chosen, notice = choose_variant(variant)
        if notice:
            print(notice, file=sys.stderr)
        mitsuba_module(chosen)
        self._seed, self._view = seed, view_config(settings)
        self._light = light.scale_to_white(unscaled_light(settings["environment_map"], envmap))

    def draw(self, asset: Asset | None, item: data_sets.ObjectData) -> np.ndarray:
        """Straight-alpha sRGB (views, height, width, 4) uint8 from the object's cameras; empty without a surface."""
        if asset is None:
            return np.zeros(item.images.shape, np.uint8)
        scene = views.build_scene(asset, self._light)
        config = dataclasses.replace(self._view, resolution=item.camera.height)
        poses = np.tile(np.eye(4), (len(item.images), 1, 1))
        poses[:, :3] = item.camera.cam_to_world
        radiance = [views.render_view(scene, p, config, self._seed + view) for view, p in enumerate(poses)]
        return np.stack([views.straight_srgb(r) for r in radiance])

    def method(self, surface: str) -> Method:
        """The surface of SURFACES as a method, through all points of an object."""
        return Method(
            encode=lambda item: reconstruct(item.cloud, SURFACES[surface]),
            draw=lambda asset, item: of_rgba(self.draw(asset, item)),
        )


def view_config(settings: dict) -> views.ViewConfig:
    """What decides a data set's pictures, given the poses of their cameras."""
    if missing := [name for name in RENDERING if name not in settings["settings"]]:
        raise UserError(f"dataset.json: the setting {missing[0]} is missing; generate the data set again")
    return views.ViewConfig(**{name: settings["settings"][name] for name in RENDERING})


def unscaled_light(described: dict, envmap: Path | None) -> np.ndarray:
    """The environment map that a data set describes; ValueError if the file given is not it."""
    if "kinds" in described:
        raise UserError("each view of the data set has its own light, and Poisson surfaces are drawn in one for all")
    if described["sha256"] is None:
        if envmap:
            raise UserError(f"--envmap {envmap}: the {described['name']} lit the data set; leave the option out")
        return indoor_envmap()
    if envmap is None:
        raise UserError(f"--envmap: give {described['name']}, which lit the data set")
    radiance = read_envmap(envmap)
    if hashlib.sha256(envmap.read_bytes()).hexdigest() != described["sha256"]:
        raise UserError(f"--envmap {envmap}: not the {described['name']} that lit the data set (another checksum)")
    return radiance
