"""Ground truth of the synthetic benchmarks and its images; and the compiled kernels that all simulations share."""


rule kernels:
    input:
        lambda wildcards: kernels("simulation") if wildcards.group == "laws" else [],
    output:
        ready=f"{KERNELS}/{{group}}.ready",
    log:
        f"{LOGS}/kernels_{{group}}.log",
    benchmark:
        f"{BENCHMARKS}/kernels_{{group}}.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=EITHER_GPU,
        mem_mb=4000,
        runtime=30,
    params:
        device=EITHER_DEVICE,
        code=lambda wildcards: code_digest(ROOT / "workflow" / "kernels" / f"{wildcards.group}.py", ROOT),
    script:
        "../scripts/kernels.py"


rule ground_truth:
    input:
        kernels=kernels("simulation"),
    output:
        particles=f"{DATA}/{{scene}}/particles.h5",
    log:
        f"{LOGS}/{{scene}}/ground_truth.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/ground_truth.tsv"
    wildcard_constraints:
        scene=scenes_with("truth", "made"),
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=EITHER_GPU,
        mem_mb=truth_memory,
        runtime=60,
    params:
        bodies=scene_bodies,
        simulation=simulation_settings,
        frames=frame_steps,
        particles=SETTINGS.dataset.particles,
        tracers=SETTINGS.dataset.tracers,
        seed=SETTINGS.dataset.seed,
        device=EITHER_DEVICE,
        code=code("ground_truth"),
    script:
        "../scripts/ground_truth.py"


rule render_static:
    input:
        particles=f"{DATA}/{{scene}}/particles.h5",
    output:
        transforms=f"{DATA}/{{scene}}/static/transforms.json",
    log:
        f"{LOGS}/{{scene}}/render_static.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/render_static.tsv"
    wildcard_constraints:
        scene=scenes_with("static", "made"),
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=4000,
        runtime=60,
    params:
        scene=scene_setting("shape", "size", "height", "center", "appearance"),
        images=SETTINGS.dataset.static.plain(),
        threads=1,
        code=code("render_static"),
    script:
        "../scripts/render_static.py"


rule render_dynamic:
    input:
        particles=f"{DATA}/{{scene}}/particles.h5",
    output:
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
    log:
        f"{LOGS}/{{scene}}/render_dynamic.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/render_dynamic.tsv"
    wildcard_constraints:
        scene=scenes_with("dynamic", "made"),
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=4000,
        runtime=240,
    params:
        scene=scene_setting("shape", "size", "height", "center", "appearance"),
        images=SETTINGS.dataset.dynamic.plain(),
        threads=1,
        code=code("render_dynamic"),
    script:
        "../scripts/render_dynamic.py"


rule supplied_static:
    input:
        images=lambda wildcards: SETTINGS.scene(wildcards.scene).images.static,
    output:
        transforms=f"{DATA}/{{scene}}/static/transforms.json",
    log:
        f"{LOGS}/{{scene}}/supplied_static.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/supplied_static.tsv"
    wildcard_constraints:
        scene=scenes_with("static", "supplied"),
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=4000,
        runtime=10,
    params:
        code=code("supplied"),
    script:
        "../scripts/supplied.py"


use rule supplied_static as supplied_dynamic with:
    input:
        images=lambda wildcards: SETTINGS.scene(wildcards.scene).images.dynamic,
    output:
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
    log:
        f"{LOGS}/{{scene}}/supplied_dynamic.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/supplied_dynamic.tsv"
    wildcard_constraints:
        scene=scenes_with("dynamic", "supplied"),
