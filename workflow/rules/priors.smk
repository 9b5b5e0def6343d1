"""Neural constitutive laws trained on published analytic materials (the paper's M_0)."""


rule prior:
    input:
        kernels=kernels("laws"),
    output:
        weights=f"{RESULTS}/priors/{{prior}}.safetensors",
        report=f"{RESULTS}/priors/{{prior}}.json",
    log:
        f"{LOGS}/priors/{{prior}}.log",
    benchmark:
        f"{BENCHMARKS}/priors/{{prior}}.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=GPU,
        mem_mb=4000,
        runtime=60,
    params:
        law=lambda wildcards: SETTINGS.priors.laws[wildcards.prior].plain(),
        method=SETTINGS.priors.method,
        options=SETTINGS.priors.plain()[SETTINGS.priors.method],
        seed=SETTINGS.priors.seed,
        device=SETTINGS.device,
        code=code("prior"),
    script:
        "../scripts/prior.py"
