"""The light of one browser: what its controls say, the maps that it can choose, and the light that comes of them.

As with an edit of the cloud, a change leaves the light behind (`stale`) until `made` makes it anew, so that a stream of
changes, as from a slider, costs one light for each picture.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from spnr_jax.errors import UserError
from spnr_jax.formats.light_files import NAMES, read_light
from spnr_jax.kernels.records import Light
from spnr_jax.tools.chosen_light import light_of_options
from spnr_jax.tools.light_options import Lighting
from spnr_jax.viewer.uploads import display_name
from spnr_jax.viewer.viewpoint import numbers

SUN_ALONE = "sun alone"  # the choice of no map
FIRST_SUN = (30.0, 40.0)  # degrees: where the controls have it before it is asked for


@dataclass(frozen=True, kw_only=True, eq=False)
class Lights:
    """`light` is that of the options (None: nothing is asked of it), of maps by name or of the package."""

    options: Lighting = Lighting()
    maps: Mapping[str, Light] = field(default_factory=dict)
    light: Light | None = None
    stale: bool = False

    @property
    def choices(self) -> tuple[str, ...]:
        """Names that can be chosen."""
        return (*NAMES, *self.maps, SUN_ALONE)

    @property
    def choice(self) -> str:
        """The name that is chosen."""
        return self.options.light or (SUN_ALONE if self.options.sun else NAMES[0])


def given(options: Lighting) -> Lights:
    """The lights of a command's options; a map's file is read, and ValueError says in one line if it is none."""
    if options.light is None or options.light in NAMES:
        return Lights(options=options, stale=bool(options.asked))
    name = display_name(Path(options.light).name)
    return with_map(Lights(options=options), name, read_light(options.light))


def with_map(lights: Lights, name: str, light: Light) -> Lights:
    """The lights with one more map, which is chosen; one of the same name is replaced."""
    options = dataclasses.replace(lights.options, light=name)
    return dataclasses.replace(lights, options=options, maps={**lights.maps, name: light}, stale=True)


def changed(lights: Lights, options: Lighting) -> Lights:
    """The lights with other options; those that name no map of ours change nothing."""
    if options.light is not None and options.light not in lights.choices:
        return lights
    return dataclasses.replace(lights, options=options, stale=True)


def options_of(
    *, choice: Any, yaw: Any, shines: Any, azimuth: Any, elevation: Any, exposure: Any, background: Any
) -> Lighting:
    """The options for what the controls say: a sun where it shines or is chosen alone; ValueError for no numbers."""
    values = numbers([yaw, azimuth, elevation, exposure], 4)
    if values is None:
        raise UserError("the light's angles and its exposure have to be numbers")
    if not isinstance(choice, str) or background not in ("white", "light"):
        raise UserError("a light has a name, and behind the object is one of white, light")
    turn, around, above, stops = (float(value) for value in values)
    alone = choice == SUN_ALONE
    return Lighting(
        light=None if alone else choice,
        light_yaw=turn,
        sun=(around, above) if shines or alone else None,
        exposure=stops,
        background=background,
    )


def made(lights: Lights) -> Lights:
    """The lights with the light of the options as they are now."""
    if not lights.stale:
        return lights
    light = light_of_options(lights.options, lambda name: lights.maps.get(name) or _named(name))
    return dataclasses.replace(lights, light=light, stale=False)


@cache
def _named(name: str) -> Light:
    """A light of the package."""
    return read_light(name)
