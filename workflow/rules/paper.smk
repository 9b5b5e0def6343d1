"""Tables of the paper, and the targets that name many results at once."""

from neuma_lib.paper.published import PAPER

SCENES = list(SETTINGS.tables["table1"].scenes) if "table1" in SETTINGS.tables else SETTINGS.plain_scenes
BENCHMARK_SCENES = list(SETTINGS.tables["table4"].scenes) if "table4" in SETTINGS.tables else SCENES


rule chamfer_table:
    input:
        metrics=lambda wildcards: table_files(wildcards.table, "metrics.json"),
    output:
        csv=report(f"{RESULTS}/{{table}}.csv", caption="../report/chamfer_table.rst", category="Tables"),
        markdown=f"{RESULTS}/{{table}}.md",
    params:
        name=lambda wildcards: wildcards.table,
        cells=lambda wildcards: table_cells(wildcards.table),
        titles=lambda wildcards: table_titles(wildcards.table),
        columns=lambda wildcards: table_columns(wildcards.table),
        notes=lambda wildcards: table_notes(wildcards.table),
        note=lambda wildcards: SETTINGS.tables[wildcards.table].note,
        caption=lambda wildcards: (
            PAPER[wildcards.table].caption if wildcards.table in PAPER else wildcards.table
        ),
    script:
        "../scripts/chamfer_table.py"


rule benchmark_table:
    output:
        csv=report(f"{RESULTS}/table4.csv", caption="../report/table4.rst", category="Tables"),
        markdown=f"{RESULTS}/table4.md",
    params:
        scenes=lambda wildcards: {name: SETTINGS.scene(name).plain() for name in BENCHMARK_SCENES},
    script:
        "../scripts/benchmark_table.py"


rule initial_states:
    input:
        reports=expand(f"{RESULTS}/{{scene}}/initial_state.json", scene=SETTINGS.plain_scenes),
    output:
        csv=report(f"{RESULTS}/initial_states.csv", caption="../report/initial_states.rst", category="Tables"),
        markdown=f"{RESULTS}/initial_states.md",
    params:
        scenes=SETTINGS.plain_scenes,
    script:
        "../scripts/initial_states.py"


rule random_table:
    input:
        metrics=random_files(SETTINGS.random.methods, "metrics.json"),
        starts=expand(f"{RESULTS}/{{scene}}/initial_state.json", scene=SETTINGS.random_scenes),
    output:
        csv=report(f"{RESULTS}/random.csv", caption="../report/random.rst", category="Tables"),
        markdown=f"{RESULTS}/random.md",
    params:
        scenes=random_scenes(),
        titles={method: cases.title(SETTINGS, method) for method in SETTINGS.random.methods},
        seed=SETTINGS.random.seed,
        development=SETTINGS.random.is_development,
    script:
        "../scripts/random_table.py"


rule piles_table:
    input:
        [file for name in SETTINGS.random_piles for own in pile_files(name).values() for file in own],
    output:
        csv=report(f"{RESULTS}/piles.csv", caption="../report/piles.rst", category="Tables"),
        markdown=f"{RESULTS}/piles.md",
    params:
        scenes=[
            {
                "name": name,
                "bodies": {body: own.law.plain() for body, own in SETTINGS.scene(name).bodies.items()},
                "frictions": [pair.plain() for pair in SETTINGS.scene(name).pairs],
            }
            for name in SETTINGS.random_piles
        ],
        files=[pile_files(name) for name in SETTINGS.random_piles],
        seed=SETTINGS.random.seed,
        development=SETTINGS.random.is_development,
    script:
        "../scripts/piles_table.py"


rule random:
    input:
        rules.random_table.output,
        expand(f"{RESULTS}/figures/random_scenes.{{kind}}", kind=["png", "pdf"]),


rule dataset:
    input:
        expand(
            f"{DATA}/{{scene}}/{{part}}",
            scene=SCENES,
            part=["truth.h5", "static/transforms.json", "dynamic/transforms.json"],
        ),


TABLES = [table for table in CHAMFER_TABLES if SETTINGS.tables[table].default_target]


rule tables:
    input:
        expand(f"{RESULTS}/{{table}}.{{kind}}", table=[*TABLES, "table4"], kind=["csv", "md"]),
        rules.initial_states.output,


rule videos:
    input:
        expand(f"{RESULTS}/{{scene}}/neuma/video.mp4", scene=SCENES),
