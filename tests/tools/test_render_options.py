"""Options of `spnr render` that cannot be, and what of a scene is asked for."""

import numpy as np
import pytest
from support import command_line, tiny_untrained

from spnr_jax.formats.cut import Cut
from spnr_jax.surfels.visibility import spiral

cli = command_line.unchecked_cli()


@pytest.fixture(autouse=True)
def nothing_set_up(monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)


@pytest.mark.parametrize("command", ["render", "view"])
def test_a_part_of_a_scene_is_asked_for_with_corners_of_either_sign(command):
    cut = cli.parse([command, "a.ply", "--crop", "-1", "-1e-3", "-.5", "1", "2", "3", "--object", "largest"]).cut
    assert cut == Cut(crop=(-1.0, -1e-3, -0.5, 1.0, 2.0, 3.0), object="largest")
    assert cli.parse([command, "a.ply", "--remove-plane"]).cut == Cut(remove_plane=True)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--crop", "7", "7", "7", "8", "8", "8"], "--crop 7 7 7 8 8 8: none of the 2,000 points, they lie in the box"),
        (["--object", "2"], "--object 2: there is 1 cluster"),
        (["--crop", "0", "1"], "--crop"),
    ],
)
def test_a_part_that_is_not_there_is_refused_in_one_line(tmp_path, capsys, options, expected):
    np.save(tmp_path / "ball.npy", spiral(2000))
    assert command_line.exit_code(cli, "render", tmp_path / "ball.npy", "--out", tmp_path, *options) == 2
    said = capsys.readouterr().err.splitlines()
    assert expected in said[-1]
    assert not any("Traceback" in line for line in said)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--sun", "30", "95"], "--sun: expected an azimuth and an elevation of -90 to 90 degrees"),
        (["--sun", "nan", "5"], "--sun: expected an azimuth"),
        (["--light-yaw", "inf"], "--light-yaw must be a number of degrees"),
        (["--exposure", "21"], "--exposure must be -20 to 20 stops"),
        (["--light", "absent.hdr"], "absent.hdr: no such file"),
        (["--transparent", "--background", "light"], "--background light: not together with --transparent"),
        (
            ["--run", "RUN", "--light", "studio"],
            "--light: the network of --run RUN knows the light of its training",
        ),
        (["--run", "RUN", "--turn", "light"], "--turn light: the network of --run RUN knows the light"),
        (
            ["--run", "RUN", "--exposure", "1", "--sun", "0", "9"],
            "--sun, --exposure: the network of --run RUN",
        ),
    ],
)
def test_light_that_cannot_be_is_one_line_and_code_2_before_the_cloud_is_read(arguments, expected, tmp_path, capsys):
    run = str(tiny_untrained.run())
    arguments = [run if word == "RUN" else word for word in arguments]
    code = command_line.exit_code(cli, "render", tmp_path / "missing.ply", "--out", tmp_path / "out", *arguments)
    said = capsys.readouterr().err
    assert code == 2
    assert expected.replace("RUN", run) in said
    assert said.count("\n") == 1
    assert "missing.ply" not in said
