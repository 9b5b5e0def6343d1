"""Ground truth of the synthetic benchmarks and its images; and the compiled kernels that all simulations share."""

BLENDER = SETTINGS.dataset.blender
RENDER_DEVICE = EITHER_DEVICE if BLENDER.device == "auto" else BLENDER.device
RENDER_GPU = {"cpu": 0, "auto": int(has_gpu()), "cuda": 1}[RENDER_DEVICE]


# Marker, log and benchmark lie with the data and not in the cache, which folders may share: where one of them is
# missing, Snakemake compiles, and then repeats all that depends on it, whether or not anything changed. (ancient() is
# no way out: what depends on a job that runs is then left out, even if it has changed itself.) Without its cache a job
# compiles what it needs.
rule kernels:
    input:
        lambda wildcards: kernels("simulation") if wildcards.group == "laws" else [],
    output:
        ready=f"{KERNELS}/{{group}}.ready",
    log:
        f"{KERNELS}/logs/{{group}}/kernels.log",
    benchmark:
        f"{KERNELS}/benchmarks/{{group}}/kernels.tsv"
    # Of jobs that are ready, those go first that begin the longest sequence: these kernels, static images, Gaussians
    # and the identification. Two cores then run the demo in 70 instead of 74 s (calculated).
    priority: lambda wildcards: int(wildcards.group == "simulation")
    resources:
        gpu=EITHER_GPU,
    params:
        group=lambda wildcards: wildcards.group,
        device=EITHER_DEVICE,
        code=lambda wildcards: code_digest(ROOT / "workflow" / "kernels" / f"{wildcards.group}.py"),
    script:
        "../scripts/kernels.py"


SIMULATED = f"{scenes_with('truth', 'made')}|experiments/({'|'.join(SETTINGS.experiments) or 'none'})"


rule solid:
    input:
        kernels=kernels("geometry"),
        mesh=lambda wildcards: body_settings("shape", "size")(wildcards)[int(wildcards.body)]["shape"],
    output:
        mesh=f"{DATA}/{{scene}}/solid_{{body}}.ply",
    wildcard_constraints:
        scene=SIMULATED,
        body="[0-9]+",
    script:
        "../scripts/solid.py"


rule ground_truth:
    input:
        kernels=kernels("geometry", "simulation"),
        meshes=solid_meshes(),
        obstacles=obstacle_meshes,
    output:
        truth=f"{DATA}/{{scene}}/truth.h5",
    wildcard_constraints:
        scene=SIMULATED,
    resources:
        gpu=EITHER_GPU,
        mem_mb=truth_memory,
    params:
        bodies=body_settings(
            "shape", "size", "height", "center", "rotation", "velocity", "spin", "density", "law"
        ),
        separate=has_separate_bodies,
        simulation=lambda wildcards: simulator(
            subject(wildcards), truth_settings(wildcards).dt, truth_settings(wildcards).grid
        ),
        dt=time_step,
        frames=frame_steps,
        particles=lambda wildcards: truth_settings(wildcards).particles,
        stored=lambda wildcards: None if truth_settings(wildcards).particles else SETTINGS.dataset.particles,
        tracers=SETTINGS.dataset.tracers,
        seed=SETTINGS.dataset.seed,
        device=EITHER_DEVICE,
    script:
        "../scripts/ground_truth.py"


rule body_truth:
    input:
        truth=of_pile(of_data("truth.h5")),
    output:
        truth=f"{DATA}/{{scene}}/truth.h5",
    wildcard_constraints:
        scene=scenes_with("truth", "part"),
    params:
        bodies=of_pile(of_section(lambda scene: list(scene.bodies))),
        body=of_section(lambda scene: scene.part_of[1]),
    script:
        "../scripts/body_truth.py"


for part, part_images in (("static", SETTINGS.dataset.static), ("dynamic", SETTINGS.dataset.dynamic)):

    rule:
        name:
            f"render_{part}"
        input:
            truth=f"{DATA}/{{scene}}/truth.h5",
            meshes=solid_meshes(),
        output:
            transforms=f"{DATA}/{{scene}}/{part}/transforms.json",
        wildcard_constraints:
            scene=scenes_with(part, "made"),
        priority: int(part == "static")
        threads: BLENDER.threads
        resources:
            gpu=RENDER_GPU,
            runtime=render_minutes(part),
        params:
            bodies=body_settings("shape", "size", "height", "center", "rotation", "appearance"),
            moving=part == "dynamic",
            images=part_images.plain(),
            threads=BLENDER.threads,
            device=RENDER_DEVICE,
        script:
            "../scripts/render.py"

    rule:
        name:
            f"body_{part}"
        input:
            transforms=of_pile(of_data(f"{part}/transforms.json")),
        output:
            transforms=f"{DATA}/{{scene}}/{part}/transforms.json",
        wildcard_constraints:
            scene=scenes_with(part, "part"),
        params:
            bodies=of_pile(of_section(lambda scene: list(scene.bodies))),
            body=of_section(lambda scene: scene.part_of[1]),
        script:
            "../scripts/body_images.py"

    rule:
        name:
            f"supplied_{part}"
        input:
            images=supplied_list(part),
        output:
            transforms=f"{DATA}/{{scene}}/{part}/transforms.json",
        wildcard_constraints:
            scene=scenes_with(part, "supplied"),
        params:
            images=supplied_world,
            dt=scene_setting("dt"),
            steps=frame_steps if part == "dynamic" else [0],
        script:
            "../scripts/supplied.py"
