"""The browser's folder of the light, without a browser: moved controls change the lights, a refusal keeps the old."""

from types import SimpleNamespace

import numpy as np
import pytest
from support import tiny_viewer

from spnr_jax.kernels.records import Light
from spnr_jax.tools.light_options import Lighting
from spnr_jax.viewer import lights
from spnr_jax.viewer.lights import Lights

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")

from spnr_jax.viewer.light_controls import LightControls  # noqa: E402


class Gui(viser.GuiApi):
    """What a browser's GUI does for controls: they keep a value and call back."""

    def __init__(self):
        self.controls = {}

    def add(self, label, *rest, initial_value=None):
        value = rest[-1] if initial_value is None else initial_value
        moved = []
        control = SimpleNamespace(value=value, options=rest[0], on_update=moved.append, moved=moved)
        self.controls[label] = control
        return control

    add_dropdown = add_slider = add_checkbox = add

    def move(self, label, value):
        self.controls[label].value = value
        for callback in self.controls[label].moved:
            with pytest.raises(StopIteration):
                callback(viser.GuiEvent(client="a person", client_id=1, target=self.controls[label])).send(None)


@pytest.fixture
def folder():
    """(the GUI, the lights as they are now, the controls)."""
    gui, now = Gui(), SimpleNamespace(lights=Lights(), refused=[])

    def change(how):
        now.lights = how(now.lights)

    def slowly(work):
        try:
            work()
        except ValueError as error:
            now.refused.append(str(error))

    return gui, now, LightControls(gui, now.lights, change, slowly)


def test_the_controls_move_the_lights_and_a_refusal_keeps_the_old(folder):
    gui, now, controls = folder
    moves = {"Light": "studio", "Turned": 90.0, "Sun": True, "Azimuth": 10.0, "Elevation": 5.0, "Exposure": 2.0}
    for label, value in (moves | {"Behind": "light"}).items():
        gui.move(label, value)
    assert set(gui.controls) == {*moves, "Behind"}
    wanted = Lighting(light="studio", light_yaw=90.0, sun=(10.0, 5.0), exposure=2.0, background="light")
    assert now.lights.options == wanted
    gui.move("Exposure", float("nan"))
    assert len(now.refused) == 1
    assert now.lights.options == wanted
    gui.controls["Exposure"].value = 2.0
    now.lights = lights.with_map(now.lights, "a.hdr", Light(tables=np.ones((7, 32, 64, 3), np.float32)))
    controls.show(tiny_viewer.state(lights=now.lights))
    assert (gui.controls["Light"].value, "a.hdr" in gui.controls["Light"].options) == ("a.hdr", True)
    gui.move("Turned", 0.0)
    assert now.lights.choice == "a.hdr"
