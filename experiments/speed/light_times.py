"""What another light costs: a picture of an encoded object, a map that is prepared, a change in the viewer.

    python -m experiments.speed.light_times CLOUD [--map sky.hdr] [--out runs/lights] [--points 16384] [--size 512]

Pictures in the room and in a light that is another each time are drawn in turns.  The viewer's own functions draw what
a browser of 1024 x 512 pixels shows after a step of the slider that turns the light: `draft` while it moves, then
`best`, both of 256 pixels.  Times are medians of wall clock.

    OUT/results.json  table.md
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro

from experiments import entry_point
from experiments.comparison import results_folder
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.light_files import read_light
from spnr_jax.kernels.records import Light, PointCloud
from spnr_jax.method.model import Model
from spnr_jax.scoring.score_tables import Table, number
from spnr_jax.tools.light_options import Lighting
from spnr_jax.training.weights import load
from spnr_jax.viewer import lights, session
from spnr_jax.viewer.picture import Layer
from spnr_jax.viewer.scene import open_scene
from spnr_jax.viewer.viewpoint import from_browser

DEGREES = 10.0  # of a step of the slider


@dataclass(frozen=True, kw_only=True)
class LightTimes:
    """Time pictures in another light, maps and the viewer's changes."""

    cloud: tyro.conf.Positional[Path]
    """File of points."""
    map: Path | None = None
    """Environment map that is read (default: none is)."""
    out: Path = Path("runs/lights")
    """Folder of the results."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    points: int = 16384
    """Points of the object, the first of the file."""
    size: int = 512
    """Pixels along each side of the pictures."""
    rounds: int = 15
    """Turns of each."""


def main(options: LightTimes) -> None:
    """Times, and writes a table."""
    cli.set_up_jax()
    model = load(options.run)
    cloud = jax.tree.map(lambda x: x[: options.points], read_cloud(options.cloud))
    found = pictures(model, cloud, options.size, options.rounds)
    found |= viewer_changes(model, cloud, options.rounds)
    if options.map is not None:
        path = options.map
        found["a map is read and prepared"] = timed([lambda _: read_light(path)], options.rounds)[0]
    rows = tuple((name, (number(1000 * seconds, 0),)) for name, seconds in found.items())
    table = Table(title="What light costs", heads=("ms",), rows=rows, note=f"{options.points:,} points.")
    results = {"seconds": found, "hardware": machine.hardware(), "load": machine.load()}
    results_folder.write(options.out, results, [table])


def pictures(model: Model, cloud: PointCloud, size: int, rounds: int) -> dict[str, float]:
    """Seconds of a picture in the room, and in another light each time."""
    volume = model.encode(cloud)
    camera, base = model.camera(volume, resolution=size), read_light("sunset")

    def draw(light: Light | None) -> None:
        jax.block_until_ready(model.render(volume, camera, light=light).image)

    turned = [base.turned(DEGREES * step) for step in range(rounds + 1)]
    room, other = timed([lambda _: draw(None), lambda step: draw(turned[step])], rounds)
    return {f"a picture of {size} px in the room": room, f"a picture of {size} px in another light": other}


def viewer_changes(model: Model, cloud: PointCloud, rounds: int) -> dict[str, float]:
    """Seconds from a step of the slider to the canvas, moving and at rest, by the panes that are shown."""
    view = from_browser((0, 1, 0, 0), (0, 0, 3.0), 0.7, 1024, 512)
    found: dict[str, float] = {}
    shown: tuple[tuple[Layer, ...], ...] = (("picture",), ("points", "picture"))
    for panes in shown:
        state = session.State(scene=open_scene(model, cloud, "cloud"), view=view, panes=panes, size=256)
        state, _ = session.draw(model, state, moving=True)  # encodes

        def change(step: int, moving: bool, state: session.State = state) -> None:
            asked = Lighting(light="sunset", light_yaw=DEGREES * step)
            now = dataclasses.replace(state, lights=lights.changed(state.lights, asked))
            session.draw(model, now, moving=moving)

        moving, resting = timed([lambda i: change(i, True), lambda i: change(i, False)], rounds)
        name = f"the viewer, {' and '.join(panes)}"
        found |= {f"{name}: the light turns": moving, f"{name}: at rest": resting}
    return found


def timed(work: list[Callable[[int], object]], rounds: int) -> list[float]:
    """Median seconds of each work over turns; it is told which, and the first compiles and does not count."""
    seconds = np.zeros((rounds + 1, len(work)))
    for turn in range(rounds + 1):
        for i, run in enumerate(work):
            begin = time.perf_counter()
            run(turn)
            seconds[turn, i] = time.perf_counter() - begin
    return [float(x) for x in np.median(seconds[1:], axis=0)]


if __name__ == "__main__":
    entry_point.run(main, LightTimes, "speed.light_times")
