"""One object under eight lights, and a film in which a light goes around it: references beside our pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.comparison import figures, results_folder
from experiments.comparison.light_scores import on_white
from experiments.comparison.relit import turned
from experiments.studies.relighting_methods import LitObject, Shots, ours, references
from experiments.studies.sharpness import view_of
from spnr_jax.formats import images
from spnr_jax.method.model import Model
from spnr_jax.surfels import skies
from spnr_jax.surfels.lighting import light_of

LIGHTS = 8  # of the gallery
HEIGHT = 256  # rows of a map
LARGEST = 256  # pixels along the sides of a picture
FPS = 12


@dataclass(frozen=True, kw_only=True)
class Show:
    """An object to show, from its first view, and what draws it."""

    lit: LitObject
    model: Model
    count: int
    out: Path

    def gallery(self, others: Mapping[str, LitObject]) -> None:
        """Writes OUT/gallery.png: the lights of the data sets, then those of the package until there are eight."""
        maps = {name: other.maps[0] for name, other in others.items()}
        for name, make in skies.NAMED.items():
            if len(maps) < LIGHTS and name not in maps:
                maps[name] = skies.normalised(make(HEIGHT))
        rows = self._drawn(list(maps.values()), f"gallery_{'_'.join(maps)}")
        size = rows[0][0].shape[0]
        sheet = figures.grid(rows, list(maps), ["reference", "ours"], size=max(size, 96))
        images.write_whole(self.out / "gallery.png", images.png(sheet))

    def film(self, frames: int) -> None:
        """Writes OUT/film.gif: the first view, its light going around once."""
        around = [turned(self.lit.maps[0], 360 * frame / frames) for frame in range(frames)]
        pairs = zip(*self._drawn(around, f"film_{frames}"), strict=True)
        heads = ["reference", f"ours, {self.count:,} points"]
        size = min(LARGEST, self.lit.item.camera.height)
        film = [figures.grid([pair], heads, size=max(size, 96)) for pair in pairs]
        images.write_turntable(self.out / "film.gif", film, FPS)

    def _drawn(self, maps: Sequence[np.ndarray], name: str) -> list[list[np.ndarray]]:
        """References and our pictures in the light of each map; the references are kept."""
        camera, _ = view_of(self.lit.item, 0, min(LARGEST, self.lit.item.camera.height))
        shots = Shots([camera] * len(maps), [light_of(envmap) for envmap in maps], maps)
        place = self.out / "references" / f"{self.lit.name}_{name}.npz"
        (true,) = results_folder.kept(place, lambda: (references(self.lit, shots),))
        drawn = ours(self.model, None)["network"].draw(self.lit, self.count, shots, True)
        return [[on_white(rgba.astype(np.float32) / 255).image for rgba in true], [x.image for x in drawn]]
