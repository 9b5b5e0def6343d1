"""Who may use the viewer's server, and with which messages.

viser answers every request and executes every message. The gate is the only way to its server: it owns the socket,
rejects requests of other web sites, and passes on only moves of the camera, drags of the handle and permitted values of
the controls.
"""

import contextlib
import errno
import http
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec  # installed with viser, which callers require first
import numpy as np
import websockets.asyncio.server

from neuma_lib.errors import InputError

PORTS = 20  # number of consecutive ports that are tried
MAX_BYTES = 16_384
"""Maximum size of a message. Those of a browser have less than 1 kB."""
RATE, BURST = 200, 400
"""Messages per second of a connection, and how many may come at once. With more it is closed. A browser sends 60."""
LOOPBACK = ("localhost", "127.0.0.1", "::1")

Real = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Triple = tuple[Real, Real, Real]


class _Message(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """A message of viser's browser client; see viser._messages."""


class ViewerCameraMessage(_Message):
    wxyz: tuple[Real, Real, Real, Real]
    position: Triple
    fov: Real
    near: Real
    far: Real
    image_height: Annotated[int, msgspec.Meta(ge=0, le=100_000)]
    image_width: Annotated[int, msgspec.Meta(ge=0, le=100_000)]
    look_at: Triple
    up_direction: Triple


class SceneNodeDragMessage(_Message):
    phase: Literal["start", "update", "end"]
    name: str
    instance_index: None
    start_position: Triple
    start_screen_pos: tuple[Real, Real]
    end_position: Triple
    end_screen_pos: tuple[Real, Real]
    button: Literal["left", "middle", "right"]
    modifier: str | None
    owner: Literal[""] = ""


class Value(msgspec.Struct, forbid_unknown_fields=True):
    """The only property of a control that a client may set."""

    value: bool | int | float | str | Triple


class GuiUpdateMessage(_Message):
    uuid: str
    updates: Value


_DECODER = msgspec.msgpack.Decoder(ViewerCameraMessage | SceneNodeDragMessage | GuiUpdateMessage)


class Gate:
    """A listening socket and the rules of its clients.

    Args:
        host, port: address to listen at. If the port is in use, the next free one of `PORTS` is used.

    Attributes:
        controls: viser's handles by their uuid; clients may change their values within their ranges.
        handles: names of the scene's nodes that may be dragged.

    Raises:
        InputError: an address that is not of this machine, or no free port.
    """

    def __init__(self, host: str, port: int):
        self.socket = listening(host, port)
        self.names = {host.lower(), *LOOPBACK}
        if self.socket.getsockname()[0] not in LOOPBACK:
            name = socket.gethostname().lower()
            self.names |= {name, f"{name}.local", socket.getfqdn().lower()}
        self.controls: Mapping[str, Any] = {}
        self.handles: Collection[str] = ()

    @property
    def port(self) -> int:
        """The port, which differs from the requested one if that is in use."""
        return self.socket.getsockname()[1]

    def admits(self, hosts: list[str], origins: list[str], local: str) -> bool:
        """Whether a request names this server.

        A web site whose name resolves to this machine (DNS rebinding) has another Host, and a page of another site
        another Origin. Programs other than browsers send no Origin.

        Args:
            hosts, origins: all values of these headers.
            local: address of this machine that the client is connected to.
        """
        if len(hosts) != 1 or len(origins) > 1:
            return False
        try:
            name = urlsplit(f"//{hosts[0]}").hostname
            same = all(urlsplit(origin).netloc == hosts[0] for origin in origins)
        except ValueError:
            return False
        return name in {*self.names, local} and same

    def accepted(self, raw: bytes | str) -> bytes | None:
        """The message with its checked fields only, or None if it is not permitted."""
        if not isinstance(raw, bytes):
            return None
        try:
            message = _DECODER.decode(raw)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None
        if isinstance(message, GuiUpdateMessage):
            control = self.controls.get(message.uuid)
            permitted = control is not None and _in_range(control, message.updates.value)
        else:
            permitted = isinstance(message, ViewerCameraMessage) or message.name in self.handles
        return msgspec.msgpack.encode(message) if permitted else None

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Context in which a server of websockets is started behind this gate."""
        plain = websockets.asyncio.server.serve

        def serve(handler: Callable, host: str, port: int, process_request: Callable, **options):
            def admitted(connection, request):
                hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
                if self.admits(hosts, origins, connection.local_address[0]):
                    return process_request(connection, request)
                text = f"This server is open to {', '.join(sorted(self.names))}. See `neuma view --help`.\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, text)

            options |= {"max_size": MAX_BYTES, "close_timeout": 1, "create_connection": _connection(self)}
            return plain(handler, sock=self.socket, process_request=admitted, **options)

        websockets.asyncio.server.serve = serve
        try:
            yield
        finally:
            websockets.asyncio.server.serve = plain


def _connection(gate: Gate) -> type:
    class Connection(websockets.asyncio.server.ServerConnection):
        """A connection that receives only accepted messages, and is closed if it sends too many."""

        credit, counted = float(BURST), 0.0

        async def recv(self, decode: bool | None = None) -> bytes:
            while True:
                raw, now = await super().recv(decode), time.monotonic()
                self.credit = min(self.credit + RATE * (now - self.counted), BURST) - 1
                self.counted = now
                if self.credit < 0:
                    await self.close(1008, "too many messages")
                elif (message := gate.accepted(raw)) is not None:
                    return message

    return Connection


def _in_range(control: Any, value: Any) -> bool:
    """Whether a control of viser can have a value: an option, a number in its range, or a boolean."""
    if hasattr(control, "options"):
        return value in control.options
    if not hasattr(control, "min"):
        return isinstance(value, bool)
    if isinstance(value, bool | str) or np.shape(value) != np.shape(control.value):
        return False
    inside = np.less_equal(control.min, value) & np.less_equal(value, control.max)
    return bool(np.all(inside)) and (not isinstance(control.value, int) or value == int(value))


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens at the first free port.

    Raises:
        InputError: an address that is not of this machine, or no free port.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}", "is not between 0 and 65535")
    for each in range(port, min(port + PORTS, 65536)):
        try:
            family, *_, address = socket.getaddrinfo(host, each, type=socket.SOCK_STREAM)[0]
            return socket.create_server(address, family=family)
        except (OSError, UnicodeError) as error:
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                continue
            remedy = "Use an address of this machine, such as 127.0.0.1, or 0.0.0.0 for all of its addresses"
            reason = str(error.args[-1]).partition(" (while")[0]
            raise InputError(f"--host {host}", f"cannot listen at port {each}: {reason}", remedy) from None
    raise InputError(f"--port {port}", f"is in use, and so are the ports up to {each}", "Choose another one")
