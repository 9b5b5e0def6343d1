"""Registration of the photographed object in the video of a take, with its motion. Needs capture_motion.smk."""


rule capture_registration:
    input:
        kernels=kernels("rendering"),
        gaussians=of_the_object("gaussians.ply"),
        mesh=of_the_object("mesh.ply"),
        sampled=of_the_object("sampled_particles.h5"),
        particles=of_the_object("particles.h5"),
        binding=of_the_object("binding.h5"),
        photographs=of_thrown(lambda wildcards: f"{DATA}/{wildcards.capture}/static/transforms.json"),
        transforms=of_filmed(MATTES),
        timelines=of_filmed(f"{RESULTS}/{{capture}}/frames/{{throw}}/{{camera}}.json"),
        flight=of_thrown(lambda wildcards: FLIGHT.format(**vars(wildcards)) + ".json"),
    output:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        mesh=f"{RESULTS}/{{scene}}/mesh.ply",
        sampled=f"{RESULTS}/{{scene}}/sampled_particles.h5",
        particles=f"{RESULTS}/{{scene}}/particles.h5",
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        velocity=f"{RESULTS}/{{scene}}/velocity.json",
        registration=f"{RESULTS}/{{scene}}/registration.json",
        picture=f"{RESULTS}/{{scene}}/registration.png",
    wildcard_constraints:
        scene=THROW_SCENE,
    params:
        cameras=lambda wildcards: SETTINGS.scene(wildcards.scene).captured.cameras,
        timing=of_thrown(camera_timing),
        name="{scene}",
    script:
        "../scripts/capture_registration.py"
