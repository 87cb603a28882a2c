"""The viewer talks to its own page alone: by plain clients, and by another site's page in a headless Chromium."""

import http.client
import http.server
import socket
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support import chromium as chromium_of
from support.tiny_viewer import viewer

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")

import websockets.asyncio.server  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from spnr_jax import cli  # noqa: E402
from spnr_jax.tools import commands  # noqa: E402
from spnr_jax.viewer import server  # noqa: E402

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


def first_message(address, path, origin):
    """What the server says first on its WebSocket, in bytes."""
    with connect(f"ws://{address.host}/{path}", origin=origin, subprotocols=[PROTOCOL], proxy=None) as socket:
        return socket.recv(timeout=20)


def refused(address, path, origin):
    with pytest.raises(InvalidStatus) as status:
        first_message(address, path, origin)
    return status.value.response.status_code == 403


def page(address, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=20)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content


def test_the_viewers_own_page_and_a_program_that_knows_the_token_are_let_in(running):
    address = Address(running.url)
    for origin in (address.origin, None):
        assert len(first_message(address, address.token, origin)) > 100
    status, content = page(address, f"/{address.token}/?fixedDpr=1")
    assert status == 200
    assert b"<title>Viser</title>" in content


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "http://127.0.0.1:1", "http://localhost", "null", "file://", "", "http://127.0.0.1"],
)
def test_another_origin_is_refused_also_with_the_token(running, origin):
    address = Address(running.url)
    assert refused(address, address.token, origin)
    status, content = page(address, f"/{address.token}/", Origin=origin)
    assert status == 403
    assert b"Viser" not in content


@pytest.mark.parametrize(
    "change", [lambda token: "", lambda token: token[:-1], lambda token: token + "a", str.swapcase]
)
def test_without_the_whole_token_nobody_is_let_in_and_no_page_is_served(running, change):
    address = Address(running.url)
    wrong = change(address.token)
    for origin in (address.origin, None):
        assert refused(address, wrong, origin)
        assert refused(address, f"?token={address.token}", origin)
    for path in (f"/{wrong}", "/index.html", f"/x/../{address.token}", f"//{address.token}/", "/%e9%ff"):
        status, content = page(address, path)
        assert status == 403
        assert content.startswith(b"Open the address that `spnr view` printed")


def test_a_name_that_an_attacker_points_at_this_machine_does_not_help_without_the_token(running):
    address = Address(running.url)
    rebound = {"Host": f"evil.example:{address.port}", "Origin": f"http://evil.example:{address.port}"}
    assert page(address, "/", **rebound)[0] == 403


BEHIND = {"viewer.example.org": "https://viewer.example.org", "10.0.0.7:9000": "http://10.0.0.7:9000"}


@pytest.mark.parametrize("reached_at", [*BEHIND, "viewer.example.org:443", "Viewer.Example.org"])
def test_behind_a_proxy_the_page_is_let_in_from_the_address_that_it_is_reached_at_alone(reached_at):
    behind = viewer(reached_at=reached_at)
    address, origin = Address(behind.url), BEHIND.get(reached_at, "https://viewer.example.org")
    asked_as = {"Host": address.host}  # what the proxy says; the browser's page is of another name
    status, content = page(address, f"/{address.token}/", Origin=origin, **asked_as)
    assert (status, b"<title>Viser</title>" in content) == (200, True)
    assert len(first_message(address, address.token, origin)) > 100
    assert len(first_message(address, address.token, address.origin)) > 100, "and without the proxy"
    assert refused(address, "", origin)
    for other in ("https://evil.example", f"{origin}.evil.example", f"{origin}:1", "null", "ftp://viewer.example.org"):
        assert refused(address, address.token, other)
    assert f"{reached_at}/{address.token}/" in behind.lines[1]
    behind.stop()


def test_without_reached_at_a_proxy_of_another_name_is_refused(running):
    address = Address(running.url)
    for origin in BEHIND.values():
        assert refused(address, address.token, origin)


@pytest.mark.parametrize("place", ["http://a.b", "a.b/c", "a b", "", "a:b", "user@a"])
def test_an_address_to_be_reached_at_is_a_host_and_a_port_alone(place):
    with pytest.raises(ValueError, match="--reached-at .*HOST"):
        commands.View(cloud=Path("a.ply"), reached_at=place)


def test_another_host_asks_for_a_token_too_and_keeps_its_warning():
    everywhere = viewer("0.0.0.0")
    address = Address(everywhere.url)
    assert "whoever reaches this machine" in everywhere.lines[1]
    assert "no encryption" in everywhere.lines[1]
    assert refused(address, "", None)
    assert refused(address, address.token, "http://evil.example")
    assert len(first_message(address, address.token, address.origin)) > 100
    everywhere.stop()


def test_every_viewer_has_its_own_token_and_other_servers_are_left_as_they_are(running):
    serve = websockets.asyncio.server.serve
    other = viewer()
    assert Address(other.url).token != Address(running.url).token
    assert websockets.asyncio.server.serve is serve
    other.stop()


def test_no_browser_can_open_the_tunnel_to_a_public_address(running):
    assert running._server.request_share_url() is None
    assert running._server._share_tunnel is None


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
     ("192.0.2.1", 0, "--host 192.0.2.1")],
)  # fmt: skip
def test_an_address_that_cannot_be_listened_on_is_refused_in_one_line(host, port, words):
    with pytest.raises(ValueError, match="--port") as refusal:
        viewer(host, port)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_port_in_use_is_refused_before_anything_is_read(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"--port {port}: Address already in use"):
            server.open_viewer(commands.View(cloud=tmp_path / "no.ply", run=tmp_path, port=port))


def test_without_viser_the_command_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'spnr-jax\[viewer\]'"):
        cli.run_view(commands.View(cloud=Path("a.ply"), run=Path("run")))


# a page of another site, in the same browser

FOREIGN = """<!doctype html><title>foreign</title><script>
window.ask = (url) => new Promise((done) => {
  const socket = new WebSocket(url, "PROTOCOL");
  socket.binaryType = "arraybuffer";
  socket.onmessage = (event) => { done("read " + event.data.byteLength); socket.close(); };
  socket.onerror = () => done("refused");
});
</script>""".replace("PROTOCOL", PROTOCOL)


class Site(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(FOREIGN.encode())

    def log_message(self, *words):
        """Nothing."""


@pytest.fixture
def foreign():
    """The address of another site on this machine."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Site) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{site.server_port}/"
        site.shutdown()


@pytest.mark.ci
@chromium_of.needed
def test_a_page_of_another_site_reads_nothing_while_the_viewer_is_open_in_the_same_browser(running, foreign):
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    address = Address(running.url)
    with chromium_of.launched(playwright) as browser:
        context = browser.new_context()
        own = context.new_page()
        own.goto(running.url)
        own.get_by_text("ball.xyz: 400 points").wait_for(timeout=60_000)  # the viewer works here
        tab = context.new_page()
        tab.goto(foreign)
        for path in ("", address.token):
            for host in (address.host, f"localhost:{address.port}"):
                assert tab.evaluate("url => ask(url)", f"ws://{host}/{path}") == "refused"
