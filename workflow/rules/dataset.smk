"""Ground truth of the synthetic benchmarks and its images; and the compiled kernels that all simulations share."""


rule kernels:
    output:
        ready=KERNELS,
    params:
        device=SETTINGS.device,
        code=code("kernels"),
    log:
        f"{LOGS}/kernels.log",
    benchmark:
        f"{BENCHMARKS}/kernels.tsv"
    threads: 1
    resources:
        gpu=GPU,
        mem_mb=4000,
        runtime=30,
    conda:
        ENVIRONMENT
    script:
        "../scripts/kernels.py"


rule ground_truth:
    input:
        kernels=ancient(KERNELS),
    output:
        particles=f"{DATA}/{{scene}}/particles.h5",
    params:
        scene=scene_setting("shape", "size", "height", "center", "velocity", "density", "law"),
        simulation=simulation_settings,
        frames=frame_steps,
        particles=SETTINGS.dataset.particles,
        tracers=SETTINGS.dataset.tracers,
        seed=SETTINGS.dataset.seed,
        device=SETTINGS.device,
        code=code("ground_truth"),
    log:
        f"{LOGS}/{{scene}}/ground_truth.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/ground_truth.tsv"
    threads: 1
    resources:
        gpu=GPU,
        mem_mb=4000,
        runtime=60,
    conda:
        ENVIRONMENT
    script:
        "../scripts/ground_truth.py"


rule render_static:
    input:
        particles=f"{DATA}/{{scene}}/particles.h5",
    output:
        transforms=f"{DATA}/{{scene}}/static/transforms.json",
    params:
        scene=scene_setting("shape", "size", "appearance"),
        images=SETTINGS.dataset.static.plain(),
        code=code("render_static"),
    log:
        f"{LOGS}/{{scene}}/render_static.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/render_static.tsv"
    threads: 1
    resources:
        gpu=0,
        mem_mb=4000,
        runtime=60,
    conda:
        ENVIRONMENT
    script:
        "../scripts/render_static.py"


rule render_dynamic:
    input:
        particles=f"{DATA}/{{scene}}/particles.h5",
    output:
        transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
    params:
        scene=scene_setting("shape", "size", "appearance"),
        images=SETTINGS.dataset.dynamic.plain(),
        code=code("render_dynamic"),
    log:
        f"{LOGS}/{{scene}}/render_dynamic.log",
    benchmark:
        f"{BENCHMARKS}/{{scene}}/render_dynamic.tsv"
    threads: 1
    resources:
        gpu=0,
        mem_mb=4000,
        runtime=120,
    conda:
        ENVIRONMENT
    script:
        "../scripts/render_dynamic.py"
