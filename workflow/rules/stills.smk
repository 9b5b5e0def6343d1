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


rule swing:
    input:
        unpack(checked(lambda wildcards: swing_inputs(wildcards.swing))),
        kernels=kernels("laws"),
    output:
        result=f"{RESULTS}/swings/{{swing}}.json",
        figure=f"{RESULTS}/swings/{{swing}}.png",
    wildcard_constraints:
        swing=names_of(RESTING.swings, replicates=False),
    resources:
        runtime=120,
    params:
        body=lambda wildcards: RESTING.bodies[RESTING.swings[wildcards.swing].body].plain(),
        swing=lambda wildcards: RESTING.swings[wildcards.swing].plain(),
        root=RESTING.root,
        size=RESTING.sizes[0],
        cells=RESTING.cells,
    script:
        "../scripts/swing.py"


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
