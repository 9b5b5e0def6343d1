"""Adaptation of the material law. A method is a block of settings over this one rule."""


rule material:
    input:
        **{name: of_each_video(of_chain(file)) for name, file in BODY.items()},
        kernels=kernels("laws", "rendering"),
        transforms=training_video,
        velocity=start_files,
        prior=material_prior,
        identified=identified_base,
        truth=training_particles,
    output:
        adaptor=f"{RESULTS}/{{scene}}/{{method}}/adaptor.safetensors",
        history=f"{RESULTS}/{{scene}}/{{method}}/history.json",
    resources:
        gpu=GPU,
        mem_mb=6000,
        runtime=240,
    params:
        simulation=simulation_settings,
        densities=training_densities,
        material=training_settings,
        base=stock_base,
        structured=structured_settings,
        checkpoint=lambda wildcards: f"{RESULTS}/{wildcards.scene}/{wildcards.method}/checkpoint.pt",
        filming=filming,
        device=SETTINGS.device,
    script:
        "../scripts/material.py"
