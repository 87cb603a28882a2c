"""The controls of a browser's light: a map, its turn, a sun, exposure, what is behind the object."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import viser

from spnr_jax.tools.light_options import Lighting
from spnr_jax.viewer.lights import FIRST_SUN, Lights, changed, options_of
from spnr_jax.viewer.session import State

WIDEST_EXPOSURE = 4.0  # stops
ONE_LIGHT = "This network knows the light of its training alone; `--run surfels` draws in any."


class LightControls:
    """The handles; `change` gets the change of the lights whenever one was moved, `slowly` shows what is refused."""

    def __init__(
        self,
        gui: viser.GuiApi,
        first: Lights,
        change: Callable[[Callable[[Lights], Lights]], None],
        slowly: Callable[[Callable[[], None]], None],
    ) -> None:
        options = first.options
        azimuth, elevation = options.sun or FIRST_SUN
        widest = max(WIDEST_EXPOSURE, abs(options.exposure))
        self._choice: Any = gui.add_dropdown("Light", first.choices, initial_value=first.choice)
        self._yaw = gui.add_slider("Turned", 0.0, 360.0, 1.0, options.light_yaw % 360)
        self._shines = gui.add_checkbox("Sun", options.sun is not None)
        self._azimuth = gui.add_slider("Azimuth", 0.0, 360.0, 1.0, azimuth % 360)
        self._elevation = gui.add_slider("Elevation", -90.0, 90.0, 1.0, elevation)
        self._exposure = gui.add_slider("Exposure", -widest, widest, 0.25, options.exposure)
        self._background: Any = gui.add_dropdown("Behind", ("white", "light"), initial_value=options.background)
        controls: Sequence[Any] = (
            *(self._choice, self._yaw, self._shines, self._azimuth),
            *(self._elevation, self._exposure, self._background),
        )

        async def moved(event: viser.GuiEvent) -> None:
            if event.client is not None:  # not when the program itself chooses a new map
                slowly(lambda: change(partial(changed, options=self._options())))

        for control in controls:
            control.on_update(moved)

    def _options(self) -> Lighting:
        """What the controls say."""
        return options_of(
            choice=self._choice.value,
            yaw=self._yaw.value,
            shines=self._shines.value,
            azimuth=self._azimuth.value,
            elevation=self._elevation.value,
            exposure=self._exposure.value,
            background=self._background.value,
        )

    def show(self, state: State) -> State:
        """Has the list of maps show those there are; the state as it is."""
        self._choice.options = state.lights.choices
        self._choice.value = state.lights.choice
        return state
