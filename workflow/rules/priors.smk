"""Neural constitutive laws trained on published analytic materials (the paper's M_0)."""


rule prior:
    input:
        kernels=kernels("laws"),
    output:
        weights=f"{RESULTS}/priors/{{prior}}.safetensors",
        report=f"{RESULTS}/priors/{{prior}}.json",
    params:
        name=lambda wildcards: prior_replicate(wildcards)[0],
        law=lambda wildcards: SETTINGS.priors.laws[prior_replicate(wildcards)[0]].plain(),
        options=SETTINGS.priors.regression.plain(),
        seed=lambda wildcards: SETTINGS.priors.seed + prior_replicate(wildcards)[1]["prior"],
    script:
        "../scripts/prior.py"


rule identified_prior:
    input:
        kernels=kernels("laws"),
        identified=f"{RESULTS}/{{scene}}/identified.json",
    output:
        weights=f"{RESULTS}/{{scene}}/priors/identified.safetensors",
        report=f"{RESULTS}/{{scene}}/priors/identified.json",
    params:
        name=IDENTIFIED,
        dt=lambda wildcards: SETTINGS.scene(wildcards.scene).dt,
        options=SETTINGS.priors.regression.plain(),
        seed=lambda wildcards: SETTINGS.priors.seed + SETTINGS.replicate(wildcards.scene)[1]["prior"],
    script:
        "../scripts/prior.py"
