"""Splats that were made elsewhere: their Gaussians and surface, and their motion under learned laws (docs/splats.md)."""

@checked
def splat_start(wildcards):
    """File of the initial motion of a splat. Its law is that of another scene, as it has no video."""
    scene, method = wildcards.scene, wildcards.method
    case = case_on(scene, method)
    case.method.model_options(case)  # refuses a true law, which a splat does not have
    if case.learned_from_moved_scene:
        raise InputError(
            f"{scene}/{method}",
            "a splat has no video to learn a law from",
            f"Use the law of another scene, {method}+{LAW_FROM}=<scene>, or the prior alone, nclaw",
        )
    return of_replicate("velocity.json")(wildcards)


def splat_clock(choose):
    """A function of wildcards: something of the time step [s] and the frames of a splat's motion."""
    return checked(lambda wildcards: choose(*cases.motion_clock(SETTINGS, wildcards.scene, wildcards.method)))


rule splat_gaussians:
    input:
        splat=of_section(lambda scene: scene.splat.file),
    output:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        report=f"{RESULTS}/{{scene}}/gaussians.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        splat=of_section(lambda scene: scene.splat.plain()),
        place=scene_setting("size", "height", "center"),
        seed=seed_of("gaussians"),
    script:
        "../scripts/splat_gaussians.py"


rule splat_mesh:
    input:
        kernels=kernels("rendering"),
        gaussians=of_replicate("gaussians.ply"),
    output:
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        views=of_section(lambda scene: scene.splat.views),
        pixels=of_section(lambda scene: scene.splat.pixels),
        edge=of_section(lambda scene: scene.splat.edge),
        surface=SETTINGS.geometry.surface.plain(),
    script:
        "../scripts/splat_mesh.py"


rule splat_velocity:
    output:
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        start=scene_setting("velocity", "spin"),
    script:
        "../scripts/splat_velocity.py"


use rule predict as predict_splat with:
    input:
        unpack(of_bodies(model_files)),
        **body_files(),
        kernels=of_bodies(model_kernels),
        velocity=splat_start,
    output:
        rollout=f"{RESULTS}/{{scene}}/{{method}}/rollout.h5",
        report=f"{RESULTS}/{{scene}}/{{method}}/motion.json",
    wildcard_constraints:
        scene=SPLAT_SCENE,
    params:
        method=of_bodies(model_parameter),
        simulation=splat_clock(lambda dt, frames: simulator(dt)),
        densities=of_case(lambda case: [SETTINGS.scene(case.moved).plain()["density"]]),
        total=of_bodies(carries_total),
        particle_source=of_bodies(shared_particle_source),
        frames=splat_clock(lambda dt, frames: list(frames)),
        cameras=None,
        scale=None,
        exposure=None,
        device=SETTINGS.device,
        code=code_of("predict.py"),
