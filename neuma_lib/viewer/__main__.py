"""``python -m neuma_lib.viewer results/BouncyBall``: the motions of a scene in a browser, and its body to play with."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from neuma_lib.device import choose_device
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.viewer.find import found_laws, found_scene
from neuma_lib.viewer.page import write_page
from neuma_lib.viewer.playground import Playground, first_law
from neuma_lib.viewer.scene import load_scene
from neuma_lib.viewer.server import ViewerServer, viser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status. Errors that users can mend are one line."""
    parser = argparse.ArgumentParser(prog="python -m neuma_lib.viewer", description=__doc__)
    parser.add_argument("scene", help="folder of a scene, for example results/BouncyBall")
    parser.add_argument(
        "--file", help="write one HTML file, which opens without a server, in place of serving"
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to serve at; by default this machine alone"
    )
    parser.add_argument(
        "--port", type=int, default=8080, help="the next free one is taken where it is in use"
    )
    parser.add_argument("--methods", nargs="+", help="methods to show; by default all that have moved it")
    parser.add_argument(
        "--configfile", nargs="+", default=(), help="settings over those of the project, as for snakemake"
    )
    parser.add_argument(
        "--device",
        default="auto",
        choices=("auto", "cpu", "cuda"),
        help="where the live mode simulates; by default on a GPU where there is one",
    )
    chosen = parser.parse_args(arguments)
    try:
        return run(chosen)
    except (InputError, NonFiniteError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def run(chosen: argparse.Namespace) -> int:
    if not chosen.file:
        viser()  # before anything is read
    settings, files = found_scene(chosen.scene, chosen.configfile)
    if chosen.methods:
        known = {run.name: run for run in files.runs}
        if unknown := [name for name in chosen.methods if name not in known]:
            raise InputError(f"--methods {unknown[0]}: {chosen.scene} has {', '.join(known) or 'none'}")
        files = replace(files, runs=tuple(known[name] for name in chosen.methods))
    viewer = settings.viewer
    scene = load_scene(files, say=print, side=viewer.image_side, skip_damaged=True)
    for note in scene.notes:
        print(note, file=sys.stderr)
    if chosen.file:
        size = write_page(Path(chosen.file), scene, viewer.particles, viewer.megabytes)
        print(f"{chosen.file}: {len(scene.motions)} motions, {size / 1e6:.1f} MB; open it in a browser")
        return 0
    device = choose_device(chosen.device)
    torch.set_num_threads(1)  # two OpenMP threads beside the server's are slower than one
    laws = found_laws(settings, files.name)
    playground = Playground(files, laws, first_law(files, laws), device) if laws else None
    server = ViewerServer(scene, playground, chosen.host, chosen.port)
    print(
        f"http://{server.host}:{server.port}  ({len(scene.motions)} motions, {len(laws)} laws; Ctrl-C ends it)"
    )
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
