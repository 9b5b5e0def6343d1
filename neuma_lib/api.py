"""Scenes in memory: what is fitted to them, rendered and evaluated. `neuma_lib` exports these names."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.config.validation import validate
from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError
from neuma_lib.evaluation import calibration
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.fitting import identify as identification
from neuma_lib.fitting.families import FAMILIES, FRICTION
from neuma_lib.fitting.frame_batches import check_contact
from neuma_lib.fitting.material import ParticleLoss, TrajectoryLoss, train_material
from neuma_lib.fitting.structured_fit import train_structured
from neuma_lib.fitting.velocity import estimate_velocity
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import EXPOSURE_SAMPLES, load_videos
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.io.simulator import simulator
from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.mechanics.analytic import specification
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.structured import StructuredLaw, structured_law
from neuma_lib.methods.neuma import Neuma, NeumaOptions
from neuma_lib.methods.structured import Structured, StructuredOptions
from neuma_lib.methods.training import pixel_loss
from neuma_lib.project.find import find_scene
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import State, Trajectory
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import Observation

FLIGHT_COURANT = 0.3
"""Courant number of the elastic body that `estimate_motion` assumes by default."""
_OF_THE_SCENE = {"particle_source", "views", "start", "prior", "assumed_density"}
"""Options of methods in the settings whose values are arguments of `adapt`."""


@dataclass(frozen=True)
class Video:
    """Frames of a motion from calibrated views.

    Attributes:
        observations: images, steps and cameras. Views with the same steps and image size form one observation.
    """

    observations: tuple[Observation, ...]

    @classmethod
    def load(
        cls,
        transforms: str | Path,
        views: Sequence[int] = (0,),
        *,
        dt: float | None = None,
        exposure_samples: int = EXPOSURE_SAMPLES,
    ) -> "Video":
        """Read the frames of some views.

        Args:
            transforms: ``transforms.json`` with camera, ``view`` and simulation ``step`` of every image.
            views: numbers of the views.
            dt: duration of a step [s], which converts exposure times to motion blur. None: no motion blur.
            exposure_samples: maximum number of renders that are averaged to a frame.

        Raises:
            InputError: a file is missing or damaged, or a view has no frames.

        Example:
            >>> video = Video.load("data/JellyDuck/dynamic/transforms.json", views=(0,))
        """
        return cls(load_videos(transforms, views, dt, exposure_samples))

    @property
    def cameras(self) -> Cameras:
        """Cameras of the first observation."""
        return self.observations[0].cameras

    @property
    def frames(self) -> tuple[int, ...]:
        """Steps of all frames, ascending."""
        return tuple(sorted({step for each in self.observations for step in each.frames}))

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> "Video":
        """Copy to another precision or device."""
        return Video(tuple(each.to(dtype, device) for each in self.observations))


@dataclass(frozen=True)
class Scene:
    """A reconstructed body, and a video of its motion.

    Attributes:
        mpm: grid, time step [s], gravity [m/s^2] and walls.
        reconstruction: particles and Gaussians of the body at step 0.
        video: what is observed, or None.
        motion: velocity and spin at step 0, or None if they are unknown.
        truth: the true motion if it is known. Its affine velocities C are not recorded and zero.
    """

    mpm: MPM
    reconstruction: Reconstruction
    video: Video | None = None
    motion: InitialMotion | None = None
    truth: Trajectory | None = None

    @classmethod
    def load(cls, folder: str | Path, *, views: Sequence[int] = (0,)) -> "Scene":
        """Read a folder of results, with the settings and data of its project.

        Args:
            folder: for example ``results/BouncyBall``.
            views: views of the video.

        Raises:
            InputError: the folder is not that of a scene, or a file is missing or damaged.

        Example:
            >>> scene = Scene.load("results/BouncyBall")
            >>> path = simulate(scene.mpm, law, scene.state(), scene.video.frames)
        """
        settings, files = find_scene(folder)
        mpm = simulator(files.simulation)
        body = load_reconstruction(files.particles, files.binding, files.gaussians, files.density)
        blur = {"dt": mpm.dt, "exposure_samples": settings.dataset.exposure_samples}
        return cls(
            mpm,
            body.to(torch.float32),
            Video.load(files.transforms, views, **blur) if files.transforms else None,
            InitialMotion.of(read_json(files.velocity)) if files.velocity else None,
            _load_truth(files.truth) if files.truth else None,
        )

    def state(self) -> State:
        """The particles of the reconstruction in the initial motion, which is estimated if it is unknown."""
        motion = self.motion or estimate_motion(self.reconstruction, _video(self), self.mpm)
        return motion.of_body(self.reconstruction)


@dataclass(frozen=True)
class Identification:
    """Result of `identify`.

    Attributes:
        law: the analytic law with the identified constants.
        family: name of its family.
        constants: constants by name, in SI units.
        std: standard deviations of the logarithms of the constants. Empty if they could not be estimated.
        ties: families that predict the held-out frames as well.
        contact_friction: ``value`` of the Coulomb coefficient and ``log_std``, the standard deviation of its logarithm,
            or ``at_least`` if the body may stick. Empty if it was not fitted. `MPM.with_friction` applies it.
        quantities: value of each constant, modulus and ratio, and the standard deviation of its logarithm, with errors
            that all images share. Empty if it could not be estimated.
        probabilities: of the families, if the material is of one of them.
    """

    law: Law
    family: str
    constants: dict[str, float]
    std: dict[str, float]
    ties: tuple[str, ...]
    contact_friction: Mapping[str, float] = field(default_factory=dict)
    quantities: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    probabilities: Mapping[str, float] = field(default_factory=dict)

    def interval(self, quantity: str, level: float = 0.95) -> tuple[float, float]:
        """Interval that contains one of ``quantities`` with the probability ``level``, which is at most 0.95.

        Its width was measured on scenes with a known truth (`neuma_lib.evaluation.calibration`).

        Example:
            >>> identify(scene).interval("E", 0.8)
            (54000.0, 68000.0)
        """
        return calibration.interval(*self.quantities[quantity], level, calibration.GRID)


@dataclass(frozen=True)
class Adaptation:
    """Result of `adapt`.

    Attributes:
        law: the adapted law, at the lowest loss.
        loss: mean loss over the frames in every iteration.
        stable: whether the training ended without divergence.
        parts: corrected parts of an analytic law, "elastic" and "plastic". None for a neural law.
    """

    law: Law
    loss: list[float]
    stable: bool
    parts: tuple[str, ...] | None = None


def estimate_motion(
    reconstruction: Reconstruction,
    video: Video,
    mpm: MPM,
    *,
    law: Law | None = None,
    options: Mapping[str, Any] | None = None,
) -> InitialMotion:
    """Estimate velocity and spin at step 0 from the frames before the first contact (paper Sec. 3.1).

    Args:
        reconstruction: the body at step 0.
        video: its motion.
        mpm: simulator constants.
        law: assumed material, which matters only for the stretch of a spinning body. None: an elastic solid as stiff
            as the time step permits with a margin.
        options: values of the section ``velocity`` of the settings.

    Returns:
        Velocity [m/s], spin [rad/s] and their standard deviations.

    Raises:
        InputError: fewer than two frames before contact, or the body touches a wall at step 0.

    Example:
        >>> estimate_motion(scene.reconstruction, scene.video, scene.mpm).velocity
        array([ 0.51, -1.49,  0.02])
    """
    if law is None:
        unit = Law.from_spec({"elasticity": {"name": "hencky", "E": 1.0, "nu": 0.3}})
        density = float((reconstruction.mass / reconstruction.vol0).min())
        stiffness = (FLIGHT_COURANT / mpm.courant(unit, density)) ** 2
        law = Law.from_spec({"elasticity": {"name": "hencky", "E": stiffness, "nu": 0.3}})
    settings = validate(VelocityConfig, dict(options or {}), "options")
    estimate = estimate_velocity(mpm, law, reconstruction, _of_body(video, reconstruction), settings)
    return InitialMotion.of(estimate.as_dict())


def identify(
    scene: Scene,
    families: Mapping[str, Mapping[str, Any]] | None = None,
    options: Mapping[str, Any] | None = None,
) -> Identification:
    """Identify the material shown in a video.

    Fits the constants of every candidate family and selects the family with the lowest held-out error.

    Args:
        scene: with a video of at least four frames.
        families: candidate laws by name, as of `Law.from_spec`. Their constants are initial guesses. None: `FAMILIES`.
        options: values of the section ``identify`` of the settings. The correction of the particle resolution needs the
            surface of the body and is off.

    Raises:
        InputError: too few frames, or an unknown family or option.
        NonFiniteError: every family diverges.

    Example:
        >>> material = identify(scene)
        >>> material.family, material.constants
        ('hencky', {'E': 61000.0, 'nu': 0.31})
    """
    values = {
        "refined_particles": 0,
        **(options or {}),
        "families": dict(FAMILIES if families is None else families),
    }
    settings = validate(IdentifyConfig, values, "options")
    if settings.refined_particles:
        problem = f"{settings.refined_particles} must be 0"
        raise InputError("options.refined_particles", problem, "Use the workflow to correct it")
    body = replace(scene.reconstruction, affine=settings.gaussian_motion == "affine")
    video = _video(scene)
    motion = scene.motion or estimate_motion(body, video, scene.mpm)
    result = identification.identify(scene.mpm, motion, body, _of_body(video, body), settings)
    best, std, friction, quantities = result.best, {}, {}, {}
    if best.covariance is not None:
        names, covariance = best.log_covariance(lambda constants: constants)
        std = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
        friction = best.contact_friction(settings)
        quantities = {key: (value, log_std) for key, value, log_std in best.quantities(settings)}
    law = Law.from_spec(best.family.law_spec(best.values), scene.mpm.dt)
    constants, std = ({k: v for k, v in values.items() if k != FRICTION} for values in (best.values, std))
    probabilities = calibration.family_probabilities(result.as_dict())
    return Identification(
        law, best.family.name, constants, std, tuple(result.ties), friction, quantities, probabilities
    )


def adapt(law: Law, scene: Scene, options: Mapping[str, Any] | None = None) -> Adaptation:
    """Adapt a law to the video of a scene.

    A neural law gets a low-rank adaptor (paper Sec. 3.3). An analytic law gets a structured correction of the parts
    that lower the held-out error.

    Args:
        law: of `Law.from_spec`, `Law.load` or `identify`. It is not changed.
        scene: with a video. With ``supervision: particles`` in the options, with the truth.
        options: training options of the method ``neuma`` or ``structured``, for example ``{"iterations": 50}``.

    Raises:
        InputError: an unknown option, too few frames, no contact in the video, or the law is too stiff for the time
            step.
        NonFiniteError: the first simulation is unstable.

    Example:
        >>> adapt(Law.load("results/priors/jelly.safetensors"), scene, {"rank": 16}).law.save("jelly.safetensors", {})
    """
    given = dict(options or {})
    if fixed := sorted(_OF_THE_SCENE & set(given)):
        raise InputError(f"options.{fixed[0]}", "is determined by the scene and the law", "Omit it")
    if isinstance(law, AdaptableLaw) and not isinstance(law, StructuredLaw):
        settings = validate(NeumaOptions, {**Neuma.presets["neuma"].options, **given}, "options")
        law = copy.deepcopy(law)
        law.attach_adaptor(settings.rank, settings.alpha, settings.seed)
        trained = train_material(
            scene.mpm, law, *_start_and_loss(scene, settings), settings, log=lambda _: None
        )
        return Adaptation(trained.law, trained.history.loss, trained.stable)
    settings = validate(
        StructuredOptions, {**Structured.presets["neuma_structured"].options, **given}, "options"
    )
    if isinstance(law, StructuredLaw):
        corrected = copy.deepcopy(law)
    else:
        spec = {
            **specification(law.elasticity, law.plasticity, law.viscosity, law.field),
            "form": settings.form,
        }
        corrected = structured_law(spec, scene.mpm.dt, seed=settings.seed)
    corrected.attach_adaptor(settings.rank, settings.alpha, settings.seed)
    problem = _start_and_loss(scene, settings)
    trained, chosen = train_structured(scene.mpm, corrected, *problem, settings, settings, log=lambda _: None)
    return Adaptation(trained.law, trained.history.loss, trained.stable, chosen.parts)


def render(path: Trajectory, reconstruction: Reconstruction, cameras: Cameras) -> Tensor:
    """Render a simulated motion. Differentiable with respect to the trajectory.

    Args:
        path: T states of the N particles of the reconstruction.
        reconstruction: Gaussians and their binding to the particles.
        cameras: V views of H x W pixels, for example ``scene.video.cameras``.

    Returns:
        Colours over white in [0, 1] and coverage in [0, 1], shape (T, V, H, W, 4).

    Raises:
        InputError: the numbers of particles differ.

    Example:
        >>> render(path, scene.reconstruction, scene.video.cameras).shape
        torch.Size([21, 1, 96, 96, 4])
    """
    if path.x.shape[1] != len(reconstruction.x0):
        count = f"{path.x.shape[1]} particles must be the {len(reconstruction.x0)} of the reconstruction"
        raise InputError("path", count)
    renderer = reconstruction.particle_gs(cameras.to(reconstruction.x0.device, reconstruction.x0.dtype))
    size, F = renderer.frames_per_batch, path.stretch
    parts = [renderer.layer(path.x[k : k + size], F[k : k + size]) for k in range(0, len(path.x), size)]
    return torch.cat(parts)


def evaluate(path: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """Compare a predicted motion with the true one at their common frames.

    Args:
        path: prediction. To compare the motion of the same points, simulate it with ``tracers=truth.tracers[0]``.
        truth: for example ``scene.truth``.

    Returns:
        ``frames``, ``chamfer`` (mean distance between both sets of particles [1e-4 m^2]) and, if both have tracers,
        ``tracer_rmse_mm``, ``tracer_error_p95_mm``, ``tracer_rmse_last_mm`` and ``tracer_rmse_mm_per_frame``.

    Raises:
        InputError: no common frames, or different numbers of tracers.

    Example:
        >>> evaluate(path, scene.truth)["tracer_rmse_mm"]
        7.4
    """
    frames = [n for n in truth.frames if n in set(path.frames)]
    if not frames:
        raise InputError("path.frames", f"{list(path.frames)} and {list(truth.frames)} have no common step")
    ours, theirs = path.at(frames), truth.at(frames)
    chamfer = chamfer_sequence(ours.x.detach(), theirs.x)
    metrics = {"frames": frames, "chamfer": float(chamfer.mean())}
    if ours.tracers is not None and theirs.tracers is not None:
        metrics |= tracer_errors(ours.tracers.detach(), theirs.tracers)
    return metrics


def _start_and_loss(scene: Scene, settings: TrainingConfig) -> tuple[State, TrajectoryLoss]:
    """Arguments of `train_material`."""
    body = replace(scene.reconstruction, affine=settings.gaussian_motion == "affine")
    start = replace(scene, reconstruction=body).state()
    if settings.supervision == "pixels":
        loss = pixel_loss(body, _of_body(_video(scene), body), settings)
    elif scene.truth is None:
        raise InputError("scene.truth", "is missing", "Use supervision: pixels")
    else:
        loss = ParticleLoss(scene.truth.frames, scene.truth.x)
    check_contact(scene.mpm, [(start, loss.frames)])
    return start, loss


def _load_truth(file: str | Path) -> Trajectory:
    names = ("x", "v", "F", "frames", "tracers")
    arrays, _ = read_arrays(file, required=("x", "v", "F", "frames"), only=names)
    x, v, F = (torch.from_numpy(arrays[name]) for name in ("x", "v", "F"))
    tracers = torch.from_numpy(arrays["tracers"]) if "tracers" in arrays else None
    return Trajectory(tuple(arrays["frames"].tolist()), x, v, F, torch.zeros(()).to(F).expand_as(F), tracers)


def _video(scene: Scene) -> Video:
    if scene.video is None:
        raise InputError("scene.video", "is missing", "Load one with Video.load")
    return scene.video


def _of_body(video: Video, body: Reconstruction) -> tuple[Observation, ...]:
    """Observations in the precision and on the device of a body."""
    return video.to(body.x0.dtype, body.x0.device).observations
