"""A predicted motion for other programs: Gaussians, particles, surface, film (docs/splats.md). Needs methods.smk."""

EXPORT = f"{RESULTS}/{{scene}}/{{method}}/export"


MOVED = {**body_files(), "rollout": f"{RESULTS}/{{scene}}/{{method}}/rollout.h5"}
SCENE_OR_EXPERIMENT = f"{names_of(SETTINGS.scenes)}|{EXPERIMENT}"


rule export_gaussians:
    input:
        **MOVED,
        kernels=kernels("rendering"),
    output:
        frames=directory(f"{EXPORT}/{{layout}}"),
    wildcard_constraints:
        scene=SCENE_OR_EXPERIMENT,
        layout="gaussians|compressed",
    params:
        particle_source=of_bodies(shared_particle_source),
        gaussian_motion=gaussian_motion,
        rotate_harmonics=SETTINGS.exports.rotate_harmonics,
        compressed=lambda wildcards: wildcards.layout == "compressed",
    script:
        "../scripts/export_gaussians.py"


rule export_particles:
    input:
        **MOVED,
        velocity=of_replicate("velocity.json"),
    output:
        frames=directory(f"{EXPORT}/particles"),
        together=f"{EXPORT}/particles.h5",
    wildcard_constraints:
        scene=SCENE_OR_EXPERIMENT,
    params:
        densities=densities_of(SETTINGS.body_scenes),
        particle_source=of_bodies(shared_particle_source),
    script:
        "../scripts/export_particles.py"


rule export_surface:
    input:
        **MOVED,
        mesh=of_replicate("mesh.ply"),
        velocity=of_replicate("velocity.json"),
        obstacles=obstacle_meshes,
    output:
        surface=f"{EXPORT}/surface.{{kind}}",
    wildcard_constraints:
        scene=SCENE_OR_EXPERIMENT,
        kind="glb|usda|usdc",
    params:
        particle_source=of_bodies(shared_particle_source),
        obstacles=lambda wildcards: SETTINGS.obstacles(subject(wildcards)),
    script:
        "../scripts/export_surface.py"


rule export_blend:
    input:
        **MOVED,
        mesh=of_replicate("mesh.ply"),
        obstacles=obstacle_meshes,
    output:
        blend=f"{EXPORT}/motion.blend",
        picture=f"{EXPORT}/motion.png",
    wildcard_constraints:
        scene=SCENE_OR_EXPERIMENT,
    params:
        particle_source=of_bodies(shared_particle_source),
        obstacles=lambda wildcards: SETTINGS.obstacles(subject(wildcards)),
    script:
        "../scripts/export_blend.py"


rule export_film:
    input:
        **MOVED,
        kernels=kernels("rendering"),
    output:
        film=f"{EXPORT}/motion{{slow}}.mp4",
        gif=f"{EXPORT}/motion{{slow}}.gif",
    log:
        f"{RESULTS}/logs/{{scene}}/{{method}}/export_film{{slow}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/{{scene}}/{{method}}/export_film{{slow}}.tsv"
    wildcard_constraints:
        slow=SLOW,
        scene=SCENE_OR_EXPERIMENT,
    params:
        particle_source=of_bodies(shared_particle_source),
        gaussian_motion=gaussian_motion,
        size=SETTINGS.exports.size,
        frame_rate=film_rate,
    script:
        "../scripts/export_film.py"
