"""The viewer talks to its own page alone: by plain clients, and by another site's page in a headless Chromium."""

import http.client
import http.server
import threading
from urllib.parse import urlsplit

import pytest
from support import chromium as chromium_of
from support.tiny_viewer import viewer

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")

import websockets.asyncio.server  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

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


def test_another_host_asks_for_a_token_too_and_keeps_its_warning():
    everywhere = viewer("0.0.0.0")
    address = Address(everywhere.url)
    assert "whoever reaches this machine" in everywhere.lines[1]
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
        own.get_by_text("halves.xyz: edits change").wait_for(timeout=60_000)  # the viewer works here
        tab = context.new_page()
        tab.goto(foreign)
        for path in ("", address.token):
            for host in (address.host, f"localhost:{address.port}"):
                assert tab.evaluate("url => ask(url)", f"ws://{host}/{path}") == "refused"
