"""Who is let in by the server of the viewer: its own page alone.

A web page of any address that is open in the same browser can connect to a server on this machine, and viser asks
nobody who he is.  So the path of the viewer's address begins with a token, made anew for every viewer, without which
no page is served and no WebSocket is opened; the page's own connection takes the token from its address.  Where a
browser names the origin of what asks, it has to be the address that was asked or, behind a proxy, `reached_at`.
"""

import contextlib
import dataclasses
import hmac
import secrets
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LENGTH = 16  # bytes of a token
CLOSED = "Open the address that `spnr view` printed, whole: it holds a token.\n"
FOREIGN = "This page is not that of the viewer.\n"
DEFAULT_PORTS = {"http": ":80", "https": ":443"}  # which a browser leaves out of an origin
_guarding = threading.Lock()

Asked = Callable[[Any, Request], Any]


def new_token() -> str:
    """A token of characters that an address may hold."""
    return secrets.token_urlsafe(LENGTH)


def admitted(request: Request, token: str, reached_at: str | None = None) -> Request | Response:
    """The request with the path behind the token, or why it is refused."""
    first, _, rest = request.path.removeprefix("/").partition("/")
    if not hmac.compare_digest(first.partition("?")[0].encode(), token.encode()):
        return _refusal(CLOSED)
    origins, asked = request.headers.get_all("Origin"), request.headers.get_all("Host")
    if not all(_is_own(origin, asked, reached_at) for origin in origins):
        return _refusal(FOREIGN)
    return dataclasses.replace(request, path="/" + rest)


def _is_own(origin: str, asked: list[str], reached_at: str | None) -> bool:
    """Whether an origin is the host that was asked, or reached_at; "null" (a file, a sandbox) is neither."""
    scheme, _, place = origin.lower().partition("://")
    if scheme not in DEFAULT_PORTS:
        return False
    known = (reached_at or "").lower().removesuffix(DEFAULT_PORTS[scheme])
    return [place] == [host.lower() for host in asked] or (known != "" and place == known)


def _refusal(why: str) -> Response:
    content = why.encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(content))})
    return Response(HTTPStatus.FORBIDDEN, HTTPStatus.FORBIDDEN.phrase, headers, content)


@contextlib.contextmanager
def guarded(token: str, reached_at: str | None = None) -> Iterator[list[Any]]:
    """Servers of websockets that are opened meanwhile, in whatever thread, admit what knows the token; their list.

    viser opens its server in its own thread and has no hook for who is let in, hence the replaced function.
    """
    original: Any = websockets.asyncio.server.serve
    opened: list[Any] = []

    def serve(*arguments: Any, process_request: Asked | None = None, **options: Any) -> Any:
        def ask(connection: Any, request: Request) -> Any:
            answer = admitted(request, token, reached_at)
            if isinstance(answer, Response) or process_request is None:
                return answer if isinstance(answer, Response) else None
            return process_request(connection, answer)

        opened.append(original(*arguments, process_request=ask, **options))
        return opened[-1]

    with _guarding:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield opened
        finally:
            websockets.asyncio.server.serve = original  # type: ignore[misc]
