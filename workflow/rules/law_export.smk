"""A learned law as one file that others can use. Needs methods.smk."""


rule export_law:
    input:
        kernels=kernels("laws"),
        prior=material_prior,
        adaptor=trained_adaptor,
        identified=identified_law,
        metrics=own_result("metrics.json"),
        rollout=own_result("rollout.h5"),
    output:
        law=f"{RESULTS}/{{scene}}/{{method}}/export/law.safetensors",
        page=f"{RESULTS}/{{scene}}/{{method}}/export/law.png",
    params:
        origin=checked(lambda wildcards: places.law_origin(SETTINGS, wildcards.scene, wildcards.method)),
        laws=lambda wildcards: [law for law in [true_law(wildcards)] if law],
    script:
        "../scripts/export_law.py"
