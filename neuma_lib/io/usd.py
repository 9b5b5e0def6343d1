"""A moving surface as USD (Universal Scene Description): a mesh with time samples of its points."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuma_lib.extras import require
from neuma_lib.geometry.obstacles import Obstacle
from neuma_lib.io.files import atomic
from neuma_lib.io.gltf import linear, mesh_names, parts_of

CODES_A_SECOND = 24.0  # USD time codes per second; frames may have fractional codes


def write_usd(
    path: str | Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    times: np.ndarray,
    colors: np.ndarray,
    obstacles: Sequence[Obstacle] = (),
    bodies: Sequence[tuple[str, int]] = (),
) -> None:
    """Write a moving surface, y up, in metres; arguments as for `write_glb`. The suffix sets the format: usda, usdc.

    Characters of names that USD does not allow become underscores.

    Raises:
        InputError: usd-core is missing.
    """
    Gf, Tf, Usd, UsdGeom, Vt = (
        require(f"pxr.{name}", "viewer") for name in ("Gf", "Tf", "Usd", "UsdGeom", "Vt")
    )
    codes = np.asarray(times, np.float64) * CODES_A_SECOND
    with atomic(path) as partial:
        partial.unlink(missing_ok=True)
        stage = Usd.Stage.CreateNew(str(partial))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
        stage.SetTimeCodesPerSecond(CODES_A_SECOND)
        stage.SetFramesPerSecond(CODES_A_SECOND)
        stage.SetStartTimeCode(float(codes[0]))
        stage.SetEndTimeCode(float(codes[-1]))
        root = UsdGeom.Xform.Define(stage, "/body")
        stage.SetDefaultPrim(root.GetPrim())
        Usd.ModelAPI(root).SetKind("component")

        def define(name: str, triangles: np.ndarray):
            mesh = UsdGeom.Mesh.Define(stage, f"/body/{name}")
            mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
            mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
            mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(triangles, np.int32).ravel()))
            return mesh

        bodies = bodies or [("surface", vertices.shape[1])]
        names = mesh_names(bodies, len(obstacles), Tf.MakeValidIdentifier)
        for name, (own, faces_of) in zip(names, parts_of(faces, bodies), strict=False):
            mesh = define(name, faces_of)
            points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
            for code, frame in zip(codes, np.ascontiguousarray(vertices[:, own], np.float32), strict=True):
                points.Set(Vt.Vec3fArray.FromNumpy(frame), float(code))
                ends = [Gf.Vec3f(*end.tolist()) for end in (frame.min(axis=0), frame.max(axis=0))]
                extent.Set(Vt.Vec3fArray(ends), float(code))
            display_color = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
            display_color.Set(Vt.Vec3fArray.FromNumpy(linear(colors[own]).astype(np.float32)))
        for name, obstacle in zip(names[len(bodies) :], obstacles, strict=True):
            mesh = define(name, obstacle.faces)
            corners = np.ascontiguousarray(obstacle.vertices, np.float32)
            mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners))
            ends = [Gf.Vec3f(*end.tolist()) for end in (corners.min(axis=0), corners.max(axis=0))]
            mesh.CreateExtentAttr(Vt.Vec3fArray(ends))
            mesh.CreateDisplayColorAttr([Gf.Vec3f(*linear(obstacle.color).tolist())])
            pose = mesh.AddTransformOp()
            for code, matrix in zip(codes, obstacle.poses, strict=True):
                pose.Set(Gf.Matrix4d(*matrix.T.ravel().tolist()), float(code))  # of row vectors
        stage.GetRootLayer().Save()
