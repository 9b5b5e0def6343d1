"""A room in Blender: textured rectangles, lamps and a moving body. Imports bpy and is used through `room`."""

import bpy
import numpy as np
from mathutils import Matrix, Vector

from neuma_lib.data.blender import cycles

SENSOR = 36.0  # width of the sensor of all cameras [mm]; only its ratio to the pixels matters
PER_SECOND = 24.0  # Blender's frames per second; the shutter time is a fraction of a frame


def start(job: dict[str, np.ndarray]) -> None:
    """An empty scene with the renderer's settings, the lamps and the ambient light."""
    cycles.start(64, 64, 1, int(job["threads"]))
    scene = bpy.context.scene
    render = scene.render
    for lamp in [o for o in scene.objects if o.type == "LIGHT"]:
        bpy.data.objects.remove(lamp)
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = int(job["bounces"])
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.view_settings.view_transform = "Raw"
    render.film_transparent = False
    render.use_border = render.use_crop_to_border = True
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode = "RGB"
    render.image_settings.color_depth = "32"
    render.fps = int(PER_SECOND)
    render.motion_blur_position = "CENTER"
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = float(job["ambient"])
    for number, (place, power) in enumerate(zip(job["lamps"], job["lamp_powers"])):
        data = bpy.data.lights.new(f"lamp{number}", "AREA")
        data.shape, data.size, data.energy = "DISK", float(job["lamp_size"]), float(power)
        lamp = bpy.data.objects.new(f"lamp{number}", data)
        lamp.rotation_mode = "QUATERNION"
        lamp.rotation_quaternion = Vector(job["lamp_target"] - place).to_track_quat("-Z", "Y")
        lamp.location = Vector(place)
        scene.collection.objects.link(lamp)


def add_rectangle(name: str, corners: np.ndarray, pixels: np.ndarray) -> None:
    """A diffuse textured rectangle.

    Args:
        corners: left upper, right upper, right lower and left lower corner of the texture [m], (4, 3).
        pixels: texture, sRGB (H, W, 3), uint8.
    """
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, float_buffer=False)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = pixels[::-1] / np.float32(255)
    image.pixels.foreach_set(rgba.ravel())
    image.pack()
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(c) for c in corners], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new()
    for loop, uv in zip(layer.data, ((0, 1), (1, 1), (1, 0), (0, 0))):
        loop.uv = uv
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    texture = nodes.new("ShaderNodeTexImage")
    texture.image, texture.extension = image, "EXTEND"
    diffuse, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    links.new(texture.outputs["Color"], diffuse.inputs["Color"])
    links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))


class Cameras:
    """A camera that takes each of a job's lenses in turn, as fisheye polynomial of Cycles, without resampling."""

    def __init__(self, lenses: np.ndarray):
        """Args: lenses: rows of width, height, full width and height [px], left, top [px], k0 to k4 [rad / px^n]."""
        self.lenses = lenses
        self.data = bpy.data.cameras.new("camera")
        self.data.type, self.data.panorama_type = "PANO", "FISHEYE_LENS_POLYNOMIAL"
        self.data.sensor_fit, self.data.sensor_width = "HORIZONTAL", SENSOR
        self.data.fisheye_fov = np.pi
        self.data.clip_start, self.data.clip_end = 0.01, 100.0
        self.object = bpy.data.objects.new("camera", self.data)
        bpy.context.scene.collection.objects.link(self.object)
        bpy.context.scene.camera = self.object

    def become(self, lens: int, c2w: np.ndarray, region: np.ndarray) -> None:
        """Set the lens, the pose (4, 4, OpenGL axes), and the rendered region x0, y0, x1, y1 [px]."""
        _, _, full_width, full_height, left, top, *polynomial = self.lenses[lens]
        millimetre = full_width / SENSOR  # in pixels
        for power, value in enumerate(polynomial):  # Blender's angle has the opposite sign
            setattr(self.data, f"fisheye_polynomial_k{power}", -float(value) * millimetre**power)
        self.object.matrix_world = Matrix(c2w.tolist())
        render = bpy.context.scene.render
        render.resolution_x, render.resolution_y = int(full_width), int(full_height)
        x0, y0, x1, y1 = region + np.array([left, top, left, top])
        tiny = 0.01  # Blender truncates to pixels
        render.border_min_x, render.border_max_x = (x0 + tiny) / full_width, (x1 + tiny) / full_width
        render.border_min_y = (full_height - y1 + tiny) / full_height
        render.border_max_y = (full_height - y0 + tiny) / full_height


class MovingBody(cycles.Body):
    """The body of a job, which may be hidden, with motion blur."""

    def pose(self, frame: int, exposure: float, read_out: float = 0.0) -> None:
        """Set the geometry of a frame, or hide the body (-1), with an exposure and a time from top to bottom [s]."""
        render, cycles = bpy.context.scene.render, bpy.context.scene.cycles
        if frame >= 0:
            self.show(frame)
            mesh = self.object.data
            velocity = mesh.attributes.get("velocity") or mesh.attributes.new(
                "velocity", "FLOAT_VECTOR", "POINT"
            )
            velocity.data.foreach_set(
                "vector", np.ascontiguousarray(self.job["velocities"][frame], np.float32).ravel()
            )
            mesh.update()
        if self.object is not None:
            self.object.hide_render = frame < 0
        render.use_motion_blur = frame >= 0 and exposure > 0
        render.motion_blur_shutter = max(exposure + read_out, 1e-4) * PER_SECOND
        cycles.rolling_shutter_type = "TOP" if read_out else "NONE"
        cycles.rolling_shutter_duration = exposure / max(exposure + read_out, 1e-4)


def shoot(path: str, samples: int) -> np.ndarray:
    """Render linear radiance (H, W, 3), float32. ``path``: temporary .exr file."""
    scene = bpy.context.scene
    scene.cycles.samples = samples
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(path)
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, -1)[::-1, :, :3]
