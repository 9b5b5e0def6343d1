"""The first minute: one small scene from nothing to a film, `snakemake --configfile config/demo.yaml -- demo`."""


rule film:
    input:
        **body_files(),
        kernels=kernels("rendering"),
        transforms=of_data("dynamic/transforms.json"),
        rollouts=expand(f"{RESULTS}/{{{{scene}}}}/{{method}}/rollout.h5", method=SETTINGS.demo.methods),
    output:
        mp4=f"{RESULTS}/{{scene}}/film{{slow}}.mp4",
        gif=f"{RESULTS}/{{scene}}/film{{slow}}.gif",
    log:
        f"{RESULTS}/logs/{{scene}}/film{{slow}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/{{scene}}/film{{slow}}.tsv"
    wildcard_constraints:
        slow=SLOW,
        scene=TRUE_SCENE,
    resources:
        gpu=GPU,
    params:
        density=scene_setting("density"),
        titles=film_titles,
        motions=film_motions,
        view=SETTINGS.evaluation.video_view,
        frame_rate=film_rate,
        magnify=SETTINGS.demo.magnify,
        device=SETTINGS.device,
    script:
        "../scripts/film.py"


rule demo:
    input:
        film=f"{RESULTS}/{SETTINGS.demo.scene}/film.mp4",
        gif=f"{RESULTS}/{SETTINGS.demo.scene}/film.gif",
        metrics=expand(
            f"{RESULTS}/{SETTINGS.demo.scene}/{{method}}/metrics.json", method=SETTINGS.demo.methods
        ),
        law=f"{RESULTS}/{SETTINGS.demo.scene}/{SETTINGS.demo.methods[-1]}/export/law.safetensors",
        page=f"{RESULTS}/{SETTINGS.demo.scene}/{SETTINGS.demo.methods[-1]}/export/law.png",
        viewer=f"{RESULTS}/{SETTINGS.demo.scene}/viewer.html",
    output:
        page=f"{RESULTS}/demo.md",
    params:
        methods=SETTINGS.demo.methods,
        titles=film_titles,
        notes=[SETTINGS.methods[method].note for method in SETTINGS.demo.methods],
    script:
        "../scripts/demo.py"
