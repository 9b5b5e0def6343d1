"""Tables of the paper, and the targets that name many results at once."""

SCENES = list(SETTINGS.tables["table1"].scenes) if "table1" in SETTINGS.tables else list(SETTINGS.scenes)


rule table1:
    input:
        metrics=lambda wildcards: table_files("table1", "metrics.json"),
    output:
        csv=report(f"{RESULTS}/table1.csv", caption="../report/table1.rst", category="Tables"),
        markdown=f"{RESULTS}/table1.md",
    log:
        f"{LOGS}/table1.log",
    benchmark:
        f"{BENCHMARKS}/table1.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=1000,
        runtime=5,
    params:
        scenes=SCENES,
        methods=lambda wildcards: table_titles("table1"),
        code=code("table1"),
    script:
        "../scripts/table1.py"


rule initial_states:
    input:
        reports=expand(f"{RESULTS}/{{scene}}/initial_state.json", scene=SETTINGS.scenes),
    output:
        csv=report(f"{RESULTS}/initial_states.csv", caption="../report/initial_states.rst", category="Tables"),
        markdown=f"{RESULTS}/initial_states.md",
    log:
        f"{LOGS}/initial_states.log",
    benchmark:
        f"{BENCHMARKS}/initial_states.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=1000,
        runtime=5,
    params:
        scenes=list(SETTINGS.scenes),
        code=code("initial_states"),
    script:
        "../scripts/initial_states.py"


rule learning_rates:
    input:
        histories=lambda wildcards: table_files("learning_rates", "history.json"),
        metrics=lambda wildcards: table_files("learning_rates", "metrics.json"),
    output:
        csv=f"{RESULTS}/learning_rates.csv",
        markdown=f"{RESULTS}/learning_rates.md",
    log:
        f"{LOGS}/learning_rates.log",
    benchmark:
        f"{BENCHMARKS}/learning_rates.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=1000,
        runtime=5,
    params:
        cells=lambda wildcards: table_cells("learning_rates"),
        code=code("learning_rates"),
    script:
        "../scripts/learning_rates.py"


rule timings:
    input:
        table=f"{RESULTS}/table1.csv",
    output:
        csv=f"{RESULTS}/timings.csv",
        markdown=f"{RESULTS}/timings.md",
    log:
        f"{LOGS}/timings.log",
    benchmark:
        f"{BENCHMARKS}/timings.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=1000,
        runtime=5,
    params:
        benchmarks=BENCHMARKS,
        code=code("timings"),
    script:
        "../scripts/timings.py"


rule overview:
    input:
        kernels=kernels("rendering"),
        transforms=overview_files(f"{DATA}/{{scene}}/dynamic/transforms.json"),
        gaussians=overview_files(f"{RESULTS}/{{scene}}/gaussians.ply"),
        binding=overview_files(f"{RESULTS}/{{scene}}/binding.h5"),
        prior=overview_files(f"{RESULTS}/{{scene}}/nclaw/rollout.h5"),
        learned=overview_files(f"{RESULTS}/{{scene}}/neuma/rollout.h5"),
    output:
        picture=f"{RESULTS}/figures/overview.png",
    log:
        f"{LOGS}/overview.log",
    benchmark:
        f"{BENCHMARKS}/overview.tsv"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        gpu=0,
        mem_mb=2000,
        runtime=10,
    params:
        scenes=list(SETTINGS.evaluation.overview),
        density=[SETTINGS.scene(name).density for name in SETTINGS.evaluation.overview],
        view=SETTINGS.evaluation.video_view,
        shown=7,
        code=code("overview"),
    script:
        "../scripts/overview.py"


rule dataset:
    input:
        expand(
            f"{DATA}/{{scene}}/{{part}}",
            scene=SCENES,
            part=["particles.h5", "static/transforms.json", "dynamic/transforms.json"],
        ),


rule tables:
    input:
        rules.table1.output,
        rules.initial_states.output,
        rules.timings.output,


rule videos:
    input:
        expand(f"{RESULTS}/{{scene}}/neuma/video.mp4", scene=SCENES),


rule figures:
    input:
        rules.overview.output,
