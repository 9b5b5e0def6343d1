"""A dataset that travels: packed where Blender is, unpacked (dataset.packed) where it is used."""

PACKED = (SETTINGS.dataset.packed or f"{DATA}/packed").rstrip("/")


if SETTINGS.dataset.packed is None:

    rule pack_images:
        input:
            static=f"{DATA}/{{scene}}/static/transforms.json",
            dynamic=f"{DATA}/{{scene}}/dynamic/transforms.json",
        output:
            packed=f"{PACKED}/{{scene}}.images.zip",
        log:
            f"{LOGS}/{{scene}}/pack_images.log",
        benchmark:
            f"{BENCHMARKS}/{{scene}}/pack_images.tsv"
        conda:
            ENVIRONMENT
        threads: 1
        resources:
            gpu=0,
            mem_mb=4000,
            runtime=30,
        params:
            code=code("pack_images"),
        script:
            "../scripts/pack_images.py"

    rule pack_truth:
        input:
            particles=f"{DATA}/{{scene}}/particles.h5",
        output:
            packed=f"{PACKED}/{{scene}}.truth.zip",
        log:
            f"{LOGS}/{{scene}}/pack_truth.log",
        benchmark:
            f"{BENCHMARKS}/{{scene}}/pack_truth.tsv"
        conda:
            ENVIRONMENT
        threads: 1
        resources:
            gpu=0,
            mem_mb=truth_memory,
            runtime=30,
        params:
            packing=SETTINGS.dataset.packing.plain(),
            seed=SETTINGS.dataset.seed,
            code=code("pack_truth"),
        script:
            "../scripts/pack_truth.py"

    rule packed:
        input:
            lambda wildcards: expand(
                f"{PACKED}/{{scene}}.{{part}}.zip", scene=SCENES, part=["images", "truth"]
            ),

else:

    rule unpack_truth:
        input:
            packed=f"{PACKED}/{{scene}}.truth.zip",
        output:
            particles=f"{DATA}/{{scene}}/particles.h5",
        log:
            f"{LOGS}/{{scene}}/unpack_truth.log",
        benchmark:
            f"{BENCHMARKS}/{{scene}}/unpack_truth.tsv"
        wildcard_constraints:
            scene=scenes_with("truth", "packed"),
        conda:
            ENVIRONMENT
        threads: 1
        resources:
            gpu=0,
            mem_mb=truth_memory,
            runtime=30,
        params:
            steps=frame_steps,
            dt=scene_setting("dt"),
            code=code("unpack_truth"),
        script:
            "../scripts/unpack_truth.py"

    rule unpack_static:
        input:
            packed=f"{PACKED}/{{scene}}.images.zip",
        output:
            transforms=f"{DATA}/{{scene}}/static/transforms.json",
        log:
            f"{LOGS}/{{scene}}/unpack_static.log",
        benchmark:
            f"{BENCHMARKS}/{{scene}}/unpack_static.tsv"
        wildcard_constraints:
            scene=scenes_with("static", "packed"),
        conda:
            ENVIRONMENT
        threads: 1
        resources:
            gpu=0,
            mem_mb=1000,
            runtime=30,
        params:
            part="static",
            steps=[0],
            code=code("unpack_images"),
        script:
            "../scripts/unpack_images.py"

    use rule unpack_static as unpack_dynamic with:
        output:
            transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
        log:
            f"{LOGS}/{{scene}}/unpack_dynamic.log",
        benchmark:
            f"{BENCHMARKS}/{{scene}}/unpack_dynamic.tsv"
        wildcard_constraints:
            scene=scenes_with("dynamic", "packed"),
        params:
            part="dynamic",
            steps=frame_steps,
            code=code("unpack_images"),
