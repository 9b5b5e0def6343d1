"""Put the motions of a scene into one file that opens in a browser, without a server."""

from neuma_lib.project.files import SceneFiles
from neuma_lib.viewer.page import write_page
from neuma_lib.viewer.scene import load_scene
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = params.viewer
    scene = load_scene(SceneFiles.of_plain(params.files), side=settings["image_side"])
    size = write_page(output.page, scene, settings["particles"], settings["megabytes"], run.log)
    titles = ", ".join(motion.title for motion in scene.motions)
    run.log(f"{titles}: {len(scene.steps)} frames, {size / 1e6:.1f} MB")


run_script(main, snakemake)
