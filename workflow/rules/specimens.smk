"""Laws of specimens that are clamped and released, from records of markers on them."""


rule specimen:
    input:
        kernels=kernels("laws"),
        records=lambda wildcards: [
            os.path.join(SETTINGS.specimens[wildcards.specimen].folder, record.file)
            for record in SETTINGS.specimens[wildcards.specimen].records
        ],
    output:
        fit=f"{RESULTS}/specimens/{{specimen}}/fit.json",
        figure=f"{RESULTS}/specimens/{{specimen}}/fit.png",
    wildcard_constraints:
        specimen="|".join(SETTINGS.specimens) or "none",
    resources:
        runtime=240,
    params:
        specimen=lambda wildcards: SETTINGS.specimens[wildcards.specimen].plain(),
    script:
        "../scripts/specimen.py"
