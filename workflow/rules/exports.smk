"""A predicted motion for other programs: Gaussians, particles, surface, film (docs/splats.md). Needs methods.smk."""

EXPORT = f"{RESULTS}/{{scene}}/{{method}}/export"


MOVED = {**body_files(), "rollout": f"{RESULTS}/{{scene}}/{{method}}/rollout.h5"}
CARRIED = {"density": scene_setting("density"), "carrier": experiment_carrier}


rule export_gaussians:
    input:
        **MOVED,
        kernels=kernels("rendering"),
    output:
        frames=directory(f"{EXPORT}/{{layout}}"),
    wildcard_constraints:
        layout="gaussians|compressed",
        method=LAW_METHOD,
    params:
        **CARRIED,
        gaussian_motion=exported_motion,
        rotate_harmonics=SETTINGS.exports.rotate_harmonics,
        compressed=lambda wildcards: wildcards.layout == "compressed",
    script:
        "../scripts/export_gaussians.py"


rule export_particles:
    input:
        **MOVED,
    output:
        frames=directory(f"{EXPORT}/particles"),
        together=f"{EXPORT}/particles.h5",
    wildcard_constraints:
        method=LAW_METHOD,
    params:
        **CARRIED,
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
        method=LAW_METHOD,
    params:
        **CARRIED,
    script:
        "../scripts/export_surface.py"


rule export_blend:
    input:
        **MOVED,
        mesh=of_chain("mesh.ply"),
    output:
        blend=f"{EXPORT}/motion.blend",
        picture=f"{EXPORT}/motion.png",
    wildcard_constraints:
        method=LAW_METHOD,
    params:
        **CARRIED,
    script:
        "../scripts/export_blend.py"


rule export_film:
    input:
        **MOVED,
        kernels=kernels("rendering"),
    output:
        film=f"{EXPORT}/motion.mp4",
        gif=f"{EXPORT}/motion.gif",
    wildcard_constraints:
        method=LAW_METHOD,
    params:
        **CARRIED,
        gaussian_motion=exported_motion,
        size=SETTINGS.exports.size,
        frame_rate=SETTINGS.evaluation.frame_rate,
    script:
        "../scripts/export_film.py"
