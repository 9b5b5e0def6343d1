"""Neural constitutive laws trained on published analytic materials (the paper's M_0)."""


rule prior:
    input:
        kernels=kernels("laws"),
    output:
        weights=f"{RESULTS}/priors/{{prior}}.safetensors",
        report=f"{RESULTS}/priors/{{prior}}.json",
    resources:
        gpu=GPU,
    params:
        name=lambda wildcards: wildcards.prior.partition("+")[0],
        law=lambda wildcards: SETTINGS.priors.laws[wildcards.prior.partition("+")[0]].plain(),
        method=SETTINGS.priors.method,
        options=SETTINGS.priors.plain()[SETTINGS.priors.method],
        seed=lambda wildcards: SETTINGS.priors.seed + int(wildcards.prior.partition("+seed=")[2] or 0),
        device=SETTINGS.device,
    script:
        "../scripts/prior.py"
