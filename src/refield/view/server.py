"""The server of a scene's view: on this machine alone, for one workspace, until it is stopped."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

from refield.scene.errors import InputError
from refield.scene.left_out import Warn
from refield.view.cast import SPLATS
from refield.view.draw import set_stage
from refield.view.scenery import Scenery
from refield.view.session import Session
from refield.workspace import Workspace

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

HOST = "127.0.0.1"
_OURS = re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?")


class Viewer:
    """Serves a workspace to browsers of this machine. Use it as a context.

    Raises:
        InputError: viser is not installed; the workspace cannot be read; the port cannot be listened on.
    """

    def __init__(self, workspace: Workspace, warn: Warn, *, port: int = 8080, splats: int = SPLATS) -> None:
        need_viser()
        self.scenery = Scenery(workspace, splats, warn)
        self._sessions: dict[int, Session] = {}
        self._server = opened_server(port)
        set_stage(self._server.scene, self.scenery.world)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._left)
        self.scenery.on_splats.append(self._splats_ready)

    @property
    def url(self) -> str:
        """Where the browser finds it."""
        return f"http://{HOST}:{self._server.get_port()}"

    def __enter__(self) -> Viewer:
        self.scenery.start()
        return self

    def __exit__(self, *what: object) -> None:
        self.scenery.end()
        for session in list(self._sessions.values()):
            session.close()
        stop(self._server)

    def prepare(self) -> None:
        """Make what the first browser is shown first, so that it need not wait."""
        with self.scenery.turns.first():
            self.scenery.glimpse(self.scenery.latest)
        self.scenery.splats(self.scenery.latest)

    def look_again(self) -> None:
        """Show visits that were made or taken back elsewhere, as by the command line."""
        if self.scenery.refresh():
            for session in list(self._sessions.values()):
                session.refresh()

    def _connected(self, client: ClientHandle) -> None:
        session = Session(client, self.scenery)
        self._sessions[client.client_id] = session
        session.open()

    def _left(self, client: ClientHandle) -> None:
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _splats_ready(self, visit: int) -> None:
        for session in list(self._sessions.values()):
            session.splats_ready(visit)


def need_viser() -> None:
    """Check that viser is there.

    Raises:
        InputError: it is not.
    """
    try:
        import viser  # noqa: F401
    except ImportError:
        what = "needs viser, which is not installed"
        raise InputError("refield view", what, "install it: pip install 'refield[view]'") from None


def opened_server(port: int) -> ViserServer:
    """viser's server, for pages of this machine alone.

    Raises:
        InputError: the port cannot be listened on.
    """
    import viser

    if not 0 <= port <= 65535:
        raise InputError("--port", f"{port} is none", "give 0 (any that is free) to 65535")
    # A browser may go while a picture for it is on its way, which nobody can know before: that is no fault.
    warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)
    with _for_our_pages_alone(), contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=HOST, port=port, verbose=False)


def stop(server: ViserServer) -> None:
    """Stop listening; what viser has to say of it nobody asked for."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _for_our_pages_alone() -> Iterator[None]:
    """Servers that are opened meanwhile refuse pages of other sites.

    viser asks nobody where he comes from: any page that is open in the same browser could connect to this machine, look
    at the scene and press its buttons.
    """
    from websockets.asyncio import server

    serve = server.serve
    server.serve = functools.partial(serve, origins=[_OURS])  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
