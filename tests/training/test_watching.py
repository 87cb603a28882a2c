"""TensorBoard shows the previews: the pixels of previews/STEP.png, at their step."""

import io
import struct

import numpy as np
import pytest
from PIL import Image
from support import tiny_dataset
from support.stopped_runs import PICTURE, without_network
from tensorboardX.proto.event_pb2 import Event

from spnr_jax.formats.images import png
from spnr_jax.training import metrics_log, trainer


def events(run):
    """(step, value) of everything in the event files of a run; a record is length, checksum, content, checksum."""
    found = []
    for path in sorted((run / "tensorboard").iterdir()):
        content, place = path.read_bytes(), 0
        while place < len(content):
            (length,) = struct.unpack_from("<Q", content, place)
            event = Event.FromString(content[place + 12 : place + 12 + length])
            found += [(event.step, value) for value in event.summary.value]
            place += 16 + length
    return found


def pixels(content):
    return np.asarray(Image.open(io.BytesIO(content)))


def test_a_row_with_a_picture_is_scalars_and_an_image_of_the_same_pixels_as_the_file(tmp_path):
    log = metrics_log.MetricsLog(tmp_path, 0)
    log.write({"step": 2, "loss": 3.0})
    log.write({"step": 3, "val_psnr": 20.5}, PICTURE)
    log.close()
    (_, loss), (at, score), (shown, picture) = events(tmp_path)
    assert (loss.tag, loss.simple_value) == ("loss", 3.0)
    assert (at, score.tag, score.simple_value) == (3, "val_psnr", 20.5)
    assert (shown, picture.tag) == (3, "preview")
    np.testing.assert_array_equal(pixels(picture.image.encoded_image_string), pixels(png(PICTURE)))
    assert metrics_log.read_rows(tmp_path) == [{"step": 2, "loss": 3.0}, {"step": 3, "val_psnr": 20.5}]


def test_every_preview_of_a_training_is_an_image_at_its_step(monkeypatch, tmp_path):
    without_network(monkeypatch)
    trainer.train(tiny_dataset.CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE)
    assert [step for step, value in events(tmp_path) if value.HasField("image")] == [3, 6]


def test_the_second_compilation_is_announced_before_the_step_that_needs_it(monkeypatch, tmp_path, capsys):
    without_network(monkeypatch)
    seen = []
    trainer.train(
        tiny_dataset.CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE,
        on_event=lambda phase, step, _: seen.append((phase, step, "discriminator joins" in capsys.readouterr().out)),
    )  # fmt: skip
    assert [step for phase, step, said in seen if said] == [3]
    assert ("step", 3, True) in seen


@pytest.mark.slow
def test_the_image_is_that_of_the_previews_folder():
    run = tiny_dataset.run()
    images = {step: value.image.encoded_image_string for step, value in events(run) if value.HasField("image")}
    for step, content in images.items():
        np.testing.assert_array_equal(pixels(content), pixels((run / "previews" / f"{step:07d}.png").read_bytes()))
    assert sorted(images) == [3, 6]
