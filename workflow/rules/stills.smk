"""Stiffness over density of bodies at rest in photographs: settings `stills`, page docs/results/silicone.md."""


rule still_fit:
    input:
        unpack(checked(lambda wildcards: resting_inputs(wildcards.body))),
    output:
        result=f"{RESULTS}/stills/{{body}}.json",
    wildcard_constraints:
        body=names_of(RESTING.bodies, replicates=False),
    params:
        body=lambda wildcards: resting_body(wildcards).plain(),
        root=RESTING.root,
        sizes=RESTING.sizes,
    script:
        "../scripts/still_fit.py"


rule stills_table:
    input:
        results=checked(lambda wildcards: resting_results()),
    output:
        csv=f"{RESULTS}/stills.csv",
        markdown=f"{RESULTS}/stills.md",
    params:
        titles=RESTING_TITLES,
    script:
        "../scripts/stills_table.py"
