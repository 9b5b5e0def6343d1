"""Coverage of the intervals of constants and predicted motions on the random scenes. Needs methods.smk."""


rule calibration_record:
    input:
        kernels=kernels("geometry", "laws"),
        identified=of_replicate("identified.json"),
    output:
        record=f"{RESULTS}/{{scene}}/calibration.json",
    wildcard_constraints:
        scene=names_of(SETTINGS.random_scenes),
    resources:
        gpu=GPU,
    params:
        name=lambda wildcards: wildcards.scene,
        random_seed=SETTINGS.random.seed,
        development=SETTINGS.random.is_development,
        scene=scene_setting("shape", "size", "height", "center", "velocity", "spin", "density", "law"),
        steps=scene_setting("steps"),
        simulation=simulation_settings,
        truth=lambda wildcards: truth_settings(wildcards).plain(),
        particles=SETTINGS.geometry.particles,
        identify=identify_settings,
        seed=seed_of("particles"),
        truth_seed=SETTINGS.dataset.seed,
        device=SETTINGS.device,
    script:
        "../scripts/calibration.py"


rule calibration_table:
    input:
        records=expand(f"{RESULTS}/{{scene}}/calibration.json", scene=SETTINGS.random_scenes),
    output:
        csv=report(f"{RESULTS}/calibration.csv", caption="../report/calibration.rst", category="Tables"),
        markdown=f"{RESULTS}/calibration.md",
    params:
        development=SETTINGS.random.is_development,
        determined=SETTINGS.identify.determined,
    script:
        "../scripts/calibration_table.py"


rule calibration:
    input:
        rules.calibration_table.output,
        expand(f"{RESULTS}/figures/reliability.{{kind}}", kind=["png", "pdf"]),
