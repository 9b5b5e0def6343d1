"""A predicted motion for other programs: Gaussians, particles, surface, film (docs/splats.md). Needs methods.smk."""

EXPORT = f"{RESULTS}/{{scene}}/{{method}}/export"


MOVED = {**body_files(), "rollout": f"{RESULTS}/{{scene}}/{{method}}/rollout.h5"}
OF_EXPERIMENTS = f"{RESULTS}/experiments/{{experiment}}/{{method}}"
MOVED_TOGETHER = {**body_files(), "rollout": f"{OF_EXPERIMENTS}/rollout.h5"}


rule export_gaussians:
    input:
        **MOVED,
        kernels=kernels("rendering"),
    output:
        frames=directory(f"{EXPORT}/{{layout}}"),
    wildcard_constraints:
        layout="gaussians|compressed",
    params:
        carrier=of_bodies(shared_carrier),
        gaussian_motion=exported_motion,
        rotate_harmonics=SETTINGS.exports.rotate_harmonics,
        compressed=lambda wildcards: wildcards.layout == "compressed",
    script:
        "../scripts/export_gaussians.py"


rule export_particles:
    input:
        **MOVED,
        velocity=of_chain("velocity.json"),
    output:
        frames=directory(f"{EXPORT}/particles"),
        together=f"{EXPORT}/particles.h5",
    params:
        densities=moved_densities,
        carrier=of_bodies(shared_carrier),
    script:
        "../scripts/export_particles.py"


rule export_surface:
    input:
        **MOVED,
        mesh=of_chain("mesh.ply"),
    output:
        surface=f"{EXPORT}/surface.{{kind}}",
    wildcard_constraints:
        kind="glb|usda|usdc",
    params:
        carrier=of_bodies(shared_carrier),
    script:
        "../scripts/export_surface.py"


rule export_blend:
    input:
        **MOVED,
        mesh=of_chain("mesh.ply"),
    output:
        blend=f"{EXPORT}/motion.blend",
        picture=f"{EXPORT}/motion.png",
    params:
        carrier=of_bodies(shared_carrier),
    script:
        "../scripts/export_blend.py"


rule export_film:
    input:
        **MOVED,
        kernels=kernels("rendering"),
    output:
        film=f"{EXPORT}/motion.mp4",
        gif=f"{EXPORT}/motion.gif",
    params:
        carrier=of_bodies(shared_carrier),
        gaussian_motion=exported_motion,
        size=SETTINGS.exports.size,
        frame_rate=SETTINGS.evaluation.frame_rate,
    script:
        "../scripts/export_film.py"


# The same of experiments, of all bodies together.
use rule export_gaussians as export_experiment_gaussians with:
    input:
        **MOVED_TOGETHER,
        kernels=kernels("rendering"),
    output:
        frames=directory(f"{OF_EXPERIMENTS}/export/{{layout}}"),


use rule export_particles as export_experiment_particles with:
    input:
        **MOVED_TOGETHER,
        velocity=of_chain("velocity.json"),
    output:
        frames=directory(f"{OF_EXPERIMENTS}/export/particles"),
        together=f"{OF_EXPERIMENTS}/export/particles.h5",


use rule export_surface as export_experiment_surface with:
    input:
        **MOVED_TOGETHER,
        mesh=of_chain("mesh.ply"),
    output:
        surface=f"{OF_EXPERIMENTS}/export/surface.{{kind}}",


use rule export_blend as export_experiment_blend with:
    input:
        **MOVED_TOGETHER,
        mesh=of_chain("mesh.ply"),
    output:
        blend=f"{OF_EXPERIMENTS}/export/motion.blend",
        picture=f"{OF_EXPERIMENTS}/export/motion.png",


use rule export_film as export_experiment_film with:
    input:
        **MOVED_TOGETHER,
        kernels=kernels("rendering"),
    output:
        film=f"{OF_EXPERIMENTS}/export/motion.mp4",
        gif=f"{OF_EXPERIMENTS}/export/motion.gif",
