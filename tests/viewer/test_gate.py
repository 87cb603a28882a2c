"""The viewer talks to its own page alone, whatever a client says that it is."""

import http.client
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.tiny_viewer import viewer

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")

import websockets.asyncio.server  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from spnr_jax.tools import commands, server  # noqa: E402

TESTS = Path(__file__).parents[1]
PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def running():
    opened = viewer()
    yield opened
    opened.stop()


class Address:
    """Parts of the address that a viewer prints; what listens everywhere is asked on this machine."""

    def __init__(self, url):
        parts = urlsplit(url)
        self.port, self.token = parts.port, parts.path.strip("/")
        self.host = f"127.0.0.1:{parts.port}"
        self.origin = f"http://{self.host}"

    def first_message(self, path, origin):
        """What the server says first on its WebSocket, in bytes; None where it refuses."""
        url = f"ws://{self.host}/{path}"
        try:
            with connect(url, origin=origin, subprotocols=[PROTOCOL], proxy=None) as socket:
                return socket.recv(timeout=20)
        except InvalidStatus as refusal:
            return None if refusal.response.status_code == 403 else b""

    def page(self, path, **headers):
        """Status and content of a page."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        found = answer.status, answer.read()
        connection.close()
        return found


def test_the_viewers_own_page_and_a_program_that_knows_the_token_are_let_in(running):
    address = Address(running.url)
    for origin in (address.origin, None):
        assert len(address.first_message(address.token, origin)) > 100
    status, content = address.page(f"/{address.token}/?fixedDpr=1")
    assert (status, b"<title>Viser</title>" in content) == (200, True)


BEHIND = {"viewer.example.org": "https://viewer.example.org", "10.0.0.7:9000": "http://10.0.0.7:9000"}
FOREIGN_ORIGINS = ("http://evil.example", "http://127.0.0.1:1", "http://localhost", "null", "file://", "")


@pytest.mark.parametrize("origin", [*FOREIGN_ORIGINS, "http://127.0.0.1", *BEHIND.values()])
def test_another_origin_is_refused_also_with_the_token(running, origin):
    address = Address(running.url)
    assert address.first_message(address.token, origin) is None
    status, content = address.page(f"/{address.token}/", Origin=origin)
    assert (status, b"Viser" in content) == (403, False)


@pytest.mark.parametrize(
    "change", [lambda token: "", lambda token: token[:-1], lambda token: token + "a", str.swapcase]
)
def test_without_the_whole_token_nobody_is_let_in_and_no_page_is_served(running, change):
    address = Address(running.url)
    wrong = change(address.token)
    for origin in (address.origin, None):
        assert address.first_message(wrong, origin) is None
        assert address.first_message(f"?token={address.token}", origin) is None
    for path in (f"/{wrong}", "/index.html", f"/x/../{address.token}", f"//{address.token}/", "/%e9%ff"):
        status, content = address.page(path)
        assert status == 403
        assert content.startswith(b"Open the address that `spnr view` printed")
    rebound = {"Host": f"evil.example:{address.port}", "Origin": f"http://evil.example:{address.port}"}
    assert address.page("/", **rebound)[0] == 403, "a name that an attacker points at this machine"


@pytest.mark.parametrize("reached_at", [*BEHIND, "viewer.example.org:443", "Viewer.Example.org"])
def test_behind_a_proxy_the_page_is_let_in_from_the_address_that_it_is_reached_at_alone(reached_at):
    behind = viewer(reached_at=reached_at)
    address, origin = Address(behind.url), BEHIND.get(reached_at, "https://viewer.example.org")
    asked_as = {"Host": address.host}  # what the proxy says; the browser's page is of another name
    status, content = address.page(f"/{address.token}/", Origin=origin, **asked_as)
    assert (status, b"<title>Viser</title>" in content) == (200, True)
    for own in (origin, address.origin):  # also without the proxy
        assert len(address.first_message(address.token, own)) > 100
    assert address.first_message("", origin) is None
    for other in ("https://evil.example", f"{origin}.evil.example", f"{origin}:1", "null", "ftp://viewer.example.org"):
        assert address.first_message(address.token, other) is None
    assert f"{reached_at}/{address.token}/" in behind.lines[1]
    behind.stop()


def test_another_host_asks_for_a_token_of_its_own_and_keeps_its_warning(running):
    serve = websockets.asyncio.server.serve
    everywhere = viewer("0.0.0.0")
    address = Address(everywhere.url)
    assert address.token != Address(running.url).token
    assert websockets.asyncio.server.serve is serve, "other servers are left as they are"
    assert "whoever reaches this machine" in everywhere.lines[1]
    assert address.first_message("", None) is None
    assert address.first_message(address.token, "http://evil.example") is None
    assert len(address.first_message(address.token, address.origin)) > 100
    everywhere.stop()
    assert running._server.request_share_url() is None, "no tunnel to a public address"
    assert running._server._share_tunnel is None


@pytest.mark.ci  # a process of its own, which compiles
def test_python_ends_well_while_programs_are_compiled_for_the_first_browser():
    program = f"import sys; sys.path.insert(0, {str(TESTS)!r}); from support.tiny_viewer import viewer; viewer().stop()"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_a_viser_that_opens_its_server_another_way_is_not_left_open(monkeypatch):
    stopped = []

    class Unguarded:
        def __init__(self, **options):
            pass

        def stop(self):
            stopped.append(True)

    monkeypatch.setattr(server, "Server", Unguarded)
    with pytest.raises(ValueError, match="cannot keep other pages out of viser"):
        viewer()
    assert stopped


@pytest.mark.parametrize(
    ("host", "port", "words"),
    [("127.0.0.1", 70000, "to 65535"), ("no.such.host.invalid", 0, "--host no.such.host.invalid"),
     ("192.0.2.1", 0, "--host 192.0.2.1"), ("127.0.0.1", None, "Address already in use")],
)  # fmt: skip
def test_an_address_that_cannot_be_listened_on_is_refused_in_one_line_before_anything_is_read(host, port, words):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1] if port is None else port
        with pytest.raises(ValueError, match="--port") as refusal:
            server.open_viewer(commands.View(cloud=Path("no.ply"), run=Path("none"), host=host, port=port))
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
