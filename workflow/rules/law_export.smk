"""A learned law as one file that others can use. Needs methods.smk."""


rule export_law:
    input:
        unpack(of_bodies(law_files)),
        kernels=kernels("laws"),
        metrics=own_result("metrics.json"),
        rollout=own_result("rollout.h5"),
    output:
        law=f"{RESULTS}/{{scene}}/{{method}}/export/law.safetensors",
        card=f"{RESULTS}/{{scene}}/{{method}}/export/law.md",
        page=f"{RESULTS}/{{scene}}/{{method}}/export/law.png",
    params:
        origin=checked(lambda wildcards: cases.law_origin(SETTINGS, wildcards.scene, wildcards.method)),
        method=of_bodies(model_parameter),
        code=code_of("export_law.py"),
    script:
        "../scripts/export_law.py"
