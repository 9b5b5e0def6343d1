"""A learned law as one file that others can use. Needs methods.smk."""

from neuma_lib.config.places import law_origin


def own_result(file):
    """A function of wildcards: a file of the same run; none where it would be another scene's, or there is no truth."""

    @checked
    def choose(wildcards):
        scene = SETTINGS.law_scene(wildcards.scene, wildcards.method)
        without = scene != wildcards.scene or SETTINGS.scene(scene).captured
        return [] if without else f"{RESULTS}/{wildcards.scene}/{wildcards.method}/{file}"

    return choose


rule export_law:
    input:
        kernels=kernels("laws"),
        prior=material_prior,
        adaptor=trained_adaptor,
        identified=identified_law,
        metrics=own_result("metrics.json"),
        rollout=own_result("rollout.h5"),
    output:
        law=f"{RESULTS}/{{scene}}/{{method}}/export/law.safetensors",
        page=f"{RESULTS}/{{scene}}/{{method}}/export/law.png",
    params:
        origin=checked(lambda wildcards: law_origin(SETTINGS, wildcards.scene, wildcards.method)),
        laws=lambda wildcards: [law for law in [true_law(wildcards)] if law],
    script:
        "../scripts/export_law.py"
