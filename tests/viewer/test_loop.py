"""The thread that draws: changes in order, at once and once more at rest."""

import contextlib
import threading
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")

from spnr_jax.tools import server  # noqa: E402
from spnr_jax.tools.server import Loop  # noqa: E402


def test_changes_are_applied_in_order_drawn_at_once_and_once_more_at_rest():
    drawn, rested = [], threading.Event()

    def show(numbers, moving):
        drawn.append((tuple(numbers), moving))
        if numbers and not moving:
            rested.set()

    loop = Loop([], show, rest=0.05)
    for number in range(5):
        loop.submit(lambda numbers, number=number: [*numbers, number])
    loop.start()
    assert rested.wait(10)
    loop.stop()
    loop.join(10.0)
    assert drawn[0] == ((), True)
    assert drawn[1:] == [((0, 1, 2, 3, 4), True), ((0, 1, 2, 3, 4), False)]
    assert loop.stopped


def test_changes_that_come_while_a_picture_is_drawn_wait_together_and_supersede_it():
    drawn, begun, go, seen = [], threading.Event(), threading.Event(), []

    def show(number, moving):
        if number == 0:
            begun.set()
            go.wait(10)
            seen.append(loop.is_superseded)
        drawn.append(number)
        if number == 3:
            loop.stop()

    loop = Loop(0, show, rest=10.0)
    loop.start()
    assert begun.wait(10)
    for _ in range(3):
        loop.submit(lambda number: number + 1)
    go.set()
    loop.join(10.0)
    assert drawn == [0, 3]
    assert seen == [True]


@pytest.mark.parametrize("error", [None, KeyError])
def test_the_page_says_why_a_picture_takes_long_until_it_is_drawn_or_fails(monkeypatch, error):
    monkeypatch.setattr(server, "PATIENCE", 0.01)
    page = SimpleNamespace(loop=SimpleNamespace(stopped=False), _status=SimpleNamespace(content=""))
    fails = pytest.raises(error) if error else contextlib.nullcontext()
    with fails, server.Browser._explain_wait(page):
        end = time.monotonic() + 10
        while page._status.content != server.PREPARING:
            assert time.monotonic() < end
            time.sleep(0.01)
        if error:
            raise error
    assert page._status.content == ""


@pytest.mark.parametrize("broken", [False, True])
def test_of_two_files_the_last_that_can_be_read_stays_though_the_first_takes_longer(monkeypatch, broken):
    begun, shown = threading.Event(), []

    def read(name, *_):
        if name == "small.ply" and broken:
            raise server.UserError(name)
        if name == "large.ply":
            begun.set()
            time.sleep(0.3)
        return SimpleNamespace(positions=[])

    monkeypatch.setattr(server.frame, "read_upload", read)
    client = MagicMock()
    page = SimpleNamespace(_model=SimpleNamespace(encode=id), _reading={}, _client=client, _opened=0, _newest=0)
    page._replace, page._title = lambda name, **_: shown.append(name), SimpleNamespace()
    files = [server.viser.UploadedFile(name, b"") for name in ("large.ply", "small.ply")]
    first = threading.Thread(target=server.Browser._open, args=(page, files[0]))
    first.start()
    assert begun.wait(10)
    with pytest.raises(server.UserError) if broken else contextlib.nullcontext():
        server.Browser._open(page, files[1])
    first.join(10)
    assert shown == ["large.ply" if broken else "small.ply"]
    assert page._title.content.startswith(shown[0])
    assert [call.args for call in client.add_notification.call_args_list] == [("Opening", x.name) for x in files]
    assert client.add_notification.return_value.remove.call_count == 2
