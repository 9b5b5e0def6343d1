"""Open the viewer on a folder of results."""

import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from neuma_lib.device import choose_device
from neuma_lib.errors import InputError
from neuma_lib.project.find import find_laws, find_scene
from neuma_lib.viewer.page import write_page
from neuma_lib.viewer.playground import Playground, first_law
from neuma_lib.viewer.scene import load_scene
from neuma_lib.viewer.server import ViewerServer, viser


def view(
    folder: str | Path,
    *,
    methods: Sequence[str] | None = None,
    file: str | Path | None = None,
    configfiles: Sequence[str | Path] = (),
    host: str = "127.0.0.1",
    port: int = 8080,
    device: str = "auto",
) -> None:
    """Serve the motions of a scene to a browser until Ctrl-C, or write them to one HTML file.

    Args:
        folder: a scene's folder of results.
        methods: methods whose motion is shown. None: all with a motion.
        file: HTML file to write instead of serving.
        configfiles: settings that override those of the folder's project.
        host, port: address to serve at. If the port is taken, the next free one is used.
        device: where the live mode simulates: "auto", "cpu" or "cuda".

    Raises:
        InputError: the folder is not that of a scene or has no motion, viser is missing (extra ``viewer``), or the
            address is not of this machine or has no free port.

    Example:
        >>> view("results/BouncyBall", file="ball.html")
        ball.html: 3 motions, 4.2 MB; open it in a browser
    """
    if not file:
        viser()  # fails before anything is read
        from neuma_lib.viewer.gate import listening  # requires packages of viser

        listening(host, port).close()
    settings, files = find_scene(folder, configfiles)
    if methods:
        known = {run.name: run for run in files.runs}
        if unknown := [name for name in methods if name not in known]:
            raise InputError(f"--methods {unknown[0]}", f"{folder} has {', '.join(known) or 'none'}")
        files = replace(files, runs=tuple(known[name] for name in methods))
    viewer = settings.viewer
    scene = load_scene(files, log=print, side=viewer.image_side, skip_damaged=True)
    for note in scene.notes:
        print(note, file=sys.stderr)
    if file:
        size = write_page(Path(file), scene, viewer.particles, viewer.megabytes, print)
        print(f"{file}: {len(scene.motions)} motions, {size / 1e6:.1f} MB; open it in a browser")
        return
    chosen = choose_device(device)
    torch.set_num_threads(1)  # two OpenMP threads next to the server's are slower than one
    laws = {} if scene.bodies else find_laws(settings, files.name)  # live, a scene has one body at first
    playground = Playground(files, laws, first_law(files, laws), chosen) if laws else None
    server = ViewerServer(scene, playground, host, port)
    counts = f"{len(scene.motions)} motions, {len(laws)} laws"
    if port not in (0, server.port):
        print(f"Port {port} is in use.", file=sys.stderr)
    address = f"[{host}]" if ":" in host else "localhost" if host == "0.0.0.0" else host
    print(f"http://{address}:{server.port}  ({counts}; Ctrl-C ends it)")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        server.close()
