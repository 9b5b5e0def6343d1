"""Registration of the photographed object in the video of a take, with its motion. Needs capture_motion.smk."""


rule capture_registration:
    input:
        kernels=kernels("rendering"),
        gaussians=captured_file(f"{RESULTS}/{{source}}/gaussians.ply"),
        mesh=captured_file(f"{RESULTS}/{{source}}/mesh.ply"),
        sampled=captured_file(f"{RESULTS}/{{source}}/sampled_particles.h5"),
        particles=captured_file(f"{RESULTS}/{{source}}/particles.h5"),
        binding=captured_file(f"{RESULTS}/{{source}}/binding.h5"),
        photographs=captured_file(f"{DATA}/{{source}}/static/transforms.json"),
        transforms=of_take_cameras(MATTES),
        timelines=of_take_cameras(f"{VIDEO_FRAMES}.json"),
        flight=captured_file(f"{FLIGHT}.json"),
        flights=of_take_bodies(f"{FLIGHT}.json"),
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
        scene=REGISTERED_SCENE,
    params:
        cameras=scene_cameras,
        timing=camera_timing,
        name="{scene}",
    script:
        "../scripts/capture_registration.py"
