"""A dataset that travels: packed where Blender is, unpacked (dataset.packed) where it is used."""

PACKED = (SETTINGS.dataset.packed or f"{DATA}/packed").rstrip("/")


if SETTINGS.dataset.packed is None:

    rule pack:
        input:
            static=f"{DATA}/{{scene}}/static/transforms.json",
            dynamic=f"{DATA}/{{scene}}/dynamic/transforms.json",
            particles=f"{DATA}/{{scene}}/particles.h5",
        output:
            images=f"{PACKED}/{{scene}}.images.zip",
            truth=f"{PACKED}/{{scene}}.truth.h5",
        resources:
            mem_mb=truth_memory,
        params:
            packing=SETTINGS.dataset.packing.plain(),
            seed=SETTINGS.dataset.seed,
        script:
            "../scripts/pack.py"

    rule packed:
        input:
            lambda wildcards: expand(rules.pack.output, scene=SCENES),

else:

    rule unpack_truth:
        input:
            packed=f"{PACKED}/{{scene}}.truth.h5",
        output:
            particles=f"{DATA}/{{scene}}/particles.h5",
        wildcard_constraints:
            scene=scenes_with("truth", "packed"),
        resources:
            mem_mb=truth_memory,
        params:
            part="truth",
            steps=frame_steps,
            dt=scene_setting("dt"),
        script:
            "../scripts/unpack.py"

    rule unpack_static:
        input:
            packed=f"{PACKED}/{{scene}}.images.zip",
        output:
            transforms=f"{DATA}/{{scene}}/static/transforms.json",
        wildcard_constraints:
            scene=scenes_with("static", "packed"),
        params:
            part="static",
            steps=[0],
        script:
            "../scripts/unpack.py"

    use rule unpack_static as unpack_dynamic with:
        output:
            transforms=f"{DATA}/{{scene}}/dynamic/transforms.json",
        wildcard_constraints:
            scene=scenes_with("dynamic", "packed"),
        params:
            part="dynamic",
            steps=frame_steps,
