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
        name=lambda wildcards: wildcards.prior,
        law=lambda wildcards: SETTINGS.priors.laws[wildcards.prior].plain(),
        method=SETTINGS.priors.method,
        options=SETTINGS.priors.plain()[SETTINGS.priors.method],
        seed=SETTINGS.priors.seed,
        device=SETTINGS.device,
    script:
        "../scripts/prior.py"
