"""The viewer's server: the motions of a scene and an interactive simulation in a browser, rendered by viser."""

import string
import threading
import time
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import torch
import trimesh
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from neuma_lib.coupling.bodies import BODY_COLOURS
from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.geometry.obstacles import obstacles
from neuma_lib.geometry.shapes import NAMES
from neuma_lib.splatting.spherical_harmonics import sh0_to_rgb
from neuma_lib.viewer.live import EARTH, MAX_SPEED, PIVOT, Snapshot
from neuma_lib.viewer.page import COLOURS
from neuma_lib.viewer.playground import Picture, Playground
from neuma_lib.viewer.scalars import QUANTITIES, rounded_up
from neuma_lib.viewer.scene import Motion, Scene, frame_at

RECORDED, LIVE = "recorded", "live"
NOTHING, SEEN, DISTANCE = "nothing", "Gaussians", "Gaussians by distance of both"
BY_QUANTITY = {"particles by body": "body"} | {
    f"particles by {quantity.label}": name for name, quantity in QUANTITIES.items()
}
"""Entry of the list "show" -> name of the quantity."""
OFFSET = 1.15  # offset of the second box from the first [m]
PACES = {"1/32": 1 / 32, "1/16": 1 / 16, "1/8": 1 / 8, "1/4": 1 / 4, "real time": 1.0}
MAX_RATE = 15  # maximum number of frames sent per second
_POLL = 0.05  # time to wait for a new snapshot [s]
_TEXT_TIME = 0.5  # minimum time between updates of the status text [s], for legibility
_FRUSTUM = 0.12
_AXES = 0.15  # length of the axes [m]
_HANDLE = 0.55  # radius of the handle for dragging, in longest sides of the body


def viser() -> ModuleType:
    """The module viser. Raises InputError if it is not installed."""
    return require("viser", "viewer")


class ViewerServer:
    """Serves a scene until it is closed.

    Args:
        scene: recorded motions.
        playground: interactive simulation, or None.
        host: address to listen on; 127.0.0.1 is this machine only.
        port: to listen on; the next free one is used if it is occupied.

    Raises:
        InputError: an address that is not of this machine, no free port, or a release of viser that bypasses `Gate`.
    """

    def __init__(
        self, scene: Scene, playground: Playground | None = None, host: str = "127.0.0.1", port: int = 8080
    ):
        self.scene, self.playground = scene, playground
        self.viser = viser()
        from neuma_lib.viewer.gate import Gate  # requires packages of viser

        gate = Gate(host, port)
        with gate.installed():
            self.server = self.viser.ViserServer(
                host=host, port=gate.port, label=f"{scene.name}", verbose=False
            )
        if self.port != gate.port:
            self.server.stop()
            problem = f"release {self.viser.__version__} is not supported"
            raise InputError("viser", problem, "Install viser 1.1.1")
        self._closing, self._dirty, self._playing = threading.Event(), True, False
        self._clock, self._number, self._nodes = 0.0, -1, {}
        self._reach: dict[tuple[str, str], float] = {}
        self._message: str | None = None
        self._acting, self._waiting = threading.Lock(), set()
        self._labels: list[Any] = []
        self._text_time, self._trouble = 0.0, (None, None, None)
        self._room()
        self._controls()
        gate.controls = {control._impl.uuid: control for control in self.gui.values()}
        if playground:
            gate.handles = (self._handle.name,)
        if playground:
            playground.simulation.run(False)
            playground.simulation.open()
        self._drawer = threading.Thread(target=self._draw_on, name="drawing", daemon=True)
        self._drawer.start()

    @property
    def port(self) -> int:
        """The port of the server."""
        return self.server.get_port()

    @property
    def host(self) -> str:
        """The address of the server."""
        return self.server.get_host()

    def close(self) -> None:
        """Stop drawing, simulation and server."""
        self._closing.set()
        self._drawer.join(timeout=10)
        if self.playground:
            self.playground.simulation.close()
        self.server.stop()

    # ---- room and controls -------------------------------------------------------------------------------------------

    def _room(self) -> None:
        scene = self.server.scene
        scene.set_up_direction("+y")
        for name, shift in (("left", 0.0), ("right", OFFSET)):
            scene.add_frame(f"/{name}", show_axes=False, position=(shift, 0.0, 0.0))
            self._nodes[name, "box"] = scene.add_frame(f"/{name}/box", show_axes=False)
            scene.add_grid(
                f"/{name}/box/floor", width=1.0, height=1.0, plane="xz", cell_size=0.1, section_size=0.5,
                position=(0.5, 0.0, 0.5), shadow_opacity=0.0,
            )  # fmt: skip
            for k, each in enumerate(obstacles(self.scene.colliders, [0.0])):
                color = tuple(round(255 * part) for part in each.color)
                self._nodes[name, "obstacle", k] = scene.add_mesh_simple(
                    f"/{name}/box/obstacle_{k}", each.vertices, each.faces, color=color, flat_shading=True
                )
        self._move_obstacles(0.0)
        self._nodes["right", "frame"] = scene.get_handle_by_name("/right")
        scene.add_frame("/axes", axes_length=_AXES, axes_radius=0.03 * _AXES)
        for name, place in (("x", (_AXES, 0, 0)), ("y (up)", (0, _AXES, 0)), ("z", (0, 0, _AXES))):
            scene.add_label(f"/axes/{name}", name, position=place)
        camera = self.server.initial_camera
        target = self.scene.motions[0].x.mean(dim=(0, 1)).numpy()
        camera.look_at = target
        camera.position = target + np.array([0.45, 0.35, 1.3])
        camera.fov = 0.75
        for view in self.scene.views:
            pose = np.linalg.inv(view.viewmat)
            self._nodes["view", view.number] = scene.add_camera_frustum(
                f"/left/view_{view.number}",
                fov=2 * np.arctan2(0.5 * view.height, view.K[1, 1]),
                aspect=view.width / view.height,
                scale=_FRUSTUM,
                thickness=0.002,
                image=next(iter(view.images.values())),
                wxyz=self.viser.transforms.SO3.from_matrix(pose[:3, :3]).wxyz,
                position=pose[:3, 3],
                color=(52, 107, 191),
            )

    def _controls(self) -> None:
        gui = self.server.gui
        # the logo looks like axes with z up; sharing, which the gate rejects, would publish the server
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.gui: dict[str, Any] = {}
        add = self.gui
        modes = [RECORDED, LIVE] if self.playground else [RECORDED]
        add["mode"] = gui.add_dropdown("mode", modes)
        self._status = gui.add_markdown("")
        add["show"] = gui.add_dropdown("show", [SEEN, DISTANCE, *BY_QUANTITY])
        self._bar = gui.add_image(colour_bar("viridis"), visible=False)
        self._legend = gui.add_markdown("", visible=False)
        titles = [motion.title for motion in self.scene.motions]
        learned = next((m.title for m in self.scene.motions if m.name == "neuma"), titles[0])
        self._recorded = gui.add_folder("recorded motions")
        with self._recorded:
            add["left"] = gui.add_dropdown("motion", titles, initial_value=learned)
            add["right"] = gui.add_dropdown("next to it", [NOTHING, *titles])
            add["frame"] = gui.add_slider("frame", 0, len(self.scene.steps) - 1, 1, 0)
            add["pace"] = gui.add_dropdown("pace", list(PACES), initial_value="1/16")
            add["play"] = gui.add_button("Play")
        add["frusta"] = gui.add_checkbox("frusta", True)
        for name in ("mode", "show", "left", "right", "frusta", "frame"):
            add[name].on_update(lambda event: self._changed())
        add["frame"].on_update(self._slid)
        add["play"].on_click(lambda event: self._play(not self._playing))
        if self.playground:
            self._live_controls()
        self._changed()

    def _live_controls(self) -> None:
        gui, play, add = self.server.gui, self.playground, self.gui
        simulation = play.simulation
        self._live = gui.add_folder("live")
        with self._live:
            add["reset"] = gui.add_button("Reset")
            add["running"] = gui.add_checkbox("running", True)
            add["law"] = gui.add_dropdown("law", list(play.laws), initial_value=play.chosen)
            add["weight"] = gui.add_slider("adaptor weight", 0.0, 1.25, 0.05, 1.0)
            add["gravity"] = gui.add_slider("gravity [m/s²]", 0.0, 25.0, 0.1, EARTH)
            add["tilt x"] = gui.add_slider("tilt about x [°]", -30.0, 30.0, 1.0, 0.0)
            add["tilt z"] = gui.add_slider("tilt about z [°]", -30.0, 30.0, 1.0, 0.0)
            add["height"] = gui.add_slider("height [m]", 0.0, 0.9, 0.01, 0.4)
            add["drop"] = gui.add_button("Drop from there")
            add["velocity"] = gui.add_vector3(
                "velocity x, y (up), z [m/s]", (1.0, 1.5, 0.0),
                min=(-MAX_SPEED,) * 3, max=(MAX_SPEED,) * 3, step=0.1,
            )  # fmt: skip
            add["launch"] = gui.add_button("Launch")
            shapes = [f"letter_{c}" for c in string.ascii_uppercase]
            add["shape"] = gui.add_dropdown("solid", [*NAMES, *shapes], initial_value="letter_N")
            add["add"] = gui.add_button("Drop it on top")
            add["flow"] = gui.add_checkbox("flow stretches Gaussians", False)
        value = lambda name: add[name].value  # noqa: E731
        actions = {
            "running": lambda: simulation.run(value("running") and value("mode") == LIVE),
            "weight": lambda: simulation.set_weight(value("weight")),
            "gravity": lambda: simulation.set_gravity(value("gravity")),
            "tilt x": lambda: simulation.set_floor(value("tilt x"), value("tilt z")),
            "tilt z": lambda: simulation.set_floor(value("tilt x"), value("tilt z")),
            "reset": play.reset,
            "drop": lambda: simulation.drop(value("height")),
            "launch": lambda: simulation.launch(value("velocity")),
            "add": lambda: play.add(value("shape")),
        }
        for name, act in actions.items():
            listen = add[name].on_click if hasattr(add[name], "on_click") else add[name].on_update
            listen(lambda event, name=name, act=act: self._act(name, act))
        # resetting the list after a rejected choice must not clear the message
        add["law"].on_update(lambda event: value("law") != play.chosen and self._act("law", self._choose))
        x = simulation.snapshot.x
        radius = _HANDLE * float((x.amax(dim=0) - x.amin(dim=0)).max())
        self._handle = self.server.scene.add_mesh_trimesh(
            "/left/box/handle", invisible_ball(radius), cast_shadow=False, receive_shadow=False, visible=False
        )

        @self._handle.on_drag
        async def dragged(event) -> None:  # async: phases in order
            simulation.hold(None if event.phase == "end" else event.end_position)

    def _choose(self) -> None:
        play, law = self.playground, self.gui["law"]
        if notice := play.choose(law.value):
            law.value = play.chosen
            raise InputError(notice)

    def _act(self, name: str, act: Callable[[], Any]) -> None:
        """Execute an action of the user, and display the message of an invalid one.

        Actions are executed one at a time with the current values of the controls. One that is already waiting is
        not repeated, so that the clicks of one client cannot occupy all threads of viser.
        """
        if name in self._waiting:
            return
        self._waiting.add(name)
        with self._acting:
            self._waiting.discard(name)
            try:
                act()
                self._message = None
            except InputError as error:
                self._message = str(error)
        self._dirty = True

    def _play(self, playing: bool) -> None:
        self._playing = playing
        self.gui["play"].label = "Pause" if playing else "Play"
        last = len(self.scene.steps) - 1
        if playing and self.gui["frame"].value == last:
            self.gui["frame"].value = 0
        self._clock = self.scene.dt * self.scene.steps[self.gui["frame"].value]

    def _slid(self, event) -> None:
        if event.client_id is not None and self._playing:  # moved by a user, not by playback
            self._play(False)

    def _changed(self) -> None:
        live = self.gui["mode"].value == LIVE
        self._recorded.visible = not live
        if self.playground:
            self._live.visible = self._handle.visible = live
            self.playground.simulation.run(live and self.gui["running"].value)
        for view in self.scene.views:
            self._nodes["view", view.number].visible = self.gui["frusta"].value and not live
        self._dirty = True

    # ---- drawing -----------------------------------------------------------------------------------------------------

    def _draw_on(self) -> None:
        last = time.perf_counter()
        while not self._closing.is_set():
            now = time.perf_counter()
            passed, last = now - last, now
            try:
                if self.gui["mode"].value == LIVE:
                    self._draw_live()
                else:
                    self._advance(passed)
                    if self._dirty:
                        self._dirty = False
                        self._draw_recorded()
            except Exception as error:  # the next frame may be valid
                self._set_status(f"**cannot be drawn:** {type(error).__name__}: {error}")
            rest = 1 / MAX_RATE - (time.perf_counter() - now)
            self._closing.wait(max(rest, 0.002))

    def _advance(self, passed: float) -> None:
        if not self._playing:
            return
        steps, dt = self.scene.steps, self.scene.dt
        self._clock += passed * PACES[self.gui["pace"].value]
        if self._clock > dt * steps[-1] + 0.03:
            self._clock = 0.0
        frame = frame_at(steps, int(self._clock / dt + 1e-6))
        if frame != self.gui["frame"].value:
            self.gui["frame"].value = frame
            self._dirty = True

    def _draw_recorded(self) -> None:
        step = self.scene.steps[self.gui["frame"].value]
        named = {motion.title: motion for motion in self.scene.motions}
        left, right = (named.get(self.gui[side].value) for side in ("left", "right"))
        display = self.gui["show"].value
        text = [f"**{1e3 * self.scene.dt * step:.0f} ms**"]
        self._turn(np.eye(3))
        with self.server.atomic():
            self._move_obstacles(self.scene.dt * step)
            named_bodies = self.scene.bodies if left and "body" in left.scalars else ()
            self._label_bodies(named_bodies, [
                left.x[frame_at(left.steps, step), left.scalars["body"][0] == k] for k in range(len(named_bodies))
            ])  # fmt: skip
            pair = display == DISTANCE
            self._draw_motion("left", left, step, display, right, text)
            if right and not pair:
                self._draw_motion("right", right, step, display, left, text)
            self._nodes["right", "frame"].visible = bool(right and not pair)
            for view in self.scene.views:
                at = frame_at(tuple(sorted(view.images)), step)
                image = view.images[sorted(view.images)[at]]
                node = self._nodes["view", view.number]
                if node.visible and self._nodes.get(("image", view.number)) is not image:
                    node.image = image
                    self._nodes["image", view.number] = image
        self._set_status("  \n".join([*text, *self.scene.notes]))

    def _draw_motion(
        self, side: str, motion: Motion, step: int, display: str, other: Motion | None, text: list[str]
    ) -> None:
        frame = frame_at(motion.steps, step)
        name = BY_QUANTITY.get(display)
        if name is None:
            if motion.means is None:
                text.append(f"{motion.title} carries no Gaussians: show its particles")
                return self._only(side, None)
            g = self.scene.gaussians
            rgb = sh0_to_rgb(g.sh0[:, 0]).clamp(0, 1).numpy()
            if display == DISTANCE and other is not None and other.means is not None:
                gap = (motion.means[frame] - other.means[frame_at(other.steps, step)]).norm(dim=-1).numpy()
                reach = self._largest_gap(motion, other)
                rgb = colours("viridis", gap / reach)
                self._show_legend("viridis", f"distance from {other.title}", 0.0, 1e3 * reach, "mm")
            else:
                self._hide_legend()
                if display == DISTANCE:
                    text.append("choose a second motion with Gaussians to see the distance")
            return self._splats(side, motion.means[frame], motion.covars[frame], rgb, g.opacities)
        known = motion.scalars.get(name)
        if known is None:
            text.append(f"{motion.title}: {display.removeprefix('particles by ')} is not known")
        self._points(side, motion.x[frame], None if known is None else known[frame], name)

    def _draw_live(self) -> None:
        play = self.playground
        snapshot = play.simulation.wait(self._number + 1, _POLL)
        if snapshot.number == self._number and not self._dirty:
            return
        self._number, self._dirty = snapshot.number, False
        self._turn(play.simulation.floor)
        self._nodes["right", "frame"].visible = False
        name = BY_QUANTITY.get(self.gui["show"].value)
        with self.server.atomic():
            self._move_obstacles(snapshot.time)
            if name is None:
                picture: Picture = play.picture(snapshot, self.gui["flow"].value)
                rgb = sh0_to_rgb(picture.gaussians.sh0[:, 0]).clamp(0, 1).numpy()
                self._hide_legend()
                self._splats("left", picture.means, picture.covars, rgb, picture.gaussians.opacities)
            else:
                self._points("left", snapshot.x, play.values(snapshot, name), name)
            self._handle.position = snapshot.x[: snapshot.counts[0]].mean(dim=0).numpy()
            self._label_bodies(play.names, snapshot.x.split(snapshot.counts))
        now, trouble = time.perf_counter(), (snapshot.trouble, snapshot.notice, self._message)
        if now - self._text_time > _TEXT_TIME or trouble != self._trouble:
            self._text_time, self._trouble = now, trouble
            self._set_status(self._live_text(snapshot))

    def _label_bodies(self, names: Sequence[str], bodies: Sequence[torch.Tensor]) -> None:
        """Number and name above the particles (N, 3) of each of several bodies."""
        texts = [f"{k + 1} {name}" for k, name in enumerate(names)] if len(bodies) > 1 else []
        for k in range(len(self._labels), len(texts)):
            self._labels.append(
                self.server.scene.add_label(f"/left/box/label_{k}", "", anchor="bottom-center")
            )
        for k, label in enumerate(self._labels):
            label.visible = k < min(len(texts), len(bodies))
            if label.visible:
                low, high = bodies[k].aminmax(dim=0)
                label.position = np.array([0.5 * (low + high)[0], high[1], 0.5 * (low + high)[2]])
                label.text = texts[k]

    def _live_text(self, snapshot: Snapshot) -> str:
        lines = [
            f"**{snapshot.time:.2f} s**, {snapshot.rate:.0f} frames/s, {snapshot.pace:.2f} × real time, "
            f"{len(snapshot.x)} particles, step {1e3 * snapshot.dt:.3g} ms"
        ]
        if snapshot.trouble:
            lines.append(f"**Stopped: the simulation diverged.** Press *Reset*. {snapshot.trouble}")
        if message := self._message or snapshot.notice:
            lines.append(f"*{message}*")
        return "  \n".join(lines)

    def _largest_gap(self, a: Motion, b: Motion) -> float:
        """99th percentile of the distances between Gaussians in all frames, rounded up [m]."""
        if (a.name, b.name) not in self._reach:
            at = [frame_at(b.steps, step) for step in a.steps]
            gaps = (a.means - b.means[at]).norm(dim=-1)
            self._reach[a.name, b.name] = rounded_up(max(float(np.percentile(gaps, 99)), 1e-4))
        return self._reach[a.name, b.name]

    def _move_obstacles(self, time: float) -> None:
        """Set the poses of all colliders at a time [s]."""
        for k, collider in enumerate(self.scene.colliders):
            axes, centre = collider.pose(time)
            for side in ("left", "right"):
                node = self._nodes[side, "obstacle", k]
                node.wxyz = self.viser.transforms.SO3.from_matrix(axes.numpy()).wxyz
                node.position = centre.numpy()

    def _turn(self, floor: np.ndarray) -> None:
        box = self._nodes["left", "box"]
        box.wxyz = self.viser.transforms.SO3.from_matrix(floor).wxyz
        box.position = PIVOT - floor @ PIVOT

    def _splats(
        self, side: str, means: torch.Tensor, covars: torch.Tensor, rgb: np.ndarray, opacities
    ) -> None:
        given = (means.numpy(), covars.numpy(), rgb, opacities[:, None].numpy())
        node = self._nodes.get((side, "splats"))
        if node is None:
            self._nodes[side, "splats"] = self.server.scene.add_gaussian_splats(f"/{side}/box/splats", *given)
        else:
            node.set_gaussians(*given)
        self._only(side, "splats")

    def _points(self, side: str, x: torch.Tensor, values: torch.Tensor | None, name: str) -> None:
        rgb = np.full((len(x), 3), 0.7)
        if quantity := QUANTITIES.get(name):
            low, high = self.scene.ranges.get(name, (0.0, quantity.min_range))
            if values is not None:
                rgb = colours(COLOURS[quantity.middle], ((values - low) / (high - low)).numpy())
            self._show_legend(COLOURS[quantity.middle], quantity.label, low, high, quantity.unit)
        else:
            self._hide_legend()
            if values is not None:
                rgb = np.array(BODY_COLOURS)[values.numpy() % len(BODY_COLOURS)]
        size = (self.scene.volume / len(x)) ** (1 / 3)
        bytes_ = (255 * rgb).astype(np.uint8)
        node = self._nodes.get((side, "points"))
        if node is None or len(node.points) != len(x):
            look = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            self._nodes[side, "points"] = self.server.scene.add_point_cloud(
                f"/{side}/box/points", x.numpy(), bytes_, **look
            )
        else:
            node.points, node.colors = x.numpy(), bytes_
        self._only(side, "points")

    def _only(self, side: str, kind: str | None) -> None:
        for other in ("splats", "points"):
            if (node := self._nodes.get((side, other))) is not None and node.visible != (other == kind):
                node.visible = other == kind

    def _show_legend(self, colour_map: str, label: str, low: float, high: float, unit: str) -> None:
        key = (colour_map, label, low, high)
        if self._nodes.get("legend") == key:
            return
        self._nodes["legend"] = key
        self._bar.image = colour_bar(colour_map)
        ends = " … ".join(in_units(value, unit) for value in (low, 0.5 * (low + high), high))
        self._legend.content = f"{label}: {ends}"
        self._bar.visible = self._legend.visible = True

    def _hide_legend(self) -> None:
        if self._nodes.pop("legend", None):
            self._bar.visible = self._legend.visible = False

    def _set_status(self, text: str) -> None:
        if self._status.content != text:
            self._status.content = text


def invisible_ball(radius: float) -> trimesh.Trimesh:
    """A transparent ball for dragging; with alpha blending, glTF viewers write no depth for it."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    transparent = PBRMaterial(baseColorFactor=(255, 255, 255, 0), alphaMode="BLEND")
    ball.visual = TextureVisuals(material=transparent)
    return ball


def colours(name: str, share: np.ndarray) -> np.ndarray:
    """RGB (N, 3) in [0, 1] of values (N,) in [0, 1] in a matplotlib colour map."""
    return require("matplotlib", "viewer").colormaps[name](np.clip(share, 0, 1))[:, :3]


def colour_bar(name: str) -> np.ndarray:
    """Image of a colour map, from low to high."""
    return np.broadcast_to((255 * colours(name, np.linspace(0, 1, 256))).astype(np.uint8), (14, 256, 3))


def in_units(value: float, unit: str) -> str:
    """A value with its unit, with a prefix for pascals."""
    for factor, prefix in ((1e6, "M"), (1e3, "k")):
        if unit == "Pa" and abs(value) >= factor:
            return f"{value / factor:.4g} {prefix}Pa"
    return f"{value:.4g} {unit}".strip()
