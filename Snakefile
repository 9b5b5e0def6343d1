"""From nothing to the tables of the paper. `snakemake --cores 2 results/table1.csv`; docs/install.md explains more."""


configfile: "config/config.yaml"


report: "workflow/report/workflow.rst"


include: "workflow/rules/settings.smk"
include: "workflow/rules/scenes.smk"
include: "workflow/rules/methods.smk"
include: "workflow/rules/tables.smk"
include: "workflow/rules/captures.smk"
include: "workflow/rules/reports.smk"
include: "workflow/rules/dataset.smk"
include: "workflow/rules/priors.smk"
include: "workflow/rules/gaussians.smk"
include: "workflow/rules/radiance.smk"
include: "workflow/rules/geometry.smk"
include: "workflow/rules/exports.smk"
include: "workflow/rules/binding.smk"
include: "workflow/rules/velocity.smk"
include: "workflow/rules/identify.smk"
include: "workflow/rules/evaluation.smk"
include: "workflow/rules/next.smk"
include: "workflow/rules/splats.smk"
include: "workflow/rules/experiments.smk"
include: "workflow/rules/calibration.smk"
include: "workflow/rules/stress.smk"
include: "workflow/rules/specimens.smk"
include: "workflow/rules/law_export.smk"
include: "workflow/rules/demo.smk"
include: "workflow/rules/resting.smk"
include: "workflow/rules/stills.smk"
include: "workflow/rules/metrics.smk"
include: "workflow/rules/paper.smk"
include: "workflow/rules/figure_table.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/capturing.smk"
include: "workflow/rules/capture_motion.smk"
include: "workflow/rules/released_captures.smk"
include: "workflow/rules/capture_registration.smk"
include: "workflow/rules/capture_scenes.smk"
include: "workflow/rules/capture_report.smk"


rule all:
    input:
        rules.tables.input,


complete(workflow, RESULTS)
if workflow.is_main_process and Path(workflow.main_snakefile).resolve() == ROOT / "Snakefile":
    tables = [f"{table}.{kind}" for table in SETTINGS.tables for kind in ("csv", "md")]
    checked(refuse_unknown)(
        requested_targets(),
        workflow.rules,
        [
            *SETTINGS.scenes,
            *SETTINGS.methods,
            *SETTINGS.experiments,
            *SETTINGS.specimens,
            *SETTINGS.stills.swings,
            *SETTINGS.priors.laws,
            *tables,
        ],
        missing_settings,
    )
