"""The Blender scene. Imports bpy and is used through `neuma_lib.data.blender.scene`."""

import ctypes
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from neuma_lib.errors import InputError

SENSOR = 36.0  # width of the camera's sensor [mm]; only its ratio to the focal length matters
SEED = 0  # seed of the sampler, for deterministic images
AMBIENT = 0.82  # radiance of the uniform surroundings, independent of the surface's orientation
KEY = 0.35  # strength of a wide soft light above the frontal camera, for shading


def start(width: int, height: int, samples: int, threads: int, device: str = "cpu") -> None:
    """An empty scene with the renderer's settings and the light.

    Args:
        device: of rendering and denoising: "cpu"; "cuda", the first visible CUDA device; or "auto", CUDA if Blender has
            a device and machine code for it.

    Raises:
        InputError: CUDA is requested, and Blender has no device or no machine code for it.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    cycles.device = "CPU"
    cycles.samples = samples
    cycles.seed = SEED
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = True
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_prefilter = "FAST"
    cycles.max_bounces = 3
    render.threads_mode, render.threads = "FIXED", threads
    render.use_persistent_data = True
    render.film_transparent = True
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.image_settings.file_format = "PNG"
    render.image_settings.color_mode = "RGBA"
    render.image_settings.color_depth = "8"
    render.image_settings.compression = 50
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs["Strength"].default_value = AMBIENT
    scene.world = world
    key = bpy.data.lights.new("key", "SUN")
    key.energy = KEY * np.pi * 0.5
    key.angle = np.radians(90.0)
    lamp = bpy.data.objects.new("key", key)
    towards = Vector((0.35, 0.8, 0.5)).normalized()
    lamp.rotation_mode = "QUATERNION"
    lamp.rotation_quaternion = towards.to_track_quat("Z", "Y")
    scene.collection.objects.link(lamp)
    if device != "cpu":
        _use_cuda(required=device == "cuda")


def _use_cuda(required: bool) -> None:
    """Render and denoise on the first CUDA device, if Blender can use one.

    Small images are rendered faster by one process per device than by several devices together.
    """
    preferences = bpy.context.preferences.addons["cycles"].preferences
    devices = [each for each in preferences.get_devices_for_type("CUDA") if each.type == "CUDA"]
    missing = _missing_code(_compute_capability()) if devices else None
    if devices and not missing:
        preferences.compute_device_type = "CUDA"
        for number, each in enumerate(devices):
            each.use = number == 0
        cycles = bpy.context.scene.cycles
        cycles.device = "GPU"
        cycles.denoising_use_gpu = True
    elif required:
        # Without machine code, the driver compiles for more than 400 s without any output.
        problem = f"{missing}, the machine code for this GPU" if missing else "CUDA device"
        remedy = "compile it as described in docs/scale.md" if missing else "check the driver"
        what = f"is cuda, but Blender has no {problem}"
        raise InputError("dataset.blender.device", what, f"Use cpu or auto, or {remedy}")


def _compute_capability() -> str | None:
    """Compute capability of the first visible CUDA device, such as "90", from the driver. None if that is unknown."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return None
    driver.cuInit(0)
    numbers = []
    for attribute in (75, 76):  # CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR and _MINOR
        number = ctypes.c_int()
        if driver.cuDeviceGetAttribute(ctypes.byref(number), attribute, 0) != 0:
            return None
        numbers.append(number.value)
    return "".join(map(str, numbers))


def _missing_code(capability: str | None) -> str | None:
    """Name of the file with machine code for a compute capability, if Cycles has files but not this one."""
    folder = Path(bpy.utils.system_resource("SCRIPTS", path="addons_core/cycles/lib"))
    name = f"kernel_sm_{capability}.cubin"
    present = {file.name.removesuffix(".zst") for file in folder.glob("kernel_sm_*.cubin*")}
    return name if capability is not None and present and name not in present else None


def add_camera(focal: float, width: int) -> bpy.types.Object:
    """A pinhole camera with square pixels; ``focal`` [px]."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR
    data.lens = focal * SENSOR / width
    data.clip_start, data.clip_end = 0.01, 100.0
    camera = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return camera


def place(camera: bpy.types.Object, c2w: np.ndarray) -> None:
    """Set the pose of a camera (camera to world, (4, 4)); Blender's camera axes are those of OpenGL."""
    camera.matrix_world = Matrix(c2w.tolist())


def render(path: Path) -> None:
    """Render the scene to a PNG file."""
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def _material() -> bpy.types.Material:
    """Diffuse material with the colours of the attribute ``rest_color``."""
    material = bpy.data.materials.new("body")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    attribute = nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = "rest_color"
    diffuse = nodes.new("ShaderNodeBsdfDiffuse")
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(attribute.outputs["Color"], diffuse.inputs["Color"])
    links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    return material


def _grain_nodes(radius: float, material: bpy.types.Material) -> bpy.types.NodeTree:
    """Geometry nodes that turn vertices into native balls."""
    tree = bpy.data.node_groups.new("grains", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    source, sink = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    balls = tree.nodes.new("GeometryNodeMeshToPoints")
    balls.inputs["Radius"].default_value = radius
    dress = tree.nodes.new("GeometryNodeSetMaterial")
    dress.inputs["Material"].default_value = material
    tree.links.new(source.outputs[0], balls.inputs["Mesh"])
    tree.links.new(balls.outputs[0], dress.inputs["Geometry"])
    tree.links.new(dress.outputs[0], sink.inputs[0])
    return tree


class Obstacles:
    """Rigid grey objects of a job, which cast shadows in pictures and none in images with masks.

    The colours of the body in the images then do not depend on obstacles, and their masks end where an obstacle hides
    the body.
    """

    def __init__(self, job: dict[str, np.ndarray], shadows: bool):
        self.poses, self.objects = job["obstacle_poses"], []
        for k, (*color, opacity) in enumerate(job["obstacle_colors"].tolist()):
            mesh = bpy.data.meshes.new("obstacle")
            mesh.from_pydata(job[f"obstacle_{k}_vertices"].tolist(), [], job[f"obstacle_{k}_faces"].tolist())
            mesh.materials.append(self._material(color, opacity))
            each = bpy.data.objects.new("obstacle", mesh)
            each.visible_shadow = each.visible_diffuse = shadows
            bpy.context.scene.collection.objects.link(each)
            self.objects.append(each)

    @staticmethod
    def _material(color: list[float], opacity: float) -> bpy.types.Material:
        material = bpy.data.materials.new("obstacle")
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        nodes.clear()
        diffuse, clear = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeBsdfTransparent")
        mix, output = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeOutputMaterial")
        diffuse.inputs["Color"].default_value = (*color, 1.0)
        mix.inputs["Fac"].default_value = opacity
        for shader, place in ((clear, 1), (diffuse, 2)):
            links.new(shader.outputs["BSDF"], mix.inputs[place])
        links.new(mix.outputs["Shader"], output.inputs["Surface"])
        return material

    def show(self, frame: int) -> None:
        """Set the poses of a frame."""
        for each, poses in zip(self.objects, self.poses, strict=True):
            each.matrix_world = Matrix(poses[frame].tolist())

    def cut_out(self, transparent: bool) -> None:
        """Whether obstacles are transparent, and hide the body nevertheless."""
        for each in self.objects:
            each.is_holdout = transparent


def cut_out_others(bodies: "Sequence[Body]", shown: int | None) -> None:
    """Make all bodies but one transparent, which hide it nevertheless, or none."""
    for k, body in enumerate(bodies):
        body.object.is_holdout = shown is not None and k != shown


class Body:
    """The object of a job, with the geometry of one frame."""

    def __init__(self, job: dict[str, np.ndarray]):
        self.job = job
        self.material = _material()
        self.same_faces = len(job["face_start"]) == 2
        self.object: bpy.types.Object | None = None

    def show(self, frame: int) -> None:
        """Set the geometry of a frame."""
        start, stop = (int(i) for i in self.job["vertex_start"][frame : frame + 2])
        vertices = self.job["vertices"][start:stop]
        if self.object is not None and self.same_faces:
            mesh = self.object.data
            mesh.vertices.foreach_set("co", vertices.ravel())
            mesh.update()
            return
        if self.same_faces:
            faces, colors = self.job["faces"], self.job["colors"]
        else:
            first, last = (int(i) for i in self.job["face_start"][frame : frame + 2])
            faces, colors = self.job["faces"][first:last], self.job["colors"][start:stop]
        mesh = self._mesh(vertices, faces, colors)
        if self.object is None:
            self.object = bpy.data.objects.new("body", mesh)
            bpy.context.scene.collection.objects.link(self.object)
            radius = float(self.job["radius"])
            if radius > 0.0:
                modifier = self.object.modifiers.new("grains", "NODES")
                modifier.node_group = _grain_nodes(radius, self.material)
        else:
            old = self.object.data
            self.object.data = mesh
            bpy.data.meshes.remove(old)

    def _mesh(self, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> bpy.types.Mesh:
        mesh = bpy.data.meshes.new("body")
        mesh.vertices.add(len(vertices))
        mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices, np.float32).ravel())
        if len(faces):
            mesh.loops.add(faces.size)
            mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
            mesh.polygons.add(len(faces))
            mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
            mesh.update(calc_edges=True)
            mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
        attribute = mesh.attributes.new("rest_color", "FLOAT_COLOR", "POINT")
        rgba = np.concatenate([colors, np.ones((len(colors), 1), np.float32)], axis=1)
        attribute.data.foreach_set("color", np.ascontiguousarray(rgba, np.float32).ravel())
        mesh.materials.append(self.material)
        mesh.update()
        return mesh
