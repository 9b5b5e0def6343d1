"""The viewer's server over a real websocket: who may connect, and which messages have an effect."""

import contextlib
import http.client
import random
import socket
import string
import time

import pytest

from neuma_lib.errors import InputError
from neuma_lib.project.find import find_laws, find_scene
from neuma_lib.viewer.open import view
from neuma_lib.viewer.playground import Playground, first_law
from neuma_lib.viewer.scene import load_scene
from neuma_lib.viewer.server import LIVE, ViewerServer
from tests.support.viewer_project import make_project

viser = pytest.importorskip("viser")
msgspec = pytest.importorskip("msgspec")
client = pytest.importorskip("websockets.sync.client")
closed = pytest.importorskip("websockets.exceptions").WebSocketException
zstandard = pytest.importorskip("zstandard")

MESSAGES = 200
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0, 0, 2.5],
    "fov": 0.75,
    "near": 0.01,
    "far": 1000,
    "image_height": 480,
    "image_width": 640,
    "look_at": [0, 0, 0],
    "up_direction": [0, 1, 0],
}
DRAG = {
    "type": "SceneNodeDragMessage",
    "phase": "update",
    "name": "/left/box/handle",
    "instance_index": None,
    "start_position": [0.5, 0.5, 0.5],
    "start_screen_pos": [0.5, 0.5],
    "end_position": [0.5, 0.6, 0.5],
    "end_screen_pos": [0.5, 0.4],
    "button": "left",
    "modifier": None,
    "owner": "",
}

SLIDER = {"type": "GuiUpdateMessage", "updates": {"value": 1e300}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_project(tmp_path_factory.mktemp("viewer"))


@contextlib.contextmanager
def serving(folder):
    """A server in live mode."""
    settings, files = find_scene(folder)
    laws = find_laws(settings)
    playground = Playground(files, laws, first_law(files, laws, ("constants",)))
    server = ViewerServer(load_scene(files), playground, port=8480)
    server.gui["mode"].value = LIVE
    yield server
    server.close()


@pytest.fixture
def served(folder):
    with serving(folder) as server:
        yield server


@pytest.fixture(scope="module")
def shared(folder):
    """A server that keeps its state."""
    with serving(folder) as server:
        yield server


@contextlib.contextmanager
def connected(server, headers=None, origin=None):
    """A connection of viser's protocol that has sent its first camera, as a browser does."""
    options = {"subprotocols": [f"viser-v{viser.__version__}"], "close_timeout": 0.5, "max_size": None}
    where = f"ws://127.0.0.1:{server.port}"
    with client.connect(where, additional_headers=headers, origin=origin, **options) as connection:
        send(connection, CAMERA)
        yield connection


def send(connection, message):
    connection.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))


def update(control, value, name="value"):
    return {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {name: value}}


def received(connection, kind, timeout=20.0):
    """The first message of a type that the server sends."""
    until = time.monotonic() + timeout
    while time.monotonic() < until:
        raw = connection.recv(timeout=timeout)
        size = int.from_bytes(raw[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size])
        for message in msgspec.msgpack.decode(inner)["messages"]:
            if message["type"] == kind:
                return message
    raise AssertionError(f"no {kind}")


def reached(condition, timeout=20.0):
    until = time.monotonic() + timeout
    while not condition() and time.monotonic() < until:
        time.sleep(0.02)
    return condition()


def check_it_serves(server):
    """A new client sees the scene, moves a slider, and the simulation runs."""
    simulation = server.playground.simulation
    with connected(server) as connection:
        assert received(connection, "GaussianSplatsMessage")["name"] == "/left/box/splats"
        send(connection, update(server.gui["reset"], True))
        wanted = 5.0 if server.gui["gravity"].value != 5.0 else 6.0
        assert reached(lambda: simulation.snapshot.trouble is None)
        send(connection, update(server.gui["gravity"], wanted))
        assert reached(lambda: simulation._strength == wanted)
        begun = simulation.snapshot
        assert reached(lambda: simulation.snapshot.number > begun.number + 3)
    assert simulation._thread.is_alive() and server._drawer.is_alive()
    assert simulation.snapshot.x.isfinite().all()


@pytest.mark.parametrize(
    ("host", "port", "where"),
    [
        ("127.0.0.1", 70000, "--port 70000"),
        ("127.0.0.1", -1, "--port -1"),
        ("203.0.113.7", 8480, "--host 203.0.113.7"),  # of no machine (RFC 5737)
        ("no such host", 8480, "--host no such host"),
    ],
)
def test_an_address_that_cannot_be_used_is_an_error_before_anything_is_read(folder, host, port, where):
    began = time.monotonic()
    with pytest.raises(InputError) as caught:
        view(folder / "missing", host=host, port=port)
    assert caught.value.where == where and time.monotonic() - began < 5


def test_a_port_in_use_is_replaced_by_the_next_one_or_is_an_error(folder):
    from neuma_lib.viewer.gate import Gate

    with socket.create_server(("127.0.0.1", 0)) as taken:
        other = Gate("127.0.0.1", taken.getsockname()[1])
        assert other.port != taken.getsockname()[1]
        other.socket.close()
    with socket.create_server(("127.0.0.1", 65535)), pytest.raises(InputError) as caught:
        Gate("127.0.0.1", 65535)
    assert caught.value.where == "--port 65535"


@pytest.mark.parametrize(
    ("host", "origin", "accepted"),
    [
        ("127.0.0.1:{port}", None, True),
        ("127.0.0.1:{port}", "http://127.0.0.1:{port}", True),
        ("LOCALHOST:{port}", "http://LOCALHOST:{port}", True),
        ("[::1]:{port}", "http://[::1]:{port}", True),
        ("localhost:9000", "http://localhost:9000", True),  # a tunnel from another port
        ("evil.example:{port}", None, False),
        ("evil.example:{port}", "http://evil.example:{port}", False),
        ("127.0.0.1:{port}", "http://evil.example", False),
        ("127.0.0.1:{port}", "http://127.0.0.1:9000", False),
        ("127.0.0.1:{port}", "null", False),
        ("127.0.0.1.evil.example", None, False),
        ("localhost@evil.example", None, False),
        ("[::1", "http://[::1", False),
        ("", None, False),
    ],
)
def test_only_pages_of_this_server_connect(shared, host, origin, accepted):
    host, origin = (text and text.format(port=shared.port) for text in (host, origin))
    plain = http.client.HTTPConnection("127.0.0.1", shared.port, timeout=10)
    headers = {
        "Host": host,
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    plain.request("GET", "/", headers={**headers, **({"Origin": origin} if origin else {})})
    assert plain.getresponse().status == (101 if accepted else 403)
    plain.close()
    plain.request("GET", "/", headers={"Host": host})
    assert plain.getresponse().status == (403 if "evil" in host or host in ("", "[::1") else 200)
    plain.close()


def test_a_server_for_other_machines_has_the_names_of_its_own(shared):
    from neuma_lib.viewer.gate import Gate

    gate, name = Gate("0.0.0.0", 0), socket.gethostname()
    gate.socket.close()
    for host in (name, f"{name}.local:8080", "192.0.2.5:80", "0.0.0.0", "localhost"):
        assert gate.admits([host], [f"http://{host}"], local="192.0.2.5")
    assert not gate.admits(["192.0.2.6"], [], local="192.0.2.5")
    assert not gate.admits(["evil.example"], [], local="192.0.2.5")
    assert not gate.admits([name, name], [], local="192.0.2.5")


def test_clients_set_values_of_controls_in_their_ranges_alone(served):
    """Permitted values are executed, others have no effect."""
    gui, simulation = served.gui, served.playground.simulation
    with connected(served) as connection:
        before = {name: control.value for name, control in gui.items()}
        state = {name: dict(vars(control._impl)) for name, control in gui.items()}
        for control, value in (
            (gui["gravity"], float("nan")), (gui["gravity"], 25.01), (gui["gravity"], 2**62), (gui["gravity"], "1"),
            (gui["gravity"], True), (gui["gravity"], [1.0, 1.0, 1.0]), (gui["frame"], 99), (gui["frame"], 0.5),
            (gui["law"], "other"), (gui["mode"], 1), (gui["frusta"], 0), (gui["velocity"], [1e9, 0.0, 0.0]),
            (gui["velocity"], 1.0), (gui["velocity"], [0.0, 0.0]), (gui["shape"], "../letter_N"),
        ):  # fmt: skip
            send(connection, update(control, value))
        for name, value in (
            ("removed", True),
            ("is_button", True),
            ("uuid", "0"),
            ("update_cb", []),
            ("props", 0),
        ):
            send(connection, update(gui["gravity"], value, name))
        send(connection, {**update(gui["gravity"], 3.0), "updates": {"value": 3.0, "removed": True}})
        send(connection, update(gui["tilt x"], 20.0))  # permitted, and the last
        assert reached(lambda: simulation.floor[1, 1] < 0.95)
        after = {name: control.value for name, control in gui.items()}
        assert after == {**before, "tilt x": 20.0}
        changed = {"value", "update_timestamp"}
        for name, control in gui.items():
            assert {k: v for k, v in vars(control._impl).items() if k not in changed} == {
                k: v for k, v in state[name].items() if k not in changed
            }
        send(connection, update(gui["velocity"], [0.0, 2.0, 0.0]))
        send(connection, DRAG)
        assert reached(lambda: simulation._hand is not None)
        assert gui["velocity"].value == (0.0, 2.0, 0.0)
    check_it_serves(served)


@pytest.mark.parametrize(
    "hostile",
    [
        {**DRAG, "end_position": ["a"]},  # not a number: ended the thread of the simulation
        {**DRAG, "end_position": [0.5, 0.5]},
        {**DRAG, "end_position": [float("nan")] * 3},
        SLIDER,  # no client could be served any more
        {"type": "ShareUrlRequest"},  # opens a tunnel for everybody
    ],
)
def test_a_single_message_does_not_end_live_mode(served, monkeypatch, hostile):
    opened = []
    monkeypatch.setattr(served.server, "request_share_url", lambda: opened.append(1))
    with connected(served) as connection:
        send(connection, hostile | ({"uuid": served.gui["frame"]._impl.uuid} if hostile is SLIDER else {}))
        send(connection, update(served.gui["frusta"], False))
        reached(lambda: not served.gui["frusta"].value, 2)
    simulation = served.playground.simulation
    before = simulation.do(timeout=2)
    assert simulation.wait(before.number + 2, timeout=2).trouble is None and not opened
    check_it_serves(served)


def anything(random, depth=0):
    """A value of any type that MessagePack has, often an extreme one."""
    numbers = (0, -1, 2**63, -(2**63), 2**64 - 1, 1e308, -1e308, float("nan"), float("inf"), 5e-324)
    words = ("", "value", "/left/box/handle", "start", "\0", "x" * 1000, "__class__")
    makers = [
        lambda: random.choice(numbers),
        lambda: random.choice(words),
        lambda: random.choice((None, True, False)),
        lambda: random.randbytes(random.randrange(40)),
        lambda: msgspec.msgpack.Ext(random.randrange(-128, 128), random.randbytes(4)),
    ]
    if depth < 3:
        makers.append(lambda: [anything(random, depth + 1) for _ in range(random.randrange(5))])
        makers.append(lambda: {random.choice(words): anything(random, depth + 1) for _ in range(3)})
    return random.choice(makers)()


def mutated(random, server):
    """A message of the protocol with one field changed, damaged bytes, or a value of any type."""
    kinds = [kind.__name__ for kind in viser._messages.Message.get_subclasses()]
    control = random.choice(list(server.gui.values()))
    valid = random.choice(
        [
            CAMERA,
            DRAG,
            update(control, control.value),
            {"type": random.choice(kinds), "uuid": "0", "name": "/left"},
        ]
    )
    message = dict(valid)
    change = random.randrange(6)
    if change == 0:
        return msgspec.msgpack.encode(anything(random))
    if change == 1:
        message[random.choice(list(message))] = anything(random)
    elif change == 2:
        message[random.choice(string.ascii_lowercase)] = anything(random)
    elif change == 3:
        name = random.choice(("value", *vars(control._impl)))
        message = update(control, anything(random), name)
    elif change == 4:
        message.pop(random.choice(list(message)))
    raw = bytearray(msgspec.msgpack.encode(message))
    if change == 5:
        for _ in range(random.randrange(1, 5)):
            raw[random.randrange(len(raw))] = random.randrange(256)
        del raw[random.randrange(1, len(raw) + 1) :]
    return bytes(raw)


def test_the_server_survives_arbitrary_messages(served, caplog):
    generator = random.Random(34)
    fixed = ["text", b"", b"\xc1", b"\x91" * 10_000, b"\xdd\xff\xff\xff\xff", b"\x00" * 1_000_000]
    left = [*fixed, *(mutated(generator, served) for _ in range(MESSAGES - len(fixed)))]
    while left:  # a closed connection is opened again, before the limit of messages
        with contextlib.suppress(closed, OSError), connected(served) as connection:
            for _ in range(min(300, len(left))):
                connection.send(left.pop())
    check_it_serves(served)
    assert not [record for record in caplog.records if record.exc_info], "no handler has failed"


def test_a_flood_of_messages_ends_its_connection_alone(served):
    with pytest.raises(closed), connected(served) as connection:
        for _ in range(5000):
            send(connection, update(served.gui["gravity"], random.uniform(0, 25)))
            time.sleep(1e-4)
    check_it_serves(served)


# ---- messages


def test_axes_and_units_are_named_with_y_up(shared):
    scene = shared.server.scene
    assert scene.get_handle_by_name("/axes/y (up)").position[1] > 0.1
    assert "x, y (up), z [m/s]" in shared.gui["velocity"].label


def test_bodies_of_the_same_shape_have_labels(served):
    play = served.playground
    texts = lambda: [label.text for label in served._labels if label.visible]  # noqa: E731
    assert reached(lambda: served._number > 0) and texts() == []
    play.simulation.run(False)
    play.simulation.drop(0.0)
    for _ in range(2):
        assert play.add("letter_I") is None
    assert reached(lambda: texts() == ["1 BouncyBall", "2 letter_I", "3 letter_I"])
    heights = [label.position[1] for label in served._labels]
    assert heights == sorted(heights)
    served.gui["show"].value = "particles by body"
    points = lambda: served._nodes.get(("left", "points"))  # noqa: E731
    assert reached(lambda: points() and len(set(map(tuple, points().colors.tolist()))) == 3)
    play.reset()
    assert reached(lambda: texts() == [])


def test_a_diverged_simulation_names_what_to_change(served):
    simulation = served.playground.simulation
    simulation.drop(0.0)
    simulation._dts[0] = 0.02  # beyond the Courant limit
    simulation.launch((1.0, -1.0, 0.0))
    assert reached(lambda: simulation.snapshot.trouble)
    text = served._live_text(simulation.snapshot)
    for words in ("*Reset*", "'BouncyBall: Constants'", "Body 1", "speed", "softer law", "smaller time step"):
        assert words in text, text
