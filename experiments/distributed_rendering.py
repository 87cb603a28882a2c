"""Pictures on one device and on eight, their rays divided: how far apart they are, and what each device does.

    python -m experiments.distributed_rendering DEVICES PLACE    one line of JSON; a process of its own, as it must be

Eight views of a ball, 128 x 128: by the network in the package, which renders blocks of those rays that come near
points, and by the preset `tiny` with fresh weights, which renders all rays.

    seconds    of the processor for all views, of all devices together: the median of five times
    blocks     that each device renders (network in the package alone)
    apart      largest difference of a pixel from one device
"""

import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

import spnr_jax
from experiments.virtual_devices import in_child
from spnr_jax import cli, presets
from spnr_jax.devices.placement import DEPTH, OBJECTS
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.method import inference
from spnr_jax.method.renderer import Renderer
from spnr_jax.training import optimisation

DEVICES = (1, 8)
VIEWS, SIZE, POINTS = 8, 128, 1500
TURNS = 5


def measured(folder: Path) -> dict[str, dict[str, Any]]:
    """What each number of devices does, by network; the pictures are kept in a folder."""
    found: dict[str, dict[str, Any]] = {"package": {}, "tiny": {}}
    pictures = {}
    for devices in DEVICES:
        kept = folder / f"rendering_{devices}.npz"
        for network, row in in_child(__name__, devices, [str(devices), str(kept)]).items():
            found[network][str(devices)] = row
        with np.load(kept, allow_pickle=False) as file:
            pictures[devices] = dict(file)
        for network, rows in found.items():
            rows[str(devices)]["apart"] = float(np.abs(pictures[devices][network] - pictures[1][network]).max())
    return found


def rendered(kept: Path) -> dict[str, dict[str, Any]]:
    """Seconds and blocks of each network on the devices of this process; the pictures go to a file."""
    cloud = ball()
    handle, config = spnr_jax.load(), presets.tiny()
    volume = handle.encode(cloud)
    views = jax.tree.map(lambda *x: np.stack(x), *(handle.camera(volume, azimuth=45.0 * i) for i in range(VIEWS)))
    variables = optimisation.averaged_variables(optimisation.create_state(config))
    camera = Camera(
        cam_to_world=np.asarray(views.cam_to_world), intrinsics=np.asarray(views.intrinsics), height=SIZE, width=SIZE
    )
    work = {
        "package": lambda: handle.render(volume, views).image,
        "tiny": lambda: inference.render_views(variables, config.model, cloud, camera).image,
    }
    found: dict[str, dict[str, Any]] = {name: {"seconds": seconds(one)} for name, one in work.items()}
    with counting() as blocks:
        jax.clear_caches()  # the counter is part of the program
        jax.block_until_ready(work["package"]())
        jax.effects_barrier()
    found["package"]["blocks"] = [count for _, count in sorted(blocks.items())]
    np.savez_compressed(kept, allow_pickle=False, **{name: np.asarray(one()) for name, one in work.items()})
    return found


def ball() -> PointCloud:
    """Coloured points on the unit sphere."""
    places = np.random.default_rng(0).normal(size=(POINTS, 3)).astype(np.float32)
    places /= np.linalg.norm(places, axis=-1, keepdims=True)
    color = np.abs(places)
    return PointCloud(
        positions=places,
        base_color=color,
        roughness=color[:, 0],
        metallic=color[:, 1],
        mask=np.ones(POINTS, bool),
    )


def seconds(work: Callable[[], object]) -> float:
    """Median of the processor's seconds; the first call, which compiles, does not count."""
    taken = []
    for _ in range(TURNS + 1):
        begin = time.process_time()
        jax.block_until_ready(work())
        taken.append(time.process_time() - begin)
    return round(float(np.median(taken[1:])), 4)


@contextmanager
def counting() -> Iterator[Counter[int]]:
    """While it lasts programs are compiled that count the blocks of rays near points which each device renders."""
    blocks: Counter[int] = Counter()
    march = Renderer.march_open

    def counted(self, *arguments):
        divided = jax.sharding.get_abstract_mesh().manual_axes
        device = jax.lax.axis_index((OBJECTS, DEPTH)) if divided else 0
        jax.debug.callback(lambda i: blocks.update([int(i)]), device)
        return march(self, *arguments)

    with mock.patch.object(Renderer, "march_open", counted):
        yield blocks


if __name__ == "__main__":
    cli.set_up_jax()
    print(json.dumps(rendered(Path(sys.argv[2]))))
